"""Colours of particles by several quantities, on scales that do not change with the parameter."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from nsf.bodies.colors import (
    CLIP,
    DIFFERENCE_COLORS,
    METRES,
    PASCALS,
    ROLES,
    SIGNED_COLORS,
    STRESS_COLORS,
    ColorScale,
)
from nsf.evaluation.metrics import pressure, von_mises
from nsf.live.model import LiveModel, Truth
from nsf.live.player import Moment

#: End of the scale of the distance to the truth, over the end of the scale of the displacement.
_DISTANCE = 0.05
DISTANCE = "distance to the truth"
_ROLES = np.array([[int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in ROLES], np.uint8)
SAMPLE = tuple(_ROLES[2].tolist())


@dataclass(frozen=True)
class Picture:
    """The drawing of a moment.

    Attributes:
        x_reduced: [n, 3] m; colors_reduced: [n, 3] of 8 bits.
        x_full, colors_full: the same of the full-order run; None without such a run.
    """

    x_reduced: np.ndarray
    colors_reduced: np.ndarray
    x_full: np.ndarray | None
    colors_full: np.ndarray | None


class Coloring:
    """Colours of a model's particles.

    Args:
        model: the training snapshots of this model set the scales.

    Attributes:
        scales: colour scale by name of the quantity; None for the particle sets, which have three colours.
    """

    def __init__(self, model: LiveModel):
        self._model = model
        x, tau = model.training_frames()
        moved = float(np.percentile(np.linalg.norm(x - model.X, axis=2), 99.5))
        equivalent, mean = (_of_stress(law, tau) for law in (von_mises, pressure))
        self.scales: dict[str, ColorScale | None] = {
            "von Mises stress": ColorScale.up_to(np.percentile(equivalent, CLIP), STRESS_COLORS, PASCALS),
            "pressure": ColorScale.up_to(np.percentile(abs(mean), CLIP), SIGNED_COLORS, PASCALS, signed=True),
            "displacement": ColorScale.up_to(moved, STRESS_COLORS, METRES),
            DISTANCE: ColorScale.up_to(_DISTANCE * moved, DIFFERENCE_COLORS, METRES),
            "particle sets": None,
        }

    def picture(self, moment: Moment, truth: Truth | None, by: str) -> Picture:
        """Positions and colours of a moment.

        Args:
            moment: the run and the step that are shown.
            truth: the full-order run at the same value, if there is one.
            by: a key of `scales`.
        """
        run, step, t = moment.run, moment.step, moment.t
        x = run.positions(step)
        x_full = truth.positions(t) if truth else None
        scale = self.scales[by]
        if scale is None:
            colors = _ROLES[self._model.roles(step)]
            return Picture(x, colors, x_full, colors if truth else None)
        if by == DISTANCE:
            if x_full is None:  # the distance is unknown, which no colour of the scale says
                return Picture(x, np.broadcast_to(_ROLES[0], x.shape), None, None)
            reduced, full = np.linalg.norm(x - x_full, axis=1), np.zeros(len(x))
        elif by == "displacement":
            reduced, full = (
                None if a is None else np.linalg.norm(a - self._model.X, axis=1) for a in (x, x_full)
            )
        else:
            law = von_mises if by == "von Mises stress" else pressure
            reduced = _of_stress(law, run.stress(step))
            full = _of_stress(law, truth.stress(t)) if truth else None
        return Picture(x, scale.pixels(reduced), x_full, scale.pixels(full) if truth else None)


def _of_stress(law: Callable[[torch.Tensor], torch.Tensor], tau: np.ndarray) -> np.ndarray:
    return law(torch.as_tensor(tau)).numpy()
