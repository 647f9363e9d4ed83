"""Quantities by which the page of `nsf view` colours particles, on scales that are the same in every case."""

from collections.abc import Callable

import numpy as np
import torch

from nsf.bodies.colors import (
    DIFFERENCE_COLORS,
    ROLES,
    SIGNED_COLORS,
    STRESS_COLORS,
    Categories,
)
from nsf.evaluation.metrics import pressure, von_mises
from nsf.live import page
from nsf.live.model import LiveModel, Truth
from nsf.live.player import Moment

#: End of the scale of the distance to the full-order run, over the end of the scale of the displacement.
_DISTANCE = 0.05
#: Shade of a particle whose value is unknown, which the page draws grey.
UNKNOWN = -1.0
STRESS, PRESSURE, DISPLACEMENT, DISTANCE, SETS = (
    "von_mises", "pressure", "displacement", "distance", "sets",
)  # fmt: skip


#: Values [n] over the end of their scale, of the reduced run and of the full-order one where there is one.
Shades = tuple[np.ndarray, np.ndarray | None]


class Coloring:
    """Values of a model's particles, from 0 to 1 over their scale.

    Args:
        model: its training snapshots set the scales.

    Attributes:
        quantities: by name, as `controls.mjs` reads them: title, unit, `low` and `top` of the scale [SI], its
            colours [256 × 3], and for categories their names in place of a scale.
    """

    def __init__(self, model: LiveModel):
        self._model = model
        tops, moved = model.tops, model.tops["displacement"]
        self.quantities = {
            STRESS: _scale("von Mises stress", "Pa", tops["von_mises"], STRESS_COLORS),
            PRESSURE: _scale("pressure", "Pa", tops["pressure"], SIGNED_COLORS, signed=True),
            DISPLACEMENT: _scale("displacement", "m", moved, STRESS_COLORS),
            DISTANCE: _scale("distance to the full-order run", "m", _DISTANCE * moved, DIFFERENCE_COLORS),
            SETS: {
                "title": "particle sets", "unit": "", "low": 0.0, "top": 2.0, "colors": _thirds(),
                "names": ["neither", "integration only", "sample"],
            },
        }  # fmt: skip

    def shades(self, moment: Moment, truth: Truth | None, by: str) -> Shades:
        """Values at a moment.

        Args:
            moment: the run and the step that are shown.
            truth: the full-order run of the same case, if there is one.
            by: a key of `quantities`.
        """
        run, step, t, X = moment.run, moment.step, moment.t, self._model.X
        if by == SETS:
            roles = self._model.roles(step)
            return self._over(by, roles, roles if truth else None)
        if by == DISTANCE:
            if truth is None:
                return np.full(len(X), UNKNOWN, np.float32), None
            apart = np.linalg.norm(run.positions(step) - truth.positions(t), axis=1)
            return self._over(by, apart, np.zeros(len(X)))
        if by == DISPLACEMENT:
            reduced, full = run.positions(step) - X, truth and truth.positions(t) - X
            return self._over(
                by, *(None if d is None else np.linalg.norm(d, axis=1) for d in (reduced, full))
            )
        law = von_mises if by == STRESS else pressure
        return self._over(
            by, _of_stress(law, run.stress(step)), _of_stress(law, truth.stress(t)) if truth else None
        )

    def _over(self, by: str, reduced: np.ndarray, full: np.ndarray | None) -> Shades:
        low, top = self.quantities[by]["low"], self.quantities[by]["top"]

        def shade(values: np.ndarray) -> np.ndarray:
            return np.clip((np.nan_to_num(values, nan=top) - low) / (top - low), 0.0, 1.0).astype(np.float32)

        return shade(reduced), None if full is None else shade(full)


def _scale(title: str, unit: str, top: float, cmap: str, signed: bool = False) -> dict:
    low = -top if signed else 0.0
    return {"title": title, "unit": unit, "low": low, "top": top, "colors": page.colors(cmap)}


def _thirds() -> list[int]:
    """[256 × 3] the colours of the particle sets, a third of the scale each."""
    colors = Categories(dict(enumerate(ROLES))).colors(np.arange(256) * 3 // 256)
    return (255 * colors).round().astype(int).ravel().tolist()


def _of_stress(law: Callable[[torch.Tensor], torch.Tensor], tau: np.ndarray) -> np.ndarray:
    return law(torch.as_tensor(tau)).numpy()
