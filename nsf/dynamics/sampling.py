"""Sample particles S: those whose new positions determine the latent vector (paper section 5.4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError, ProjectionError


@dataclass(frozen=True)
class SamplePhase:
    """Sample particles that hold from a moment on.

    Attributes:
        start: first moment, as a fraction of the time span T.
        particles: [s] particle indices.
    """

    start: float
    particles: np.ndarray


@dataclass(frozen=True)
class Region:
    """How many sample particles, from where, from when.

    Attributes:
        size: |S|.
        lower, upper: corners of a box of reference positions [m]; the whole body by default.
        start: first moment, as a fraction of T.
    """

    size: int
    lower: Sequence[float] | None = None
    upper: Sequence[float] | None = None
    start: float = 0.0


@dataclass(frozen=True)
class Sampler:
    """Random choice of sample particles, by region and by phase of time.

    The same seed orders the particles once, so a later, smaller phase of the same region
    keeps a part of the earlier one.

    Attributes:
        size: |S| of the first phase.
        seed: of the random order.
        lower, upper: box of reference positions [m] of the first phase.
        phases: later phases, each with keys size, start and optionally lower, upper.

    Raises:
        ConfigError: a size is not positive, or phases are out of order.

    Source: paper section 5.4; phases: section 6.1 (cake, 700 then 400 particles).
    """

    size: int
    seed: int = 0
    lower: Sequence[float] | None = None
    upper: Sequence[float] | None = None
    phases: Sequence[dict] = ()

    def __post_init__(self):
        try:
            regions = self.regions
        except TypeError as error:
            raise ConfigError(
                f"sampler.phases={self.phases}: give size, start, lower, upper ({error})"
            ) from error
        if not isinstance(self.seed, int) or self.seed < 0:
            raise ConfigError(f"sampler.seed={self.seed} must be a whole number of at least 0")
        for region in regions:
            if not isinstance(region.size, int) or region.size < 1:
                raise ConfigError(f"sampler.size={region.size} must be a whole number of at least 1")
            for name in ("lower", "upper"):
                corner = getattr(region, name)
                if corner is not None and (np.shape(corner) != (3,) or not np.isfinite(corner).all()):
                    raise ConfigError(f"sampler.{name}={corner} must be 3 numbers [m] or null")
        starts = [region.start for region in regions]
        if starts != sorted(set(starts)) or not 0.0 <= starts[-1] < 1.0:
            raise ConfigError(f"sampler.phases start at {starts} of T; give rising fractions in (0, 1)")

    @property
    def regions(self) -> list[Region]:
        """Every phase, the first included."""
        return [Region(self.size, self.lower, self.upper), *(Region(**p) for p in self.phases)]

    def phases_of(self, X: np.ndarray) -> list[SamplePhase]:
        """Draw the sample particles of each phase.

        Args:
            X: [P, 3] reference positions [m].

        Raises:
            ConfigError: a region holds fewer particles than asked for.
        """
        order = np.random.default_rng(self.seed).permutation(len(X))
        found = []
        for region in self.regions:
            lower = np.full(3, -np.inf) if region.lower is None else np.asarray(region.lower, float)
            upper = np.full(3, np.inf) if region.upper is None else np.asarray(region.upper, float)
            inside = order[((X[order] >= lower) & (X[order] <= upper)).all(1)]
            if len(inside) < region.size:
                raise ConfigError(
                    f"sampler.size={region.size}, but the region holds {len(inside)} particles; "
                    "choose a smaller size or a larger region"
                )
            found.append(SamplePhase(region.start, np.sort(inside[: region.size])))
        return found


def check_well_posed(sample: int, latent_dim: int) -> None:
    """The projection needs at least as many equations as unknowns (paper section 5.4).

    Raises:
        ProjectionError: 3|S| < r.
    """
    if 3 * sample < latent_dim:
        raise ProjectionError(
            f"|S|={sample} gives {3 * sample} equations for r={latent_dim} unknowns; "
            f"choose |S| >= {-(-latent_dim // 3)}"
        )
