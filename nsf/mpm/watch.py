"""Checks of a running simulation: one pass over the particles, now and then, for less than a step costs."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from nsf.errors import InstabilityError
from nsf.mpm.boundaries.arrays import make_solids
from nsf.mpm.boundaries.contact import CUBOID, SPHERE
from nsf.mpm.forcing import Forcing
from nsf.mpm.grid.nodes import inside
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.native.access import WARP, make_warp_sum
from nsf.mpm.precision import FP64, Precision
from nsf.mpm.stability import MAX_ADVECTIVE_CFL

#: J = det F_e below which a particle counts as collapsed.
COLLAPSED = 1.0 / 20.0
# A determinant is rounded by so many units of the last place of |F_e|³.
_ROUNDED = 16.0
# A run warns above the first value and stops above the second.
_COLLAPSED_SHARES = 0.01, 0.5
_ADVECTIVE_CFLS = 0.8, MAX_ADVECTIVE_CFL
# These only warn: a caller may set velocities between steps.
_INSIDE_SHARE = 0.01
_ENERGY_RISE = 0.05
# Motion with less energy than this strain² in all particles is round-off.
_STILL = 1e-9
_NEVER = 2**31 - 1
_THREADS = 2**15  # of a GPU; each looks at several particles, so that few add to one sum
_UNITS = "check its unit (m, kg, s, Pa)"


@cache
def make_depth(precision: Precision):
    """Warp function (x, dt, dx, solids) → how deep x lies in a solid [m], at the end of the step; else ≤ 0.

    A cuboid is as thick as nodes see it; a solid that does not act has no depth.
    """
    real, vec3 = precision.real, precision.vec3
    Solids = make_solids(precision)

    @wp.func
    def depth(x: vec3, dt: real, dx: real, solids: Solids):
        deepest = real(0.0)
        for c in range(solids.kind.shape[0]):
            if solids.active[c] != 0:
                # The pose is that at the start of the step.
                arm = x - solids.position[c] - dt * solids.velocity[c]
                extents = solids.extents[c]
                distance = real(0.0)
                if solids.shape[c] == wp.static(CUBOID):
                    local = wp.transpose(solids.orientation[c]) * arm
                    distance = real(wp.inf)
                    for a in range(3):
                        distance = wp.min(distance, extents[a] - wp.abs(local[a]))
                elif solids.shape[c] == wp.static(SPHERE):
                    distance = extents[0] - wp.length(arm)
                else:
                    distance = -wp.dot(arm, solids.orientation[c] * extents)
                deepest = wp.max(deepest, distance)
        return deepest

    return depth


@cache
def make_watch(precision: Precision, shape_name: str):
    """Kernel of one look at all particles.

    It finds the lowest index of a particle that is non-finite, off the grid, inside out, collapsed and too
    fast, in this order; the sums of kinetic and potential energy, of collapsed particles and of particles
    inside a collider by more than Δx; and the largest speed.
    """
    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
    shape = shape_functions(precision, shape_name)
    base_node, width = shape.base_node, shape.degree + 1
    depth, total, Solids = make_depth(precision), make_warp_sum(FP64), make_solids(precision)
    rounding = _ROUNDED * float(np.finfo(precision.numpy).eps)

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def watch(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        tau: wp.array(dtype=mat33),
        F_e: wp.array(dtype=mat33),
        mass: wp.array(dtype=real),
        order: wp.array(dtype=wp.int32),
        grid_shape: wp.vec3i,
        dx: real,
        dt: real,
        gravity: wp.array(dtype=vec3),
        solids: Solids,
        threads: int,
        lanes: int,
        first: wp.array(dtype=wp.int32),
        sums: wp.array(dtype=wp.float64),
        fastest: wp.array(dtype=real),
    ):
        p = wp.tid()
        energy, counts = wp.vec3d(), wp.vec3d()
        speed = real(0.0)
        while p < x.shape[0]:
            F = F_e[p]
            # The sum of squares is finite only if every entry is.
            size = wp.length_sq(x[p]) + wp.length_sq(v[p]) + wp.ddot(tau[p], tau[p]) + wp.ddot(F, F)
            if not wp.isfinite(size):
                wp.atomic_min(first, 0, order[p])
            else:
                if not inside(base_node(x[p], real(1.0) / dx), width, grid_shape):
                    wp.atomic_min(first, 1, order[p])
                J = wp.determinant(F)
                squared = wp.ddot(F, F)
                if -real(wp.static(rounding)) * squared * wp.sqrt(squared) >= J:
                    wp.atomic_min(first, 2, order[p])
                if real(wp.static(COLLAPSED)) > J:
                    wp.atomic_min(first, 3, order[p])
                    counts[0] += wp.float64(1.0)
                particle_speed = wp.length(v[p])
                if particle_speed * dt > real(wp.static(MAX_ADVECTIVE_CFL)) * dx:
                    wp.atomic_min(first, 4, order[p])
                speed = wp.max(speed, particle_speed)
                if depth(x[p], dt, dx, solids) > dx:
                    counts[1] += wp.float64(1.0)
                m = wp.float64(mass[p])
                energy[0] += wp.float64(0.5) * m * wp.float64(particle_speed) * wp.float64(particle_speed)
                energy[1] -= m * wp.float64(wp.dot(gravity[0], x[p]))
            p += threads
        energy, counts = total(energy, lanes), total(counts, lanes)
        if wp.tid() % lanes == 0:
            for i in range(2):
                wp.atomic_add(sums, i, energy[i])
                wp.atomic_add(sums, 2 + i, counts[i])
        if speed > fastest[0]:
            wp.atomic_max(fastest, 0, speed)

    return watch


class Look(NamedTuple):
    """The sums and extremes of one look.

    Attributes:
        non_finite, outside, inverted, collapsed, fast: lowest index of such a particle; None for none.
        kinetic, potential: energy [J], the potential one that of gravity.
        collapsed_share, inside_share: of the particles below J = 1/20, and inside a collider by more than Δx.
        speed: largest [m/s].
    """

    non_finite: int | None
    outside: int | None
    inverted: int | None
    collapsed: int | None
    fast: int | None
    kinetic: float
    potential: float
    collapsed_share: float
    inside_share: float
    speed: float


class Watch:
    """Looks at a full-order run now and then; errors end it, and the worst of each warning is remembered.

    Energy is compared with that at the start: while nothing outside does work, a body that starts free of
    stress never has more kinetic and potential energy than then, whatever is stored elastically.

    Args:
        precision, shape_name, device: of the solver.
        stiffness: Σ V⁰ (λ + 2μ̂) [J], which tells motion from round-off.
    """

    def __init__(self, precision: Precision, shape_name: str, device, stiffness: float):
        self._kernel, self._device, self._still = (
            make_watch(precision, shape_name),
            device,
            _STILL * stiffness,
        )
        self._first = wp.empty(5, dtype=wp.int32, device=device)
        self._sums = wp.empty(4, dtype=wp.float64, device=device)
        self._fastest = wp.empty(1, dtype=precision.real, device=device)
        self.restart()

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(a.capacity for a in (self._first, self._sums, self._fastest))

    def restart(self) -> None:
        """Begin anew with the next look, at whose moment no energy is stored elastically."""
        self._unstressed, self._energy, self._inside, self._kinetic = True, None, 0.0, 0.0
        self._worst: dict[str, tuple[float, str]] = {}

    def look(self, state, mass: wp.array, grid, forcing: Forcing, dt: float) -> Look:
        """One pass over the particles of a state."""
        self._first.fill_(_NEVER)
        self._sums.zero_()
        self._fastest.zero_()
        lanes = WARP if self._device.is_cuda else 1
        threads = min(_THREADS, -(-len(state) // WARP) * WARP) if self._device.is_cuda else 1
        inputs = [a.rows for a in (state.x, state.v, state.tau, state.F_e)]
        inputs += [
            mass,
            state.order,
            grid.shape,
            grid.geometry.dx,
            dt,
            forcing.now,
            forcing.boundaries.solids,
        ]
        inputs += [threads, lanes, self._first, self._sums, self._fastest]
        wp.launch(self._kernel, dim=threads, inputs=inputs, device=self._device)
        first = [None if p == _NEVER else int(p) for p in self._first.numpy()]
        kinetic, potential, collapsed, inside_solid = self._sums.numpy()
        shares = float(collapsed) / len(state), float(inside_solid) / len(state)
        return Look(*first, float(kinetic), float(potential), *shares, float(self._fastest.numpy()[0]))

    def judge(
        self, look: Look, steady: bool, dt: float, dx: float, when: str, J_of: Callable[[int], float]
    ) -> None:
        """Remember what is odd.

        Args:
            look: at the state.
            steady: whether nothing outside does work.
            dt, dx: step [s] and grid spacing [m].
            when: step and time, for messages.
            J_of: J = det F_e of a particle.

        Raises:
            InstabilityError: the law or the step no longer holds; names particle, value and remedy.
        """
        if look.inverted is not None:
            raise InstabilityError(
                f"particle {look.inverted} is inside out {when}: J = {J_of(look.inverted):.3g}; "
                f"give a stiffer material or a smaller load ({_UNITS}), or reduce dt={dt:g} s"
            )
        if look.collapsed_share > _COLLAPSED_SHARES[1]:
            raise InstabilityError(
                f"the body has collapsed {when}: {100 * look.collapsed_share:.3g} % of the particles have "
                f"less than 1/20 of their volume, particle {look.collapsed} has "
                f"J = {J_of(look.collapsed):.3g}; "
                f"give a stiffer material or a smaller load ({_UNITS})"
            )
        cfl = look.speed * dt / dx
        if look.fast is not None:
            raise InstabilityError(
                f"particle {look.fast} moves more than a cell in a step {when}: the largest |v| dt/dx is "
                f"{cfl:.3g}; reduce dt={dt:g} s to {0.5 * dt / cfl:.2g} s, or the load ({_UNITS})"
            )
        if self._energy is None:
            self._energy, self._inside = look.kinetic + look.potential, look.inside_share
        self._unstressed = self._unstressed and steady
        self._kinetic = max(self._kinetic, look.kinetic)
        rise = 0.0
        if self._unstressed and self._kinetic > self._still:
            rise = (look.kinetic + look.potential - self._energy) / self._kinetic
        self._remember("collapsed", look.collapsed_share, _COLLAPSED_SHARES[0], when)
        self._remember("cfl", cfl, _ADVECTIVE_CFLS[0], when)
        self._remember("inside", look.inside_share - self._inside, _INSIDE_SHARE, when)
        self._remember("energy", rise, _ENERGY_RISE, when)

    def _remember(self, quantity: str, value: float, limit: float, when: str) -> None:
        if value > max(limit, self._worst.get(quantity, (limit, ""))[0]):
            self._worst[quantity] = value, when

    @property
    def warnings(self) -> list[str]:
        """A line for each thing that was odd, at its worst."""
        texts = {
            "collapsed": "{:.3g} % of the particles have less than 1/20 of their volume {}; give a stiffer "
            f"material or a smaller load, or {_UNITS}",
            "cfl": "a particle moves {:.3g} % of a cell in a step {}; reduce dt",
            "inside": "{:.3g} % of the particles are inside a collider by more than dx {}; reduce dt or dx",
            "energy": "kinetic and potential energy rose by {:.3g} % of the largest kinetic energy {}, "
            "and nothing did work; reduce dt",
        }
        return [texts[quantity].format(100 * value, when) for quantity, (value, when) in self._worst.items()]
