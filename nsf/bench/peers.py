"""A full-order step written in Taichi, beside ours: the same law, particles and grid."""

from functools import partial

import numpy as np

from nsf.bench.full_order import SIZES, collapse
from nsf.bench.measure import WARM_UP, build, window_times
from nsf.bench.rows import Case, Measurements, size_name
from nsf.errors import MissingExtraError
from nsf.extras import optional
from nsf.mpm import DomainWalls, FullOrderMPM
from nsf.pipeline.stages.cores import cores

_STEPS = 60  # of a run that is timed
_MARGIN = 8  # [cells] around the body, which moves by half of one meanwhile


def run(figures: Measurements) -> None:
    """Every size and precision; skipped with a line where Taichi is not installed.

    On a CPU Taichi has one core, turn by turn with ours, which has no more, and then all cores.
    """
    try:
        taichi = optional("taichi", "peers")
    except MissingExtraError as error:
        figures.say(f"peers: skipped, {error}")
        return
    settings, device = figures.settings, figures.settings.device
    several = () if settings.on_gpu else (cores(device),)
    for particles in settings.particles or SIZES["cuda" if settings.on_gpu else "cpu"]:
        for precision in settings.precisions:
            ours, _ = build(partial(collapse, particles, precision, device), device)
            for threads in dict.fromkeys((1, *several)):
                sides = {"taichi" + f"_{threads}_cores" * (threads > 1): TaichiMPM(taichi, ours, threads)}
                if threads == 1:
                    sides["full_order"] = ours
                for solver in sides.values():
                    solver.step(WARM_UP - min(WARM_UP, solver.steps_taken))
                times = window_times(sides, WARM_UP + _STEPS, settings.trials, device)
                for side, ms in times.items():
                    name = f"{side}_{size_name(particles)}"
                    case = Case(bench="peers", name=name, particles=particles, precision=precision)
                    step = figures.add(case, "step", ms)
                    speed = figures.add(case, "speed", particles / (1e-3 * ms), "particles/s")
                    figures.say(f"{name} {precision}: {step:.4g} ms a step, {speed:.3g} particles a second")


class TaichiMPM:
    """The beginning of a run of `collapse` as a plain Taichi program: scatter, grid, gather.

    It clears and updates each node that it stores, so that it stores those of a box around the body alone.
    APIC with quadratic B-splines, Drucker-Prager over Hencky elasticity, a sticky floor and separating walls,
    see `nsf.mpm`. Another one may not be made while this one is used, as Taichi is begun anew.

    Args:
        taichi: the module.
        solver: the run at its beginning, which the positions, order and constants are of.
        threads: of a CPU.
    """

    def __init__(self, taichi, solver: FullOrderMPM, threads: int = 1):
        real = taichi.f64 if solver.precision.name == "fp64" else taichi.f32
        arch = taichi.cuda if solver.device.is_cuda else taichi.cpu
        taichi.init(arch, default_fp=real, cpu_max_num_threads=threads, log_level=taichi.ERROR)
        self._taichi, self.steps_taken = taichi, 0
        self._x, self._stages = _stages(taichi, real, solver)

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt, and wait for them."""
        for _ in range(n):
            for stage in self._stages:
                stage()
        self._taichi.sync()
        self.steps_taken += n

    @property
    def x(self) -> np.ndarray:
        """[P, 3] positions [m], in the order of the solver's rows."""
        return self._x.to_numpy()


