"""A folder of reports as one: one table of all their rows, one page, one picture a chart.

`reports/results.csv` is the table, with the name of the report in each row; `provenance.json` has what each
report says beside it, the origin of each run, and the sha256 of each picture that runs alone can make.
`index.md` and the charts are made of these two. Reports of inverse problems and benchmarks, whose rows are
no cases, keep files of their own and are listed.
"""

import html
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

from nsf import schemas
from nsf.errors import SchemaError
from nsf.results import report, table
from nsf.results.averages import averaged
from nsf.results.charts import CHARTS, View
from nsf.results.columns import COLUMNS
from nsf.results.folder import MARK
from nsf.results.formats import Rows, markdown_document
from nsf.results.page import Picture, Section
from nsf.results.question import Question
from nsf.results.sources import file_hash
from nsf.runs.provenance import not_ignored
from nsf.schemas import Maybe
from nsf.storage import write_json, writing

TABLE, PROVENANCE, LIST = "results.csv", "provenance.json", "index.md"
CHAPTERS = {
    "Main results": (
        *("quickstart", "table1/seeds", "table1/scenes", "table1/operators", "table1/operators_seeds"),
        *("table1/networks", "table1/ablation", "table1/small", "table1/figures"),
        *("forcing", "large", "super_resolution"),
    ),
    "Choices of the method": ("latent_dim", "sampling", "timestep", "training", "training_runs", "noise"),
    "Beyond training": ("generalise",),
    "Inverse problems and speed": (),
}
"""Headings of the page and the reports, or experiments, below each; the last one is of all others."""
OF_THE_PAPER = (
    ("Figure 1", "cake, cut at several angles", "table1/scenes/cake-final-shapes.png"),
    ("Figure 4", "sample and integration particles", "table1/scenes/cake-particle-sets.png"),
    ("Figure 5", "bread beside the baseline", "table1/scenes/bread-strip.png"),
    ("Figure 6", "sand at many more points", "super_resolution/sand-basis-superresolution.png"),
    ("Figure 7", "sand at several friction angles", "table1/scenes/sand-final-shapes.png"),
    ("Table 1", "seven scenes", "table1/scenes/delta.png", "table1/seeds/delta.png"),
    ("Figures 8 and 9", "metal at several hardenings", "table1/scenes/metal-final-shapes.png"),
    ("Figure 10", "toothpaste at several angles", "table1/scenes/toothpaste-final-shapes.png"),
    (
        "Figure 11",
        "toothpaste with fewer sample particles",
        "table1/figures/toothpaste-settings.png",
        "sampling/size/delta-over-sampler-size.png",
    ),
    ("Figure 12", "jelly cube beside the baseline", "table1/scenes/jelly_cube-strip.png"),
    ("Figure 13", "squishy ball beside the baseline", "table1/scenes/squishy_ball-strip.png"),
    (
        "Figure 14",
        "bread with perturbed weak elements",
        "generalise/weak_elements/8-percent-final-shapes.png",
        "generalise/weak_elements/30-percent-final-shapes.png",
    ),
    ("Figure 15", "training data of bread", "table1/figures/bread-final-shapes.png"),
    ("Figure 16", "training data of sand", "table1/figures/sand-final-shapes.png"),
    ("Figure 17", "sand beyond its training", "generalise/extrapolation/final-shapes.png"),
    (
        "Figure 18",
        "time of a step by stage",
        "table1/scenes/cake-runtime.png",
        "table1/scenes/metal-runtime.png",
    ),
    (
        "Sections 6.1, 6.3",
        "1.5 Δt",
        "timestep/delta-over-deploy-dt-multiplier.png",
        "table1/figures/metal-settings.png",
    ),
)
"""The paper's figures: what they show, and their counterparts among the reports."""
_COLUMNS = (
    *("body", "variant", "case", "paper_delta", "delta", "displacement_error", "displacement_interpolated"),
    *("speedup_decoded", "stress_error"),
)
_WIDE, _LONG = 7, 14  # columns and rows of a table of the page
_EXPLAINED = ("delta", "displacement_error", "stress_error", "displacement_interpolated")
_MADE_ANEW = (".gif", ".html", ".mp4", ".svg", ".tex")  # of a report, and not committed
_SAME = 1.0  # mean difference of pixels, of 255, that another version of a library may make
_REBUILD = "build it again with `nsf report`"


