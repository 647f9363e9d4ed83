"""A folder of results of inverse problems: a page, tables, charts and sources, listed by `nsf reports`."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from nsf.reporting.build import commit_text
from nsf.reporting.sources import file_hash
from nsf.reporting.text.columns import ABSENT
from nsf.results.folder import MARK, replaced
from nsf.results.formats import Rows, spreadsheet
from nsf.results.page import Page, Picture, Section, Table, html_page, markdown_page
from nsf.runs import Run
from nsf.runs.provenance import provenance

_KEPT = ("commit", "dirty", "device", "precision", "seed", "created", "versions", "parents")
_SHOWN = ("device", "precision", "seed", "created")
_HEADINGS = ("run", "commit", *_SHOWN)
_NOTE = (
    "Every number above is computed from these runs; sources.json names them with the hash of each file that "
    "was written, and the csv files hold the rows."
)


@dataclass(frozen=True)
class Results:
    """What a folder is to tell.

    Attributes:
        title, lead: of the page.
        tables: the first one is what `nsf reports` shows.
        files: data frames by the name of their csv, or csv.gz.
        runs: everything is computed from; beside: and these, which sources.json alone names.
        draw: folder → sections of pictures that it wrote there.
        facts, definitions: terms and what they say.
        warnings: sentences.
        asked: what was asked for, for sources.json.
        said: a sentence beside the first table in the list.
    """

    title: str
    lead: str
    tables: Sequence[Table]
    files: Mapping[str, pd.DataFrame]
    runs: Sequence[Run]
    draw: Callable[[Path], list[Section]]
    beside: Sequence[Run] = ()
    facts: Sequence[tuple[str, str]] = ()
    definitions: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()
    asked: Mapping = field(default_factory=dict)
    said: str = ""


def write(results: Results, folder: Path) -> Path:
    """Write a folder anew, whole or not at all, and give its `index.html`.

    Raises:
        ConfigError: the folder holds something else.
        StorageError: the disk refused a file.
    """
    with replaced(folder) as fresh:
        for name, frame in results.files.items():
            # The hour would make another file of the same rows.
            packed = {"compression": {"method": "gzip", "mtime": 0}} if name.endswith(".gz") else {}
            frame.map(spreadsheet).to_csv(fresh / name, index=False, **packed)
        sections = results.draw(fresh)
        page = Page(
            title=results.title,
            lead=results.lead,
            facts=results.facts,
            warnings=results.warnings,
            tables=results.tables,
            sections=sections,
            provenance=Table("Sources", _provenance(results.runs), _NOTE),
            definitions=results.definitions,
        )
        (fresh / "index.html").write_text(html_page(page), encoding="utf-8")
        (fresh / "index.md").write_text(markdown_page(page), encoding="utf-8")
        told = json.dumps(_sources(results, sections, fresh), indent=2, ensure_ascii=False) + "\n"
        (fresh / MARK).write_text(told, encoding="utf-8")
    return Path(folder) / "index.html"


def _provenance(runs: Sequence[Run]) -> Rows:
    body = []
    for run in runs:
        kept = (run.manifest.get(key) for key in _SHOWN)
        shown = [ABSENT if value is None else str(value) for value in kept]
        body.append([run.id, commit_text(run.manifest), *shown])
    return Rows(list(_HEADINGS), body, [False] * len(_HEADINGS))


def _sources(results: Results, sections: Sequence[Section], folder: Path) -> dict:
    pictures: list[Picture] = [picture for section in sections for picture in section.pictures]
    own = {key: value for key, value in provenance().items() if key != "versions"}
    table, runs = results.tables[0].content, (*results.runs, *results.beside)
    chart = {"file": pictures[0].files[-1], "caption": pictures[0].caption} if pictures else None
    return {
        "title": results.title,
        "question": results.lead,
        "paper": None,
        "asked": dict(results.asked),
        "files": {path.name: file_hash(path) for path in sorted(folder.iterdir())},
        "runs": {run.id: {key: run.manifest.get(key) for key in _KEPT} for run in runs},
        "rows": [],
        "pictures": {file: picture.runs for picture in pictures for file in picture.files},
        "chart": chart,
        # How `nsf reports` lists it.
        "listed": {
            "headings": table.headings,
            "body": table.body,
            "numeric": table.numeric,
            "said": results.said or results.tables[0].note,
            "made": f"{_counted(runs)}; {commit_text(own)}.",
        },
    }


def _counted(runs: Sequence[Run]) -> str:
    days = sorted({str(run.manifest.get("created"))[:10] for run in runs})
    devices = sorted({str(run.manifest.get("device")) for run in runs})
    span = " to ".join(dict.fromkeys((days[0], days[-1])))
    return f"{len(runs)} run{'s' * (len(runs) > 1)} on {', '.join(devices)}, {span}"
