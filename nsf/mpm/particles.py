"""Constants of the particles."""

from dataclasses import dataclass

import numpy as np

from nsf.errors import ShapeError


@dataclass(frozen=True)
class ParticleConstants:
    """Constants of the particles, as host arrays in float64.

    Attributes:
        X: [P, 3] reference position [m].
        mass: [P] [kg].
        volume0: [P] reference volume [m³].
        mu: [P] shear modulus [Pa].
        lam: [P] first Lamé parameter [Pa].

    Raises:
        ShapeError: the arrays differ in particle number, or there are none.
    """

    X: np.ndarray
    mass: np.ndarray
    volume0: np.ndarray
    mu: np.ndarray
    lam: np.ndarray

    def __post_init__(self):
        P = len(self.X)
        shapes = {name: np.shape(getattr(self, name)) for name in ("X", "mass", "volume0", "mu", "lam")}
        if P == 0 or shapes["X"] != (P, 3) or any(shapes[k] != (P,) for k in shapes if k != "X"):
            raise ShapeError(
                f"particle arrays must be X [P, 3] and mass, volume0, mu, lam [P] with P > 0; got {shapes}"
            )

    def __len__(self) -> int:
        return len(self.X)
