"""The charts of a report: each is one function of its table.

A chart takes a `View` and gives figures by the name of their file, or none where the table holds nothing of
its kind. A new one is one function below `@chart(caption)`; pages, `nsf reports` and `plots` of an
experiment's yaml know it by its name from then on.
"""

import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nsf.results.columns import COLUMNS, RIVALS, SEEDS, axis, column, number
from nsf.results.formats import file_name
from nsf.results.scales import LOST, error_scale, plain_ticks, set_apart
from nsf.results.style import (
    FULL,
    INK,
    MUTED,
    PALETTE,
    PAPER,
    REDUCED,
    STAGE_TITLES,
    figure,
    legend_above,
    line_style,
    stage_colors,
    styled,
)
from nsf.results.table import means, parameter, variants

Figures = Mapping[str, Figure]
_ACROSS = 4  # panels in a row
_LINE = 60  # letters of a label beside a chart, in a line
_MARKERS = "o^vDsP"
_LINES = ((0, (6, 2)), (0, (2, 1.5)), (0, (1, 3)))
_COARSE = {"color": FULL, "marker": "s", "mfc": "white", "mew": 1.6, "ls": ""}
_OVER_TIME = (
    *("delta", "displacement_error", "stress_error"),
    *("linear_momentum_error", "angular_momentum_error"),
)
_LOG = ("sampler.size", "training_runs", "trainer.steps", "particles", "train_seconds", "sampler.cells")


@dataclass(frozen=True)
class View:
    """What charts see of a report.

    Attributes:
        frame: its rows, as `nsf.results.table.labelled` gives them.
        series: errors and latent coordinates, a row a frame, with `body`, `variant` and `case`; None where
            the runs are not there.
        stages: time of a step by stage [ms], of each variant by "body · variant", and of the full-order
            step under "full order".
        trained: the training cases of each scene, a mapping from parameter to value.
        logarithmic: names of parameters whose design is logarithmic.
    """

    frame: pd.DataFrame
    series: pd.DataFrame | None = None
    stages: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    trained: Mapping[str, Sequence[Mapping[str, float]]] = field(default_factory=dict)
    logarithmic: frozenset[str] = frozenset()

    @property
    def bodies(self) -> list[tuple[str, pd.DataFrame]]:
        """The rows of each body."""
        return list(self.frame.groupby("body", sort=False))


@dataclass(frozen=True)
class Chart:
    """A chart: the function that draws it, and the caption of its figures."""

    draw: Callable[[View], Figures]
    caption: str


CHARTS: dict[str, Chart] = {}
"""Every chart by its name, in the order in which a page shows them."""


def chart(caption: str) -> Callable[[Callable[[View], Figures]], Callable[[View], Figures]]:
    """Register a function of a `View` as a chart under its own name."""

    def register(draw: Callable[[View], Figures]) -> Callable[[View], Figures]:
        CHARTS[draw.__name__] = Chart(draw, caption)
        return draw

    return register


@chart(
    "Mean δ of each variant (bar or diamond), and δ of each case or, where there are several, seed (dots)."
)
def delta(view: View) -> Figures:
    """δ of every variant, and what the paper prints."""
    averages = means(view.frame)
    groups = view.frame.groupby(["body", "variant"], sort=False)["delta"]
    labels = _labels(averages)
    with styled():
        fig = figure(1.5 + 0.34 * len(averages), 8.4)
        panel, at = fig.subplots(), np.arange(len(averages))
        every = []
        for i, row in averages.iterrows():
            values = 100 * _finite(_of_each(view.frame.loc[groups.groups[(row["body"], row["variant"])]]))
            every += [*values, 100 * row["delta"], 100 * row["paper_delta"]]
            panel.plot(values, np.full(len(values), i), "o", ms=4.5, mfc="white", mec=INK, mew=0.9)
        panel.plot(100 * averages["paper_delta"], at, "|", ms=13, mew=2.6, color=PAPER, label="the paper")
        average = 100 * _finite(averages["delta"])
        for y in np.flatnonzero(~(average <= LOST)):
            beside = {"transform": panel.get_yaxis_transform(), "ha": "left", "va": "center"}
            panel.text(1.01, float(y), "diverged" if np.isnan(average[y]) else "lost", **beside)
        average[average > LOST] = np.nan
        error_scale(panel, every, "x")
        if panel.get_xscale() == "log":  # a bar's length means nothing there
            panel.plot(average, at, "D", ms=7, color=REDUCED, label="mean", zorder=1.9)
        else:
            panel.barh(at, average, height=0.58, color=REDUCED, alpha=0.75, label="mean")
        panel.set_yticks(at, labels)
        panel.set(ylim=(len(averages) - 0.45, -0.55), xlabel=COLUMNS["delta"].heading)
        panel.tick_params(axis="y", length=0)
        _legend(fig, [panel])
        set_apart(fig)
    return {"delta": fig}


