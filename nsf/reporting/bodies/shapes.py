"""Particle pictures: final shapes, strips and animations of full-order and reduced models side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from nsf.reporting.bodies.camera import Camera, View
from nsf.reporting.bodies.gif import gif
from nsf.reporting.bodies.sheet import Sheet
from nsf.reporting.bodies.solids import Face, faces, reaches, upright
from nsf.reporting.sources import Motion
from nsf.reporting.text.columns import parameter_text
from nsf.results.style import (
    CLIP,
    DIFFERENCE_COLORS,
    METRES,
    PASCALS,
    ROLES,
    STRESS_COLORS,
    ColorScale,
    styled,
)
from nsf.vectors import spaced

if TYPE_CHECKING:
    from nsf.evaluation import SuperResolution

GIF_BYTES = 2**20
_THIN = 0.5  # of the larger horizontal extent: below it a body, as a slice or a frame, counts as thin
_INSIDE = 0.5  # share of all particles' stress below which a surface tells little of it
#: Of particles in N alone and in S over the whole body: S stands out, and both are seen through it.
_OPACITIES = 0.5, 1.0
_WHITE = 250  # of 255: a brighter pixel shows no particle
_LOOKS = 7  # frames by which a window is chosen
_STRESS = "von Mises equivalent of the Kirchhoff stress"


@dataclass(frozen=True)
class Case:
    """A case in pictures.

    Attributes:
        motion: of both models; baseline: of the baseline in the same case.
        place: which of several it is: "worst" or "best" of its variant and seed, a setting, or nothing.
        delta: δ as a fraction, where it is to be said.
    """

    motion: Motion
    place: str = ""
    delta: float = np.nan
    baseline: Motion | None = None

    @property
    def remark(self) -> str:
        """What is said of it in a picture."""
        return ", ".join(
            [self.place] * bool(self.place) + [f"δ {100 * self.delta:.2g} %"] * bool(np.isfinite(self.delta))
        )

    def models(self) -> Iterator[tuple[str, Motion, np.ndarray, np.ndarray]]:
        """Of each model its name, its motion, x [F, n, 3] [m] and the equivalent of τ [F, n] [Pa]."""
        m = self.motion
        yield "full-order", m, m.x_full, m.stress_full
        yield "reduced", m, m.x_reduced, m.stress_reduced
        if (b := self.baseline) is not None:
            yield "deformation only", b, b.x_reduced, b.stress_reduced


class Stage:
    """Where a scene is seen from: one camera, window and size of particles for all its pictures.

    Args:
        cases: all that are known of the scene; `cases` of the stage are upright (`solids.upright`).
        cut: whether the front half is cut away; not of a thin body, which hides nothing inside.
    """

    def __init__(self, cases: Sequence[Case], cut: bool = False):
        upright_ones = [
            replace(c, motion=upright(c.motion), baseline=c.baseline and upright(c.baseline)) for c in cases
        ]
        X = upright_ones[0].motion.x_full[0]
        self.camera, self.radius = Camera.facing(X), _radius(X)
        self.cut, self._middle = cut and is_cut_open(X), X.mean(axis=0, dtype=float)
        self.cases = [self._cut(case) for case in upright_ones] if self.cut else upright_ones
        self._whole = [case.motion for case in upright_ones]
        self._reach = reaches(self._whole)

    def _cut(self, case: Case) -> Case:
        """The case without its front half."""
        baseline = case.baseline and self._behind(case.baseline)
        return replace(case, motion=self._behind(case.motion), baseline=baseline)

    def _behind(self, motion: Motion) -> Motion:
        """The particles that start behind the middle, as the camera sees them; each run kept its own."""
        toward = self.camera.axes[2] * (1.0, 1.0, 0.0)
        rows = (motion.x_full[0].astype(float) - self._middle) @ toward <= 0.0
        names = ("x_full", "x_reduced", "stress_full", "stress_reduced", "role")
        known = {name: values for name in names if (values := getattr(motion, name)) is not None}
        return replace(motion, **{name: values[:, rows] for name, values in known.items()})

    @cached_property
    def _window(self) -> View:
        motions = self._whole
        frames = spaced(len(motions[0].t), _LOOKS)
        x = np.concatenate([m.x_full[frames].reshape(-1, 3) for m in motions])
        seen = [face.corners for m in motions for frame in frames for face in self.faces(m, int(frame))]
        return View.around(x, 100, self.camera, np.concatenate(seen) if seen else None)

    def view(self, width: int) -> View:
        """The window, so many pixels wide."""
        return replace(self._window, width=width)

    def picture(self, view: View, motion: Motion, frame: int, x: np.ndarray, colors) -> np.ndarray:
        """Pixels of particles x [n, 3] among the colliders of a motion's frame."""
        return view.picture(x, colors, self.radius, self.faces(motion, frame))

    def faces(self, motion: Motion, frame: int) -> list[Face]:
        """What is seen of the colliders at a motion's frame."""
        return faces(motion, frame, self.camera.axes[2], self._reach)


