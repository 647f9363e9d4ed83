"""Particles: what stays constant and what a step changes."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from nsf.errors import ShapeError
from nsf.mpm.precision import Precision


@dataclass(frozen=True)
class ParticleConstants:
    """What identifies the particles; host arrays in float64.

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


class ParticleState:
    """Device arrays that a step changes.

    Attributes:
        x, v: [P, 3] position [m] and velocity [m/s].
        C: [P, 3, 3] affine momentum [1/s].
        F_e: [P, 3, 3] elastic deformation gradient.
        tau: [P, 3, 3] Kirchhoff stress [Pa].
        history: [P] vectors of the law's history variables.
    """

    def __init__(self, x: np.ndarray, v: np.ndarray, history: np.ndarray, precision: Precision, device):
        P = len(x)
        identity = np.tile(np.eye(3, dtype=precision.numpy), (P, 1, 1))
        self.x = wp.array(x, dtype=precision.vec3, device=device)
        self.v = wp.array(v, dtype=precision.vec3, device=device)
        self.C = wp.zeros(P, dtype=precision.mat33, device=device)
        self.F_e = wp.array(identity, dtype=precision.mat33, device=device)
        self.tau = wp.zeros(P, dtype=precision.mat33, device=device)
        width = history.shape[1]
        self.history = wp.array(
            history, dtype=wp.types.vector(length=width, dtype=precision.real), device=device
        )

    def __len__(self) -> int:
        return self.x.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(a.capacity for a in (self.x, self.v, self.C, self.F_e, self.tau, self.history))

    def numpy(self) -> dict[str, np.ndarray]:
        """Host copies: x, v [P, 3], C, F_e, tau [P, 3, 3], history [P, H]."""
        # Warp's own numpy() is a view of the array where the device is the CPU.
        return {name: getattr(self, name).numpy().copy() for name in ("x", "v", "C", "F_e", "tau", "history")}
