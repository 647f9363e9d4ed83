"""Names, titles, units and errors that try to be more than text, in every format that is written."""

import csv
import json
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser

import pandas as pd
import pytest
from finished import job, write_report
from markdown_it import MarkdownIt
from synthetic import TEST, Made, rewrite_manifest, seal, write_run

from nsf.reporting import build, build_report
from nsf.reporting.committed import write_list
from nsf.reporting.overview.index import write_index
from nsf.runs import Run

SCRIPT = "</title></style></script><script>alert(1)</script>"
TEXTS = (
    SCRIPT,
    '"><img src=x onerror=alert(1)>',
    "' onload='alert(1)",
    "{{ 7 * 7 }}{% raw %}<% x %><< y >>",
    "[x](javascript:alert(1)) ![y](http://evil) <http://evil> [z][x]",
    "a\n\n<script>alert(1)</script>\n\n[x]: javascript:alert(1)",
    "a | b \\| c",
    "*a* _b_ ~~c~~ __d__ \\*e\\* # f",
    "`unpaired <b>",
    "# heading",
    "- item",
    "1. item",
    "==",
    "[x] done",
    "&lt;b&gt; &amp; & &#60;",
    "t\n\\write18{id}\r\\input{/etc/passwd} % $x^2$ #1 ~ {} & \\\\",
    "[5pt] *x",
    "=HYPERLINK('http://evil')",
    "$\\frac{$",
    "a\x00b\x1b[31mc\u202ed\u2028e",
    "../../escaped",
)


class Elements(HTMLParser):
    """Elements, their attributes, and the text of a page, but for its style and script."""

    def __init__(self, page: str):
        super().__init__()
        self.found, self.text, self.inside = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        self.inside = [*self.inside, tag] if tag in ("style", "script") else self.inside

    def handle_endtag(self, tag):
        self.inside = self.inside[:-1] if tag in ("style", "script") else self.inside

    def handle_data(self, data):
        if not self.inside:
            self.text.append(data)


def tags(page: str) -> list[str]:
    return [tag for tag, _ in Elements(page).found]


def markdown_kinds(text: str) -> list[str]:
    """What a reader of Markdown sees, kind by kind, but for the text."""
    parsed = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text)
    flat = [token for block in parsed for token in (block, *(block.children or ()))]
    kinds = [
        token.type for token in flat if token.type not in ("text", "inline", "softbreak", "text_special")
    ]
    return [kind for kind in kinds if not kind.startswith("code")]


def hostile(root, text: str, seed: int = 0, values: int = 2):
    """An evaluate run that says a text wherever it can; a run for each seed."""
    made = Made(particles=30, frames=2, parameters=TEST[:values], splits=("test",) * values, seed=seed)
    run = write_run(root, made)
    rows = pd.read_csv(run.path / "results.csv")
    rows[["scene", "method", "field", "precision", "device", "commit"]] = text
    rows.to_csv(run.path / "results.csv", index=False)
    summary = json.loads((run.path / "summary.json").read_text())
    summary |= {"title": text, "parameter_name": text, "parameter_unit": text, "scale": text}
    summary |= {"paper": {"place": text, text: {"delta": 0.1}}}
    (run.path / "summary.json").write_text(json.dumps(summary))
    seal(run)
    rewrite_manifest(run, commit=text, device=text, precision=text, versions={text: text})
    return run


