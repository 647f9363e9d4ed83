"""Whether to believe a reduced run: how far it is from what its fields were trained on.

A reduced run has no truth beside it, but two things tell when it leaves its training data: the sample
particles move where no latent vector can follow, which leaves a projection residual, and the latent vector
goes where no training snapshot was. Both are measured in units of what training data themselves show, so
that a ratio of 1 means "as far as training data are from themselves". Not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

#: Of the distances between training trajectories: the largest ones are of single frames.
QUANTILE = 0.95
#: A calibration run gone astray must not vouch for others: beyond this many medians it does not count.
STRAY = 2.0
_ROWS = 256  # steps decoded, and held with their distances to all training snapshots, at once


class LatentDistance:
    """How far latent vectors are from the training latents, as a distance of the sample particles [m].

    The RMS distance of g(X_S, x̂) to the nearest g(X_S, x̂_train). Between latents of unit variance a
    component that hardly moves anything would count as much as the first.

    Args:
        manifold: trained fields.
        particles: [s] indices of S, of all phases.
        device: torch device.
    """

    def __init__(self, manifold, particles: np.ndarray, device: str | torch.device = "cpu"):
        self._at = manifold.restrict(particles=torch.as_tensor(particles), device=device)
        known = self._positions(manifold.training_latents)
        self._origin = known.mean(0)  # near which distances lose fewer digits
        self._known = known - self._origin
        self._trajectories = manifold.training_trajectories.to(device)

    def of(self, xhat: np.ndarray) -> np.ndarray:
        """Distance [n] [m] of latent vectors [n, r] to the nearest training latent; NaN where x̂ is."""
        return _nearest(self._positions(torch.as_tensor(xhat)) - self._origin, self._known).cpu().numpy()

    def between_trajectories(self) -> np.ndarray:
        """[M] distance [m] of each training latent to the nearest of another trajectory; [0] if none."""
        found = [np.zeros(0)]
        for k in self._trajectories.unique():
            own = self._trajectories == k
            if not own.all():
                found.append(_nearest(self._known[own], self._known[~own]).cpu().numpy())
        return np.concatenate(found)

    def _positions(self, latents: torch.Tensor) -> torch.Tensor:
        """g(X_S, x̂) [n, 3 s] over √s: Euclidean distances of rows are RMS distances of particles."""
        latents = latents.to(self._at.device, self._at.dtype)
        with torch.no_grad():
            rows = [self._at.position(part).flatten(1) for part in latents.split(_ROWS)]
        return torch.cat(rows) / self._at.points**0.5


@dataclass(frozen=True)
class Trust:
    """The estimate, calibrated on training data.

    Attributes:
        residual: scale of projection residuals [m].
        distance: scale of the latent distance [m].
        latent_distance: the distance itself.
    """

    residual: float
    distance: float
    latent_distance: LatentDistance

    @classmethod
    def calibrated(
        cls, latent_distance: LatentDistance, runs: Sequence[tuple[np.ndarray, np.ndarray]]
    ) -> Trust:
        """From reduced runs at training values.

        The residual's scale is the largest that these runs leave; but at most `STRAY` times the median of
        each run's largest, as a run at a training value may go astray too. The distance's is how far these
        runs go by the same rule, or the `QUANTILE` of what separates each training trajectory from the
        others where that is more.

        Args:
            latent_distance: distance from the training latents.
            runs: x̂ [N + 1, r] and residuals [N] [m] of each run, as for `ratios`, as far as it went well.
        """
        between = latent_distance.between_trajectories()
        apart = float(np.quantile(between, QUANTILE)) if len(between) else 0.0
        drift = _largest([latent_distance.of(xhat) for xhat, _ in runs])
        return cls(_largest([residuals for _, residuals in runs]), max(apart, drift), latent_distance)

    def ratios(self, xhat: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """The larger of both signals over its scale, at each step; ∞ where a value is not finite.

        Args:
            xhat: [N + 1, r] latent vectors.
            residuals: [N] projection residuals after the last iteration [m]; none at t = 0.

        Returns:
            [N + 1] dimensionless; above 1 the step is not to be believed.
        """
        residual = np.concatenate([[0.0], residuals]) / self.residual
        # Not np.fmax: a value that is not finite must not hide behind the other.
        ratios = np.maximum(residual, self.latent_distance.of(xhat) / self.distance)
        return np.nan_to_num(ratios, nan=np.inf, posinf=np.inf)


def first_distrusted(ratios: np.ndarray) -> int:
    """First step whose ratio [N + 1] exceeds 1; −1 when none does."""
    above = np.flatnonzero(ratios > 1.0)
    return int(above[0]) if len(above) else -1


def training_values(manifold) -> list[float]:
    """First, middle and last of the training values of the problem parameter, without repetition."""
    # Snapshots keep parameters in float32, of which seven digits are the value's own.
    values = sorted({float(f"{v:.7g}") for v in manifold.training_parameters[:, 0].tolist()})
    return sorted({values[0], values[len(values) // 2], values[-1]})


def _nearest(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Distance [n] of each row of a [n, c] to the nearest row of b [m, c]."""
    return torch.cat([torch.cdist(rows, b).amin(1) for rows in a.split(_ROWS)])


def _largest(runs: list[np.ndarray]) -> float:
    """Largest value of all runs, at most `STRAY` medians of their own largest; never 0, since it divides."""
    largest = [float(np.max(values, initial=np.finfo(float).tiny)) for values in runs]
    return min(max(largest), STRAY * float(np.median(largest)))