_PROVENANCE = {key: {...: dict} for key in ("reports", "runs", "pictures")}
_MARK = {
    Maybe("title"): str,
    Maybe("files"): {...: str},
    Maybe("chart"): ({"file": str}, None),
    Maybe("listed"): {"headings": [str], "body": [[str]], "numeric": [bool], "made": str},
}
#: Of a report that `nsf report` wrote.
_WRITTEN = {
    "name": str,
    "files": {...: str},
    "runs": {...: dict},
    "pictures": {...: {"caption": str, "runs": [str]}},
}


@dataclass(frozen=True)
class Reports:
    """What a folder of reports holds.

    Attributes:
        folder: the folder.
        frame: the table.
        texts: by report, what it says beside the table.
        runs: by run id, its origin.
        pictures: by path, caption, runs and sha256 of what was drawn from runs.
        questions: by report, title, question and paper of its experiment, which say more than `texts`.
    """

    folder: Path
    frame: pd.DataFrame
    texts: Mapping[str, Mapping]
    runs: Mapping[str, Mapping]
    pictures: Mapping[str, Mapping]
    questions: Mapping[str, Mapping] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, questions: Mapping[str, Mapping] | None = None) -> "Reports":
        """Those of a folder, which may hold none.

        Raises:
            SchemaError: the table is none, or `provenance.json` lacks a key.
        """
        path = folder / PROVENANCE
        content = _read(path, _PROVENANCE) if path.is_file() else {}
        frame = table.read(folder / TABLE) if (folder / TABLE).is_file() else pd.DataFrame(columns=[*COLUMNS])
        beside = (content.get(key, {}) for key in ("reports", "runs", "pictures"))
        return cls(folder, frame, *beside, questions or {})

    def collected(self) -> "Reports":
        """With every report that `nsf report` wrote in the folder, each in the place of its older rows."""
        found = self
        for mark in sorted(self.folder.rglob(MARK)):
            content = _read(mark, _MARK)
            if "made_of" in content and not_ignored([mark.with_name("delta.png")]):
                found = found._with(mark.parent, _read(mark, _WRITTEN))
        return found

    def _with(self, place: Path, content: Mapping) -> "Reports":
        rows, name = table.read(place / TABLE), str(content["name"])
        others = self.frame[self.frame["report"] != name]
        frame = pd.concat([others, rows], ignore_index=True) if len(others) else rows
        prefix = place.relative_to(self.folder).as_posix()
        drawn = {
            f"{prefix}/{file}": {**picture, "sha256": content["files"].get(file, "")}
            for file, picture in content["pictures"].items()
            if picture["caption"] not in {chart.caption for chart in CHARTS.values()}
        }
        kept = {path: one for path, one in self.pictures.items() if not path.startswith(f"{prefix}/")}
        keys = ("title", "question", "paper", "missing", "plots", "trained", "logarithmic")
        texts = dict(self.texts) | {name: {key: content.get(key) for key in keys}}
        return replace(
            self, frame=frame, texts=texts, runs={**self.runs, **content["runs"]}, pictures=kept | drawn
        )

    def save(self) -> None:
        """Write the table and what stands beside it, without runs that no row or picture is of."""
        runs = {*self.frame["run"], *(run for one in self.pictures.values() for run in one["runs"])}
        table.write(self.frame, self.folder / TABLE)
        content = {
            "reports": {name: self.texts[name] for name in sorted(self.texts)},
            "runs": {run: self.runs[run] for run in sorted(self.runs) if run in runs},
            "pictures": {path: self.pictures[path] for path in sorted(self.pictures)},
        }
        write_json(self.folder / PROVENANCE, content)

    @property
    def names(self) -> list[str]:
        """The reports, in the order of the page."""
        return sorted(set(self.frame["report"]), key=_place)

    def rows(self, name: str) -> pd.DataFrame:
        """The table of one report."""
        return self.frame[self.frame["report"] == name].reset_index(drop=True)

    def question(self, name: str) -> Question:
        """What a report is about."""
        told = {**self.texts.get(name, {}), **self.questions.get(name, {})}
        return Question(
            name, told.get("title") or name, told.get("question") or "", told.get("paper") or "",
            missing=told.get("missing") or (), plots=told.get("plots"),
        )  # fmt: skip

    def view(self, name: str) -> View:
        """What charts see of a report."""
        told = self.texts.get(name, {})
        logarithmic = frozenset(told.get("logarithmic") or ())
        return View(table.labelled(self.rows(name)), None, {}, told.get("trained") or {}, logarithmic)

    def drawn(self, name: str) -> list[Picture]:
        """Pictures of a report that were drawn from runs."""
        own = {path: one for path, one in self.pictures.items() if path.rpartition("/")[0] == name}
        return [
            Picture([path.rpartition("/")[2]], str(one["caption"]), list(one["runs"]))
            for path, one in own.items()
        ]


