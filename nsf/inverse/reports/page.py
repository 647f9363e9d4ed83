"""A folder of results of inverse problems: a page, tables, charts and sources, listed by `nsf reports`."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.inverse.model import Model
from nsf.results.columns import ABSENT, axis, number
from nsf.results.folder import MARK, replaced
from nsf.results.formats import Rows, spreadsheet
from nsf.results.page import Page, Picture, Section, Table, html_page, markdown_page
from nsf.results.report import commit_text
from nsf.results.sources import file_hash
from nsf.results.style import save
from nsf.runs import Run
from nsf.runs.provenance import provenance

_KEPT = ("commit", "dirty", "device", "precision", "seed", "created", "versions", "parents")
_SHOWN = ("device", "precision", "seed", "created")
_NOTE = (
    "Every number above is computed from these runs; sources.json names them with the hash of each file that "
    "was written, and the csv files hold the rows."
)


@dataclass(frozen=True)
class Chart:
    """A picture of the page: under which heading, in which file, its caption, and what draws it."""

    heading: str
    stem: str
    caption: str
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Results:
    """The content of a folder.

    Attributes:
        title, lead: of the page.
        models: of its runs; beside: runs that everything is computed from as well, with their parents.
        tables: the first one is the row of `nsf reports`.
        files: data frames by the name of their csv, or csv.gz.
        charts: of the page.
        facts, definitions: terms and what they say.
        warnings: sentences.
        asked: settings of the command, for sources.json.
        hidden: runs that sources.json alone names.
    """

    title: str
    lead: str
    models: Sequence[Model]
    tables: Sequence[Table]
    files: Mapping[str, pd.DataFrame]
    charts: Sequence[Chart]
    beside: Sequence[Run] = ()
    facts: Sequence[tuple[str, str]] = ()
    definitions: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()
    asked: Mapping = field(default_factory=dict)
    hidden: Sequence[Run] = ()

    @property
    def runs(self) -> list[Run]:
        """Those that the page names."""
        own = [run for model in self.models for run in (model.run, *model.run.parent_runs)]
        return [*own, *self.beside]


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
        sections = _drawn(results, fresh)
        page = Page(
            title=results.title, lead=results.lead, facts=results.facts, warnings=results.warnings,
            tables=results.tables, sections=sections, definitions=results.definitions,
            provenance=Table("Sources", _provenance(results.runs), _NOTE),
        )  # fmt: skip
        (fresh / "index.html").write_text(html_page(page), encoding="utf-8")
        (fresh / "index.md").write_text(markdown_page(page), encoding="utf-8")
        sources = json.dumps(_sources(results, sections, fresh), indent=2, ensure_ascii=False) + "\n"
        (fresh / MARK).write_text(sources, encoding="utf-8")
    return Path(folder) / "index.html"


def title_of(model: Model) -> str:
    """The scene's title."""
    return model.pipeline.config.scene.get("title") or model.scene.name


def frame_table(heading: str, frame: pd.DataFrame, note: str = "", text: int = 1) -> Table:
    """A table of a data frame, numbers with three digits; so many first columns are text."""
    body = [[number(value) for value in row] for row in frame.itertuples(index=False, name=None)]
    return Table(heading, Rows(list(frame), body, [k >= text for k in range(len(frame.columns))]), note)


def named(model: Model, name: str) -> str:
    """A parameter with its unit, as a heading."""
    return axis(name.replace("_", " "), model.units[model.names.index(name)])


def rms(values) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _drawn(results: Results, folder: Path) -> list[Section]:
    """Charts as files of a folder, those of one heading in a section."""
    ids, sections = [model.run.id for model in results.models], {}
    for chart in results.charts:
        files = save(chart.draw(), folder, chart.stem, kinds=("png",))
        sections.setdefault(chart.heading, []).append(Picture(files, chart.caption, ids))
    return [Section(heading, pictures) for heading, pictures in sections.items()]


def _provenance(runs: Sequence[Run]) -> Rows:
    headings, body = ["run", "commit", *_SHOWN], []
    for run in runs:
        values = (run.manifest.get(key) for key in _SHOWN)
        shown = [ABSENT if value is None else str(value) for value in values]
        body.append([run.id, commit_text(run.manifest), *shown])
    return Rows(headings, body, [False] * len(headings))


def _sources(results: Results, sections: Sequence[Section], folder: Path) -> dict:
    pictures = [picture for section in sections for picture in section.pictures]
    table, runs = results.tables[0], [*results.runs, *results.hidden]
    days = sorted({str(run.manifest.get("created"))[:10] for run in runs})
    devices = ", ".join(sorted({str(run.manifest.get("device")) for run in runs}))
    span = " to ".join(dict.fromkeys((days[0], days[-1])))
    made = f"{len(runs)} run{'s' * (len(runs) > 1)} on {devices}, {span}"
    return {
        "title": results.title,
        "question": results.lead,
        "paper": None,
        "asked": dict(results.asked),
        "files": {path.name: file_hash(path) for path in sorted(folder.iterdir())},
        "runs": {run.id: {key: run.manifest.get(key) for key in _KEPT} for run in runs},
        "rows": [],
        "pictures": {file: picture.runs for picture in pictures for file in picture.files},
        "chart": {"file": pictures[0].files[-1], "caption": pictures[0].caption} if pictures else None,
        # How `nsf reports` lists it.
        "listed": vars(table.content) | {"said": table.note, "made": f"{made}; {commit_text(provenance())}."},
    }
