"""Pictures of evaluated cases, by `nsf.bodies`: final shapes, strips and films of models side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from nsf import bodies
from nsf.bodies import Body, Categories, ColorScale, is_cut_open
from nsf.bodies.colors import CLIP, DIFFERENCE_COLORS, METRES, PASCALS, ROLES, STRESS_COLORS
from nsf.bodies.film import GIF_BYTES
from nsf.reporting.sources import Motion
from nsf.reporting.text.columns import parameter_text

if TYPE_CHECKING:
    from nsf.evaluation import SuperResolution

__all__ = [
    "GIF_BYTES", "Case", "animation", "final_shapes", "fine_shapes", "hides_stress", "is_cut_open",
    "particle_sets", "strip",
]  # fmt: skip

_STRESS = "von Mises equivalent of the Kirchhoff stress"
_SETS = dict(zip(("in neither", "integration particles N", "sample particles S"), ROLES, strict=True))
#: Opacity of particles in N alone and in S: S stands out, and both are seen through the body.
_THROUGH = {1: 0.5, 2: 1.0}


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
        """Its place and δ, for the name of a row."""
        return ", ".join(
            [self.place] * bool(self.place) + [f"δ {100 * self.delta:.2g} %"] * bool(np.isfinite(self.delta))
        )

    def models(self, scale: ColorScale, name: str, unit: str) -> Iterator[tuple[str, Body]]:
        """Each model's name and body."""
        value, m, b = parameter_text(self.motion.parameter, name, unit), self.motion, self.baseline

        def body(model: str, x, stress, remark: str = "", stopped: float | None = None) -> Body:
            told = ", ".join(filter(None, (model, value, remark)))
            return Body(x, stress, scale, m.surroundings, told, _warning(stopped))

        yield "full-order", body("full-order", m.x_full, m.stress_full)
        yield "reduced", body("reduced", m.x_reduced, m.stress_reduced, self.remark, m.stopped)
        if b is not None:
            model = "deformation only"
            yield model, body(model, b.x_reduced, b.stress_reduced, stopped=b.stopped)


def final_shapes(cases: Sequence[Case], name: str = "parameter", unit: str = "") -> Figure:
    """Last frame of each case: full-order, reduced, and the distance between the two.

    The front half is cut away (`is_cut_open`): a free surface carries little stress, the inside does.

    Args:
        cases: one a row; positions in metres.
        name, unit: of the problem parameter.
    """
    motions, ends = [case.motion for case in cases], [0, -1]
    stress = _stress_scale([m.stress_full[-1] for m in motions])
    apart = [np.linalg.norm(m.x_reduced - m.x_full, axis=-1)[ends] for m in motions]
    finite = np.concatenate([d[-1][np.isfinite(d[-1])] for d in apart])
    top = np.percentile(finite, 99.5) if len(finite) else 0.0
    distance = ColorScale.up_to(top, DIFFERENCE_COLORS, METRES, title="distance ‖x_rom − x_fom‖")
    rows = []
    for case, m, d in zip(cases, motions, apart, strict=True):
        value, t = parameter_text(m.parameter, name, unit), f"t = {m.t[-1]:.3g} s"
        told = ", ".join(filter(None, (value, t, case.remark)))
        around, warning = _at(m.surroundings, ends), _warning(m.stopped)
        rows.append(
            [
                Body(x[ends], values, scale, around, told, warning)
                for x, values, scale in (
                    (m.x_full, m.stress_full[ends], stress),
                    (m.x_reduced, m.stress_reduced[ends], stress),
                    (m.x_reduced, d, distance),
                )
            ]
        )
    return bodies.grid(rows, ("full-order", "reduced", "distance apart"), cut=True)


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
    distances = np.linalg.norm(fine[0].x_full - fine[0].X, axis=1)
    moved = ColorScale.up_to(
        np.percentile(distances[np.isfinite(distances)], 99.5), STRESS_COLORS, METRES,
        title="displacement ‖x − X‖",
    )  # fmt: skip
    rows = []
    for f, by in zip(fine, around, strict=True):
        told, twice = parameter_text(f.row["parameter"], name, unit), _at(by, [-1, -1])
        shown = ((f.x_reduced, f.particles), (f.x_reduced, ...), (f.x_full, ...))
        rows.append(
            [
                Body(
                    np.stack([f.X[which], x[which]]),
                    np.linalg.norm(np.stack([np.zeros_like(x), x - f.X])[:, which], axis=-1),
                    moved, twice, told,
                )
                for x, which in shown
            ]
        )  # fmt: skip
    count, more = len(fine[0].particles), len(fine[0].X)
    titles = f"reduced, {count:,} particles", f"reduced, {more:,} points", f"full-order, {more:,} particles"
    return bodies.grid(rows, titles)


