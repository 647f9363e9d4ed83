"""The reports of a folder: a list of them, and whether they are still as they were generated."""

import json
from pathlib import Path

from nsf.errors import SchemaError
from nsf.provenance import not_ignored
from nsf.reporting.provenance import commit_text
from nsf.reporting.sources import file_hash
from nsf.reporting.swap import MARK
from nsf.reporting.tables import markdown_rows
from nsf.storage import writing

LIST = "index.md"
_HEADINGS = ["report", "question", "runs", "made", "commit"]
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
    """What differs from what was generated, each with its remedy: files of reports, and the list of them.

    Raises:
        SchemaError: a report's sources.json lacks the hashes.
    """
    found = [fault for report in _reports(folder) for fault in _changed(report)]
    path = folder / LIST
    if not path.is_file() or path.read_text(encoding="utf-8") != _list(folder):
        command = f"nsf reports folder={folder}"
        found.append(f"{path} does not list the reports as they are; write it with `{command}`")
    return found


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
    body = []
    for report in _reports(folder):
        told = _sources(report)
        runs = told["runs"].values()
        days = sorted({str(run["created"])[:10] for run in runs})
        commits = sorted({commit_text(run) for run in runs})
        made = " to ".join(dict.fromkeys((days[0], days[-1])))
        title = f"[{told['title']}]({report.name}/index.md)"
        body.append([title, told["question"], f"{len(runs)}", made, ", ".join(commits)])
    table = markdown_rows(_HEADINGS, body, [name == "runs" for name in _HEADINGS])
    return f"# Reports\n\nMade of evaluate runs alone; `nsf reports` writes this list.\n\n{table}\n"


def _reports(folder: Path) -> list[Path]:
    """Folders of reports that git does not ignore; every one where there is no git."""
    marks = not_ignored(sorted(folder.glob(f"*/{MARK}")))
    return [mark.parent for mark in marks]


def _sources(report: Path) -> dict:
    told = json.loads((report / MARK).read_text(encoding="utf-8"))
    absent = [key for key in ("title", "question", "runs", "files") if key not in told]
    if absent:
        raise SchemaError(f"{report / MARK} lacks {', '.join(absent)}; {_REBUILD}")
    return told
