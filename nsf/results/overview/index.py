"""A page of all runs that sorts and filters in the browser, and needs nothing but itself."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from PIL import Image

from nsf.data import Trajectory, archives
from nsf.deployment import Rollout
from nsf.results.formats import HTML
from nsf.results.overview.tables import Column, columns
from nsf.results.style import FULL, PALETTE, figure, model_color, styled
from nsf.runs import Run
from nsf.runs.listing import FIELDS, Entry, entries, text
from nsf.storage import write_text, writing

_CHOSEN = ("stage", "scene", "status")

_SIZE = (1.6, 1.0)  # [inch] at 100 dpi
_POINTS = 1500
_REDUCED = model_color("projected")


def write_index(folder: Path, root: Path | None = None) -> Path:
    """Write `index.html` of all runs, and a thumbnail of each that has something to be seen.

    Args:
        folder: of the page; thumbnails lie in `folder/thumbnails`, and are drawn once.
        root: folder of all runs; NSF_RUNS, else ./runs.

    Returns:
        The page.

    Raises:
        StorageError: the disk refused a file.
    """
    runs = entries(root=root)
    shown, _ = columns(runs)
    choices = [
        {
            "name": field,
            "column": 1 + FIELDS.index(field),  # the first is the thumbnail
            "choices": sorted({str(entry.values[field]) for entry in runs}),
        }
        for field in _CHOSEN
    ]
    page = HTML.get_template("runs.html").render(
        title="Runs",
        choices=choices,
        headings=[column.title for column in shown],
        rows=[_row(entry, shown, folder) for entry in runs],
    )
    return write_text(folder / "index.html", page)


def _row(entry: Entry, shown: Sequence[Column], folder: Path) -> dict:
    """A row of the page: its cells as shown, and the values by which they sort."""
    picture = f"thumbnails/{entry.run.id}.png"
    return {
        "picture": picture if thumbnail(entry.run, folder / picture) else None,
        "link": Path(os.path.relpath(entry.run.path / "manifest.json", folder)).as_posix(),
        "error": text(entry.fault or entry.manifest.get("error") or ""),
        "cells": [
            {"name": column.key, "text": column.text(entry), "value": "" if value is None else value}
            for column in shown
            for value in [column.value(entry)]
        ],
    }


def thumbnail(run: Run, path: Path) -> bool:
    """Draw a run into a png, unless it is there already; False where there is nothing to be seen.

    Raises:
        StorageError: the disk refused the file.
    """
    if path.is_file():
        return True
    draw = _DRAWN.get(run.stage)
    if draw is None or not run.complete:
        return False
    with styled():
        fig = figure(_SIZE[1], _SIZE[0])
        fig.set_layout_engine("none")
        ax = fig.add_axes((0, 0, 1, 1))
        ax.axis("off")
        try:
            draw(ax, run)
        except Exception:
            return False  # a page of all runs must not fail for one whose files are not what they should be
        with writing(path) as partial:
            fig.savefig(partial, metadata={"Software": None})
    return True


def _simulated(ax: Axes, run: Run) -> None:
    """The particles at the end."""
    with Trajectory.of(run) as trajectory:
        step = max(1, trajectory.particles // _POINTS)
        x = trajectory.read("x", trajectory.frames - 1, slice(None, None, step)).reshape(-1, 3)
    _scatter(ax, x, FULL)


def _trained(ax: Axes, run: Run) -> None:
    """The losses of the three phases."""
    phases: dict[str, list[Path]] = {}
    for log in sorted(run.path.glob("*/csv/*/metrics.csv")):
        phases.setdefault(log.parents[2].name, []).append(log)
    if not phases:
        raise ValueError("no log")
    for color, (phase, logs) in zip(PALETTE, phases.items(), strict=False):
        loss = pd.concat(map(pd.read_csv, logs)).sort_values("step")
        name = f"{phase}/loss" if f"{phase}/loss" in loss else "loss"  # of earlier versions
        ax.semilogy(loss["step"], loss[name], color=color, linewidth=1)


def _deployed(ax: Axes, run: Run) -> None:
    """The first two latent coordinates of every reduced run."""
    for path in sorted(run.path.glob("rollout_*.h5")):
        xhat = Rollout.open(run.file(path.name)).xhat
        ax.plot(xhat[:, 0], xhat[:, min(1, xhat.shape[1] - 1)], color=_REDUCED, linewidth=1)


def _evaluated(ax: Axes, run: Run) -> None:
    """The particles at the end, full-order and reduced, of the first value."""
    frames = archives.arrays(run.file("frames.npz"), "frames", "evaluate")
    for name, color in (("x_full", FULL), ("x_reduced", _REDUCED)):
        x = frames[name][0, -1]
        _scatter(ax, x[:: max(1, len(x) // _POINTS)], color)


def _superresolved(ax: Axes, run: Run) -> None:
    """The picture that the run holds."""
    with Image.open(run.file("superresolution.png")) as picture:
        picture.thumbnail((320, 200))
        ax.imshow(np.asarray(picture))


def _scatter(ax: Axes, x: np.ndarray, color: str) -> None:
    ax.scatter(x[:, 0], x[:, 2], s=2.0, color=color, linewidths=0, alpha=0.7)
    ax.set_aspect("equal", adjustable="datalim")


_DRAWN: dict[str, Callable[[Axes, Run], None]] = {
    "simulate": _simulated,
    "train": _trained,
    "deploy": _deployed,
    "evaluate": _evaluated,
    "superresolve": _superresolved,
}