@chart(
    "Mean δ (line), and from the smallest to the largest over cases and seeds (band). A line has a gap where "
    "a run diverged. A cross is what the paper prints; dashed are interpolated latents, which take no step."
)
def delta_over(view: View) -> Figures:
    """δ over each number that the report varies: a panel a scene, a line for each setting of the others."""
    return {f"delta-over-{file_name(re.sub(r'[._]', '-', key))}": _over(view, key) for key in _axes(view)}


def _axes(view: View) -> list[str]:
    """The numbers that vary within a scene."""
    frame = view.frame
    known = [name for name in frame if "." in name and name not in SEEDS] + ["training_runs", "r"]
    if "trainer.steps" in frame and frame["train_seconds"].notna().all():
        known = ["train_seconds", *(name for name in known if name != "trainer.steps")]
    sizes = [name for name in known if name.endswith(".particles")]
    known = [name for name in known if not name.startswith("scene.") or name in sizes]
    return [
        name
        for name in known
        if name in frame
        and pd.api.types.is_numeric_dtype(frame[name])
        and (frame.groupby("scene")[name].nunique() > 1).any()
    ]


def _over(view: View, key: str) -> Figure:
    """δ over one number."""
    frame = view.frame[view.frame[key].notna()]
    bound = [name for name in frame if key.endswith(".particles") and name.startswith("scene.")]
    hidden = [key, *bound, *(["trainer.steps"] if key == "train_seconds" else [])]
    if key == "train_seconds":
        mean = frame.groupby(["body", "variant"])[key].transform("mean")
        frame = frame.assign(train_seconds=mean)
    panels = "scene" if bound else "body"
    frame = frame.assign(line=variants(frame.assign(body=frame[panels]), hidden))
    names = list(dict.fromkeys(frame["line"]))
    groups = list(frame.groupby(panels, sort=False))
    with styled():
        fig, drawn = _panels(len(groups), 2.8, sharex=True)
        for panel, (body, part) in zip(drawn, groups, strict=True):
            every = []
            for name, line in part.groupby("line", sort=False):
                values = 100 * line.groupby(key)["delta"].agg(["min", "max", _mean])
                low, high, middle = (_finite(values[of]) for of in ("min", "max", "_mean"))
                style = line_style(names.index(name))
                panel.fill_between(values.index, low, high, color=style["color"], alpha=0.18, linewidth=0)
                panel.plot(values.index, middle, marker="o", ms=4, label=name, **style)
                every += [*low, *high]
            if key == "training_runs":
                free = 100 * part.groupby(key)["delta_interpolated"].agg(_mean)
                panel.plot(free.index, free, "s--", ms=4, color=MUTED, label="interpolate")
            papers = part[[key, "paper_delta"]].dropna().drop_duplicates()
            panel.plot(papers[key], 100 * papers["paper_delta"], "X", ms=8, color=PAPER, label="the paper")
            error_scale(panel, [*every, *(100 * papers["paper_delta"])])
            panel.set(title=body, ylabel=COLUMNS["delta"].heading)
            panel.tick_params(labelbottom=True)
        fig.supxlabel(column(key).heading)
        if frame[key].min() > 0 and (key in _LOG or frame[key].max() > 10 * frame[key].min()):
            drawn[0].set_xscale("log")
            plain_ticks(drawn[0].xaxis, "{:,.10g}".format)
        _legend(fig, drawn)
    return fig


