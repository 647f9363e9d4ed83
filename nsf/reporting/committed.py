"""The reports of a folder: what they found, in the order of a paper, and whether they are as generated."""

import json
import re
from pathlib import Path

import pandas as pd

from nsf.errors import SchemaError
from nsf.provenance import not_ignored
from nsf.reporting.headline import Report, headline
from nsf.reporting.page import DEFINITIONS
from nsf.reporting.provenance import commit_text
from nsf.reporting.sources import file_hash
from nsf.reporting.superresolution import fine_means
from nsf.reporting.swap import MARK
from nsf.storage import writing

LIST = "index.md"
#: Headings, and the folders under each in their order; the last heading is of all others.
CHAPTERS = {
    "Main results": ("table1",),
    "What the method needs": (
        "ablation", "field", "width", "latent_dim", "sample_size", "sampler", "timestep", "seeds",
    ),
    "Beyond what was trained": ("extrapolation", "weak_elements", "super_resolution", "path_dependent"),
    "One scene in detail, and speed": ("sand", "speed"),
}  # fmt: skip
_OTHERS = "Further reports"
_LEAD = (
    "Every number here is computed from the files of the reports, and every report from the runs that its "
    "sources.json names; `nsf reports` writes this page. Each report has all values, charts and pictures. "
    "Reports were made at different commits and seeds, so that the same setting differs from one to another "
    "as it does from seed to seed. The state of the tree is unknown where the code ran outside of git."
)
_CHART = {"file": "delta.png", "caption": "Mean δ, each value, and the paper's."}  # of reports that name none
_REBUILD = "build it again with `nsf report`"


def write_list(folder: Path) -> Path:
    """Write `index.md` of a folder of reports, and give it.

    Raises:
        SchemaError: a report's sources.json lacks what the list tells.
        StorageError: the disk refused the file.
    """
    text = _list(folder)
    with writing(folder / LIST) as partial:
        partial.write_text(text, encoding="utf-8")
    return folder / LIST


def faults(folder: Path) -> list[str]:
    """What differs from what was generated, each with its remedy: files of reports, or the list of them.

    Raises:
        SchemaError: a report's sources.json lacks the hashes.
    """
    found = [fault for report in _reports(folder) for fault in _changed(report)]
    if found:
        return found  # a list made from changed files would be no better
    path = folder / LIST
    if not path.is_file() or path.read_text(encoding="utf-8") != _list(folder):
        command = f"nsf reports folder={folder}"
        return [f"{path} does not list the reports as they are; write it with `{command}`"]
    return []


def _changed(report: Path) -> list[str]:
    """Files of a report that are not those whose hashes it holds."""
    known = _sources(report)["files"]
    present = {path.name: file_hash(path) for path in sorted(report.iterdir()) if path.name != MARK}
    told = {
        "is missing": known.keys() - present.keys(),
        "is not of the report": present.keys() - known.keys(),
        "was changed": {name for name in known.keys() & present.keys() if known[name] != present[name]},
    }
    return [f"{report / name} {what}; {_REBUILD}" for what, names in told.items() for name in sorted(names)]


def _list(folder: Path) -> str:
    sections = {report.name: _section(report, _sources(report)) for report in _reports(folder)}
    sections |= {report.name: _bench_section(report) for report in _benches(folder)}
    chapters: dict[str, list[str]] = {heading: [] for heading in (*CHAPTERS, _OTHERS)}
    for name in sorted(sections, key=_place):
        chapters[_place(name)[1]].append(name)
    contents = [
        f"- {heading}: " + ", ".join(f"[{sections[name][0]}](#{name})" for name in names)
        for heading, names in chapters.items()
        if names
    ]
    terms = "\n".join(f"- **{term}**: {text}" for term, text in DEFINITIONS)
    parts = ["# Results", _LEAD, "\n".join(contents), "What is measured:", terms]
    for heading, names in chapters.items():
        parts += [f"## {heading}"] if names else []
        for name in names:
            title, body = sections[name]
            parts += [f'<a id="{name}"></a>', f"### {title}", *body]
    return "\n\n".join(parts) + "\n"


def _place(name: str) -> tuple[int, str, int, str]:
    """Number and heading of a report's chapter, its place in there, and its name."""
    for number, (heading, names) in enumerate(CHAPTERS.items()):
        if (whole := name.removesuffix("_small")) in names:
            return number, heading, names.index(whole), name
    return len(CHAPTERS), _OTHERS, 0, name


def _section(folder: Path, told: dict) -> tuple[str, list[str]]:
    """Title and paragraphs of a report."""
    report = Report(folder, told)
    body = [told["question"]]
    if told.get("paper"):
        body.append(f"**The paper:** {told['paper']}")
    body.append(headline(report))
    if (folder / "superresolution.csv").is_file():
        body.append(fine_means(folder))
    chart = told.get("chart") or _CHART
    if chart["file"] in told["files"]:
        body.append(f"![{told['title']}]({folder.name}/{chart['file']})\n\n{chart['caption']}")
    return told["title"], [*body, f"{_made(report)} [The whole report]({folder.name}/index.md)."]


def _made(report: Report) -> str:
    """How many runs, where, when and from what code, as sentences."""
    runs = report.told["runs"].values()
    days = sorted({str(run["created"])[:10] for run in runs})
    scales = sorted({f"{run['scale']} scale" for run in runs if run.get("scale")})
    where = [
        *(["at " + " and ".join(scales)] if scales else []),
        "on " + ", ".join(sorted(set(report.rows["device"].astype(str)))),
        "in " + ", ".join(sorted(set(report.rows["precision"].astype(str)))),
    ]
    commits = ", ".join(sorted({commit_text(run) for run in runs}))
    count = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    made = f"{count} {' '.join(where)}, {' to '.join(dict.fromkeys((days[0], days[-1])))}, {commits}."
    missing = len(report.told.get("missing") or ())
    return f"{made} Missing jobs: {missing}, with the reasons in the report." if missing else made


def _bench_section(folder: Path) -> tuple[str, list[str]]:
    """Title, first lines and first chart of a page of benchmarks."""
    page = (folder / LIST).read_text(encoding="utf-8")
    title, lead = page.split("\n\n")[:2]
    rows = pd.read_csv(folder / "results.csv")
    charts = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", page)
    devices, commits = (", ".join(sorted(rows[name].astype(str).unique())) for name in ("device", "commit"))
    body = [lead, *(f"![{caption}]({folder.name}/{file})\n\n{caption}" for caption, file in charts[:1])]
    made = f"{len(rows)} rows on {devices}, {commits}."
    return title.removeprefix("# "), [*body, f"{made} [The whole report]({folder.name}/index.md)."]


def _reports(folder: Path) -> list[Path]:
    """Folders of reports that git does not ignore; every one where there is no git."""
    marks = not_ignored(sorted(folder.glob(f"*/{MARK}")))
    return [mark.parent for mark in marks]


def _benches(folder: Path) -> list[Path]:
    """The same of what `nsf bench` wrote."""
    marks = not_ignored(sorted(folder.glob("*/kernels.csv")))
    return [mark.parent for mark in marks]


def _sources(report: Path) -> dict:
    told = json.loads((report / MARK).read_text(encoding="utf-8"))
    absent = [key for key in ("title", "question", "runs", "rows", "files") if key not in told]
    if absent:
        raise SchemaError(f"{report / MARK} lacks {', '.join(absent)}; {_REBUILD}")
    return told
