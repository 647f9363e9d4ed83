"""The full-order material point method (paper section 3.3)."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import warp as wp

from nsf.errors import ConfigError, InstabilityError, ShapeError
from nsf.gpu import without_collection
from nsf.mpm.boundaries.arrays import BoundaryArrays
from nsf.mpm.boundaries.colliders import Collider
from nsf.mpm.boundaries.walls import DomainWalls
from nsf.mpm.device import warp_device
from nsf.mpm.forcing import Forcing, Gravity, Hand
from nsf.mpm.grid.geometry import GridGeometry
from nsf.mpm.grid.nodes import Grid
from nsf.mpm.grid.shape import stencil_offset
from nsf.mpm.materials.base import Material, make_elastic_stress, make_stress_update
from nsf.mpm.particles import ParticleConstants
from nsf.mpm.precision import Precision, precision_of
from nsf.mpm.stability import MAX_ELASTIC_CFL, check_time_step, wave_speed_at
from nsf.mpm.state import ParticleState, cell_order
from nsf.mpm.step import GridStep
from nsf.mpm.transfer.g2p import make_g2p_stress
from nsf.mpm.transfer.scheme import Transfer
from nsf.mpm.watch import Watch
from nsf.timing import StageTimer


class State(Protocol):
    """The state of a simulation, on its device."""

    def __len__(self) -> int:
        """Number of particles P."""

    def numpy(self) -> dict[str, np.ndarray]:
        """Host copies by name: x, v [P, 3] m and m/s, C, tau [P, 3, 3] 1/s and Pa, and what else there is."""


@runtime_checkable
class Solver(Protocol):
    """The interface of a simulation, at full order or reduced, whatever computes its steps.

    A step takes no argument: the forcing of its moment, gravity and where colliders are, is on the device.

    Attributes:
        dt: step [s]; device: Warp device.
    """

    dt: float
    device: object

    @property
    def forcing(self) -> Hand:
        """Gravity and colliders, which may be set between steps."""

    @property
    def state(self) -> State:
        """Where the particles are."""

    @property
    def steps_taken(self) -> int:
        """Number of steps since t = 0."""

    @property
    def time(self) -> float:
        """Simulated time [s]."""

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays take on the device."""

    @property
    def stages(self) -> Mapping[str, Callable[[], None]]:
        """One step, stage by stage, in order."""

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt."""

    def timed_step(self, timer: StageTimer) -> None:
        """One step, stage by stage under a timer."""

    def restart(self) -> None:
        """Go back to t = 0."""


def bytes_on_device(particles: int, grid: GridGeometry, material: Material, precision: Precision) -> int:
    """[byte] that the arrays of a `FullOrderMPM` will take, its `nbytes`, before anything is made."""
    # mass, V⁰, μ̂, λ; x and v; C, F_e and τ; the history; and the order.
    values = 4 + 2 * 3 + 3 * 9 + material.history_size
    real = np.dtype(precision.numpy).itemsize
    return particles * (values * real + 4) + grid.nbytes(precision)


class FullOrderMPM:
    """Explicit symplectic MPM over all particles.

    Args:
        constants: particles.
        material: constitutive law.
        grid: grid geometry.
        dt: step [s].
        gravity: [3] [m/s²], or its keyframes.
        colliders: solids, at rest or moving, applied in order.
        walls: condition on the faces of the domain.
        transfer: PIC, APIC or RPIC, and the B-spline.
        x, v: [P, 3] initial position [m] (default X) and velocity [m/s] (default 0).
        precision: `fp64` or `fp32`.
        device: `cpu`, `cuda`, `cuda:N` or `auto`.
        check_every: steps between looks at the particles.
        names: of the colliders, for `forcing`.

    Raises:
        InstabilityError: Δt is unstable, or a collider too fast; the message names the largest stable Δt.
        ConfigError: the grid does not resolve a collider.
        ShapeError: x or v is not [P, 3].
        DeviceError: the device does not exist.

    Source: paper section 3.3.
    """

    def __init__(
        self,
        constants: ParticleConstants,
        material: Material,
        grid: GridGeometry,
        dt: float,
        gravity: Sequence[float] | Gravity = (0.0, 0.0, 0.0),
        colliders: Sequence[Collider] = (),
        walls: DomainWalls = DomainWalls(),
        transfer: Transfer = Transfer(),
        x: np.ndarray | None = None,
        v: np.ndarray | None = None,
        precision: str | Precision = "fp64",
        device: str = "cpu",
        check_every: int = 50,
        names: Sequence[str] = (),
    ):
        if check_every < 1:
            raise ConfigError(f"check_every={check_every} must be at least 1 step")
        self.constants, self.material, self.dt = constants, material, float(dt)
        self._names = tuple(names)
        self.precision = precision_of(precision)
        self.device = warp_device(device)
        self.check_every = check_every
        self.steps_taken = 0
        x = constants.X if x is None else np.asarray(x, np.float64)
        v = np.zeros_like(constants.X) if v is None else np.asarray(v, np.float64)
        if x.shape != constants.X.shape or v.shape != constants.X.shape:
            raise ShapeError(f"x {x.shape} and v {v.shape} must have the shape of X {constants.X.shape}")
        check_time_step(constants, v, grid.dx, dt)

        real = self.precision.real

        order = cell_order(x, grid.dx, stencil_offset(transfer.shape))

        def on_device(values):
            return wp.array(values[order], dtype=real, device=self.device)

        self.mass, self.volume0 = on_device(constants.mass), on_device(constants.volume0)
        self.mu, self.lam = on_device(constants.mu), on_device(constants.lam)
        history = material.initial_history(len(constants))
        self._start = {"x": x, "v": v, "history": history}
        self.state = ParticleState(x, v, history, order, self.precision, self.device)
        self.grid = Grid(grid, self.precision, self.device)
        boundaries = BoundaryArrays(colliders, walls, self.precision, self.device)
        acting = Forcing([gravity], boundaries, self.precision, self.device)
        self.grid_step = GridStep(self.grid, acting, transfer, dt, self.precision, self.device)
        law = material.functions(self.precision)
        self._stress_update = make_stress_update(law, self.precision, material.history_size)
        self._g2p_stress = make_g2p_stress(self.precision, transfer.shape, law, material.history_size)
        self._params = material.params(self.precision)
        stiffness = float((constants.volume0 * (constants.lam + 2.0 * constants.mu)).sum())
        self._watch = Watch(self.precision, transfer.shape, self.device, stiffness)
        self._graph = None
        self.check()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.steps_taken * self.dt

    @property
    def forcing(self) -> Hand:
        """Gravity and colliders, which may be set between steps."""
        # Made on each call: if it were stored, the solver would hold itself, and keep its memory for a while.
        return Hand(self.grid_step.forcing, lambda: self.time, names=self._names)

    @property
    def nbytes(self) -> int:
        """Bytes that the solver's arrays take on the device."""
        arrays = (self.mass, self.volume0, self.mu, self.lam)
        return self.state.nbytes + self.grid.nbytes + self._watch.nbytes + sum(a.capacity for a in arrays)

    @property
    def warnings(self) -> list[str]:
        """A line for each warning since t = 0, at its worst: the state was odd, though law and step held."""
        return self._watch.warnings

    def restart(self) -> None:
        """Go back to t = 0; captured graphs stay good."""
        for name, values in self._start.items():
            getattr(self.state, name).assign(values)
        self.state.unload()
        self.forcing.release()
        self.grid_step.forcing.start_from(0)
        self.steps_taken = 0
        self._watch.restart()

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt.

        Raises:
            InstabilityError: law or step no longer hold, see `check`, at a look every `check_every` steps;
                the message names particle, step and time.
        """
        for _ in range(n):
            self._advance()
            self.steps_taken += 1
            if self.steps_taken % self.check_every == 0:
                self.check()

    def _advance(self) -> None:
        if not self.device.is_cuda:
            self._run()
        elif self._graph is None:
            # The first step runs uncaptured, so that every kernel is compiled and loaded.
            self._run()
            with without_collection(), wp.ScopedCapture(device=self.device) as capture:
                self._run()
            self._graph = capture.graph
        else:
            wp.capture_launch(self._graph)

    def _run(self) -> None:
        self.p2g()
        self.grid_step.update()
        self.g2p_stress()

    def timed_step(self, timer: StageTimer) -> None:
        """Take one step, stage by stage under a timer; on a GPU, as a graph that is captured anew."""
        if self._graph is None:
            self._run_stages(timer)
        else:
            _ = self.increment  # allocated outside the graph
            with without_collection(), wp.ScopedCapture(device=self.device) as capture:
                self._run_stages(timer.captured)
            wp.capture_launch(capture.graph)
            timer.add_launch()
        self.steps_taken += 1

    def _run_stages(self, timer: Callable) -> None:
        for name, stage in self.stages.items():
            with timer(name):
                stage()

    @property
    def stages(self) -> dict[str, Callable[[], None]]:
        """The stages of one step, in order. `step` does the last two in one pass."""
        return {"p2g": self.p2g, "grid": self.grid_step.update, "g2p": self.g2p, "stress": self.update_stress}

    def p2g(self) -> None:
        """Particles → grid."""
        s = self.state
        self.grid_step.p2g(s.x.rows, s.v.rows, s.C.rows, s.tau.rows, self.mass, self.volume0)

    def g2p_stress(self) -> None:
        """Grid → particles, F_e ← returnMap(f F_e), τ ← τ(F_e)."""
        s = self.state
        inputs = [*self.grid_step.gathering, self.mu, self.lam, self._params]
        inputs += [a.rows for a in (s.x, s.v, s.C, s.F_e, s.history, s.tau)]
        wp.launch(self._g2p_stress, dim=len(s), inputs=inputs, device=self.device)

    @cached_property
    def increment(self) -> wp.array:
        """[P, 3, 3] f = I + Δt ∇v of the last step taken stage by stage; `step` does not store it."""
        return wp.empty_like(self.state.F_e.rows)

    def g2p(self) -> None:
        """Grid → particles."""
        s = self.state
        self.grid_step.g2p(s.x.rows, s.v.rows, s.C.rows, self.increment)

    def update_stress(self) -> None:
        """F_e ← returnMap(f F_e), τ ← τ(F_e)."""
        s = self.state
        inputs = [self.increment, self.mu, self.lam, self._params, self.grid_step.dt]
        inputs += [s.F_e.rows, s.history.rows, s.tau.rows]
        wp.launch(self._stress_update, dim=len(s), inputs=inputs, device=self.device)

    def elastic_cfl(self) -> float:
        """Largest elastic CFL number c Δt/Δx of the state, c from the law's tangent stiffness at F_e.

        For a diagnosis: it copies the state to the host and back.
        """
        kernel = make_elastic_stress(
            self.material.functions(self.precision), self.precision, self.material.history_size
        )
        s = self.state
        tau = wp.empty_like(s.tau.rows)

        def tau_of(F: np.ndarray) -> np.ndarray:
            stretched = wp.array(F, dtype=self.precision.mat33, device=self.device)
            inputs = [stretched, s.history.rows, self.mu, self.lam, tau]
            wp.launch(kernel, dim=len(F), inputs=inputs, device=self.device)
            return tau.numpy().astype(float)

        density = (self.constants.mass / self.constants.volume0)[s.order.numpy()]
        speed = wave_speed_at(tau_of, s.F_e.rows.numpy().astype(float), density)
        return speed * self.dt / self.grid.geometry.dx

    def check(self) -> None:
        """Look at all particles, raise if law or step no longer hold, and keep what is odd for `warnings`.

        Raises:
            InstabilityError: a particle is non-finite, off the grid, inside out or faster than a cell a step,
                or most are collapsed; names the particle, the step and the time.
        """
        s, forcing, dx = self.state, self.grid_step.forcing, self.grid.geometry.dx
        look = self._watch.look(s, self.mass, self.grid, forcing, self.dt)
        when = f"at step {self.steps_taken}, t = {self.time:.6g} s"
        if look.non_finite is not None:
            raise InstabilityError(
                f"particle {look.non_finite} became non-finite {when} or in the {self.check_every} steps "
                f"before; reduce dt={self.dt:g} s"
            )
        if look.outside is not None:
            where = np.array2string(s.x.numpy()[look.outside], precision=4)
            raise InstabilityError(
                f"particle {look.outside} left the grid {when}: x = {where} m, "
                f"domain [0, {self.grid.geometry.upper}] m; "
                f"enlarge the domain, add a boundary or reduce dt={self.dt:g} s"
            )

        def J_of(p: int) -> float:
            return float(np.linalg.det(s.F_e.numpy()[p].astype(float)))

        self._watch.judge(look, forcing.steady, self.dt, dx, when, J_of)


def diagnosed(
    error: InstabilityError, build: Callable[[], FullOrderMPM], steps_taken: int
) -> InstabilityError:
    """The error of a run that failed a check, with the elastic CFL number at the check before it.

    The check of Δt before a run knows the material at rest only, and a law that stiffens in tension outgrows
    it. The number is found by making the failed run again, so that runs without a failure pay nothing.

    Args:
        error: error of the check that failed.
        build: gives the solver at t = 0.
        steps_taken: number of steps up to the check that failed.
    """
    solver = build()
    cfl_at_rest = solver.elastic_cfl()
    solver.step((steps_taken - 1) // solver.check_every * solver.check_every)
    cfl = solver.elastic_cfl()
    advice = ""
    if cfl > MAX_ELASTIC_CFL:
        advice = f", as the material is stretched: try dt={solver.dt * MAX_ELASTIC_CFL / cfl:.2g} s"
    return InstabilityError(
        f"{error}; elastic CFL c dt/dx = {cfl_at_rest:.3g} at rest, {cfl:.3g} at step {solver.steps_taken} "
        f"(limit {MAX_ELASTIC_CFL:g}){advice}"
    )
