"""Weak elements, which seed a fracture (paper section 6.1)."""

from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import number
from nsf.scenes.shapes.geometry import Shape


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
        perturbation: share of the weak particles that are exchanged for others: of the region while
            it has others, then of the rest of the body. The number of weak particles stays, and what a
            smaller perturbation exchanges a larger one does too.

    Raises:
        ConfigError: a value lies outside its range.

    Source: paper section 6.1, "Weak elements are inserted in the middle region", and the appendix
    on extrapolation, "unseen weak elements … a random perturbation with a scale of 8 %". What is
    perturbed is left open. Other elements are read here, not other strengths: they are "unseen",
    and 30 % makes "the fracture pattern drastically different", which 30 % more or less of an
    already small stiffness would not. A region that is nearly all weak, as bread's, has too few
    others for 30 %; those beyond it leave the band stronger.
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
        if self.perturbation > 1.0:
            raise ConfigError(f"weakness.perturbation={self.perturbation} must lie in [0, 1]: it is a share")

    def of(self, X: np.ndarray) -> np.ndarray:
        """[P] factor on E of each of the particles X [P, 3] [m].

        Raises:
            ConfigError: the region holds no weak particle, or the body too few to exchange them for.
        """
        inside = self.region.contains(X)
        region = np.flatnonzero(inside)
        weak = round(self.share * len(region))
        if weak == 0:
            raise ConfigError(
                f"weakness.share={self.share} of the {len(region)} particles in its region "
                f"(bounds {self.region.bounds} m) is none; enlarge the region or the share"
            )
        exchanged = round(self.perturbation * weak)
        if weak + exchanged > len(X):
            raise ConfigError(
                f"weakness.perturbation={self.perturbation} exchanges {exchanged} of {weak} weak particles, "
                f"but only {len(X) - weak} of the body are not weak; lower it or share={self.share}"
            )
        draw = np.random.default_rng(self.seed)
        # Later in one order, so that a perturbed draw needs no second one.
        order = np.concatenate([draw.permutation(region), draw.permutation(np.flatnonzero(~inside))])
        stiffness = np.ones(len(X))
        stiffness[order[exchanged : weak + exchanged]] = self.factor
        return stiffness
