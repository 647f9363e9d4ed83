"""A folder of results of inverse problems: a page, tables, charts and sources, listed by `nsf reports`."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.data import PROGRAM
from nsf.inverse.model import Forcing, Model
from nsf.results.columns import axis, number
from nsf.results.folder import record, replaced
from nsf.results.formats import Rows, spreadsheet
from nsf.results.page import Page, Picture, Section, Table
from nsf.results.report import commit_text, provenance_rows
from nsf.results.sources import KEPT
from nsf.results.style import save
from nsf.runs import Run
from nsf.runs.provenance import provenance

_MOST = 20  # runs that the page names
_NOTE = (
    "Every number above is computed from these runs; sources.json names all of them with the hash of each "
    "file that was written, and the csv files hold the rows."
)


@dataclass(frozen=True)
class Problem:
    """A model, and the program that its runs follow where the scene has programs."""

    model: Model
    program: int | None = None

    @property
    def forcing(self) -> Forcing | None:
        """Forcing by the program; None for the scene's at each run's parameters."""
        return None if self.program is None else self.model.forcing(program=self.program)

    def full_order(self, parameters: Iterable[Mapping[str, float]]) -> list[Run]:
        """The full-order runs at parameters by name, each made where it is not there."""
        program = {} if self.program is None else {PROGRAM: self.program}
        return self.model.pipeline.full_order([self.model.scene.case({**of, **program}) for of in parameters])


@dataclass(frozen=True)
class Chart:
    """A picture of the page: under which heading, in which file, its caption, and the figure."""

    heading: str
    stem: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Results:
    """The content of a folder.

    Attributes:
        title, lead: of the page.
        models: whose runs everything is computed from; runs: others, as full-order ones.
        tables: the first one is the row of `nsf reports`.
        files: data frames by the name of their csv, or csv.gz.
        charts: of the page.
        facts, definitions: terms and their meaning.
        warnings: sentences.
        settings: of the command, for sources.json.
    """

    title: str
    lead: str
    models: Sequence[Model]
    tables: Sequence[Table]
    files: Mapping[str, pd.DataFrame]
    charts: Sequence[Chart]
    runs: Sequence[Run] = ()
    facts: Sequence[tuple[str, str]] = ()
    definitions: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()
    settings: Mapping = field(default_factory=dict)

    @property
    def origins(self) -> dict[str, dict]:
        """By run id, where and from what code each run was made."""
        chains = [run for model in self.models for run in (model.run, *model.run.parent_runs)]
        keys = (*KEPT, "parents")
        return {run.id: {key: run.manifest.get(key) for key in keys} for run in (*chains, *self.runs)}


def write(results: Results, folder: Path) -> Path:
    """Write a folder anew, whole or not at all, and give its `index.html`.

    Raises:
        ConfigError: the folder holds something else.
        StorageError: the disk refused a file.
    """
    origins = results.origins
    shown = provenance_rows(dict(itertools.islice(origins.items(), _MOST)))
    with replaced(folder) as fresh:
        for name, frame in results.files.items():
            # The hour would make another file of the same rows.
            packed = {"compression": {"method": "gzip", "mtime": 0}} if name.endswith(".gz") else {}
            frame.map(spreadsheet).to_csv(fresh / name, index=False, **packed)
        sections = _sections(results, fresh)
        page = Page(
            title=results.title, lead=results.lead, facts=results.facts, warnings=results.warnings,
            tables=results.tables, sections=sections, definitions=results.definitions,
            provenance=Table("Sources", shown, _NOTE),
        )  # fmt: skip
        page.write(fresh)
        first = results.charts[0]
        content = {
            "title": results.title,
            "question": results.lead,
            "asked": dict(results.settings),
            "runs": origins,
            "chart": {"file": f"{first.stem}.png", "caption": first.caption},
            "listed": _listed(results.tables[0], origins),
        }
        record(fresh, content)
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


def _sections(results: Results, folder: Path) -> list[Section]:
    """Charts as files of a folder, those of one heading in a section."""
    ids, sections = [model.run.id for model in results.models], {}
    for chart in results.charts:
        files = save(chart.figure, folder, chart.stem, kinds=("png",))
        sections.setdefault(chart.heading, []).append(Picture(files, chart.caption, ids))
    return [Section(heading, pictures) for heading, pictures in sections.items()]


def _listed(table: Table, origins: Mapping[str, Mapping]) -> dict:
    """How `nsf reports` lists the folder."""
    days = sorted({str(origin["created"])[:10] for origin in origins.values()})
    devices = ", ".join(sorted({str(origin["device"]) for origin in origins.values()}))
    span = " to ".join(dict.fromkeys((days[0], days[-1])))
    runs = f"{len(origins)} run{'s' * (len(origins) > 1)} on {devices}, {span}"
    return vars(table.content) | {"said": table.note, "made": f"{runs}; {commit_text(provenance())}."}
