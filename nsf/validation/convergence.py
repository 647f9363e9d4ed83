"""How far the paper's scenes are from themselves on finer grids: `nsf validate scenes=…`.

The first test case of a scene runs with half and a third of its cell, and with other particles. The first
particles of a finer run lie where those of the scene do, so that nothing is interpolated between them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.optimize import brentq

from nsf.config.scenes import load_scene
from nsf.kinematics.interpolation import interpolation
from nsf.results.columns import number
from nsf.results.folder import check_place, record, replaced
from nsf.results.formats import Rows, TerminalTable
from nsf.results.page import Page, Picture, Section, Table
from nsf.results.report import commit_text
from nsf.results.style import PALETTE, figure, save, styled
from nsf.results.table import parsed
from nsf.runs.provenance import provenance
from nsf.scalars import one_of
from nsf.scenes import Scene, Shape

#: In the order of the paper's Table 1.
SCENES = ("bread", "cake", "sand", "metal", "toothpaste", "jelly_cube", "squishy_ball")
FILE = "convergence.csv"
_TEXTS = ("scene", "scale", "case", "device", "commit")
_FRAMES = 5  # spread over the run, the last one included
_FINER = {"half": 2, "third": 3}
_MOST = 7e7  # particles times steps of a finer run, two minutes on a core; longer ones are left out on a CPU
_REDUCED = "table1/small"  # the report with the reduced runs of the same cases, at this scale:
_SCALE = "small"
_LEAD = (
    "How far is the grid of each scene from finer ones, and how far are reduced runs from the grid's own run?"
)
_NOTE = (
    "All distances are from the run of the scene, over how far its particles move, or over its stress. "
    "half, third: that of the cell and of the time step, with as many particles a cell; – where it takes "
    "over 7e7 steps of a particle, on a CPU. order p: from these two, as the error of a grid is taken to "
    "be C hᵖ. grid: the error of the scene's grid by this order. Both are – where half and third differ by "
    "less than `sampling`, and where they tell no order: where they go on growing the error is more than "
    "`third`. sampling: other particles on the same grid, carried to those of the scene; a smaller error "
    "tells of these particles, not of the body. projected, recurrence: means over the test cases and seeds "
    "of `table1/small`, of scenes at small scale."
)
_COLUMNS = {
    "half": "half [%]", "third": "third [%]", "grid": "grid [%]", "sampling": "sampling [%]",
    "projected": "projected [%]", "recurrence": "recurrence [%]", "half_stress": "τ half [%]",
    "third_stress": "τ third [%]", "sampling_stress": "τ sampling [%]", "projected_stress": "τ projected [%]",
    "recurrence_stress": "τ recurrence [%]",
}  # fmt: skip
_TICKS = (0.01, 0.1, 1, 10, 100)
_DRAWN = {"half": "half the cell", "sampling": "other particles", "projected": "projected run"}
_DRAWN |= {"recurrence": "recurrence"}
_CHART = "Distances from the full-order run of the scene, over how far its particles move."


@dataclass(frozen=True)
class Others(Shape):
    """A shape whose particles are those of another after its first ones: a second sampling.

    Attributes:
        shape: the other one.
    """

    shape: Shape

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return self.shape.volume

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return self.shape.bounds

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the shape is read from."""
        return self.shape.files

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        return self.shape.contains(x)

    def sample(self, count: int, start: int = 0) -> np.ndarray:
        """The points after the first `count` of the other shape."""
        return self.shape.sample(count, start + count)


@dataclass(frozen=True)
class Frames:
    """Particles X [P, 3] [m] of a run, and x [F, P, 3] [m] and τ [F, P, 9] [Pa] in a few frames."""

    X: np.ndarray
    x: np.ndarray
    tau: np.ndarray

    def distances(self, other: "Frames") -> tuple[float, float]:
        """Of another run at the same particles: over the displacement of this one, and over its stress."""
        moved, stress = np.linalg.norm(self.x - self.X), np.linalg.norm(self.tau)
        return (
            float(np.linalg.norm(other.x - self.x) / moved),
            float(np.linalg.norm(other.tau - self.tau) / stress),
        )

    def at(self, X: np.ndarray) -> "Frames":
        """Displacement and stress carried to points X [n, 3] [m] by moving least squares."""
        to = interpolation(torch.as_tensor(X), torch.as_tensor(self.X))

        def carried(frames: np.ndarray) -> np.ndarray:
            return to.value(torch.as_tensor(frames).movedim(0, 1)).movedim(1, 0).numpy()

        return Frames(X, X + carried(self.x - self.X), carried(self.tau))


