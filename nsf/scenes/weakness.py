"""Weak elements, which seed a fracture (paper section 6.1)."""

from dataclasses import dataclass

import numpy as np

from nsf.config import number
from nsf.errors import ConfigError
from nsf.scenes.geometry import Shape


@dataclass(frozen=True)
class Weakness:
    """Some particles of a region, drawn at random, are softer than the body.

    The draw hangs on the seed, the region and the particles alone. The paper says neither how
    many elements are weak nor by how much.

    Attributes:
        region: where they are [m].
        factor: by which E, hence μ̂ and λ, is multiplied there, dimensionless.
        share: of the region's particles that are weak.
        seed: of the draw.
        perturbation: share of the weak particles that are exchanged for others of the region; the
            number of weak particles stays, and what a smaller perturbation exchanges a larger one
            does too.

    Raises:
        ConfigError: a value lies outside its range, or the exchange needs more particles than
            the region has: share (1 + perturbation) > 1.

    Source: paper section 6.1, "Weak elements are inserted in the middle region", and the appendix
    on extrapolation, "unseen weak elements … a random perturbation with a scale of 8 %". What is
    perturbed is left open. Other elements are read here, not other strengths: they are "unseen",
    and 30 % makes "the fracture pattern drastically different", which 30 % more or less of an
    already small stiffness would not.
    """

    region: Shape
    factor: float = 0.1
    share: float = 0.3
    seed: int = 0
    perturbation: float = 0.0

    def __post_init__(self):
        if not isinstance(self.region, Shape):
            raise ConfigError(
                f"weakness.region={self.region} must be a shape; give it a _target_: nsf.scenes.…"
            )
        for name in ("factor", "share", "perturbation"):
            number(f"weakness.{name}", getattr(self, name), least=0.0)
        number("weakness.seed", self.seed, least=0, whole=True)
        if not 0.0 < self.factor <= 1.0:
            raise ConfigError(f"weakness.factor={self.factor} must lie in (0, 1]: it multiplies E")
        if not 0.0 < self.share <= 1.0:
            raise ConfigError(f"weakness.share={self.share} must lie in (0, 1]")
        if self.perturbation > 1.0 or self.share * (1.0 + self.perturbation) > 1.0:
            raise ConfigError(
                f"weakness.perturbation={self.perturbation} needs a share of "
                f"{self.share * (1.0 + self.perturbation):.3g} of the region; lower it or share={self.share}"
            )

    def of(self, X: np.ndarray) -> np.ndarray:
        """[P] factor on E of each of the particles X [P, 3] [m].

        Raises:
            ConfigError: the region holds no weak particle.
        """
        region = np.flatnonzero(self.region.contains(X))
        weak = round(self.share * len(region))
        if weak == 0:
            raise ConfigError(
                f"weakness.share={self.share} of the {len(region)} particles in its region "
                f"(bounds {self.region.bounds} m) is none; enlarge the region or the share"
            )
        order = np.random.default_rng(self.seed).permutation(region)
        # Later in one order, so that a perturbed draw needs no second one.
        exchanged = min(round(self.perturbation * weak), len(region) - weak)
        stiffness = np.ones(len(X))
        stiffness[order[exchanged : weak + exchanged]] = self.factor
        return stiffness
