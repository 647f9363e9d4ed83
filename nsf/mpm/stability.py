"""Stability: the largest stable time step, and the checks that end a run which has gone wrong."""

from collections.abc import Callable, Sequence

import numpy as np

from nsf.errors import ConfigError, InstabilityError
from nsf.mpm.boundaries.colliders import Collider
from nsf.mpm.grid.geometry import GridGeometry
from nsf.mpm.particles import ParticleConstants

# c Δt/Δx = 1 is the limit of one quadrature point in the middle of each cell, the worst regular
# arrangement of particles under B-splines (quadratic with exact quadrature: 1.63).
MAX_ELASTIC_CFL = 1.0
# A particle or a collider must not cross more than a cell in a step.
MAX_ADVECTIVE_CFL = 1.0
# c Δt/Δx above which no arrangement of particles is stable: quadratic B-splines with exact quadrature.
_NEVER_STABLE_CFL = 1.63
_ROUND_OFF = 1e-9
_STRETCHED = 1e-3  # by which a principal stretch grows for the tangent stiffness: a round-off of fp32 is 1e-7


def wave_speed(constants: ParticleConstants) -> float:
    """Largest elastic wave speed c = √((λ + 2μ̂)/ρ) [m/s]."""
    density = constants.mass / constants.volume0
    return float(np.sqrt((constants.lam + 2.0 * constants.mu) / density).max())


def wave_speed_at(tau_of: Callable[[np.ndarray], np.ndarray], F: np.ndarray, density: np.ndarray) -> float:
    """Largest speed in space of an elastic wave along a principal direction n of stretched particles [m/s].

    c² = (∂τ_nn/∂ log λ_n − τ_nn)/ρ₀: the tangent stiffness ∂P/∂F of that direction, and the wave travels λ_n
    times as far in space as in the reference. Fixed corotated: ρ₀ c² = 2μ̂ λ_n² + λ J², so a stretch λ_n
    multiplies the speed at rest.

    Args:
        tau_of: elastic deformation gradients [P, 3, 3] → Kirchhoff stress [P, 3, 3] [Pa].
        F: [P, 3, 3] elastic deformation gradients.
        density: [P] reference density [kg/m³].
    """
    tau, directions, largest = tau_of(F), np.linalg.svd(F)[0], 0.0
    for axis in range(3):
        n = directions[:, :, axis]
        longer = F + _STRETCHED * np.einsum("pi,pj,pjk->pik", n, n, F)
        along, before = (np.einsum("pi,pij,pj->p", n, t, n) for t in (tau_of(longer), tau))
        largest = max(largest, float((((along - before) / _STRETCHED - before) / density).max()))
    return largest**0.5


def largest_stable_dt(constants: ParticleConstants, v: np.ndarray, dx: float) -> float:
    """Largest Δt [s] that both CFL conditions allow.

    Args:
        constants: the particles.
        v: [P, 3] velocity [m/s].
        dx: grid spacing [m].
    """
    elastic = MAX_ELASTIC_CFL * dx / wave_speed(constants)
    speed = float(np.linalg.norm(v, axis=1).max())
    return elastic if speed == 0.0 else min(elastic, MAX_ADVECTIVE_CFL * dx / speed)


def check_time_step(constants: ParticleConstants, v: np.ndarray, dx: float, dt: float) -> None:
    """Refuse an unstable step before it is taken.

    Raises:
        InstabilityError: Δt exceeds the elastic or the advective limit; names the largest stable one.
    """
    if not (np.isfinite(dt) and dt > 0):
        raise InstabilityError(f"dt={dt} s must be positive and finite")
    largest = largest_stable_dt(constants, v, dx)
    if dt > largest * (1.0 + _ROUND_OFF):
        c = wave_speed(constants)
        speed = float(np.linalg.norm(v, axis=1).max())
        raise InstabilityError(
            f"dt={dt:g} s is unstable: elastic CFL c dt/dx = {c * dt / dx:.3g} "
            f"(limit {MAX_ELASTIC_CFL:g}, c = {c:.4g} m/s), "
            f"advective CFL |v| dt/dx = {speed * dt / dx:.3g} (limit {MAX_ADVECTIVE_CFL:g}); "
            f"the largest stable dt is {_rounded_down(largest)} s"
        )


def check_colliders(colliders: Sequence[Collider], grid: GridGeometry, dt: float) -> None:
    """Refuse solids that the grid or the step is too coarse for.

    Raises:
        ConfigError: a shape is smaller than the grid resolves.
        InstabilityError: a solid crosses more than a cell in a step; names the largest stable Δt.
    """
    for index, collider in enumerate(colliders):
        which = f"collider {index} ({collider.name}, kind={collider.kind})"
        blade = ", or for a blade kind=slip" if collider.name == "cuboid" else ""
        if grid.dx > collider.coarsest_dx * (1.0 + _ROUND_OFF):
            raise ConfigError(
                f"{which} needs dx of at most {_rounded_down(collider.coarsest_dx)} m, not {grid.dx:g} m; "
                f"choose a finer grid or a larger solid{blade}"
            )
        speed = collider.top_speed(np.array(grid.upper))
        if speed * dt > MAX_ADVECTIVE_CFL * grid.dx * (1.0 + _ROUND_OFF):
            raise InstabilityError(
                f"{which} moves at up to {speed:.6g} m/s, {speed * dt / grid.dx:.3g} cells "
                f"in a step of dt={dt:g} s (limit {MAX_ADVECTIVE_CFL:g}); "
                f"the largest stable dt is {_rounded_down(MAX_ADVECTIVE_CFL * grid.dx / speed)} s"
            )


def _rounded_down(value: float) -> str:
    """Six digits, which must not round up past the value."""
    return f"{(1.0 - 5e-6) * value:.6g}"


def multiplied_step_warning(multiplier: float, dt: float, stable: float) -> str | None:
    """A line where a reduced step of `multiplier` Δt is unstable however the particles lie; else None.

    Args:
        multiplier: `deploy.dt_multiplier`.
        dt: full-order step [s].
        stable: largest stable full-order step [s].
    """
    cfl = multiplier * dt / stable * MAX_ELASTIC_CFL
    if cfl <= _NEVER_STABLE_CFL:
        return None
    most = 0.99 * _NEVER_STABLE_CFL * stable / (MAX_ELASTIC_CFL * dt)
    return (
        f"deploy.dt_multiplier={multiplier:g}: in a reduced step c dt/dx is {cfl:.3g}, and above "
        f"{_NEVER_STABLE_CFL:g} it may diverge wherever particles lie; choose at most {most:.2g}"
    )