def run(scene: Scene, device: str, like: Scene | None = None) -> Frames:
    """The frames of a full-order run, at the particles that it shares with the run of a scene it refines."""
    like = like or scene
    solver, frames = scene.full_order(device=device), []
    counts = [body.particles for body in scene.bodies.values()]
    shared = [body.particles for body in like.bodies.values()]
    starts = np.cumsum([0, *counts[:-1]])
    rows = np.concatenate([start + np.arange(n) for start, n in zip(starts, shared, strict=True)])
    stops = like.steps * np.arange(1, _FRAMES + 1) // _FRAMES * (scene.steps // like.steps)
    for stop in stops:
        solver.step(int(stop) - solver.steps_taken)
        state = solver.state.numpy()
        frames.append((state["x"][rows], state["tau"][rows].reshape(-1, 9)))
    x, tau = (np.stack(of).astype(float) for of in zip(*frames, strict=True))
    return Frames(solver.constants.X[rows], x, tau)


def second_sampling(scene: Scene) -> Scene:
    """The scene with other particles in each body; weak elements are drawn among them."""
    bodies = {name: replace(body, shape=Others(body.shape)) for name, body in scene.bodies.items()}
    return replace(scene, bodies=bodies)


def observed_order(half: float, third: float) -> float:
    """p of errors C hᵖ, from the distances of the runs with half and a third of the cell; NaN without one.

    (1 − 3⁻ᵖ)/(1 − 2⁻ᵖ) = third/half, which is log 3/log 2 at p = 0.
    """

    def excess(p: float) -> float:
        return (1.0 - 3.0**-p) / (1.0 - 2.0**-p) - third / half

    least, most = 0.5, 4.0  # a lower order would multiply the distances by more than three
    return float(brentq(excess, least, most)) if excess(least) > 0.0 > excess(most) else np.nan


def converge(folder: str | Path, options: Mapping[str, str], say: Callable[[str], object]) -> Path:
    """Run scenes on finer grids, and write the report of these and of those that the folder has already.

    Args:
        folder: of the report; rows of other scenes and scales stay. Errors of reduced runs are read from the
            table of all reports, in the folder that holds it.
        options: `scenes`, `scale` and `device`, as on the command line.
        say: called with a line on each scene.

    Returns:
        The report's page.

    Raises:
        ConfigError: a scene is not one of the paper's, or the folder is no report.
        DeviceError: the device does not exist.
    """
    folder = Path(folder)
    names = dict.fromkeys(one_of("scenes", name, SCENES) for name in options["scenes"].split(","))
    check_place(folder)
    scale, rows = options.get("scale", _SCALE), []
    for name in names:
        scene = load_scene(name, [f"scale={scale}"])
        rows.append({"scene": name, "scale": scale} | _row(scene, options.get("device", "cpu")))
        stated = [f"{_COLUMNS[key]} {number(rows[-1][key], 100)}" for key in _COLUMNS if key in rows[-1]]
        say(f"{name}: " + ", ".join(stated))
    frame = pd.DataFrame(rows)
    if (folder / FILE).is_file():
        frame = pd.concat([parsed(folder / FILE, _TEXTS), frame])
    frame = frame.drop_duplicates(["scene", "scale"], keep="last")
    order = {"key": lambda of: of.map(SCENES.index), "kind": "stable", "ignore_index": True}
    return _write(folder, frame.sort_values("scene", **order))


def _row(scene: Scene, device: str) -> dict:
    """The distances of one scene, in its first test case, as fractions."""
    start, case = process_time(), scene.split.test[0]
    scene = scene.at(case)
    exact = run(scene, device)
    row = {"case": case.named, "cell": scene.dx, "particles": scene.particle_count}
    for name, factor in _FINER.items():
        finer, distances = scene.coarsened(1.0 / factor, 1.0 / factor), (np.nan, np.nan)
        if device != "cpu" or finer.particle_count * finer.steps < _MOST:
            distances = exact.distances(run(finer, device, scene))
        row[name], row[f"{name}_stress"] = distances
    other = run(second_sampling(scene), device).at(exact.X)
    row["sampling"], row["sampling_stress"] = exact.distances(other)
    return row | {"seconds": process_time() - start, "device": device, "commit": commit_text(provenance())}