@pytest.fixture(scope="module")
def harmless(tmp_path_factory):
    """The elements of a page, and of its Markdown, where every text is a word."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "draw", lambda merged, folder, **_: [])
        root = tmp_path_factory.mktemp("harmless")
        folder = build_report([hostile(root / "runs", "word")], root / "reports" / "a", "word").parent
    listed = write_list(folder.parent).read_text()
    return (
        tags((folder / "index.html").read_text()),
        markdown_kinds((folder / "index.md").read_text()),
        (folder / "results.tex").read_text().count("\n"),
        markdown_kinds(listed),
    )


@pytest.mark.parametrize("text", TEXTS, ids=range(len(TEXTS)))
def test_a_report_says_a_text_and_no_more(text, harmless, tmp_path, no_pictures):
    elements, kinds, lines, listed = harmless
    folder = build_report([hostile(tmp_path / "runs", text)], tmp_path / "reports" / "a", text).parent
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert tags(page) == elements
    shown = re.sub(r"\s+", " ", "".join(Elements(page).text))
    assert re.sub(r"[\x00-\x20\x7f-\x9f\u2028\u202e]+", " ", text).strip() in shown
    assert not re.search(r"[\x00-\x09\x0b-\x1f\u202e]", page)

    assert markdown_kinds((folder / "index.md").read_text(encoding="utf-8")) == kinds
    found = markdown_kinds(write_list(folder.parent).read_text(encoding="utf-8"))
    # Text that begins as a formula has an apostrophe in results.csv, and so is no method of the paper.
    assert found == listed or text[0] in "=-"

    tex = (folder / "results.tex").read_text(encoding="utf-8")
    assert tex.count("\n") == lines
    commands = set(re.findall(r"\\[a-zA-Z]+|\\.", tex))
    assert not commands & {r"\write", r"\input", r"\frac"}
    cells = [line.removesuffix(r" \\") for line in tex.splitlines() if line.endswith(r" \\")]
    assert len({len(re.findall(r"(?<!\\)&", row)) for row in cells}) == 1
    assert not any(re.match(r"\s*[\[*]", row) for row in cells)

    with (folder / "results.csv").open(newline="") as file:
        for row in csv.reader(file):
            assert not any(cell[:1] in "=+-@\t\r" for cell in row if cell)
    json.loads((folder / "sources.json").read_text(encoding="utf-8"))


def test_a_lone_surrogate_is_no_traceback(tmp_path, no_pictures):
    run = hostile(tmp_path / "runs", "word")
    summary = json.loads((run.path / "summary.json").read_text()) | {"title": "a\ud800b"}
    (run.path / "summary.json").write_text(json.dumps(summary))
    seal(run)
    folder = build_report([run], tmp_path / "reports" / "a", "a\ud800b").parent
    assert "<h1>a b</h1>" in (folder / "index.html").read_text(encoding="utf-8")
    assert json.loads((folder / "sources.json").read_text())["title"] == "a\ud800b"


@pytest.mark.slow
@pytest.mark.parametrize("texts", [(SCRIPT, "$\\frac{$"), ("a\x00b\x1bc", "../../escaped")], ids=range(2))
def test_pictures_of_such_names_stay_in_the_folder_and_are_drawings(texts, tmp_path):
    runs = [hostile(tmp_path / "runs", text, seed, values=1) for seed, text in enumerate(texts)]
    folder = build_report(runs, tmp_path / "reports" / "a", texts[0]).parent
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "reports"}
    assert {path.name for path in folder.parent.iterdir()} <= {"a", ".a.lock"}
    found = Elements((folder / "index.html").read_text()).found
    linked = [attributes["src"] for tag, attributes in found if tag == "img"]
    assert linked
    assert all((folder / name).is_file() for name in linked)
    for drawing in folder.glob("*.svg"):
        assert not list(ElementTree.parse(drawing).iter("{http://www.w3.org/2000/svg}script"))


def test_the_list_of_reports_and_its_links(tmp_path):
    name = 'a"><script>alert(1)<|b'
    folder = write_report(tmp_path / name, [job()], chart="delta.png")
    told = json.loads((folder / "sources.json").read_text())
    told |= {"title": SCRIPT, "question": "<b>", "paper": "[x](javascript:y)"}
    (folder / "sources.json").write_text(json.dumps(told))
    text = write_list(tmp_path).read_text()
    assert "<script" not in text
    assert "<b>" not in text
    hrefs = [
        token.attrs["href"]
        for block in MarkdownIt("commonmark").enable("table").parse(text)
        for token in block.children or ()
        if token.type == "link_open"
    ]
    assert hrefs == [
        "#a%22%3E%3Cscript%3Ealert%281%29%3C%7Cb",
        "a%22%3E%3Cscript%3Ealert%281%29%3C%7Cb/index.md",
    ]


def test_the_lines_of_a_page_of_benchmarks_are_text(tmp_path):
    folder = tmp_path / "speed"
    folder.mkdir()
    lead = "Time of `nsf bench`. <img src=x onerror=y> \\|S\\|"
    (folder / "index.md").write_text(f"# <b>Speed\n\n{lead}\n\n![a](javascript:b)\n\n![Over P.](step.png)\n")
    (folder / "bench.csv").write_text("bench,device,commit\nscaling,<i>,1f2e\n")
    text = write_list(tmp_path).read_text()
    assert "html_inline" not in markdown_kinds(text.replace('<a id="speed"></a>', ""))
    assert "Time of `nsf bench`." in text
    assert "javascript" not in text
    assert "](speed/step.png)" in text


NAMES = ('"><img src=x onerror=alert(1)>', "a#b?c%41&lt;", "' onload='x")


@pytest.mark.parametrize("name", NAMES)
def test_the_page_of_runs_is_not_hurt_by_names_of_folders(name, tmp_path):
    run = write_run(tmp_path / "runs", Made(particles=30, frames=4))
    moved = run.path.with_name(name)
    run.path.rename(moved)
    moved = Run("evaluate", "sand", name, tmp_path / "runs")
    rewrite_manifest(moved, hash=name, error=f"{name} {SCRIPT}", status="complete")
    page = write_index(tmp_path / "page", tmp_path / "runs").read_text()
    found = Elements(page).found
    assert not [
        attributes for tag, attributes in found if tag == "img"
    ]  # a name that is no hash is of no run
    assert not [attributes for _, attributes in found if {"onload", "onerror"} & attributes.keys()]
    assert page.count("<script>") == 1
    assert SCRIPT not in page
