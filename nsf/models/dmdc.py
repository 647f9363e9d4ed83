"""`model=dmdc`: a linear system with inputs, fitted to latent vectors by least squares."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from nsf.errors import ConfigError, InstabilityError
from nsf.models.drawn import Drawn
from nsf.models.inputs import Inputs, Lessons, Validation
from nsf.models.latent import LatentModel
from nsf.recurrence.engine import between
from nsf.scalars import number


@dataclass(frozen=True)
class DMDc(Drawn, LatentModel):
    """x̂ₙ₊₁ = x̂ₙ + A [x̂ₙ, …, x̂ₙ₋q₊₁] + B u + b in strides, with u parameters, gravity and solids.

    Attributes:
        delays: q, past states in the state; ridge: of the least squares, over the mean square of a column.
            Of each all are tried, and the pair is taken that is nearest at validation runs.

    Source: Proctor, Brunton and Kutz 2016, "Dynamic mode decomposition with control"; with past states as in
    Arbabi and Mezić 2017.
    """

    delays: Sequence[int] = (2, 4, 8)
    ridge: Sequence[float] = (1e-8, 1e-5, 1e-3)

    def __post_init__(self):
        super().__post_init__()
        for name, least in (("delays", 1), ("ridge", 0)):
            values = getattr(self, name)
            if not isinstance(values, list | tuple) or not values:
                raise ConfigError(f"model.{name}={values} must be a list of numbers, as [{least}]")
            for value in values:
                number(f"model.{name}", value, least, whole=name == "delays")

    @override
    def fit(self, manifold, lessons: Lessons, validation: Validation | None, seed: int) -> dict[str, Any]:
        stride = self.stride_of(lessons.xhat.shape[1] - 1)
        nodes, best, least = lessons.xhat[:, ::stride].astype(float), None, np.inf
        u = lessons.inputs.in_strides(stride)
        target = np.diff(nodes, axis=1).reshape(-1, nodes.shape[2])
        for q in self.delays:
            rows = np.concatenate([_history(nodes, lessons.inputs.first * stride, q), u], 2)
            rows = rows.reshape(len(target), -1)
            mean, scale = rows.mean(0), rows.std(0)
            scale[scale <= 1e-9 * np.abs(rows).max(0)] = np.inf  # what never varies is in b
            columns, level = (rows - mean) / scale, target.mean(0)
            square, across = columns.T @ columns / len(rows), columns.T @ (target - level) / len(rows)
            for ridge in self.ridge:
                lines = np.linalg.lstsq(square + ridge * np.eye(len(square)), across, rcond=None)[0]
                matrix = lines / scale[:, None]
                content = {"matrix": matrix, "level": level - mean @ matrix}
                fitted = {name: torch.as_tensor(values) for name, values in content.items()}
                fitted |= {"delays": int(q), "stride": stride}
                error = validation.error(self.run(fitted, validation.inputs))
                if error < least:
                    best, least = fitted, error
        if best is None:
            raise InstabilityError(
                "every linear system that was fitted loses a validation run; raise model.ridge or model.runs"
            )
        return best

    @override
    def run(self, fitted: dict[str, Any], inputs: Inputs) -> np.ndarray:
        matrix, level = fitted["matrix"].numpy(), fitted["level"].numpy()
        stride, q, first = fitted["stride"], fitted["delays"], inputs.first * fitted["stride"]
        u, nodes = inputs.in_strides(stride), inputs.start[:, None]
        past = _history(nodes, first, q)[:, 0]
        r = nodes.shape[2]
        path = [past[:, :r]]
        with np.errstate(over="ignore", invalid="ignore"):  # a system may be unstable
            for n in range(u.shape[1]):
                path.append(path[-1] + np.hstack([past, u[:, n]]) @ matrix + level)
                past = np.hstack([path[-1], past[:, :-r]])
        nodes = torch.as_tensor(np.stack(path, 1))
        return between(nodes, torch.as_tensor(first), stride).numpy()


def _history(nodes: np.ndarray, first: np.ndarray, q: int) -> np.ndarray:
    """[B, N, q r] of x̂ [B, N + 1, r], or of one node: the q last ones before each stride.

    Before t = 0 it goes back by `first` [B, r] a stride.
    """
    back = [nodes[:, :1] - j * first[:, None] for j in range(q - 1, 0, -1)]
    whole, count = np.concatenate([*back, nodes], 1), max(1, nodes.shape[1] - 1)
    return np.concatenate([whole[:, q - 1 - j : q - 1 - j + count] for j in range(q)], 2)