def write_list(folder: Path, pages: bool = False, questions: Mapping[str, Mapping] | None = None) -> Path:
    """Take in what `nsf report` wrote below a folder, draw the charts of all reports, and write their page.

    Args:
        folder: of reports.
        pages: write each report's HTML and LaTeX, and its charts as SVG, too.
        questions: title, question and paper of the experiments, by name.

    Returns:
        Its `index.md`.

    Raises:
        SchemaError: a file of the folder is no table, or lacks a key.
        StorageError: the disk refused a file.
    """
    reports = Reports.of(folder, questions).collected()
    if len(reports.frame):
        reports.save()
        reports = Reports.of(folder, questions)
    charts = {name: _draw(reports, name, folder, pages) for name in reports.names}
    with writing(folder / LIST) as partial:
        partial.write_text(_page(reports, charts), encoding="utf-8")
    return folder / LIST


def faults(folder: Path, questions: Mapping[str, Mapping] | None = None) -> list[str]:
    """What differs from what was generated, each with its remedy: pictures, charts, and the page of them.

    Args:
        folder, questions: as for `write_list`.

    Raises:
        SchemaError: the table is none, or a key is missing.
    """
    reports = Reports.of(folder, questions)
    found = [fault for mark in _listed(folder) for fault in _changed(mark.parent)]
    for path, one in reports.pictures.items():
        if not (folder / path).is_file():
            found.append(f"{folder / path} is missing; {_REBUILD}")
        elif file_hash(folder / path) != one["sha256"]:
            found.append(f"{folder / path} was changed; {_REBUILD}")
    if missing := set(reports.frame["run"]) - set(reports.runs):
        found.append(f"{folder / PROVENANCE} has no origin of {sorted(missing)[0]}; {_REBUILD}")
    again = f"write it with `nsf reports folder={folder}`"
    with tempfile.TemporaryDirectory() as fresh:
        charts = {name: _draw(reports, name, Path(fresh)) for name in reports.names}
        for name, pictures in charts.items():
            for file in (picture.files[-1] for picture in pictures):
                if not _alike(Path(fresh) / name / file, folder / name / file):
                    found.append(f"{folder / name / file} is not the chart of {folder / TABLE}; {again}")
        page = folder / LIST
        if not page.is_file() or page.read_text(encoding="utf-8") != _page(reports, charts):
            found.append(f"{page} does not list the reports as they are; {again}")
    return found


def _draw(reports: Reports, name: str, folder: Path, pages: bool = False) -> list[Picture]:
    """The charts of a report in its folder, and its pages."""
    place, question, view = folder / name, reports.question(name), reports.view(name)
    place.mkdir(parents=True, exist_ok=True)
    charts = report.draw(view, place, question.plots, ("svg", "png") if pages else ("png",))
    if pages:
        runs = {run: reports.runs[run] for run in sorted(set(view.frame["run"])) if run in reports.runs}
        sections = [Section("Charts", charts), Section("Pictures", reports.drawn(name))]
        report.write_pages(reports.rows(name), question, place, sections, runs, view)
    return charts


def _alike(made: Path, there: Path) -> bool:
    """Whether two pictures are one, but for what another version of a library may change."""
    if not there.is_file():
        return False
    with Image.open(made) as a, Image.open(there) as b:
        if a.size != b.size:
            return False
        pixels = [np.asarray(image.convert("RGB"), float) for image in (a, b)]
    return float(np.abs(pixels[0] - pixels[1]).mean()) <= _SAME


def _page(reports: Reports, charts: Mapping[str, list[Picture]]) -> str:
    """The text of `index.md`."""
    chapters: dict[str, list[dict]] = {heading: [] for heading in CHAPTERS}
    for name in reports.names:
        chapters[_place(name)[1]].append(_section(reports, name, charts[name]))
    for entry in (*map(_listed_section, _listed(reports.folder)), *map(_bench, _benches(reports.folder))):
        chapters[list(CHAPTERS)[-1]].append(entry)
    known = {*reports.pictures, *(f"{n}/{p.files[-1]}" for n, of in charts.items() for p in of)}
    figures = [(figure, shows, [p for p in paths if p in known]) for figure, shows, *paths in OF_THE_PAPER]
    return markdown_document(
        "list.md",
        chapters={heading: entries for heading, entries in chapters.items() if entries},
        definitions=report.definitions(_EXPLAINED),
        of_the_paper=figures if any(paths for *_, paths in figures) else [],
    )


