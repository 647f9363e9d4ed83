"""A report: the table of some runs, a question, charts and pictures, on one page.

A report is a folder with `index.html`, `index.md`, `results.csv` (the table), `results.tex` (means, with
booktabs), charts and pictures, and `sources.json`: the origin of each run, and the sha256 of each file.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.errors import ConfigError
from nsf.manifest import digest
from nsf.progress import Progress
from nsf.results import table
from nsf.results.averages import SAID_ONCE, averaged, constants, rows_of, where_rivals_win, with_intervals
from nsf.results.charts import CHARTS, View
from nsf.results.charts.bounds import BAD, GOOD, judged, promise
from nsf.results.charts.cases import COLORS
from nsf.results.columns import (
    ABSENT,
    COLUMNS,
    DERIVED,
    QUANTITIES,
    RIVALS,
    SEEDS,
)
from nsf.results.folder import record, replaced
from nsf.results.formats import Rows, latex_table, spreadsheet
from nsf.results.page import Page, Picture, Section, Table
from nsf.results.question import Question, made_of
from nsf.results.sources import KEPT, Source, open_sources
from nsf.results.style import save
from nsf.results.verdict import verdict
from nsf.runs import Run
from nsf.runs.columns import differing
from nsf.runs.listing import Entry

_IDENTITY = (
    *("scene", "material", "model", "stress", "affine", "field", "r", "particles", "case"),
    *("seed", "setting", "split", "precision", "device"),
)
_MEANS = (
    *("body", "variant", "case", "cases", "diverged", "displacement_error", "displacement_worst"),
    *("stress_error", *RIVALS, "paper_delta", "delta", "delta_interval", "delta_static"),
    *("gamma", "sample", "integration_share", "step_ms_full", "step_ms", "total_ms", "decode_ms"),
    *("speedup_step", "speedup_total", "speedup_decoded", "memory_full_mib", "memory_mib"),
    *("train_seconds", "teach_seconds", "ready_seconds", "break_even_runs", "fallback_share"),
)
_EACH = (
    *("body", "variant", "seed", "sampler.seed", "case", "displacement_error", "stress_error", "delta"),
    *("error_bound", "flag", "flag_reason", "distance", "distance_max", "fallback_share", *QUANTITIES),
)
_PASSING = ("evaluation.", "data.", "super_resolution.", "report.")  # keys that tell no models apart
_OF_COLUMNS = ("case", "latent_dim", "model", "stress", "affine", "field", "seed", "precision", "device")
_MOST = 3  # keys by which runs without an experiment are told apart
_FEW = 5  # runs from which shares of them say anything
_FINE = "superresolution.csv"
_NOTE = (
    "results.csv holds every row in full precision with its run; sources.json names the origin of "
    "each run and the hash of each file; results.tex is the first table."
)


def build_report(
    runs: Iterable[Run], folder: Path, question: Question, first: Run | None = None, films: bool = True
) -> Path:
    """Write a report of evaluate runs to a folder, in place of a report that is there, and give its page.

    Equal runs give equal files, byte for byte. The folder changes only once everything is written.

    Args:
        runs: evaluate runs; those not complete are passed over.
        folder: where the report goes.
        question: what it is about.
        first: the run that stands for its row where several are of one; else the newest.
        films: whether bodies are drawn in motion, too.

    Raises:
        MissingRunError: no run is complete.
        SchemaError: a run's file is missing, altered since the run, or lacks a column.
        ConfigError: folder holds something that is not a report.
        StorageError: the disk refused a file.
    """
    from nsf.results import pictures

    if unknown := [name for name in question.plots or () if name not in CHARTS]:
        raise ConfigError(f"plots={unknown[0]} is no chart; choose of {', '.join(CHARTS)}")
    runs = list(runs)
    sources = open_sources(runs, first)
    frame = rows_of_runs(sources, question)
    with replaced(Path(folder)) as fresh:
        table.write(table.with_settings(frame), fresh / "results.csv")
        view = view_of(frame, sources)
        bodies = len(list(pictures.best(view.frame)))
        with Progress("report", len(_named(question.plots)) + bodies, "pictures") as progress:
            sections = [
                Section("Charts", draw(view, fresh, question.plots, progress.advance)),
                *pictures.sections(view.frame, sources, fresh, question, films, progress.advance),
            ]
        fine = _fine_tables(view.frame, question, fresh)
        runs_of = origins(sources) | _fine_origins(view.frame, question)
        write_pages(question, fresh, sections, runs_of, view, fine, _warnings(sources))
        shown = [picture for section in sections for picture in section.pictures]
        content = {
            "made_of": made_of(runs, question, first),
            "title": question.title,
            "question": question.text,
            "paper": question.paper,
            "missing": list(question.missing),
            "plots": question.plots and list(question.plots),
            "runs": runs_of,
            "trained": view.trained,
            "logarithmic": sorted(view.logarithmic),
            "pictures": {p.files[-1]: {"caption": p.caption, "runs": list(p.runs)} for p in shown},
        }
        record(fresh, content)
    return Path(folder) / "index.html"


def rows_of_runs(sources: Sequence[Source], question: Question) -> pd.DataFrame:
    """The table of some runs, newest first; of a row that several runs have, the first one's.

    Args:
        sources: the runs.
        question: names the report, what the paper prints, and what tells its runs apart.
    """
    settings = question.settings or told_apart(sources)
    jobs = {source.id: question.keys.get(source.id, {}) for source in sources}
    parts = [
        source.rows.assign(
            report=question.name,
            run=source.id,
            setting=table.setting(settings.get(source.id, {})),
            paper_delta=[
                printed(row, source, question, jobs[source.id]) for row in source.rows.to_dict("records")
            ],
        )
        for source in sources
    ]
    frame = pd.concat(parts, ignore_index=True)
    frame = frame[~frame[list(_IDENTITY)].astype(str).duplicated()].reset_index(drop=True)
    order = table.labelled(frame).index
    return frame.loc[[*order, *frame.index.difference(order)]].reset_index(drop=True)


def printed(row: Mapping, source: Source, question: Question, job: Mapping[str, str]) -> float:
    """δ that the paper prints of a row, a fraction; NaN where it prints none.

    Without entries of the question's own, what the scene's file says holds at its r, and at its number of
    sample particles where the job sets one.
    """
    if question.printed is not None:
        values = {name: str(value) for name, value in {**row, **job}.items()}
        values["parameter"] = f"{row['value']:g}"
        fits = [e for e in question.printed if all(values.get(k, "null") == e[k] for k in e if k != "delta")]
        return fits[0]["delta"] if fits else math.nan
    name = {("field", "field"): "nsf", ("deformation", "none"): "deformation_only"}
    paper = source.summary.get("paper") or {}
    stated = paper.get(name.get((row["stress"], row["affine"]), ""), {})
    same, size = stated.get("r", row["r"]) == row["r"], job.get("sampler.size", "null")
    same &= size in ("null", str(stated.get("sample", size)))
    return stated.get("delta", math.nan) if same else math.nan


def told_apart(sources: Sequence[Source]) -> dict[str, dict[str, str]]:
    """By run id, the keys in which runs without an experiment differ, but for those that columns say."""
    cache: dict = {}
    entries = [Entry(source.run, cache) for source in sources]
    keys = [key for key in differing(entries) if key not in _OF_COLUMNS and not key.startswith(_PASSING)]
    return {
        entry.run.id: {
            key: str(value) for key in keys[:_MOST] if (value := entry.settings.get(key)) is not None
        }
        for entry in entries
    }


def view_of(frame: pd.DataFrame, sources: Sequence[Source] = ()) -> View:
    """A table as charts see it, with series and stages of the runs that are there."""
    frame = table.labelled(frame)
    opened = {source.id: source for source in sources}
    parts, stages, trained = [], {}, {}
    for run, rows in frame.groupby("run", sort=False):
        if run not in opened:
            continue
        source = opened[run]
        names = rows.drop_duplicates("case").set_index("case")[["run", "body", "variant", "model_name"]]
        parts.append(source.series.join(names, on="case", how="inner"))
        measured, row = source.cost.get("breakdown", {}), rows.iloc[0]
        stages[f"{row['body']} · {row['variant']}"] = measured.get("reduced", {})
        stages["full order"] = measured.get("full_order", {})
        trained.setdefault(row["scene"], source.training_cases)
    logarithmic = frozenset().union(*(source.logarithmic for source in sources))
    series = pd.concat(parts, ignore_index=True) if parts else None
    return View(frame, series, stages, trained, logarithmic)


def _named(plots: Sequence[str] | None) -> list[str]:
    """The charts that are named, or all, in order."""
    return [name for name in CHARTS if plots is None or name in plots]


def figures(
    view: View, plots: Sequence[str] | None, advance: Callable[[], object] = lambda: None
) -> Iterator[tuple[str, str, Figure]]:
    """File stem, caption and figure of the charts that are named, or of all; counts each chart."""
    for name in _named(plots):
        for stem, figure in CHARTS[name].draw(view).items():
            yield stem, CHARTS[name].caption, figure
        advance()


def draw(
    view: View, folder: Path, plots: Sequence[str] | None, advance: Callable[[], object] = lambda: None
) -> list[Picture]:
    """Charts as SVG and PNG in a folder, with their captions and runs; counts each chart."""
    runs = sorted(set(view.frame["run"]) - {""})
    return [
        Picture(save(figure, folder, stem, ramps=[COLORS]), caption, runs)
        for stem, caption, figure in figures(view, plots, advance)
    ]


def write_pages(
    question: Question,
    folder: Path,
    sections: Sequence[Section],
    runs: Mapping[str, Mapping],
    view: View,
    more: Sequence[Table] = (),
    warnings: Sequence[str] = (),
) -> None:
    """Write `index.html`, `index.md` and `results.tex` of a report.

    Args:
        question, sections: what it is about, and its pictures.
        runs: the origin of each run, by id.
        view: of the table.
        more: tables after the first.
        warnings: of its simulations.
    """
    averages = with_intervals(averaged(view.frame), view.frame)
    names = [name for name in _MEANS if name not in ("variant", "body") or averages[name].nunique() > 1]
    shown = rows_of(averages, [name for name in names if name != "case" or "case" in averages])
    once = constants(view.frame, (*SAID_ONCE, "body"))
    said = ", ".join(f"{title} {text}" for title, text in once.items())
    first = Table("Results", shown, " ".join([_averages_of(view.frame), *findings(view)]))
    each = rows_of(view.frame, _EACH)
    headings = {*shown.headings, *each.headings, *(name for one in more for name in one.content.headings)}
    used = [name for name, column in {**COLUMNS, **DERIVED}.items() if column.heading in headings]
    page = Page(
        title=question.title,
        lead=question.text,
        facts=[
            *([("The paper", question.paper)] if question.paper else []),
            *(("Missing", missing) for missing in question.missing),
            *([("The same in every row", said)] if said else []),
            *_facts(view.frame),
        ],
        warnings=list(warnings),
        tables=[first, *more, *_bounds(view.frame), Table("Each case", each, "")],
        sections=[section for section in sections if section.pictures],
        provenance=Table("Where the numbers come from", provenance_rows(runs), _NOTE),
        definitions=definitions(used),
        answers=verdict(view.frame),
    )
    page.write(folder)
    tex = latex_table(shown, question.title, first.note)
    (folder / "results.tex").write_text(tex, encoding="utf-8")


def _fine_tables(frame: pd.DataFrame, question: Question, folder: Path) -> list[Table]:
    """The table of superresolve runs, in full in `superresolution.csv`; none without such runs."""
    parts = []
    for of, run in question.fine.items():
        rows = frame[frame["run"] == of]
        if len(rows):
            head = {name: rows[name].iloc[0] for name in ("body", "variant")} | {"run": run.id}
            path = run.file(_FINE)
            parts.append(table.numbers(table.parsed(path, ("case",)), path, ("case",)).assign(**head))
    if not parts:
        return []
    fine = pd.concat(parts, ignore_index=True)
    fine = fine[["body", "variant", *(name for name in fine if name not in ("body", "variant"))]]
    fine.map(spreadsheet).to_csv(folder / _FINE, index=False)
    shown = [name for name in fine if name in COLUMNS or name in DERIVED]
    note = "The fields at the points, beside a full-order run of as many particles on the same grid."
    return [Table("At many more points", rows_of(fine, [n for n in shown if n != "run"]), note)]


def findings(view: View) -> list[str]:
    """Sentences: where δ is below the paper's, where rivals win, and how many runs diverged."""
    averages, frame, sentences = view.averages, view.frame, []
    compared = averages.dropna(subset="paper_delta")
    compared = compared[compared["stress"].ne("deformation")]
    if len(compared):
        below = int((compared["delta"] < compared["paper_delta"]).sum())
        sentences.append(f"δ is below the paper's in {below} of {len(compared)} rows.")
    if won := where_rivals_win(averages):
        sentences.append(won)
    if lost := int(np.isinf(frame["delta"]).sum()):
        sentences.append(f"∞: {lost} of {len(frame)} runs diverged.")
    return sentences