@chart(
    "Displacement error over the time for one full-order Δt (a solver of longer steps takes fewer): the "
    "full-order solver is the vertical line, squares are coarser grids; horizontal lines take no step."
)
def error_over_cost(view: View) -> Figures:
    """Error of every model over the time of its step, where it was timed."""
    averages = means(view.frame)
    timed = averages[averages["step_ms"].notna()]
    if timed.empty:
        return {}
    styles = _styles(dict.fromkeys(timed["variant"]))
    groups = list(timed.groupby("body", sort=False))
    with styled():
        fig, drawn = _panels(len(groups), 3.1, 3)
        for panel, (body, part) in zip(drawn, groups, strict=True):
            for row in part.to_dict("records"):
                span = row["step_ms"] * _longer(view, row)
                _dot(
                    panel,
                    span,
                    100 * row["displacement_error"],
                    label=row["variant"],
                    **styles[row["variant"]],
                )
            everywhere = averages[averages["body"] == body]
            panel.axvline(part["step_ms_full"].median(), color=FULL, lw=1.6, label="full order")
            coarse = [part[name].median() for name in ("step_ms_coarse", "displacement_coarse")]
            _dot(panel, coarse[0], 100 * coarse[1], label="full order on a coarser grid", **_COARSE)
            for name, ls in zip(RIVALS[:3], _LINES, strict=True):
                if math.isfinite(error := everywhere[name].min()):
                    panel.axhline(100 * error, color=MUTED, ls=ls, lw=1.2, label=COLUMNS[name].title)
            panel.set(xscale="log", yscale="log", title=body, xlabel="time for one full-order Δt [ms]")
            panel.set(ylabel=COLUMNS["displacement_error"].heading)
            panel.margins(0.12)
            panel.set_ylim(top=min(panel.get_ylim()[1], LOST))
            panel.grid()
            for line in (panel.xaxis, panel.yaxis):
                plain_ticks(line)
        _legend(fig, drawn)
        set_apart(fig)
    return {"error-over-cost": fig}


def _longer(view: View, row: Mapping) -> float:
    """Steps of a model for each full-order one: fewer where its Δt is longer."""
    name = "deploy.dt_multiplier"
    if name not in view.frame:
        return 1.0
    own = view.frame[(view.frame["body"] == row["body"]) & (view.frame["variant"] == row["variant"])]
    return 1.0 / own[name].fillna(1.0).iloc[0]


@chart("Speedup over the full-order model, of mean times (line: 1×), and peak memory of the steps of both.")
def speedup_and_memory(view: View) -> Figures:
    """Speedup [×] and memory [MiB] of every variant that was timed."""
    averages = means(view.frame)
    averages = averages[averages["speedup_step"].notna()].reset_index(drop=True)
    if averages.empty:
        return {}
    pairs = (
        {"speedup_step": "#009E73", "speedup_total": "#CC79A7", "speedup_decoded": "#E69F00"},
        {"memory_full_mib": FULL, "memory_mib": REDUCED},
    )
    with styled():
        fig = figure(1.7 + 0.5 * len(averages))
        panels = fig.subplots(1, 2, sharey=True)
        for panel, columns in zip(panels, pairs, strict=True):
            _numbers(panel, averages, columns)
        panels[0].axvline(1, color=INK, lw=1)
        panels[0].set_xlabel("speedup over full order [×]")
        panels[1].set_xlabel("peak memory [MiB]")
        panels[0].set_yticks(np.arange(len(averages)), _labels(averages))
        panels[0].set_ylim(len(averages) - 0.4, -0.6)
        _legend(fig, panels)
        set_apart(fig)
    return {"speedup-memory": fig}


