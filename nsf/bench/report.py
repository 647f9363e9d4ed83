"""The report of all benchmarks: tables, and charts beside the floor that the memory sets."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nsf.bench.rows import FILE, WIDE, read, size_name
from nsf.results.charts.costs import bars
from nsf.results.columns import axis, number
from nsf.results.formats import Rows, TerminalTable, markdown_document
from nsf.results.style import (
    DASHES,
    FULL,
    INK,
    band,
    figure,
    legend,
    line_style,
    model_color,
    plain_ticks,
    save,
    styled,
)
from nsf.storage import write_text

_LEAD = (
    "Time of a step, both sides of a ratio measured in one process turn by turn, after a warm-up, around a "
    "synchronised device: the median over the trials, each the mean of many steps, with 10 and 90 % of them. "
    "Memory is the peak of every allocator beyond what was held before the solver was built. "
    f"`nsf bench` writes this report from {FILE}."
)
_WHOLE = (
    "Whole runs from t = 0, all sides of a scene turn by turn: the run by recurrence has its error bounded "
    "and every frame decoded in fp32, the others leave their states on the device. The grid of `coarse` is "
    "twice as coarse. Error: of the displacements of all particles over five frames, beside those of the "
    "full-order run in the highest precision measured; error bar: what `nsf deploy` says of that run, which "
    "the error exceeds in one run of ten. First frame: from the files of a deployed model, nothing compiled "
    "anew. The model is trained and taught quickly, with fewer runs and steps than by default."
)
_REDUCED = "Time of a step of both solvers by scene; a point names δ of its run, at the first held-out value."
_STAGES = (
    "Where the time of a reduced step goes, by events within the captured step, which take a little time of "
    "their own; what of the inversion is prepared on another stream counts where the step waits for it. "
    "Beside it a frame of the paper's reduced solver on a Quadro P6000 (its appendix, Runtime analysis)."
)
_FLOORS = (
    "Passes of a reduced step within the captured step, beside the time that a copy takes for the modes and "
    "the state of the particles that a step needs, each value once, which bounds what does not fit into a "
    "cache, and that of empty launches, as many as a step has passes that wait for each other."
)
_TRAINING = (
    "Training of all networks of a scene with field=basis: the time is that of a whole training, from "
    "opening its files to the manifold, and the trials are seeds."
)
_RECURRENCE = (
    "Time of a step of one of many runs by the recurrence at once: all steps of all runs are one launch, "
    "over their number. A run holds no particles but S."
)
_BATCH = (
    "Time of a simulation-step, which is the step of a batch over the simulations that take it together, by "
    "their number; the band is from 10 % to 90 % of the trials. Dotted: half the time for twice as many."
)
_SIZES = (
    "Time of a step over the number of particles; dashed: the floor that the bandwidth sets a full-order "
    "step. `full_order`: a block of sand on the paper's grid. `scaling`: the sand column, whose reduced runs "
    "evaluate one training's fields at every number of particles, and have as many samples at each."
)
_SAMPLES = (
    "Time of a reduced step of the sand column over the number of sample particles, beside the full-order "
    "step of the same scene; a mark names δ of its run."
)
_PASSES = (
    "Each pass of a full-order step on its own; the mark is its floor. Moved: the bytes it has to read and "
    "write, each value once. Floor: the time that these bytes take a copy measured in the same run; a step "
    "cannot be faster than the floors of its passes together as long as its state does not fit into a cache."
)
_PEERS = (
    "A full-order step written in Taichi, beside ours: the same law, particles, grid and Δt, and the same "
    "positions to round-off. It is a plain program on the nodes around the body. On a CPU ours has one core; "
    "`nsf simulate` takes runs side by side on all of them."
)
#: Of a reduced frame [ms]: the networks, the projection and copies between Warp and torch, and all of it
#: (appendix of the paper, Runtime analysis; double precision, one Quadro P6000).
_PAPER = {"reduced_cake": (1.95, 4.69), "reduced_metal": (1.78, 2.09)}
_KEY = ["bench", "case", "particles", "sample", "integration", "batch", "precision", "part", "commit"]
_HEADINGS = {"sample": "|S|", "integration": "|N|", "part": "pass"}
_OF_SAMPLE = r"_s\d+$"  # a case of one of several numbers of samples


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        text: over the table.
        chosen: of a device's rows, those of the table.
        chart: stem of the picture; draw: device's rows → figure.
        listed: whether there is a table.
    """

    text: str
    chosen: Callable[[pd.DataFrame], pd.Series]
    chart: str = ""
    draw: Callable[[pd.DataFrame], Figure] | None = None
    listed: bool = True


