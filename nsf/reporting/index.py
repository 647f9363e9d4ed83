"""A page of all runs that sorts and filters in the browser, and needs nothing but itself."""

import html
import os
from collections.abc import Iterable
from pathlib import Path

from nsf.reporting.listing import FIELDS, Entry, entries, text
from nsf.reporting.page import CSS
from nsf.reporting.thumbnails import thumbnail
from nsf.storage import writing

#: What tells variants apart, beside the fields: keys of the configuration, by the heading they get.
_SETTINGS = {
    "method": "method.name",
    "r": "latent_dim",
    "|S|": "sampler.size",
    "parameter": "parameter.value",
}
_HEADINGS = {"seconds": "time [s]"}
_CHOSEN = ("stage", "scene", "status")

_STYLE = """
main { max-width: none; }
form { display: flex; flex-wrap: wrap; gap: .6rem; margin: 1rem 0; align-items: center; }
input, select { font: inherit; padding: .25rem .5rem; color: inherit; background: var(--page);
  border: 1px solid var(--line); border-radius: 6px; }
input { flex: 1 1 18rem; max-width: 32rem; }
th button { all: unset; cursor: pointer; } th button:focus-visible { outline: 2px solid currentColor; }
th[aria-sort=ascending] button::after { content: " ▲"; }
th[aria-sort=descending] button::after { content: " ▼"; }
td { vertical-align: middle; } td img { display: block; width: 120px; background: #fff; }
.broken, .failed, .killed, .interrupted { color: #b04a00; font-weight: 600; }
"""
_SCRIPT = """
const body = document.querySelector("tbody"), rows = [...body.rows], count = document.querySelector("output");
const words = document.querySelector("input"), choices = [...document.querySelectorAll("select")];
const heads = [...document.querySelectorAll("th")];
function filter() {
  const wanted = words.value.toLowerCase().split(/\\s+/).filter(Boolean);
  let shown = 0;
  for (const row of rows) {
    const text = row.textContent.toLowerCase();
    const kept = wanted.every(word => text.includes(word)) &&
      choices.every(c => !c.value || row.cells[c.dataset.column].textContent === c.value);
    row.hidden = !kept;
    shown += kept;
  }
  count.textContent = `${shown} of ${rows.length} runs`;
}
function sort(head) {
  const down = head.getAttribute("aria-sort") === "ascending", at = head.cellIndex;
  heads.forEach(h => h.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const key = row => row.cells[at].dataset.value ?? "";
  rows.sort((a, b) => {
    const [x, y] = [key(a), key(b)];
    if (!x || !y) return !x - !y;
    const numbers = !isNaN(x) && !isNaN(y);
    return (down ? -1 : 1) * (numbers ? x - y : x.localeCompare(y));
  });
  body.append(...rows);
}
document.querySelector("form").addEventListener("submit", event => event.preventDefault());
words.addEventListener("input", filter);
choices.forEach(choice => choice.addEventListener("change", filter));
heads.forEach(head => head.querySelector("button")?.addEventListener("click", () => sort(head)));
filter();
"""


def write_index(folder: Path, root: Path | None = None) -> Path:
    """Write `index.html` of all runs, and a thumbnail of each that has something to be seen.

    Args:
        folder: of the page; thumbnails lie in `folder/thumbnails`, and are drawn once.
        root: folder of all runs; NSF_RUNS, else ./runs.

    Returns:
        The page.

    Raises:
        StorageError: the disk refused a file.
    """
    found = entries(root=root)
    body = "\n".join(_row(entry, folder) for entry in found)
    heads = "".join(
        f'<th scope="col"><button type="button">{_esc(name)}</button></th>'
        for name in (*(_HEADINGS.get(field, field) for field in FIELDS), *_SETTINGS)
    )
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Runs</title>\n<style>{CSS}{_STYLE}</style>\n</head>\n<body>\n<main>\n<h1>Runs</h1>\n"
        '<form><input type="search" placeholder="words that a run must have" aria-label="filter by words">'
        f"{''.join(_choice(found, field) for field in _CHOSEN)}<output></output></form>\n"
        f'<div class="table"><table><thead><tr><th scope="col"></th>{heads}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>\n</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )
    with writing(folder / "index.html") as partial:
        partial.write_text(page, encoding="utf-8")
    return folder / "index.html"


def _row(entry: Entry, folder: Path) -> str:
    picture = f"thumbnails/{entry.run.id.replace('/', '-')}.png"
    image = f'<img src="{picture}" alt="" loading="lazy">' if thumbnail(entry.run, folder / picture) else ""
    link = Path(os.path.relpath(entry.run.path / "manifest.json", folder)).as_posix()
    cells = [f"<td>{image}</td>"]
    for field, told in zip(FIELDS, entry.texts(), strict=True):
        shown = f'<a href="{_esc(link)}">{_esc(told)}</a>' if field == "id" else _esc(told)
        kind = f' class="{_esc(told)}"' if field == "status" else ""
        why = entry.fault or entry.manifest.get("error")
        title = f' title="{_esc(text(why))}"' if kind and why else ""
        cells.append(f"<td{kind}{title} data-value={_quoted(entry.values[field])}>{shown}</td>")
    for key in _SETTINGS.values():
        value = entry.settings.get(key)
        cells.append(f"<td data-value={_quoted(value)}>{_esc(text(value))}</td>")
    return f"<tr>{''.join(cells)}</tr>"


def _choice(found: Iterable[Entry], field: str) -> str:
    """A list of a field's values to choose one from; the first column is the thumbnail."""
    values = sorted({str(entry.values[field]) for entry in found})
    options = "".join(f"<option>{_esc(value)}</option>" for value in values)
    return (
        f'<select data-column="{1 + FIELDS.index(field)}" aria-label="{field}">'
        f'<option value="">every {field}</option>{options}</select>'
    )


def _quoted(value) -> str:
    return f'"{"" if value is None else _esc(str(value))}"'


_esc = html.escape