@chart(
    "Time for one full-order Δt over the particles of the scene; each size has a Δt and a field of its own."
)
def step_over_particles(view: View) -> Figures:
    """Time of a step over the number of particles, where a scene has several."""
    averages = means(view.frame).dropna(subset="step_ms")
    several = averages.groupby("scene")["particles"].transform("nunique") > 1
    averages = averages[several]
    if averages.empty:
        return {}
    groups = list(averages.groupby("scene", sort=False))
    styles = _styles(dict.fromkeys(averages["model_name"]))
    with styled():
        fig, drawn = _panels(len(groups), 3.4, 2)
        for panel, (scene, part) in zip(drawn, groups, strict=True):
            full = part.groupby("particles")[["step_ms_full", "step_ms_coarse"]].median()
            panel.plot(full.index, full["step_ms_full"], "o-", ms=5, color=FULL, label="full order")
            coarse = _COARSE | {"ls": "--", "label": "full order on a coarser grid"}
            panel.plot(full.index, full["step_ms_coarse"], ms=5, **coarse)
            for name, own in part.groupby("model_name", sort=False):
                times = own.groupby("particles")["step_ms"].median()
                panel.plot(times.index, times, ms=5, label=name, **styles[name])
            panel.set(xscale="log", yscale="log", title=scene)
            panel.set(xlabel=COLUMNS["particles"].heading, ylabel="time for one full-order Δt [ms]")
            panel.set_xticks(full.index, [f"{size:,.0f}" for size in full.index])
            panel.minorticks_off()
            panel.grid()
            plain_ticks(panel.yaxis)
        _legend(fig, drawn)
    return {"step-over-particles": fig}


@chart(
    "Errors of held-out cases frame by frame, of the best variant of each model. Dashed: δ of the full-order "
    "frames encoded and decoded, which the fields alone explain. The displacement error divides by the "
    "distance moved, so it starts high."
)
def error_over_time(view: View) -> Figures:
    """δ, displacement, stress and momentum errors [%] over time [s], a figure a body and model."""
    figures = {}
    for stem, series in _best_series(view):
        shown = [name for name in _OVER_TIME if name in series and series[name].notna().any()]
        name, unit = parameter(series["case"].iloc[0])
        with styled():
            fig, drawn = _panels(len(shown), 2.9, 3)
            for panel, error in zip(drawn, shown, strict=True):
                for i, (case, part) in enumerate(series.groupby("case", sort=False)):
                    style = line_style(i) | {"label": _value(case)}
                    panel.plot(part["t"], _finite(100 * part[error]), **style)
                    if error == "delta" and "reconstruction_delta" in part:
                        encoded = {"color": style["color"], "ls": (0, (2, 1.6)), "alpha": 0.5}
                        panel.plot(part["t"], 100 * part["reconstruction_delta"], **encoded)
                title = column(error).title
                panel.set(xlabel="time t [s]", ylabel=axis(title, "%"))
                error_scale(panel, 100 * series[error])
                panel.set_xlim(-0.01 * series["t"].max(), 1.01 * series["t"].max())
                panel.xaxis.set_major_locator(MaxNLocator(5))
            _legend(fig, drawn, axis(name, unit))
        figures[f"{stem}error-over-time"] = fig
    return figures


@chart("The latent path of a run (solid) and of the full-order frames through the encoder (dashed).")
def latent(view: View) -> Figures:
    """Latent coordinates over time, a figure a body and model."""
    figures = {}
    for stem, series in _best_series(view):
        r = sum(name.startswith("xhat_") and series[name].notna().any() for name in series)
        if not r:
            continue
        name, unit = parameter(series["case"].iloc[0])
        with styled():
            fig, drawn = _panels(r, 2.1, 3, sharex=True)
            for k, panel in enumerate(drawn, start=1):
                for i, (case, part) in enumerate(series.groupby("case", sort=False)):
                    style = line_style(i)
                    panel.plot(part["t"], part[f"xhat_{k}"], label=_value(case), **style)
                    dashed = {"color": style["color"], "ls": (0, (2, 1.6)), "lw": 2.4, "alpha": 0.45}
                    panel.plot(part["t"], part[f"encoded_{k}"], **dashed)
                panel.set(ylabel=f"x̂{chr(0x2080 + k) if k < 10 else k} [–]", xlabel="t [s]")
                panel.locator_params(nbins=4)
                panel.grid()
            _legend(fig, drawn, axis(name, unit))
        figures[f"{stem}latent"] = fig
    return figures