def completed(frame: pd.DataFrame, reports: Path) -> pd.DataFrame:
    """Distances with what follows from them, order and error of the grid, and the errors of reduced runs.

    Args:
        frame: a row a scene and scale.
        reports: the folder with the table of all reports.
    """
    apart = (frame["third"] - frame["half"]).abs() > frame["sampling"]
    pairs = zip(frame["half"], frame["third"], apart, strict=True)
    order = pd.Series([observed_order(*pair) if far else np.nan for *pair, far in pairs], frame.index)
    grid = frame["half"] / (1.0 - 2.0**-order)
    reduced = [_reduced(*row, reports) for row in zip(frame["scene"], frame["scale"], strict=True)]
    return frame.assign(order=order, grid=grid).join(pd.DataFrame(reduced, frame.index))


def _reduced(scene: str, scale: str, reports: Path) -> dict:
    """Errors of reduced runs of a scene in the table of all reports; NaN where it has none."""
    errors = {"": "displacement_error", "_stress": "stress_error"}
    names = {
        f"{model}{end}": (model, key) for model in ("projected", "recurrence") for end, key in errors.items()
    }
    if scale != _SCALE or not (reports / "results.csv").is_file():
        return dict.fromkeys(names, np.nan)
    table = pd.read_csv(reports / "results.csv", low_memory=False)
    table = table[(table["report"] == _REDUCED) & (table["scene"] == scene)]
    return {name: table.loc[table["model"] == model, key].mean() for name, (model, key) in names.items()}


def table(frame: pd.DataFrame) -> Rows:
    """The table of the page and of the terminal, of a completed frame."""
    columns = {"scene": _titles(frame), "case": frame["case"], "cell [m]": frame["cell"].map(number)}
    columns |= {"order p": frame["order"].map(number)}
    columns |= {heading: frame[key].map(lambda x: number(x, 100)) for key, heading in _COLUMNS.items()}
    body = [list(row) for row in zip(*columns.values(), strict=True)]
    return Rows(list(columns), body, [heading not in ("scene", "case") for heading in columns])


def _titles(frame: pd.DataFrame) -> pd.Series:
    """The scene of each row, with its scale unless it is the usual one."""
    return frame["scene"].where(frame["scale"] == _SCALE, frame["scene"] + ", " + frame["scale"])


def terminal(page: Path) -> TerminalTable:
    """The table of a report for a terminal."""
    return TerminalTable(table(completed(parsed(page.with_name(FILE), _TEXTS), page.parent.parent)))


def chart(frame: pd.DataFrame) -> Figure:
    """A row a scene: distances in displacement [%], on a logarithmic scale."""
    with styled():
        fig = figure(1.0 + 0.34 * len(frame))
        panel, at = fig.subplots(), np.arange(len(frame))
        for color, (key, title) in zip(PALETTE, _DRAWN.items(), strict=False):
            panel.plot(100.0 * frame[key], at, "o", color=color, label=title)
        panel.set(xscale="log", xlabel="displacement [%]", yticks=at, ylim=(len(frame) - 0.5, -0.5))
        panel.set(xlim=(0.01, 100.0), xticks=_TICKS, xticklabels=[f"{tick:g}" for tick in _TICKS])
        panel.set_yticklabels(_titles(frame).str.replace("_", " "))
        panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(_DRAWN))
        panel.grid(axis="x")
    return fig


def _write(folder: Path, frame: pd.DataFrame) -> Path:
    """The report of a table, whole or not at all."""
    full = completed(frame, folder.parent)
    rows, made = table(full), "; ".join(dict.fromkeys(frame["device"] + ", " + frame["commit"]))
    with replaced(folder) as fresh:
        frame.to_csv(fresh / FILE, index=False)
        save(chart(full), fresh, "distances", kinds=("png",))
        runs = frame[["scene", "scale", "particles", "seconds", "device", "commit"]]
        body = [[number(value) for value in row] for row in runs.itertuples(index=False, name=None)]
        headings = ["scene", "scale", "particles", "host CPU [s]", "device", "commit"]
        runs = Rows(headings, body, [heading in ("particles", "host CPU [s]") for heading in headings])
        page = Page(
            title="The grid's own error", lead=_LEAD, facts=[("Made", made)], warnings=[],
            tables=[Table("Distances", rows, _NOTE)],
            sections=[Section("Chart", [Picture(["distances.png"], _CHART, [])])],
            provenance=Table("Scenes", runs, "CPU time of the host over all runs of a scene."),
        )  # fmt: skip
        page.write(fresh)
        listed = vars(rows) | {"said": _NOTE, "made": made}
        content = {"title": page.title, "question": _LEAD, "runs": {}, "listed": listed}
        record(fresh, content | {"chart": {"file": "distances.png", "caption": _CHART}})
    return folder / "index.html"