def particle_sets(case: Case, name: str = "parameter", unit: str = "", count: int = 4) -> Figure:
    """S and N in `count` frames of a reduced run, as seen through the body.

    Args:
        case: whose motion has `role`; positions in metres.
        name, unit: of the problem parameter.
        count: of frames; all where there are fewer.
    """
    m = case.motion
    told = ", ".join(filter(None, (parameter_text(m.parameter, name, unit), case.remark)))
    body = Body(m.x_reduced, m.role, Categories(_SETS), m.surroundings, told, _warning(m.stopped), _THROUGH)
    return bodies.strip([body], m.t, count)


def strip(cases: Sequence[Case], name: str = "parameter", unit: str = "", count: int = 5) -> Figure:
    """The motion of each case in `count` pictures, a row a model.

    Whole bodies, but cut open where the surface carries little of the stress.

    Args:
        cases: positions in metres.
        name, unit: of the problem parameter.
    """
    stress = _stress_scale([case.motion.stress_full for case in cases])
    rows = [body for case in cases for _, body in case.models(stress, name, unit)]
    return bodies.strip(rows, cases[0].motion.t, count, hides_stress(cases[0].motion))


def animation(
    cases: Sequence[Case], path, name: str = "parameter", unit: str = "", frames: int = 31, width: int = 380,
    max_bytes: int = GIF_BYTES,
) -> None:  # fmt: skip
    """Write a film: the models side by side, cut open, coloured by stress, with the time.

    Args:
        cases: one or two, a row each.
        path: of the film.
        name, unit: of the problem parameter.
        frames: at most this many, evenly spread over the simulated time.
        width: of one picture of two [pixel].
        max_bytes: of a GIF at most.
    """
    stress = _stress_scale([case.motion.stress_full for case in cases])
    models = [list(case.models(stress, name, unit)) for case in cases]
    titles = [model for model, _ in max(models, key=len)]
    rows = [[body for _, body in row] for row in models]
    images = bodies.frames(rows, cases[0].motion.t, titles, frames, 2 * width, cut=True)
    bodies.film(images, path, most=max_bytes)


def hides_stress(motion: Motion) -> bool:
    """Whether the stress lies within the body: its surface carries little of it."""
    return bodies.hides_inside(motion.x_full[0], motion.x_full[-1], motion.stress_full[-1])


def _warning(stopped: float | None) -> str:
    """Over a run that diverged, that its last good state stands there."""
    return "" if stopped is None else f"diverged; shown as at t = {stopped:.3g} s"


def _at(around: Mapping[str, np.ndarray], frames: list[int]) -> dict[str, np.ndarray]:
    """Surroundings in some of their frames."""
    still = ("solid_shape", "solid_extents")
    return {name: values if name in still else values[frames] for name, values in around.items()}


def _stress_scale(values: Sequence[np.ndarray]) -> ColorScale:
    top = np.percentile(np.concatenate([own.ravel() for own in values]), CLIP)
    return ColorScale.up_to(top, STRESS_COLORS, PASCALS, title=_STRESS)
