"""The page of a folder of reports: a table and a chart of each, and where the paper's figures are."""

import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from nsf.results import report, table
from nsf.results.averages import averaged, rows_of
from nsf.results.folder import ANY, MARK, read
from nsf.results.formats import Rows, markdown_document
from nsf.runs.provenance import not_ignored
from nsf.schemas import Maybe

if TYPE_CHECKING:
    from nsf.results.committed import Reports

INDEX = "index.md"
_COLUMNS = (
    *("body", "variant", "case", "displacement_error", "displacement_interpolated", "paper_delta", "delta"),
    *("speedup_decoded", "stress_error"),
)
_WIDE, _LONG = 7, 14  # columns and rows of a table of the page
_EXPLAINED = ("displacement_error", "displacement_interpolated", "stress_error", "delta")
#: Of the record of a report that has files of its own.
_LISTED = ANY | {
    Maybe("chart"): ({"file": str}, None),
    "listed": {"headings": [str], "body": [[str]], "numeric": [bool], "made": str},
}


def page_of(reports: "Reports") -> str:
    """The text of `index.md`."""
    chapters: dict[str, list[dict]] = {heading: [] for heading in reports.contents["chapters"]}
    for name in reports.names:
        chapters[reports.place(name)[1]].append(_section(reports, name))
    for entry in (*map(_listed_section, listed(reports.folder)), *map(_bench, _benches(reports.folder))):
        chapters[list(chapters)[-1]].append(entry)
    pictures = {f"{name}/{one.files[-1]}" for name in reports.names for one in reports.drawn(name)}
    pictures |= reports.seals.keys()
    figures = [
        (figure, entry["shows"], [path for path in entry["here"] if path in pictures])
        for figure, entry in reports.contents["paper"].items()
    ]
    return markdown_document(
        "list.md",
        note=reports.contents["note"],
        chapters={heading: entries for heading, entries in chapters.items() if entries},
        definitions=report.definitions(_EXPLAINED),
        long=_LONG,
        of_the_paper=figures if any(paths for *_, paths in figures) else [],
    )


def _section(reports: "Reports", name: str) -> dict:
    """One report on the page."""
    view = reports.views[name]
    averages, said = averaged(view.frame), []
    if len(averages) > _LONG:
        averages = averages.loc[
            sorted(averages.groupby("body", sort=False)["displacement_error"].idxmin().dropna())
        ]
    if averages["variant"].nunique() == 1:
        said.append(f"Model: {averages['model_name'].iloc[0]}.")
    varying = [c for c in _COLUMNS if c != "variant" or averages[c].nunique() > 1]
    names = [c for c in varying if c in averages and not averages[c].isna().all()][:_WIDE]
    files = list(reports.records[name]["charts"])
    first = next((file for file in files if file.startswith("delta-over")), files[0] if files else "")
    return {
        "name": name,
        "title": reports.question(name).title,
        "table": rows_of(averages, names),
        "said": " ".join([*said, *report.findings(view)[:1]]),
        "chart": first,
        "more": [file for file in [*files, *(p.files[-1] for p in reports.drawn(name))] if file != first],
        "made": _made(reports, name),
    }


def _made(reports: "Reports", name: str) -> str:
    """How many runs, on what, at which scale and commit."""
    rows, origins = reports.rows(name), reports.records[name]["runs"]
    runs = [origins.get(run, {}) for run in rows["run"].unique()]
    scales = " and ".join(sorted({str(run["scale"]) for run in runs if run.get("scale")}))
    commits = ", ".join(sorted({report.commit_text(run) for run in runs}))
    devices = sorted({re.sub(r"^NVIDIA | \d+GB.*", "", device) for device in rows["device"]})
    return f"{len(runs)} run{'s' * (len(runs) > 1)}, {scales} scale, {', '.join(devices)}, {commits}"


def listed(folder: Path) -> Iterator[Path]:
    """Marks of reports that have files of their own, as of inverse problems."""
    for mark in not_ignored(sorted(folder.rglob(MARK))):
        if "listed" in read(mark):
            yield mark


def _listed_section(mark: Path) -> dict:
    """A report that has its files, on the page: its first table, as its `sources.json` has it."""
    content = read(mark, _LISTED)
    rows = content["listed"]
    wide = [text[:_WIDE] for text in rows["body"]]
    return {
        "name": mark.parent.name,
        "title": content["title"],
        "table": Rows(rows["headings"][:_WIDE], wide, rows["numeric"][:_WIDE]),
        "said": "",
        "chart": (content.get("chart") or {}).get("file", ""),
        "more": [INDEX],
        "made": rows["made"].rstrip("."),
    }


def _benches(folder: Path) -> list[Path]:
    """Folders that `nsf bench` wrote."""
    return [mark.parent for mark in not_ignored(sorted(folder.glob("*/bench.csv")))]


def _bench(folder: Path) -> dict:
    """Benchmarks on the page: their title and first chart."""
    text = (folder / INDEX).read_text(encoding="utf-8")
    chart = re.search(r"^!\[.*\]\(([\w-]+\.png)\)$", text, re.MULTILINE)
    rows = table.parsed(folder / "bench.csv", ())
    devices, commits = (", ".join(sorted(rows[name].astype(str).unique())) for name in ("device", "commit"))
    return {
        "name": folder.name,
        "title": html.unescape(text.partition("\n")[0].removeprefix("# ")),
        "table": None,
        "said": "",
        "chart": chart[1] if chart else "",
        "more": [INDEX],
        "made": f"{len(rows)} rows, {devices}, {commits}",
    }