def write_report(folder: Path) -> Path:
    """Charts and index.md from the table of a folder."""
    frame = read(folder / FILE)
    devices = {device: _parts(folder, rows) for device, rows in frame.groupby("device", sort=False)}
    return write_text(folder / "index.md", markdown_document("speed.md", lead=_LEAD, devices=devices))


def _parts(folder: Path, rows: pd.DataFrame) -> list[dict]:
    """The page's parts on one device: charts, their captions, and tables, each where it has rows."""
    device, parts = re.sub("[^a-z0-9]+", "-", rows["device"].iloc[0].lower()), []
    for section in SECTIONS:
        chosen = rows[section.chosen(rows)]
        if not len(chosen):
            continue
        chart = section.chart and f"{section.chart}-{device}"
        if section.draw:
            save(section.draw(rows), folder, chart, kinds=("png",))
        constant, table = _rows(chosen)
        texts = [section.text, *([constant] if section.listed and constant else []), *_spread_widely(chosen)]
        parts.append({"chart": chart, "texts": texts, "table": table if section.listed else None})
    return parts


def _spread_widely(rows: pd.DataFrame) -> list[str]:
    """A warning that names the cases whose trials spread widely; none where there are none."""
    wide = rows[rows["p90"] > WIDE * rows["p10"]]
    names = dict.fromkeys(wide["case"] + " " + wide["precision"])
    return [f"Trials of {', '.join(names)} spread by more than {WIDE:g} times: measure again."] * bool(names)


def wide(rows: pd.DataFrame) -> pd.DataFrame:
    """A row a subject and part, a column a figure with its unit, quantiles after it where there are any."""
    body = []
    for key, part in rows.groupby(_KEY, sort=False, dropna=False):
        row = dict(zip(_KEY, key, strict=True))
        for what, unit, *values in part[["what", "unit", "median", "p10", "p90"]].itertuples(index=False):
            named = dict(zip(("", ", 10 %", ", 90 %"), values, strict=True))
            row |= {axis(what + end, unit.replace("1", "")): v for end, v in named.items() if not pd.isna(v)}
        if row.get("moved [MiB]"):
            row["bandwidth [GB/s]"] = row["moved [MiB]"] * 2**20 / row["time [ms]"] / 1e6
        body.append(row)
    return pd.DataFrame(body)


def table(path: Path) -> TerminalTable:
    """The whole steps of a table for a terminal."""
    rows = read(path)
    constant, whole = _rows(rows[rows["part"] == ""].assign(commit=""))
    return TerminalTable(whole, constant)


def _rows(rows: pd.DataFrame) -> tuple[str, Rows]:
    """Columns that do not vary in a sentence, and the others as a table."""
    frame = wide(rows).replace("", np.nan).dropna(axis=1, how="all")
    same = [name for name in frame.columns[: len(_KEY)] if name in _KEY and frame[name].nunique() == 1]
    same = [name for name in same if name != "case" and frame[name].notna().all()]
    said = ", ".join(f"{_HEADINGS.get(name, name)} {number(frame[name].iloc[0])}" for name in same)
    frame = frame.drop(columns=same)
    body = [[number(value) for value in row] for row in frame.itertuples(index=False, name=None)]
    headings = [_HEADINGS.get(name, name) for name in frame]
    return f"All: {said}." if said else "", Rows(headings, body, [_is_number(frame[c]) for c in frame])


