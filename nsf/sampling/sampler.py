"""Sample particles S: those whose new positions determine the latent vector (paper section 5.4)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from typing_extensions import override

from nsf.errors import ConfigError, ProjectionError
from nsf.scalars import number


class EquationSolver(Protocol):
    """A reduced solver whose sample is every particle, for a sampler that learns from its steps.

    Attributes:
        dt: step [s]; dx: grid spacing [m].
    """

    dt: float
    dx: float

    def equations_at(
        self, step: int, xhat: torch.Tensor, previous: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Error [P, 3] and Jacobian [P, 3, r] [m] of the projection that ends a step from x̂_n and x̂_{n−1}."""


@dataclass(frozen=True)
class SampleSpan:
    """Sample particles that hold from a moment on.

    Attributes:
        start: first moment, as a fraction of the time span T.
        particles: [s] particle indices.
        weights: [s] of their squared distances in the projection; None for all one.

    Raises:
        ConfigError: a weight is not positive, or there are not as many as particles.
    """

    start: float
    particles: np.ndarray
    weights: np.ndarray | None = None

    def __post_init__(self):
        if self.weights is None:
            return
        positive = np.isfinite(self.weights) & (np.asarray(self.weights) > 0)
        if np.shape(self.weights) != np.shape(self.particles) or not positive.all():
            raise ConfigError(
                f"weights of {len(self.particles)} sample particles must be as many positive numbers; "
                f"got {np.shape(self.weights)}, {int(positive.sum())} of them positive"
            )


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

    def candidates(self, X: np.ndarray) -> np.ndarray:
        """Indices of the particles inside, ascending; X [P, 3] are reference positions [m].

        Raises:
            ConfigError: the region holds fewer particles than its size.
        """
        lower = -np.inf if self.lower is None else np.asarray(self.lower, float)
        upper = np.inf if self.upper is None else np.asarray(self.upper, float)
        inside = np.flatnonzero(((lower <= X) & (upper >= X)).all(1))
        if len(inside) < self.size:
            everywhere = self.lower is None and self.upper is None
            where, remedy = (
                ("scene has", "more particles") if everywhere else ("region holds", "a larger region")
            )
            raise ConfigError(
                f"sampler.size={self.size}, but the {where} {len(inside)} particles; "
                f"choose a smaller size or {remedy}"
            )
        return inside


@dataclass(frozen=True)
class Sampler(ABC):
    """A choice of sample particles, by region and by span of time.

    Attributes:
        size: |S| of the first span.
        lower, upper: box of reference positions [m] of the first span.
        phases: later spans, each with keys size, start and optionally lower, upper.

    Raises:
        ConfigError: a size is not positive, or spans are out of order.

    Source: paper section 5.4; spans of time: section 6.1 (cake, 700 then 400 particles).
    """

    size: int
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
        for region in regions:
            number("sampler.size", region.size, 1, whole=True)
            for name in ("lower", "upper"):
                corner = getattr(region, name)
                if corner is not None and (np.shape(corner) != (3,) or not np.isfinite(corner).all()):
                    raise ConfigError(f"sampler.{name}={corner} must be 3 numbers [m] or null")
        starts = [region.start for region in regions]
        if starts != sorted(set(starts)) or not 0.0 <= starts[-1] < 1.0:
            raise ConfigError(f"sampler.phases start at {starts} of T; give rising fractions in (0, 1)")

    @property
    def regions(self) -> list[Region]:
        """Every span, the first included."""
        return [Region(self.size, self.lower, self.upper), *(Region(**p) for p in self.phases)]

    def spans_of(
        self,
        manifold,
        device: str | torch.device = "cpu",
        solver_at: Callable[[Mapping[str, float]], EquationSolver] | None = None,
    ) -> list[SampleSpan]:
        """Choose the sample particles of each span.

        Args:
            manifold: trained fields of the particles.
            device: where the fields are evaluated, if the choice needs them.
            solver_at: problem parameters → the reduced solver whose sample is every particle, if the choice
                needs steps of it.

        Raises:
            ConfigError: a region holds fewer particles than its size.
        """
        ends = [region.start for region in self.regions[1:]] + [1.0]
        return [
            self.span_of(region, end, manifold, device, solver_at)
            for region, end in zip(self.regions, ends, strict=True)
        ]

    @abstractmethod
    def span_of(self, region: Region, end: float, manifold, device="cpu", solver_at=None) -> SampleSpan:
        """The sample particles of one span, which ends at a fraction of T; the rest as for `spans_of`."""


class UnweightedSampler(Sampler):
    """A choice of particles that all weigh the same."""

    @override
    def span_of(self, region, end, manifold, device="cpu", solver_at=None):
        candidates = region.candidates(manifold.X.cpu().numpy())
        return SampleSpan(region.start, np.sort(self.choose(manifold, candidates, region.size, device)))

    @abstractmethod
    def choose(self, manifold, candidates: np.ndarray, size: int, device="cpu") -> np.ndarray:
        """`size` of the candidates [c], as particle indices; a smaller sample is a part of a larger."""


@dataclass(frozen=True)
class RandomSampler(UnweightedSampler):
    """Particles drawn at random.

    Attributes:
        seed: of the order in which all particles are drawn.

    Source: paper section 5.4.
    """

    seed: int = 0

    def __post_init__(self):
        super().__post_init__()
        number("sampler.seed", self.seed, 0, whole=True)

    @override
    def choose(self, manifold, candidates, size, device="cpu"):
        order = np.random.default_rng(self.seed).permutation(len(manifold.X))
        return order[np.isin(order, candidates)][:size]


def check_well_posed(sample: int, latent_dim: int) -> None:
    """The projection needs at least as many equations as unknowns (paper section 5.4).

    Raises:
        ProjectionError: 3|S| < r.
    """
    if 3 * sample < latent_dim:
        raise ProjectionError(
            f"|S|={sample} gives {3 * sample} equations for r={latent_dim} unknowns; "
            f"choose sampler.size >= {-(-latent_dim // 3)} or latent_dim <= {3 * sample}"
        )