@chart("Where the time of a step goes, stage by stage; measuring takes a little time too.")
def runtime(view: View) -> Figures:
    """Time of each stage of a step beside those of the full-order step, a figure a body and model."""
    figures, full = {}, view.stages.get("full order", {})
    for stem, series in _best_series(view):
        own = view.stages.get(f"{series['body'].iloc[0]} · {series['variant'].iloc[0]}", {})
        if len(own) > 1:
            name = series["model_name"].iloc[0]
            figures[f"{stem}runtime"] = rings([{f"{name} step": own, "full-order step": full}])
    return figures


def rings(rows: Sequence[Mapping[str, Mapping[str, float]]]) -> Figure:
    """Where the time [ms] of a step goes, a ring each with its sum in the middle.

    Args:
        rows: of two rings, {title: {stage: ms}}; without stages it says that nothing was measured.
    """
    with styled():
        fig = figure(2.75 * len(rows))
        panels = fig.subplots(len(rows), 4, width_ratios=[1, 0.78, 1, 0.78], squeeze=False)
        for across, row in zip(panels, rows, strict=True):
            for ring, key, (title, stages) in zip(across[::2], across[1::2], row.items(), strict=True):
                _ring(ring, key, stages, title)
    return fig


def _ring(pie, key, stages: Mapping[str, float], title: str) -> None:
    pie.set_title(title)
    key.axis("off")
    if not stages:
        pie.axis("off")
        pie.text(0.5, 0.5, "not measured", transform=pie.transAxes, ha="center", color=MUTED)
        return
    total = sum(stages.values())
    decimals = max(0, 2 - math.floor(math.log10(total)))
    wedges, *_ = pie.pie(
        list(stages.values()), colors=stage_colors(stages), startangle=90, counterclock=False,
        wedgeprops={"width": 0.36, "edgecolor": "white", "linewidth": 1.5},
    )  # fmt: skip
    pie.text(0, 0, f"{number(total)} ms,\nall stages", ha="center", va="center", fontsize=11)
    labels = [
        f"{STAGE_TITLES.get(stage, stage.replace('_', ' '))}  {ms:.{decimals}f} ms, {100 * ms / total:.0f} %"
        for stage, ms in stages.items()
    ]
    place = {"loc": "center left", "bbox_to_anchor": (-0.18, 0.5), "handlelength": 1, "labelspacing": 0.7}
    key.legend(wedges, labels, **place)


def best(frame: pd.DataFrame) -> Iterator[tuple[str, str, str]]:
    """File stem, body and variant of the best variant of each body and model: all would drown a page.

    One whose steps another model took stands last.
    """
    averages = means(frame)
    averages["rank"] = averages["delta"].where(averages["fallback_share"].fillna(0) < 1, math.inf)
    chosen = averages.sort_values("rank", kind="stable").groupby(["body", "model_name"], sort=False).head(1)
    chosen = averages.loc[sorted(chosen.index)]
    for row in chosen.to_dict("records"):
        several = (chosen["body"].nunique() > 1, (chosen["body"] == row["body"]).sum() > 1)
        parts = [row["body"] if several[0] else "", row["model_name"] if several[1] else ""]
        stem = "".join(f"{file_name(re.sub(r'[ ,=()·]+', '-', part)).strip('-')}-" for part in parts if part)
        yield stem, row["body"], row["variant"]


def _best_series(view: View) -> Iterator[tuple[str, pd.DataFrame]]:
    """The series of the best variant of each body and model, of the first seed, by file stem."""
    if view.series is None:
        return
    for stem, body, variant in best(view.frame):
        own = view.series[(view.series["body"] == body) & (view.series["variant"] == variant)]
        if not own.empty:
            yield stem, own[own["run"] == own["run"].iloc[0]]


