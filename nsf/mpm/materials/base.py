"""The parts of a constitutive law: parameters, a stress function and a return map."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from nsf.errors import ConfigError, InstabilityError
from nsf.mpm.precision import Precision

_HALVINGS = 30  # of the share of a stress that a law carries


@dataclass(frozen=True)
class LawFunctions:
    """The Warp side of a law.

    Attributes:
        tau_of: (F_e, history, mu, lam) → Kirchhoff stress [Pa].
        return_map: (F_trial, history, mu, lam, params, dt) → (F_e, history); None where `update` is given.
        Params: Warp struct of the law's constants.
        update: (F_trial, history, mu, lam, params, dt) → (F_e, history, tau), for a law whose return map and
            stress share work; by default `return_map` and then `tau_of`.
    """

    tau_of: Any
    return_map: Any
    Params: Any
    update: Any = None


@dataclass(frozen=True)
class Material(ABC):
    """A constitutive law with its parameters.

    A law defines `functions` and `stretches_of`. It inherits one history variable a particle, which is zero
    at rest (`history_size`, `initial_history`), and that at rest where τ alone is known (`history_of`). A law
    whose return map reads a history overrides these: with a yield stress of zero everything would flow.
    Constants of the return map are its attributes (`params`).

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, dimensionless, in (−1, 1/2).

    Raises:
        ConfigError: a value lies outside its physical range.
    """

    E: float
    nu: float

    history_size: ClassVar[int] = 1  # Warp has no vector of length 0, so laws without history carry one zero

    def __post_init__(self):
        if not 0.0 < self.E < math.inf:
            raise ConfigError(f"material.E={self.E} Pa must be positive and finite")
        if not -1.0 < self.nu < 0.5:
            raise ConfigError(f"material.nu={self.nu} must lie in (-1, 0.5)")

    @property
    def mu(self) -> float:
        """Shear modulus μ̂ = E/(2(1 + ν)) [Pa]."""
        return self.E / (2.0 * (1.0 + self.nu))

    @property
    def lam(self) -> float:
        """First Lamé parameter λ = Eν/((1 + ν)(1 − 2ν)) [Pa]."""
        return self.E * self.nu / ((1.0 + self.nu) * (1.0 - 2.0 * self.nu))

    def initial_history(self, particles: int) -> np.ndarray:
        """[P, H] history variables at rest."""
        return np.zeros((particles, self.history_size))

    @abstractmethod
    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions in one precision."""

    @abstractmethod
    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """Principal stretches that carry principal Kirchhoff stresses, on the branch through the identity.

        Args:
            principal: [P, 3] principal Kirchhoff stresses [Pa].
            mu, lam: [P] Lamé parameters [Pa].

        Returns:
            [P, 3] in the order of the stresses; NaN where the law carries no such stress.
        """

    def stretch_of(self, tau: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """The symmetric F_e = V with τ(V) = τ: the inverse of the elastic law.

        τ does not tell the rotation R of F_e = V R. An isotropic law needs no R: neither τ(F_e) nor the
        return map of f F_e depends on it.

        Args:
            tau: [P, 3, 3] symmetric Kirchhoff stress [Pa].
            mu, lam: [P] Lamé parameters [Pa].

        Returns:
            [P, 3, 3] left elastic stretch, dimensionless.

        Raises:
            InstabilityError: no deformation carries the stress of a particle; names the first.
        """
        principal, axes = np.linalg.eigh(tau)
        stretches = self._stretches(principal, mu, lam)
        bad = ~np.isfinite(stretches).all(1)
        if bad.any():
            p = int(bad.argmax())
            shown = np.array2string(principal[p], precision=4)
            raise InstabilityError(
                f"no deformation of {type(self).__name__} carries the stress of {int(bad.sum())} particles: "
                f"particle {p} has the principal stresses {shown} Pa at mu={mu[p]:g} Pa"
            )
        return (axes * stretches[:, None, :]) @ axes.transpose(0, 2, 1)

    def carried_share(self, tau: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """Largest share [P] of each stress, at most 1, that a deformation carries, by bisection.

        A stress that the law did not give, such as that of a field, may lie beyond the law.

        Args:
            tau: [P, 3, 3] symmetric Kirchhoff stress [Pa].
            mu, lam: [P] Lamé parameters [Pa].
        """
        principal = np.linalg.eigvalsh(tau)
        share = np.ones(len(tau))
        beyond = ~np.isfinite(self._stretches(principal, mu, lam)).all(1)
        principal, mu, lam = principal[beyond], mu[beyond], lam[beyond]
        lower, upper = np.zeros(len(mu)), np.ones(len(mu))
        for _ in range(_HALVINGS):
            middle = 0.5 * (lower + upper)
            carried = np.isfinite(self._stretches(middle[:, None] * principal, mu, lam)).all(1)
            lower, upper = np.where(carried, middle, lower), np.where(carried, upper, middle)
        share[beyond] = lower
        return share

    def _stretches(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """`stretches_of` without NumPy's warnings, because its NaN are answers."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.stretches_of(principal, mu, lam)

    def history_of(self, tau: np.ndarray) -> np.ndarray:
        """[P, H] history variables to assume from τ [P, 3, 3] [Pa] alone: by default those at rest.

        A law that can tell more from τ overrides this.
        """
        return self.initial_history(len(tau))

    def params(self, precision: Precision):
        """The law's constants as its Warp struct: each has the value of the law's attribute of that name.

        One without such an attribute is zero.
        """
        Params = self.functions(precision).Params
        params = Params()
        for name, field in Params.vars.items():
            if hasattr(self, name):
                setattr(params, name, field.type(getattr(self, name)))
        return params


@cache
def make_law_update(law: LawFunctions, precision: Precision, history_size: int):
    """Warp function (F_trial, history, mu, lam, params, dt) → (F_e, history, τ): the constitutive update."""
    import warp as wp

    if law.update is not None:
        return law.update
    tau_of, return_map, Params = law.tau_of, law.return_map, law.Params
    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=history_size, dtype=real)

    @wp.func
    def update(F_trial: mat33, history: vecH, mu: real, lam: real, params: Params, dt: real):
        F, h = return_map(F_trial, history, mu, lam, params, dt)
        return F, h, tau_of(F, h, mu, lam)

    return update


@cache
def make_stress_update(law: LawFunctions, precision: Precision, history_size: int):
    """Kernel of the constitutive update, one thread a particle: one kernel a law and precision.

    F_trial = f F_e, F_e ← returnMap(F_trial), τ = τ(F_e); both may read the history variables.

    Source: paper section 3.3, step 3.
    """
    import warp as wp

    law_update, Params = make_law_update(law, precision, history_size), law.Params
    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=history_size, dtype=real)

    @wp.kernel(enable_backward=False, module="unique")
    def update(
        increment: wp.array(dtype=mat33),
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
        params: Params,
        dt: real,
        F_e: wp.array(dtype=mat33),
        history: wp.array(dtype=vecH),
        tau: wp.array(dtype=mat33),
    ):
        p = wp.tid()
        F, h, stress = law_update(increment[p] * F_e[p], history[p], mu[p], lam[p], params, dt)
        F_e[p] = F
        history[p] = h
        tau[p] = stress

    return update


@cache
def make_elastic_stress(law: LawFunctions, precision: Precision, history_size: int):
    """Kernel of the elastic law alone: τ = τ(F) at a given history, no return map."""
    import warp as wp

    tau_of = law.tau_of
    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=history_size, dtype=real)

    @wp.kernel(enable_backward=False, module="unique")
    def elastic_stress(
        F: wp.array(dtype=mat33),
        history: wp.array(dtype=vecH),
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
        tau: wp.array(dtype=mat33),
    ):
        p = wp.tid()
        tau[p] = tau_of(F[p], history[p], mu[p], lam[p])

    return elastic_stress


@cache
def no_params():
    """Struct of a law without constants of its own."""
    import warp as wp

    @wp.struct
    class NoParams:
        unused: wp.int32

    return NoParams


@cache
def no_return_map(precision: Precision):
    """Return map of a purely elastic law: F_e = F_trial."""
    import warp as wp

    real, mat33, NoParams = precision.real, precision.mat33, no_params()
    vecH = wp.types.vector(length=1, dtype=real)

    @wp.func
    def elastic(F_trial: mat33, history: vecH, mu: real, lam: real, params: NoParams, dt: real):
        return F_trial, history

    return elastic