def _section(reports: Reports, name: str, charts: list[Picture]) -> dict:
    """What the page says of one report."""
    frame = reports.view(name).frame
    averages = averaged(frame)
    best = len(averages) > _LONG
    if best:
        averages = averages.loc[sorted(averages.groupby("body", sort=False)["delta"].idxmin().dropna())]
    varying = [c for c in _COLUMNS if c != "variant" or averages[c].nunique() > 1]
    names = [c for c in varying if c in averages and not averages[c].isna().all()][:_WIDE]
    said = "The best of each scene. " if best else ""
    files = [chart.files[-1] for chart in charts]
    first = next((file for file in files if file.startswith("delta-over")), files[0] if files else "")
    return {
        "name": name,
        "title": reports.question(name).title,
        "table": table.rows_of(averages, names),
        "said": f"{said}{' '.join(report.findings(frame)[:1])}",
        "chart": first,
        "more": [file for file in [*files, *(p.files[-1] for p in reports.drawn(name))] if file != first],
        "made": _made(reports, name),
    }


def _made(reports: Reports, name: str) -> str:
    """How many runs, on what, at which scale and commit."""
    rows = reports.rows(name)
    runs = [reports.runs.get(run, {}) for run in rows["run"].unique()]
    scales = " and ".join(sorted({str(run["scale"]) for run in runs if run.get("scale")}))
    commits = ", ".join(sorted({report.commit_text(run) for run in runs}))
    devices = sorted({re.sub(r"^NVIDIA | \d+GB.*", "", device) for device in rows["device"]})
    return f"{len(runs)} run{'s' * (len(runs) > 1)}, {scales} scale, {', '.join(devices)}, {commits}"


def _place(name: str) -> tuple[int, str, int, str]:
    """Number and heading of a report's chapter, its place in there, and its name."""
    whole = name.removesuffix("_small")
    for number, (heading, names) in enumerate(CHAPTERS.items()):
        for known in (whole, whole.partition("/")[0]):
            if known in names:
                return number, heading, names.index(known), name
    return len(CHAPTERS) - 1, list(CHAPTERS)[-1], 0, name


def _read(path: Path, schema: Mapping) -> dict:
    try:
        return schemas.read(path, schema)
    except SchemaError as error:
        raise SchemaError(f"{path.parent}: {error}; write the report again, or take it from git") from error


def _listed(folder: Path) -> Iterator[Path]:
    """Marks of reports that have files of their own, as of inverse problems."""
    for mark in not_ignored(sorted(folder.rglob(MARK))):
        if "listed" in _read(mark, _MARK):
            yield mark


def _listed_section(mark: Path) -> dict:
    """What the page says of a report with files of its own: what it says itself."""
    content = _read(mark, _MARK)
    rows = content["listed"]
    wide = [text[:_WIDE] for text in rows["body"]]
    return {
        "name": mark.parent.name,
        "title": content["title"],
        "table": Rows(rows["headings"][:_WIDE], wide, rows["numeric"][:_WIDE]),
        "said": "",
        "chart": (content.get("chart") or {}).get("file", ""),
        "more": [LIST],
        "made": rows["made"].rstrip("."),
    }


def _changed(folder: Path) -> list[str]:
    """Files of such a report that are not those whose hashes it holds."""
    known = _read(folder / MARK, _MARK).get("files", {})
    there = {path.name: file_hash(path) for path in sorted(folder.iterdir()) if path.name != MARK}
    missing = {name for name in known.keys() - there.keys() if not name.endswith(_MADE_ANEW)}
    changed = {name for name in known.keys() & there.keys() if known[name] != there[name]}
    return [
        *(f"{folder / name} is missing; {_REBUILD}" for name in sorted(missing)),
        *(f"{folder / name} was changed; {_REBUILD}" for name in sorted(changed)),
    ]


def _benches(folder: Path) -> list[Path]:
    """Folders that `nsf bench` wrote."""
    return [mark.parent for mark in not_ignored(sorted(folder.glob("*/bench.csv")))]


def _bench(folder: Path) -> dict:
    """What the page says of benchmarks: their title and first chart."""
    text = (folder / LIST).read_text(encoding="utf-8")
    chart = re.search(r"^!\[.*\]\(([\w-]+\.png)\)$", text, re.MULTILINE)
    rows = table.parsed(folder / "bench.csv", ())
    devices, commits = (", ".join(sorted(rows[name].astype(str).unique())) for name in ("device", "commit"))
    return {
        "name": folder.name,
        "title": html.unescape(text.partition("\n")[0].removeprefix("# ")),
        "table": None,
        "said": "",
        "chart": chart[1] if chart else "",
        "more": [LIST],
        "made": f"{len(rows)} rows, {devices}, {commits}",
    }