def _panels(count: int, height: float, across: int = _ACROSS, **shared) -> tuple[Figure, list]:
    """A figure with some panels, at most `across` in a row."""
    rows = math.ceil(count / across)
    fig = figure(0.9 + height * rows)
    grid = fig.subplots(rows, min(across, count), squeeze=False, **shared).ravel()
    for panel in grid[count:]:
        panel.axis("off")
    return fig, list(grid[:count])


def _legend(fig: Figure, panels: Sequence, title: str | None = None) -> None:
    """One legend of what all panels show; none where everything is one line."""
    handles: dict[str, object] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            empty = (
                hasattr(handle, "get_ydata") and not np.isfinite(np.asarray(handle.get_ydata(), float)).any()
            )
            if not empty and hasattr(handle, "get_xdata"):
                empty = not np.isfinite(np.asarray(handle.get_xdata(), float)).any()
            if not empty:
                handles.setdefault(label, handle)
    if len(handles) > 1 or title:
        legend_above(fig, list(handles.values()), list(handles), 6, title=title, alignment="left")


def _is_empty(handle) -> bool:
    """Whether a line has no point that is drawn, as of what the paper does not print."""
    if not hasattr(handle, "get_xydata"):
        return False
    points = np.asarray(handle.get_xydata(), float)
    return len(points) > 0 and not np.isfinite(points).all(axis=1).any()


def _styles(names: Sequence[str]) -> dict[str, dict]:
    """Colour and marker of each name."""
    return {
        name: {"color": PALETTE[i % len(PALETTE)], "marker": _MARKERS[i // len(PALETTE) % len(_MARKERS)]}
        for i, name in enumerate(names)
    }


def _dot(panel, x: float, y: float, **style) -> None:
    if math.isfinite(x) and math.isfinite(y) and x > 0 and y > 0:
        panel.plot(x, y, ms=7, **{"ls": ""} | style)


def _numbers(panel, averages: pd.DataFrame, columns: Mapping[str, str]) -> None:
    """Dots of each variant, a colour a column, each with its number beside it, on a logarithmic axis."""
    panel.set_xscale("log")
    for k, (name, color) in enumerate(columns.items()):
        at = np.arange(len(averages)) + 0.72 * ((k + 0.5) / len(columns) - 0.5)
        panel.plot(averages[name], at, "o", ms=6, color=color, label=column(name).title)
        for x, y in zip(averages[name], at, strict=True):
            if math.isfinite(x):
                beside = {"textcoords": "offset points", "va": "center", "fontsize": 8.5}
                panel.annotate(number(x), (x, y), (6, 0), **beside)
    low, high = panel.get_xlim()
    panel.set_xlim(low, high * (high / low) ** 0.16)  # room for the last numbers
    plain_ticks(panel.xaxis, "{:,g}".format)
    panel.grid(axis="x")
    panel.tick_params(axis="y", length=0)


def _labels(averages: pd.DataFrame) -> list[str]:
    """Names of the rows of `means`, in lines; the body alone, or the variant alone, where that tells them."""
    bodies, kinds = averages["body"].nunique(), averages["variant"].nunique()
    names = averages["body"] + (" · " + averages["variant"] if kinds > 1 else "")
    names = averages["variant"] if bodies == 1 and kinds > 1 else names
    return ["\n".join(textwrap.wrap(name, _LINE, break_on_hyphens=False)) for name in names]


def _of_each(part: pd.DataFrame) -> pd.Series:
    """δ of each seed, the mean over cases, where there are several; else of each case."""
    seeds = [part[name].fillna(-1) for name in SEEDS if name in part and part[name].nunique() > 1]
    return part["delta"].groupby(seeds).agg(_mean) if seeds else part["delta"]


def _value(case: str) -> str:
    """The value of a case with one parameter, the whole text of others."""
    return case.partition("=")[2] if case.count("=") == 1 else case


def _mean(values: pd.Series) -> float:
    return values.mean(skipna=False)


def _finite(values) -> np.ndarray:
    """Values with gaps where they are not finite: a run that diverged has no line from there on."""
    values = np.array(values, float)
    values[~np.isfinite(values)] = np.nan
    return values