def final_shapes(cases: Sequence[Case], name: str = "parameter", unit: str = "") -> Figure:
    """Last frame of each case: full-order, reduced, and the distance between the two.

    The front half is cut away (`is_cut_open`): a free surface carries little stress, the inside does.

    Args:
        cases: one a row; positions in metres.
        name, unit: of the problem parameter.
    """
    stage = Stage(cases, cut=True)
    motions = [case.motion for case in stage.cases]
    stress = _stress_scale([m.stress_full[-1] for m in motions])
    apart = [np.linalg.norm(m.x_reduced[-1] - m.x_full[-1], axis=-1) for m in motions]
    distance = ColorScale.up_to(_percentile(np.concatenate(apart), 99.5), DIFFERENCE_COLORS, METRES)
    view = stage.view(520)
    with styled():
        sheet = Sheet(view, rows=len(motions), columns=3, titles=("full-order", "reduced", "distance apart"))
        for row, (case, d) in enumerate(zip(stage.cases, apart, strict=True)):
            m = case.motion
            _name(
                sheet, row, [parameter_text(m.parameter, name, unit), f"t = {m.t[-1]:.3g} s", case.remark], m
            )
            shown = (
                (m.x_full[-1], stress.colors(m.stress_full[-1])),
                (m.x_reduced[-1], stress.colors(m.stress_reduced[-1])),
                (m.x_reduced[-1], distance.colors(d)),
            )
            for column, (x, colors) in enumerate(shown):
                sheet.show(row, column, stage.picture(view, m, -1, x, colors))
        sheet.color_bar(stress, 0, 1, _STRESS)
        sheet.color_bar(distance, 2, 2, "distance ‖x_rom − x_fom‖")
        sheet.scale_bar()
    return sheet.fig


def fine_shapes(
    fine: list["SuperResolution"], around: Sequence[Mapping], name: str = "parameter", unit: str = ""
) -> Figure:
    """Last frame of the reduced run at its particles and at many more points, and the fine full-order run.

    Whole bodies, coloured by ‖x − X‖: a picture of many points shows the surface, which carries no stress.

    Args:
        fine: one a row.
        around: the surroundings of each at its last frame alone.
        name, unit: of the problem parameter.
    """
    motions = []
    for f, by in zip(fine, around, strict=True):
        x, none = (f.x_full[None], f.x_reduced[None]), np.zeros((1, len(f.X)))
        motions.append(upright(Motion(f.row["parameter"], "", np.zeros(1), *x, none, none, None, by)))
    distances = np.linalg.norm(fine[0].x_full - fine[0].X, axis=1)
    moved = ColorScale.up_to(_percentile(distances, 99.5), STRESS_COLORS, METRES)
    stage = Stage([Case(m) for m in motions])
    view = stage.view(520)
    count, more = len(fine[0].particles), len(fine[0].X)
    titles = (f"reduced, {count:,} particles", f"reduced, {more:,} points", f"full-order, {more:,} particles")
    few, many = (_radius(fine[0].X[rows]) for rows in (fine[0].particles, ...))
    with styled():
        sheet = Sheet(view, rows=len(fine), columns=3, titles=titles)
        for row, (f, m) in enumerate(zip(fine, motions, strict=True)):
            sheet.name_row(row, parameter_text(m.parameter, name, unit))
            x_full, x_reduced = m.x_full[-1], m.x_reduced[-1]
            shown = ((x_reduced, f.x_reduced, f.particles, few), (x_reduced, f.x_reduced, ..., many),
                     (x_full, f.x_full, ..., many))  # fmt: skip
            for column, (x, own, rows, radius) in enumerate(shown):
                front = view.front(x[rows], radius)
                colors = moved.colors(np.linalg.norm(own[rows][front] - f.X[rows][front], axis=1))
                solids = stage.faces(m, -1)
                sheet.show(row, column, view.picture(x[rows][front], colors, radius, solids))
        sheet.color_bar(moved, 0, 2, "displacement ‖x − X‖")
        sheet.scale_bar()
    return sheet.fig


