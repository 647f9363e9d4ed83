"""The report of all benchmarks: tables, and charts beside the floor that the memory sets."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from nsf.bench.rows import OTHER_SAMPLER, size_name
from nsf.reporting.drawing.charts import rings
from nsf.reporting.text.columns import number
from nsf.results.formats import Rows, markdown_document, terminal_table
from nsf.results.scales import plain_ticks
from nsf.results.style import INK, figure, line_style, save, stage_colors, styled
from nsf.storage import writing

_HEADINGS = {
    "ms_median": "step, median [ms]",
    "ms_p10": "10 % [ms]",
    "ms_p90": "90 % [ms]",
    "peak_mib": "peak memory [MiB]",
    "speed_up": "speed-up",
    "delta": "δ",
    "run_mib": "of a run [MiB]",
    "decode_ms": "a frame decoded [ms]",
    "checked_ms": "a step, checked [ms]",
    "teach_seconds": "teaching [s]",
    "teacher_steps": "teacher's steps",
    "sample": "|S|",
    "integration": "|N|",
    "ms": "time [ms]",
    "mib": "moved [MiB]",
    "gb_per_s": "bandwidth [GB/s]",
    "floor_ms": "floor [ms]",
}
_TEXT = ("bench", "case", "precision", "device", "kernel", "stage", "commit")
_LEAD = (
    "Time of a step, both sides of a ratio measured in one process turn by turn, after a warm-up, around a "
    "synchronised device: the median over the trials, each the mean of many steps. Memory is the peak of "
    "every allocator beyond what was held before the solver was built. `nsf bench` writes this report."
)
_BATCH = (
    "Time of a simulation-step, which is the step of a batch over the simulations that take it together, by "
    "their number; the band is from 10 % to 90 % of the trials. Dotted: half the time for twice as many."
)
_OPERATORS = (
    "Time of a step by operators: all steps of a run in one launch, over their number; of many runs at once, "
    "over their number too. Checked: the same with what `nsf deploy` adds to a run, a projected step for "
    "every 20 steps, the estimated error and the distrust ratio. Speed-up: over the full-order step of the "
    "same call, without checks. A run holds no particles "
    "but S; the time of decoding a frame stands apart. The operators of the sand column step as at the "
    "scene's own size, while the full-order step of as many particles as are decoded is on a finer grid, and "
    "shorter."
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
_KERNELS = (
    "Each pass of a full-order step on its own. Moved: what it has to read and write, each value once. "
    "Floor: the time that these bytes take a copy measured in the same run; a step cannot be faster than "
    "the floors of its passes together as long as its state does not fit into a cache."
)
_FLOORS = (
    "Passes of a reduced step within the captured step, beside the time that a copy takes for the modes and "
    "the state of the particles that a step needs, each value once, which bounds what does not fit into a "
    "cache, and that of empty launches, as many as a step has passes that wait for each other."
)
#: Of a reduced frame [ms]: the networks, the projection and copies between Warp and torch, and all of it
#: (appendix of the paper, Runtime analysis; double precision, one Quadro P6000).
_PAPER = {"reduced_cake": (1.95, 4.69), "reduced_metal": (1.78, 2.09)}
_STAGES = (
    "Where the time of a reduced step goes, by events within the captured step, which take a little time of "
    "their own; what of the inversion is prepared on another stream counts where the step waits for it. "
    "Beside it a frame of the paper's reduced solver on a Quadro P6000 (its appendix, Runtime analysis)."
)
_TRAINING = (
    "Training of all networks of a scene with field=basis: the time is that of a whole training, from "
    "opening its files to the manifold, and the trials are seeds."
)


#: A case of one of several numbers of samples.
_OF_SAMPLE = r"_s\d+$"


def write_report(folder: Path) -> Path:
    """Charts and index.md from results.csv, kernels.csv and stages.csv of a folder."""
    frames = [pd.read_csv(folder / name) for name in ("results.csv", "kernels.csv", "stages.csv")]
    devices = {
        device: _parts(folder, *(frame[frame["device"] == device] for frame in frames))
        for device in frames[0]["device"].unique()
    }
    page = folder / "index.md"
    with writing(page) as partial:
        partial.write_text(markdown_document("speed.md", lead=_LEAD, devices=devices), encoding="utf-8")
    return page


def _parts(folder: Path, results: pd.DataFrame, kernels: pd.DataFrame, stages: pd.DataFrame) -> list[dict]:
    """What the page says of one device: charts, what they show, and tables, each where it has rows."""
    of_reduced = kernels["bench"] == "reduced"
    passes, floors = kernels[~of_reduced], kernels[of_reduced]
    of_size = results[results["bench"].isin(["full_order", "scaling"])]
    by_sample = of_size["case"].str.contains(_OF_SAMPLE)
    of_sample, sizes = of_size[by_sample], of_size[~by_sample]
    same = (sizes["bench"] == "scaling") & sizes["particles"].isin(of_sample["particles"])
    of_stages = stages[stages["case"].isin(_PAPER)]
    of_scene, of_training, of_batch, of_operators = (
        results[results["bench"] == name] for name in ("reduced", "training", "batch", "operators")
    )
    of_pass = "Time of each pass of a full-order step; the mark is its floor."
    of_case = (
        "Time of a step of both solvers by scene; a point names δ of its run, at the first held-out value."
    )
    listed = (  # rows, texts, chart and what draws it from which rows; the rows are the table
        (of_scene, [of_case], "reduced", steps_by_scene, [of_scene]),
        (of_stages, [_STAGES], "stages", step_beside_paper, [of_stages]),
        (floors, [_FLOORS], None, None, []),
        (of_training, [_TRAINING], None, None, []),
        (of_operators, [_OPERATORS], None, None, []),
        (of_batch, [_BATCH], "batch", step_over_batch, [of_batch]),
        (sizes, [_SIZES], "step", step_over_particles, [sizes, passes]),
        (of_sample, [_SAMPLES], "sample", step_over_sample, [of_sample, sizes[same]]),
        (passes, [of_pass, _KERNELS], "kernels", passes_beside_floor, [passes]),
    )
    parts = []
    for rows, texts, chart, draw, drawn in listed:
        if not len(rows):
            continue
        device = re.sub("[^a-z0-9]+", "-", str(rows["device"].iloc[0]).lower())
        if chart:
            save(draw(*drawn), folder, f"{chart}-{device}")
        table = None if rows is of_stages else _rows(rows)
        parts.append({"chart": chart and f"{chart}-{device}", "texts": texts, "table": table})
    return parts


def step_over_particles(results: pd.DataFrame, kernels: pd.DataFrame) -> Figure:
    """Time of a step [ms] over P, both axes logarithmic: a line for each kind of solver and precision.

    Args:
        results: rows of one device.
        kernels: passes of its full-order steps, whose floors add up to that of a step.
    """
    of_block = results["bench"].eq("full_order").map({True: " of a block", False: ""})
    series = results.assign(solver=[_solver(case) for case in results["case"]] + of_block)
    with styled():
        fig, panel = _over("particles P [–]")
        colors = {}
        for (solver, precision), part in series.groupby(["solver", "precision"], sort=False):
            color = _line(panel, part, "particles", f"{solver}, {precision}")
            if solver.startswith("full-order"):
                colors[precision] = color
        for precision, part in kernels.groupby("precision", sort=True):
            floor = part.groupby(["bench", "particles"])["floor_ms"].sum().groupby("particles").mean()
            panel.plot(
                floor.index, floor, ls=(0, (5, 2)), lw=1.2, label=f"full-order floor, {precision}",
                color=colors[precision],
            )  # fmt: skip
        plain_ticks(panel.xaxis, lambda count: size_name(round(count)))
        fig.legend(loc="outside upper left", ncols=3, handlelength=2.6)
    return fig


def step_beside_paper(stages: pd.DataFrame) -> Figure:
    """Rings of the stages of a reduced step [ms], a scene a row, and of the paper's.

    Args:
        stages: of one device, of cases of the paper; where there are two precisions, fp64 counts.
    """
    rows = []
    for case, own in stages.groupby("case", sort=True):
        precision, scene = own["precision"].max(), case.partition("_")[2]
        own, (networks, whole) = own[own["precision"] == precision], _PAPER[case]
        told = {"networks, projection, copies": networks, "MPM": whole - networks}
        rows.append(
            {
                f"{scene}, reduced step, {precision}": dict(zip(own["stage"], own["ms"], strict=True)),
                f"{scene}, the paper's frame": told,
            }
        )
    return rings(rows)


def step_over_sample(results: pd.DataFrame, full_order: pd.DataFrame) -> Figure:
    """Time of a reduced step [ms] over |S|, both axes logarithmic, a line for each precision.

    Args:
        results: rows of one device and one number of particles.
        full_order: rows of as many particles.
    """
    with styled():
        fig, panel = _over("sample particles |S| [–]", results["sample"].astype(int))
        for i, (precision, part) in enumerate(results.groupby("precision")):
            part = part.sort_values("sample")
            color = _line(panel, part, "sample", f"reduced, {precision}")
            for at, ms, delta in zip(
                part["sample"], part["ms_median"], part["delta"].astype(float), strict=True
            ):
                panel.annotate(
                    f"{number(100 * delta)} %", (at, ms), (0, 6 - 18 * (i == 0)), ha="center",
                    textcoords="offset points", fontsize=8.5, color=color,
                )  # fmt: skip
            for ms in full_order.loc[full_order["precision"] == precision, "ms_median"]:
                panel.axhline(ms, ls=":", lw=1.4, color=color, label=f"full-order, {precision}")
        fig.legend(loc="outside upper left", ncols=2, handlelength=2.6)
    return fig


def step_over_batch(results: pd.DataFrame) -> Figure:
    """Time of a simulation-step [ms] over the size of the batch, both axes logarithmic.

    Args:
        results: rows of `batch` of one device; a line for each number of particles, end of the case and
            precision.
    """
    ends = results["case"].str.extract(r"\d+(.*)$")[0].rename("end")
    with styled():
        fig, panel = _over("simulations B [–]", results["batch"], "time of a simulation-step [ms]")
        for (particles, end, precision), part in results.groupby(["particles", ends, "precision"]):
            name = f"{size_name(particles)} particles{end.replace('_', ', ')}, {precision}"
            part = part.sort_values("batch")
            color = _line(panel, part, "batch", name)
            shared = part["ms_median"].iloc[0] * part["batch"].iloc[0] / part["batch"]
            panel.plot(part["batch"], shared, ls=":", lw=1.2, color=color)
        fig.legend(loc="outside upper left", ncols=2, handlelength=2.6)
    return fig


def _over(x: str, at: pd.Series | None = None, y: str = "time of a step [ms]") -> tuple[Figure, Axes]:
    """An empty chart with logarithmic axes; x has ticks at the values `at`."""
    fig = figure(4.4)
    panel = fig.subplots()
    panel.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    if at is not None:
        sizes = sorted(at.unique())
        panel.set_xticks(sizes, [str(size) for size in sizes])
        panel.minorticks_off()
    panel.grid(which="major")
    return fig, panel


def _line(panel: Axes, rows: pd.DataFrame, x: str, label: str) -> str:
    """The median over a column, and a band from 10 % to 90 % of the trials; gives the colour."""
    rows, style = rows.sort_values(x), line_style(len(panel.collections))
    panel.fill_between(rows[x], rows["ms_p10"], rows["ms_p90"], color=style["color"], alpha=0.18, lw=0)
    panel.plot(rows[x], rows["ms_median"], marker="o", ms=4.5, label=label, **style)
    plain_ticks(panel.yaxis)
    return style["color"]


def steps_by_scene(results: pd.DataFrame) -> Figure:
    """Time of a step [ms] of the full-order and of the reduced solver, a point each, a panel a scene.

    Args:
        results: rows of `reduced` of one device.
    """
    ends = "|".join([r"[\d.]+dt", r"mlp\w*", *OTHER_SAMPLER.values()])
    scene = results["case"].str.extract(rf"^(?:full_order|reduced)_(.+?)(?:_(?:{ends}))?$")[0]
    panels_of = list(results.groupby(scene, sort=False))
    with styled():
        fig = figure(1.2 + 0.3 * max(len(part) for _, part in panels_of))
        panels = fig.subplots(1, len(panels_of), squeeze=False)[0]
        for panel, (name, part) in zip(panels, panels_of, strict=True):
            at = np.arange(len(part))
            full = part["case"].str.startswith("full_order").to_numpy()
            median = part["ms_median"].to_numpy()
            colors = [line_style(0)["color"] if whole else line_style(1)["color"] for whole in full]
            panel.scatter(median, at, s=42, color=colors)
            for ms, delta, y in zip(median, part["delta"].astype(float), at, strict=True):
                text = number(ms) if np.isnan(delta) else f"{number(ms)}, δ {number(100 * delta)} %"
                place = {"xytext": (9, 0), "textcoords": "offset points", "va": "center_baseline"}
                panel.annotate(text, (ms, y), fontsize=8.5, color=INK, **place)
            kinds = part["case"].str.replace(f"_{name}", "").str.replace("_", " ")
            panel.set_yticks(at, [f"{kind}, {p}" for kind, p in zip(kinds, part["precision"], strict=True)])
            panel.set_ylim(len(part) - 0.5, -0.5)
            low, high = median.min(), median.max()
            panel.set(xscale="log", title=name, xlabel="time of a step [ms]")
            panel.set_xlim(low / (high / low) ** 0.1, high * (high / low) ** 0.75 * 1.5)
            panel.xaxis.set_major_formatter("{x:g}")
            panel.grid()
            panel.tick_params(axis="y", length=0)
    return fig


def passes_beside_floor(kernels: pd.DataFrame) -> Figure:
    """Time [ms] of the passes of a full-order step, a bar each, and its floor as a mark; the largest case."""
    largest = kernels[kernels["particles"] == kernels["particles"].max()].drop_duplicates(
        ["precision", "kernel"], keep="last"
    )
    names = list(dict.fromkeys(largest["kernel"]))
    with styled():
        fig = figure(1.5 + 0.42 * len(names))
        panels = fig.subplots(1, largest["precision"].nunique(), sharey=True, squeeze=False)[0]
        at = np.arange(len(names))
        for panel, (precision, part) in zip(panels, largest.groupby("precision", sort=True), strict=True):
            part = part.set_index("kernel").loc[names]
            bars = panel.barh(at, part["ms"], height=0.6, color=stage_colors(["p2g"]), label="time")
            panel.bar_label(bars, [number(ms) for ms in part["ms"]], padding=4, fontsize=8.5, color=INK)
            panel.plot(part["floor_ms"], at, "|", ms=17, mew=2.4, color=INK, label="floor")
            panel.set(title=f"{part['case'].iloc[0]}, {precision}", xlabel="time [ms]")
            panel.set_yticks(at, names)
            panel.set_ylim(len(names) - 0.5, -0.5)
            panel.set_xlim(0, 1.16 * part["ms"].max())
            panel.grid(axis="x")
            panel.tick_params(axis="y", length=0)
        handles, texts = panels[0].get_legend_handles_labels()
        fig.legend(handles, texts, loc="outside upper left", ncols=2)
    return fig


def table(path: Path) -> Table:
    """Rows of results.csv for a terminal."""
    return terminal_table(_rows(pd.read_csv(path).drop(columns="commit")))


def _solver(case: str) -> str:
    """The kind of solver that a case times: its name without the size."""
    return case.rpartition("_")[0].replace("_", "-")


def _rows(frame: pd.DataFrame) -> Rows:
    frame = frame.dropna(axis=1, how="all")
    body = [[number(value) for value in row] for row in frame.itertuples(index=False, name=None)]
    return Rows([_HEADINGS.get(name, name) for name in frame], body, [name not in _TEXT for name in frame])
