"""Charts of what the two solvers cost: where a step's time goes, speedup, memory."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from nsf.reporting.columns import number
from nsf.reporting.style import FULL, INK, MUTED, REDUCED, STAGE_TITLES, figure, stage_colors, styled


def runtime_breakdown(breakdown: dict[str, dict[str, float]]) -> Figure:
    """Where one step's time [ms] goes, for the reduced and for the full-order solver.

    Args:
        breakdown: {"reduced": {stage: ms}, "full_order": {stage: ms}}. Each ring is one whole step; the
            sum of its stages stands in the middle.
    """
    titles = {"reduced": "reduced step", "full_order": "full-order step"}
    return rings([{title: breakdown.get(solver, {}) for solver, title in titles.items()}])


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


def speedup_and_memory(variants: list[dict]) -> Figure:
    """Speedup [×] and peak memory [MiB] of each variant.

    Args:
        variants: per variant `label, speedup_step, speedup_total, memory_full_mib, memory_reduced_mib`;
            what was not measured is NaN and is said so.
    """
    with styled():
        fig = figure(1.7 + 0.62 * len(variants))
        left, right = fig.subplots(1, 2, sharey=True)
        light = "#56B4E9"
        _pairs(
            left,
            variants,
            ("speedup_step", "speedup_total"),
            ("one step", "whole simulation"),
            (REDUCED, light),
        )
        _pairs(
            right,
            variants,
            ("memory_full_mib", "memory_reduced_mib"),
            ("full-order", "reduced"),
            (FULL, REDUCED),
        )
        left.axvline(1, color=INK, lw=1)
        left.set_xlabel("speedup over full-order [×]")
        right.set_xlabel("peak memory [MiB]")
        left.set_yticks(np.arange(len(variants)), [v["label"] for v in variants])
        left.set_ylim(len(variants) - 0.4, -0.6)
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
    key.legend(
        wedges, labels, loc="center left", bbox_to_anchor=(-0.18, 0.5), handlelength=1, labelspacing=0.7
    )


def _pairs(panel, variants: list[dict], columns, labels, colors) -> None:
    """Two bars a variant, each with its number at its end."""
    height = 0.36
    at = np.arange(len(variants))
    for k, (column, label, color) in enumerate(zip(columns, labels, colors, strict=True)):
        values = np.array([v[column] for v in variants], float)
        shown = np.nan_to_num(values)
        bars = panel.barh(at + (k - 0.5) * height, shown, height=height * 0.92, color=color, label=label)
        texts = ["not measured" if np.isnan(value) else number(value) for value in values]
        panel.bar_label(bars, texts, padding=3, fontsize=8.5, color=INK)
    panel.margins(x=0.16)
    panel.set_xlim(left=0)
    panel.grid(axis="x")
    panel.tick_params(axis="y", length=0)
    panel.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=2, columnspacing=1.2, handlelength=1.2)