def particle_sets(case: Case, name: str = "parameter", unit: str = "", count: int = 4) -> Figure:
    """S and N in `count` frames of a reduced run, as seen through the body.

    Args:
        case: whose motion has `role`; positions in metres.
        name, unit: of the problem parameter.
        count: of frames; all where there are fewer.
    """
    stage = Stage([case])
    (case,) = stage.cases
    m = case.motion
    frames = spaced(len(m.t), count)
    view = stage.view(520)
    with styled():
        titles = [f"t = {m.t[frame]:.3g} s" for frame in frames]
        sheet = Sheet(view, rows=1, columns=len(frames), titles=titles)
        _name(sheet, 0, [parameter_text(m.parameter, name, unit), case.remark], m)
        for column, frame in enumerate(frames):
            x, role = m.x_reduced[frame], m.role[frame]
            picture = stage.picture(view, m, frame, x, _in_color(x, ROLES[0]))
            for number, opacity in enumerate(_OPACITIES, 1):
                own = x[role == number]
                over = view.picture(own, _in_color(own, ROLES[number]), stage.radius)
                picture = _laid_over(picture, over, opacity)
            sheet.show(0, column, picture)
        sheet.legend(
            dict(zip(("in neither", "integration particles N", "sample particles S"), ROLES, strict=True))
        )
        sheet.scale_bar()
    return sheet.fig


def _laid_over(picture: np.ndarray, over: np.ndarray, opacity: float) -> np.ndarray:
    """Pixels with those of another picture over them, where that shows a particle."""
    mixed = (1 - opacity) * picture + opacity * over
    return np.where((over < _WHITE).any(axis=-1, keepdims=True), mixed, picture).astype(np.uint8)


def strip(cases: Sequence[Case], name: str = "parameter", unit: str = "", count: int = 5) -> Figure:
    """The motion of each case in `count` pictures, a row a model.

    Whole bodies, but cut open where the surface carries little of the stress.

    Args:
        cases: positions in metres.
        name, unit: of the problem parameter.
    """
    stage = Stage(cases, cut=hides_stress(cases[0].motion))
    motion = stage.cases[0].motion
    frames = spaced(len(motion.t), count)
    stress = _stress_scale([case.motion.stress_full for case in stage.cases])
    view = stage.view(420)
    rows = [(case, *model) for case in stage.cases for model in case.models()]
    with styled():
        sheet = Sheet(view, len(rows), len(frames), [f"t = {motion.t[k]:.3g} s" for k in frames])
        for row, (case, model, m, x, values) in enumerate(rows):
            own = m is case.motion and x is not m.x_full
            told = [model, parameter_text(m.parameter, name, unit), case.remark if own else ""]
            _name(sheet, row, told, None if x is case.motion.x_full else m)
            for column, k in enumerate(frames):
                colors = stress.colors(values[k])
                sheet.show(row, column, stage.picture(view, case.motion, k, x[k], colors))
        sheet.color_bar(stress, 0, len(frames) - 1, _STRESS)
        sheet.scale_bar()
    return sheet.fig