def _stages(ti, real, solver: FullOrderMPM):
    """Positions as a field, and the kernels of a step in order."""
    P, shape = len(solver.state), solver.grid.geometry.nodes
    dx, dt = solver.grid.geometry.dx, solver.dt
    alpha, mu, lam = solver.material.alpha, solver.material.mu, solver.material.lam
    (gravity,) = solver.grid_step.forcing.gravities
    fall = tuple(map(float, dt * gravity.at(np.zeros(1))[0]))
    floor = float(solver.grid_step.forcing.boundaries.colliders[0].point[2]) + 0.5 * dx
    padding = DomainWalls().padding
    mass, volume = float(solver.constants.mass[0]), float(solver.constants.volume0[0])

    x, v = (ti.Vector.field(3, real, P) for _ in range(2))
    C, F, tau = (ti.Matrix.field(3, 3, real, P) for _ in range(3))
    lower = np.maximum(np.floor(solver.constants.X.min(0) / dx).astype(int) - _MARGIN, 0)
    upper = np.minimum(np.ceil(solver.constants.X.max(0) / dx).astype(int) + _MARGIN, np.array(shape) - 1)
    box = {"shape": tuple(upper - lower + 1), "offset": tuple(lower)}
    node_m, node_v = ti.field(real, **box), ti.Vector.field(3, real, **box)
    x.from_numpy(solver.constants.X[solver.state.order.numpy()].astype(solver.precision.numpy))

    @ti.kernel
    def begin():
        for p in x:
            F[p] = ti.Matrix.identity(real, 3)

    @ti.func
    def splines(at):
        base = ti.floor(at / dx - 0.5, int)
        f = at / dx - ti.cast(base, real)
        w = ti.Matrix.rows([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
        d = ti.Matrix.rows([f - 1.5, -2.0 * (f - 1.0), f - 0.5])
        return base, f, w, d

    @ti.func
    def slope(w, d, a: ti.template(), b: ti.template(), c: ti.template()):
        along = d[a, 0] * w[b, 1] * w[c, 2], w[a, 0] * d[b, 1] * w[c, 2], w[a, 0] * w[b, 1] * d[c, 2]
        return ti.Vector([along[0], along[1], along[2]])

    @ti.kernel
    def clear():
        for node in ti.grouped(node_m):
            node_m[node] = 0.0
            node_v[node] = ti.Vector.zero(real, 3)

    @ti.kernel
    def scatter():
        for p in x:
            base, f, w, d = splines(x[p])
            affine = (mass * dx) * C[p]
            momentum = mass * v[p] - affine @ f
            impulse = (-dt * volume / dx) * tau[p]
            for a, b, c in ti.static(ti.ndrange(3, 3, 3)):
                node = base + ti.Vector([a, b, c])
                weight = w[a, 0] * w[b, 1] * w[c, 2]
                reach = ti.Vector([a, b, c], real)
                node_v[node] += weight * (momentum + affine @ reach) + impulse @ slope(w, d, a, b, c)
                node_m[node] += weight * mass

    @ti.kernel
    def update():
        for node in ti.grouped(node_m):
            if node_m[node] > 0.0:
                speed = node_v[node] / node_m[node] + ti.Vector(fall, real)
                if dx * node[2] <= floor:
                    speed = ti.Vector.zero(real, 3)
                for axis in ti.static(range(3)):
                    low, high = node[axis] < padding, node[axis] >= shape[axis] - padding
                    if (low and speed[axis] < 0.0) or (high and speed[axis] > 0.0):
                        speed[axis] = 0.0
                node_v[node] = speed

    @ti.kernel
    def gather():
        for p in x:
            base, f, w, d = splines(x[p])
            speed, affine = ti.Vector.zero(real, 3), ti.Matrix.zero(real, 3, 3)
            gradient = ti.Matrix.zero(real, 3, 3)
            for a, b, c in ti.static(ti.ndrange(3, 3, 3)):
                at_node = node_v[base + ti.Vector([a, b, c])]
                weight = w[a, 0] * w[b, 1] * w[c, 2]
                speed += weight * at_node
                affine += at_node.outer_product(weight * (ti.Vector([a, b, c], real) - f))
                gradient += at_node.outer_product(slope(w, d, a, b, c))
            v[p], C[p] = speed, (4.0 / dx) * affine
            x[p] += dt * speed
            F[p], tau[p] = flowed((ti.Matrix.identity(real, 3) + (dt / dx) * gradient) @ F[p])

    @ti.func
    def flowed(trial):
        U, S, V = ti.svd(trial, real)
        eps = ti.log(ti.Vector([S[0, 0], S[1, 1], S[2, 2]]))
        trace, elastic, kept = eps.sum(), eps, trial
        deviator = eps - trace / 3.0
        size = deviator.norm()
        excess = size + alpha * (3.0 * lam + 2.0 * mu) * trace / (2.0 * mu)
        if trace > 0.0:
            elastic = ti.Vector.zero(real, 3)
        elif excess > 0.0:
            elastic = eps - (excess / size) * deviator
        if trace > 0.0 or excess > 0.0:
            kept = U @ diagonal(ti.exp(elastic)) @ V.transpose()
        return kept, U @ diagonal(2.0 * mu * elastic + lam * elastic.sum()) @ U.transpose()

    @ti.func
    def diagonal(values):
        return ti.Matrix([[values[0], 0.0, 0.0], [0.0, values[1], 0.0], [0.0, 0.0, values[2]]], real)

    begin()
    return x, (clear, scatter, update, gather)