def _is_number(values: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(values)


# -- charts ---------------------------------------------------------------------------------------------


def steps_over(
    rows: pd.DataFrame, x: str, label: str, by: Iterable[tuple[str, pd.DataFrame]], y: str = "a step"
) -> tuple[Figure, Axes]:
    """Time [ms] over a size, both axes logarithmic: a line a group with a band of 10 to 90 % of the trials.

    Args:
        rows: all that are drawn, whose sizes are ticks where there are few.
        x: column of the size; label: of its axis.
        by: label and rows of each line.
        y: what takes the time.
    """
    fig = figure(4.4)
    panel = fig.subplots()
    panel.set(xscale="log", yscale="log", xlabel=label, ylabel=f"time of {y} [ms]")
    by = list(by)
    for (name, part), line in zip(by, _lines([name for name, _ in by]), strict=True):
        part, style = part.sort_values(x), {"marker": "o", "ms": 4.5, "label": name, **line}
        band(panel, part[x], part["median"], part["p10"], part["p90"], **style)
    plain_ticks(panel.yaxis)
    sizes = sorted(rows[x].unique())
    if len(sizes) < 8:
        panel.set_xticks(sizes, [size_name(round(size)) for size in sizes])
        panel.minorticks_off()
    else:
        plain_ticks(panel.xaxis, lambda count: size_name(round(count)))
    panel.grid(which="major")
    return fig, panel


def _lines(names: list[str]) -> list[dict]:
    """Colour and dash of lines: shades of the colour of their solver where their names begin with one."""
    solvers = {"reduced": "projected", "full-order": "full"}
    of = [next((model for start, model in solvers.items() if name.startswith(start)), "") for name in names]
    if not all(of):
        return [line_style(i) for i in range(len(names))]
    return [
        {"color": model_color(model, of[:i].count(model), of.count(model)), "ls": DASHES[i % 2]}
        for i, model in enumerate(of)
    ]


def step_over_particles(rows: pd.DataFrame) -> Figure:
    """A line for each kind of solver and precision, and the floors of a full-order step's passes."""
    steps = rows[_sizes(rows) & (rows["what"] == "step")]
    kind = steps["case"].str.rpartition("_")[0].str.replace("_", "-")
    kind += steps["bench"].eq("full_order").map({True: " of a block", False: ""})
    groups = steps.groupby([kind, "precision"], sort=False)
    floors = rows[_passes(rows) & (rows["what"] == "floor")]
    with styled():
        fig, panel = steps_over(
            steps, "particles", "particles P [–]", ((f"{k}, {p}", part) for (k, p), part in groups)
        )
        for i, (precision, part) in enumerate(floors.groupby("precision")):
            floor = part.groupby(["bench", "particles"])["median"].sum().groupby("particles").mean()
            name, dashes = f"full-order floor, {precision}", (0, (5, 2))
            panel.plot(floor.index, floor, ls=dashes, lw=1.2, label=name, color=(INK, "#888888")[i])
        legend(fig)
    return fig


def step_over_sample(rows: pd.DataFrame) -> Figure:
    """A line a precision over |S|, δ at each point, and the full-order step of as many particles."""
    chosen = rows[_samples(rows)]
    steps, deltas = chosen[chosen["what"] == "step"], chosen[chosen["what"] == "δ"]
    full = rows[(rows["bench"] == "scaling") & rows["case"].str.startswith("full_order")]
    full = full[(full["what"] == "step") & full["particles"].isin(chosen["particles"])]
    groups = steps.groupby("precision")
    with styled():
        fig, panel = steps_over(
            steps, "sample", "sample particles |S| [–]", ((f"reduced, {p}", part) for p, part in groups)
        )
        for i, (precision, part) in enumerate(groups):
            color, gray = (model_color(model, i, len(groups)) for model in ("projected", "full"))
            both = part.merge(deltas, on=["case", "precision"])
            for at, ms, delta in zip(both["sample_x"], both["median_x"], both["median_y"], strict=True):
                panel.annotate(
                    f"{number(100 * delta)} %", (at, ms), (0, 9 - 24 * (i == 0)), ha="center",
                    textcoords="offset points", fontsize=8.5, color=color,
                )  # fmt: skip
            for ms in full.loc[full["precision"] == precision, "median"]:
                panel.axhline(ms, ls=":", lw=1.6, color=gray, label=f"full-order, {precision}")
        legend(fig)
    return fig


def step_over_batch(rows: pd.DataFrame) -> Figure:
    """A line for each body, end of the case and precision; dotted, half the time for twice as many."""
    steps = rows[(rows["bench"] == "batch") & (rows["what"] == "step")]
    ends = steps["case"].str.extract(r"\d+(.*)$")[0].str.replace("_", ", ")
    groups = list(steps.groupby(["particles", ends, "precision"]))
    named = ((f"{size_name(count)} particles{end}, {p}", part) for (count, end, p), part in groups)
    with styled():
        fig, panel = steps_over(steps, "batch", "simulations B [–]", named, "a simulation-step")
        for i, (_, part) in enumerate(groups):
            part = part.sort_values("batch")
            shared = part["median"].iloc[0] * part["batch"].iloc[0] / part["batch"]
            panel.plot(part["batch"], shared, ls=":", lw=1.2, color=line_style(i)["color"])
        legend(fig)
    return fig


def steps_by_scene(rows: pd.DataFrame) -> Figure:
    """Time of a step [ms] of either solver, a point each with its δ, a panel a scene."""
    chosen = rows[(rows["bench"] == "reduced") & (rows["part"] == "")]
    steps = chosen[chosen["what"] == "step"]
    deltas = chosen[chosen["what"] == "δ"].set_index(["case", "precision"])["median"]
    scene = steps["case"].str.extract(r"^(?:full_order|reduced)_([^_]+(?:_cube)?)")[0]
    panels_of = list(steps.groupby(scene, sort=False))
    with styled():
        fig = figure(1.2 + 0.3 * max(len(part) for _, part in panels_of))
        for panel, (name, part) in zip(
            fig.subplots(1, len(panels_of), squeeze=False)[0], panels_of, strict=True
        ):
            at, median = np.arange(len(part)), part["median"].to_numpy()
            full = part["case"].str.startswith("full_order")
            panel.scatter(median, at, s=42, color=np.where(full, FULL, model_color("projected")))
            for y, (case, precision, ms) in enumerate(part[["case", "precision", "median"]].to_numpy()):
                delta = deltas.get((case, precision))
                text = number(ms) if delta is None else f"{number(ms)}, δ {number(100 * delta)} %"
                place = {"xytext": (9, 0), "textcoords": "offset points", "va": "center_baseline"}
                panel.annotate(text, (ms, y), fontsize=8.5, color=INK, **place)
            kinds = part["case"].str.replace(f"_{name}", "").str.replace("_", " ")
            panel.set_yticks(at, kinds + ", " + part["precision"])
            panel.set_ylim(len(part) - 0.5, -0.5)
            low, high = median.min(), median.max()
            panel.set(xscale="log", title=name, xlabel="time of a step [ms]")
            panel.set_xlim(low / (high / low) ** 0.1, high * (high / low) ** 0.75 * 1.5)
            panel.xaxis.set_major_formatter("{x:g}")
            panel.grid()
    return fig


def passes_beside_floor(rows: pd.DataFrame) -> Figure:
    """The passes of a full-order step of the largest case."""
    chosen = rows[_passes(rows)]
    chosen = chosen[chosen["particles"] == chosen["particles"].max()]
    times, floors = {}, {}
    for (case, precision), part in chosen.groupby(["case", "precision"]):
        for chosen, what in ((times, "time"), (floors, "floor")):
            values = part[part["what"] == what].set_index("part")["median"]
            chosen[f"{case}, {precision}"] = values[~values.index.duplicated(keep="last")]
    return bars(times, floors)


def step_beside_paper(rows: pd.DataFrame) -> Figure:
    """The stages of a reduced step and those of the paper's frame, a scene each; in fp64 if measured."""
    panels = {}
    for case, stages in rows[_paper(rows)].groupby("case"):
        precision, (networks, whole) = stages["precision"].max(), _PAPER[case]
        stages, scene = stages[stages["precision"] == precision], case.partition("_")[2]
        panels[f"{scene}, {precision}"] = stages.set_index("part")["median"]
        paper = {"networks, projection, copies": networks, "MPM": whole - networks}
        panels[f"{scene}, the paper"] = pd.Series(paper)
    return bars(panels)


# -- parts of the page ----------------------------------------------------------------------------------


def _of_bench(name: str) -> Callable[[pd.DataFrame], pd.Series]:
    return lambda rows: (rows["bench"] == name) & (rows["part"] == "")


def _paper(rows: pd.DataFrame) -> pd.Series:
    return rows["case"].isin(_PAPER) & (rows["what"] == "stage")


def _floors(rows: pd.DataFrame) -> pd.Series:
    return (rows["bench"] == "reduced") & rows["what"].isin(["time", "moved", "floor"])


def _passes(rows: pd.DataFrame) -> pd.Series:
    return rows["bench"].isin(["full_order", "scaling"]) & (rows["part"] != "")


def _samples(rows: pd.DataFrame) -> pd.Series:
    return _of_bench("scaling")(rows) & rows["case"].str.contains(_OF_SAMPLE)


def _sizes(rows: pd.DataFrame) -> pd.Series:
    whole = rows["bench"].isin(["full_order", "scaling"]) & (rows["part"] == "")
    return whole & ~rows["case"].str.contains(_OF_SAMPLE)


SECTIONS = (
    Section(_WHOLE, _of_bench("whole")),
    Section(_REDUCED, _of_bench("reduced"), "reduced", steps_by_scene),
    Section(_STAGES, _paper, "stages", step_beside_paper, listed=False),
    Section(_FLOORS, _floors),
    Section(_TRAINING, _of_bench("training")),
    Section(_RECURRENCE, _of_bench("recurrence")),
    Section(_BATCH, _of_bench("batch"), "batch", step_over_batch),
    Section(_SIZES, _sizes, "step", step_over_particles),
    Section(_SAMPLES, _samples, "sample", step_over_sample),
    Section(_PASSES, _passes, "kernels", passes_beside_floor),
    Section(_PEERS, _of_bench("peers")),
)