def animation(
    cases: Sequence[Case], path, name: str = "parameter", unit: str = "", frames: int = 31, width: int = 380,
    max_bytes: int = GIF_BYTES,
) -> None:  # fmt: skip
    """Write a gif: the models side by side, cut open, coloured by stress, with the time.

    Args:
        cases: one or two, a row each.
        path: of the gif.
        name, unit: of the problem parameter.
        frames: at most this many, evenly spread over the simulated time.
        width: of one picture of two [pixel].
        max_bytes: colours, size and frames are given up in that order until the file is no larger.
    """
    stage = Stage(cases, cut=True)
    rows = [list(case.models()) for case in stage.cases]
    stress = _stress_scale([case.motion.stress_full for case in stage.cases])
    titles = [model for model, *_ in max(rows, key=len)]
    width = 2 * width // len(titles)
    view = stage.view(width)
    times = stage.cases[0].motion.t
    chosen = spaced(len(times), frames)
    images = []
    with styled():
        inches = len(titles) * width / 100 + 0.5
        sheet = Sheet(view, len(rows), len(titles), titles, inches=inches, dpi=100)
        sheet.color_bar(stress, 0, len(titles) - 1, _STRESS)
        sheet.scale_bar()
        clock = sheet.clock()
        for row, case in enumerate(stage.cases):
            _name(sheet, row, [parameter_text(case.motion.parameter, name, unit), case.remark], case.motion)
        for frame in chosen:
            for row, models in enumerate(rows):
                around = stage.cases[row].motion
                for column, (_, _, x, values) in enumerate(models):
                    colors = stress.colors(values[frame])
                    sheet.show(row, column, stage.picture(view, around, frame, x[frame], colors))
            clock.set_text(f"t = {times[frame]:.2f} s")
            images.append(sheet.pixels())
    path.write_bytes(gif(images, max_bytes))


def is_cut_open(X: np.ndarray) -> bool:
    """Whether pictures cut the front half of a body X [n, 3] away: not of a thin one, which hides nothing."""
    extent = np.ptp(X[:, :2], axis=0)
    return bool(extent.min() > _THIN * extent.max())


def hides_stress(motion: Motion) -> bool:
    """Whether the stress lies within the body: what is seen from outside carries little of it."""
    X, x = motion.x_full[0], motion.x_full[-1]
    view = View.around(x, 100)
    front = view.front(x, _radius(X))
    seen, everywhere = motion.stress_full[-1][front].mean(), motion.stress_full[-1].mean()
    return is_cut_open(X) and bool(seen < _INSIDE * everywhere)


def _in_color(x: np.ndarray, color: str) -> np.ndarray:
    """One colour for each of the particles x [n, 3]."""
    return np.broadcast_to(to_rgb(color), x.shape)


def _name(sheet: Sheet, row: int, told: Sequence[str], motion: Motion | None) -> None:
    """Name a row; over a run that diverged, that what stands there is its last good state."""
    stopped = motion.stopped if motion is not None else None
    warning = "" if stopped is None else f"diverged; shown as at t = {stopped:.3g} s"
    sheet.name_row(row, ", ".join(filter(None, told)), warning)


def _stress_scale(values: Sequence[np.ndarray]) -> ColorScale:
    return ColorScale.up_to(
        np.percentile(np.concatenate([own.ravel() for own in values]), CLIP), STRESS_COLORS, PASCALS
    )


def _radius(X: np.ndarray) -> float:
    """A sphere's radius [m] at which particles X [n, 3] look closed: from how near their neighbours are."""
    neighbours = min(8, len(X) - 1)
    reach = cKDTree(X).query(X, neighbours + 1)[0][:, -1]
    return max(0.58 * float(np.median(reach)), 1e-9)


def _percentile(values: np.ndarray, percent: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if len(finite) else 0.0
