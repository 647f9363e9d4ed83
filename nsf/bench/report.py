"""The report of all benchmarks: tables, and charts beside the floor that the memory sets."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table

from nsf.bench.rows import OTHER_SAMPLER, size_name
from nsf.reporting.charts import plain_ticks
from nsf.reporting.columns import number
from nsf.reporting.cost_charts import rings
from nsf.reporting.style import INK, figure, line_style, save, stage_colors, styled
from nsf.reporting.tables import markdown_rows
from nsf.storage import writing

_HEADINGS = {
    "ms_median": "step, median [ms]",
    "ms_p10": "10 % [ms]",
    "ms_p90": "90 % [ms]",
    "peak_mib": "peak memory [MiB]",
    "speed_up": "speed-up",
    "delta": "δ",
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
_SEVERAL = (
    "Several GPUs of the host; a case ends with their number. Simulate: the time of a data set, the start of "
    "processes and the writing of files included, over the steps of all trajectories. Train: the time of an "
    "optimiser step of field=mlp on as many points as the batch says, in whole. Speed-up: over one GPU."
)


#: A case of one of several numbers of samples.
_OF_SAMPLE = r"_s\d+$"


def write_report(folder: Path) -> Path:
    """Charts and index.md from results.csv, kernels.csv and stages.csv of a folder."""
    results, kernels, stages = (
        pd.read_csv(folder / name) for name in ("results.csv", "kernels.csv", "stages.csv")
    )
    parts = ["# Speed", _LEAD]
    for device in results["device"].unique():
        rows, passes = (frame[frame["device"] == device] for frame in (results, kernels))
        of_reduced = passes["bench"] == "reduced"
        passes, floors = passes[~of_reduced], passes[of_reduced]
        stem = re.sub("[^a-z0-9]+", "-", device.lower())
        parts.append(f"## On {device}")
        of_size = rows[rows["bench"].isin(["full_order", "scaling"])]
        by_sample = of_size["case"].str.contains(_OF_SAMPLE)
        of_sample = of_size[by_sample]
        of_scene, of_batch = (rows[rows["bench"] == name] for name in ("reduced", "batch"))
        if len(of_scene):
            caption = "Time of a step of both solvers by scene; a point names δ of its run."
            with styled():
                save(steps_by_scene(of_scene), folder, f"reduced-{stem}")
            parts += [f"![{caption}](reduced-{stem}.png)", caption, _markdown(of_scene)]
        of_stages = stages[(stages["device"] == device) & stages["case"].isin(_PAPER)]
        if len(of_stages):
            with styled():
                save(step_beside_paper(of_stages), folder, f"stages-{stem}")
            parts += [f"![{_STAGES}](stages-{stem}.png)", _STAGES]
        if len(floors):
            parts += [_FLOORS, _markdown(floors)]
        of_training = rows[rows["bench"] == "training"]
        if len(of_training):
            parts += [_TRAINING, _markdown(of_training)]
        if len(of_batch):
            with styled():
                save(step_over_batch(of_batch), folder, f"batch-{stem}")
            parts += [f"![{_BATCH}](batch-{stem}.png)", _BATCH, _markdown(of_batch)]
        if len(of_size):
            with styled():
                save(step_over_particles(of_size[~by_sample], passes), folder, f"step-{stem}")
                save(passes_beside_floor(passes), folder, f"kernels-{stem}")
            parts += [f"![{_SIZES}](step-{stem}.png)", _SIZES, _markdown(of_size[~by_sample])]
        if len(of_sample):
            same = (of_size["bench"] == "scaling") & of_size["particles"].isin(of_sample["particles"])
            full_order = of_size[same & ~by_sample]
            with styled():
                save(step_over_sample(of_sample, full_order), folder, f"sample-{stem}")
            parts += [f"![{_SAMPLES}](sample-{stem}.png)", _SAMPLES, _markdown(of_sample)]
        if len(of_size):
            caption = "Time of each pass of a full-order step; the mark is its floor."
            parts += [f"![{caption}](kernels-{stem}.png)", caption, _KERNELS, _markdown(passes)]
        of_several = rows[rows["bench"] == "multi_gpu"]
        if len(of_several):
            parts += [_SEVERAL, _markdown(with_speed_up(of_several))]
    page = folder / "index.md"
    with writing(page) as partial:
        partial.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return page


def with_speed_up(results: pd.DataFrame) -> pd.DataFrame:
    """Rows of `multi_gpu` of one device, each with the ratio of the time on one GPU to its own."""
    work = results["case"].str.rpartition("_on_")
    keys = pd.Series(list(zip(work[0], results["precision"], strict=True)), index=results.index)
    alone = results["ms_median"][work[2] == "1"].groupby(keys).last()
    return results.assign(speed_up=keys.map(alone) / results["ms_median"])


def step_over_particles(results: pd.DataFrame, kernels: pd.DataFrame) -> Figure:
    """Time of a step [ms] over P, both axes logarithmic: a line for each kind of solver and precision.

    Args:
        results: rows of one device.
        kernels: passes of its full-order steps, whose floors add up to that of a step.
    """
    of_block = results["bench"].eq("full_order").map({True: " of a block", False: ""})
    series = results.assign(solver=[_solver(case) for case in results["case"]] + of_block)
    with styled():
        fig = figure(4.4)
        panel = fig.subplots()
        colors = {}
        lines = series.groupby(["solver", "precision"], sort=False)
        for i, ((solver, precision), part) in enumerate(lines):
            part = part.sort_values("particles")
            style = line_style(i)
            P, median = part["particles"], part["ms_median"]
            panel.fill_between(P, part["ms_p10"], part["ms_p90"], color=style["color"], alpha=0.18, lw=0)
            panel.plot(P, median, marker="o", ms=4.5, label=f"{solver}, {precision}", **style)
            if solver.startswith("full-order"):
                colors[precision] = style["color"]
        for precision, part in kernels.groupby("precision", sort=True):
            floor = part.groupby(["bench", "particles"])["floor_ms"].sum().groupby("particles").mean()
            panel.plot(
                floor.index, floor, ls=(0, (5, 2)), lw=1.2, label=f"full-order floor, {precision}",
                color=colors[precision],
            )  # fmt: skip
        panel.set(xscale="log", yscale="log", xlabel="particles P [–]", ylabel="time of a step [ms]")
        panel.grid(which="major")
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
        fig = figure(4.4)
        panel = fig.subplots()
        for i, (precision, part) in enumerate(results.groupby("precision")):
            part, style = part.sort_values("sample"), line_style(i)
            S, median = part["sample"], part["ms_median"]
            panel.fill_between(S, part["ms_p10"], part["ms_p90"], color=style["color"], alpha=0.18, lw=0)
            panel.plot(S, median, marker="o", ms=4.5, label=f"reduced, {precision}", **style)
            for at, ms, delta in zip(S, median, part["delta"].astype(float), strict=True):
                panel.annotate(
                    f"{number(100 * delta)} %", (at, ms), (0, 6 - 18 * (i == 0)), ha="center",
                    textcoords="offset points", fontsize=8.5, color=style["color"],
                )  # fmt: skip
            for ms in full_order.loc[full_order["precision"] == precision, "ms_median"]:
                panel.axhline(ms, ls=":", lw=1.4, color=style["color"], label=f"full-order, {precision}")
        panel.set(xscale="log", yscale="log")
        panel.set(xlabel="sample particles |S| [–]", ylabel="time of a step [ms]")
        sizes = sorted(results["sample"].astype(int).unique())
        panel.set_xticks(sizes, [str(size) for size in sizes])
        panel.minorticks_off()
        plain_ticks(panel.yaxis)
        panel.grid(which="major")
        fig.legend(loc="outside upper left", ncols=2, handlelength=2.6)
    return fig


def step_over_batch(results: pd.DataFrame) -> Figure:
    """Time of a simulation-step [ms] over the size of the batch, both axes logarithmic.

    Args:
        results: rows of `batch` of one device; a line for each number of particles, end of the case and
            precision.
    """
    with styled():
        fig = figure(4.4)
        panel = fig.subplots()
        ends = results["case"].str.extract(r"\d+(.*)$")[0].rename("end")
        for i, ((particles, end, precision), part) in enumerate(
            results.groupby(["particles", ends, "precision"])
        ):
            part, style = part.sort_values("batch"), line_style(i)
            B, median = part["batch"], part["ms_median"]
            panel.fill_between(B, part["ms_p10"], part["ms_p90"], color=style["color"], alpha=0.18, lw=0)
            name = f"{size_name(particles)} particles{end.replace('_', ', ')}, {precision}"
            panel.plot(B, median, marker="o", ms=4.5, label=name, **style)
            shared = median.iloc[0] * B.iloc[0] / B
            panel.plot(B, shared, ls=":", lw=1.2, color=style["color"])
        panel.set(xscale="log", yscale="log")
        panel.set(xlabel="simulations B [–]", ylabel="time of a simulation-step [ms]")
        sizes = sorted(results["batch"].unique())
        panel.set_xticks(sizes, [str(size) for size in sizes])
        panel.minorticks_off()
        panel.grid(which="major")
        fig.legend(loc="outside upper left", ncols=2, handlelength=2.6)
    return fig


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
    frame = pd.read_csv(path).drop(columns="commit").dropna(axis=1, how="all")
    drawn = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in frame:
        drawn.add_column(_HEADINGS.get(name, name), justify="left" if name in _TEXT else "right")
    for row in _cells(frame):
        drawn.add_row(*row)
    return drawn


def _solver(case: str) -> str:
    """The kind of solver that a case times: its name without the size."""
    return case.rpartition("_")[0].replace("_", "-")


def _markdown(frame: pd.DataFrame) -> str:
    frame = frame.dropna(axis=1, how="all")
    return markdown_rows(
        [_HEADINGS.get(name, name) for name in frame], _cells(frame), [name not in _TEXT for name in frame]
    )


def _cells(frame: pd.DataFrame) -> list[list[str]]:
    return [[number(value) for value in row] for row in frame.itertuples(index=False, name=None)]