def definitions(names: Iterable[str]) -> list[tuple[str, str]]:
    """Title and meaning of columns."""
    columns = [(COLUMNS | DERIVED)[name] for name in dict.fromkeys(names)]
    return [(column.title, column.meaning) for column in columns if column.meaning]


def origins(sources: Iterable[Source]) -> dict[str, dict]:
    """By run id, where and from what code each run was made, and the hashes of its files."""
    ordered = sorted(sources, key=lambda source: (source.created, source.id), reverse=True)
    return {
        source.id: {key: source.manifest.get(key) for key in KEPT}
        | {"scale": source.summary.get("scale"), "files": source.hashes}
        for source in ordered
    }


def _fine_origins(frame: pd.DataFrame, question: Question) -> dict[str, dict]:
    """The same of superresolve runs."""
    shown = [run for of, run in question.fine.items() if of in set(frame["run"])]
    return {
        run.id: {key: run.manifest.get(key) for key in KEPT} | {"files": {_FINE: digest(run.file(_FINE))}}
        for run in shown
    }


def provenance_rows(runs: Mapping[str, Mapping]) -> Rows:
    """A row a run: commit, device, precision, seed, time and versions."""
    body = []
    for run, origin in runs.items():
        versions = ", ".join(f"{name} {of}" for name, of in (origin.get("versions") or {}).items() if of)
        cells = [origin.get(key) for key in ("device", "precision", "seed", "created")]
        cells = [ABSENT if cell is None else str(cell) for cell in cells]
        body.append([run, commit_text(origin), *cells, versions or ABSENT])
    headings = ["run", "commit", "device", "precision", "seed", "made", "versions"]
    return Rows(headings, body, [False] * len(headings))


def commit_text(origin: Mapping) -> str:
    """The commit a run was made at, or nsf's version; says so where the tree had uncommitted changes."""
    if not origin.get("commit"):
        return f"nsf {(origin.get('versions') or {}).get('nsf') or '(version unknown)'}"
    commit = str(origin["commit"])[:12]
    if origin.get("dirty") is None:
        return f"{commit} (tree unknown)"
    return f"{commit} + uncommitted changes" if origin["dirty"] else commit


def _facts(frame: pd.DataFrame) -> list[tuple[str, str]]:
    """The cases of each body, and its particles."""
    facts = []
    for body, rows in frame.groupby("body", sort=False):
        cases = list(dict.fromkeys(rows["case"]))
        listed = "; ".join(cases[:8]) + (f"; … {len(cases)} in all" if len(cases) > 8 else "")
        particles = ", ".join(f"{count:,.0f}" for count in sorted(rows["particles"].dropna().unique()))
        facts.append((str(body), f"{' and '.join(rows['split'].unique())} {listed}; {particles} particles"))
    return facts


def _averages_of(frame: pd.DataFrame) -> str:
    """Over which cases and seeds the first table averages, in a sentence."""
    seeds = any(name in frame and frame[name].nunique() > 1 for name in SEEDS)
    splits = " and ".join(frame["split"].unique())
    return (
        f"Means over {splits} cases{' and seeds (± their standard deviation)' if seeds else ', of one seed'}."
    )


def _bounds(frame: pd.DataFrame) -> list[Table]:
    """Whether error bounds held, a row a body and model; none of few runs."""
    if len(judged(frame)) < _FEW:
        return []
    off = f"more than {100 * BAD:.0f} % off; false alarms: red, and less than {100 * GOOD:.0f} % off."
    note = f"Missed: green, and {off}"
    return [Table("Error bounds", rows_of(promise(frame), list(promise(frame))), note)]


def _warnings(sources: Sequence[Source]) -> list[str]:
    return list(dict.fromkeys(line for source in sources for line in source.warnings))
