"""A full-order step: a block of dry sand that collapses, at several sizes."""

from functools import partial

import numpy as np

from nsf.bench.measure import WARM_UP, WINDOW, bandwidth, build, pass_time, window_times
from nsf.bench.rows import Case, Measurements, name_of, size_name
from nsf.mpm import DomainWalls, FullOrderMPM, GridGeometry, HalfSpace, ParticleConstants
from nsf.mpm.grid.geometry import BLOCK
from nsf.mpm.materials import DruckerPrager
from nsf.scenes import Box
from nsf.timing import elapsed_ms, synchronizer

SIZES = {"cuda": (71_000, 200_000, 1_000_000), "cpu": (10_000, 40_000)}
_CELLS = 160  # along the edge of the domain, the paper's grid
_PARTICLES_PER_CELL = 8
_FLOOR = 4  # [cells]
_SAND = DruckerPrager(E=2000.0, nu=0.2, friction_angle=30.0)
_DENSITY, _GRAVITY, _DT = 200.0, (0.0, 0.0, -4.0), 6e-4


def collapse(particles: int, precision: str, device: str) -> FullOrderMPM:
    """A cube of sand on the floor of the unit cube, 8 particles a cell, just let go.

    The grid is the paper's, 160³, whatever the number of particles; the sand is that of the scene `sand`.
    """
    dx = 1.0 / _CELLS
    edge = dx * (particles / _PARTICLES_PER_CELL) ** (1.0 / 3.0)
    low = (0.5 - edge / 2, 0.5 - edge / 2, _FLOOR * dx)
    X = Box(low, tuple(a + edge for a in low)).sample(particles)
    volume0 = np.full(particles, edge**3 / particles)
    moduli = (np.full(particles, m) for m in (_SAND.mu, _SAND.lam))
    return FullOrderMPM(
        ParticleConstants(X, _DENSITY * volume0, volume0, *moduli),
        _SAND,
        GridGeometry.of_domain((1.0, 1.0, 1.0), dx),
        _DT,
        gravity=_GRAVITY,
        colliders=[HalfSpace(low, (0.0, 0.0, 1.0), "sticky")],
        walls=DomainWalls(),
        precision=precision,
        device=device,
    )


def run(figures: Measurements) -> None:
    """Every size; the precisions of a size turn by turn."""
    settings, device = figures.settings, figures.settings.device
    speed = bandwidth(device)
    figures.say(f"full_order: a copy on {name_of(device)} moves {speed / 1e9:.0f} GB/s")
    for particles in settings.particles or SIZES["cuda" if settings.on_gpu else "cpu"]:
        built = {p: build(partial(collapse, particles, p, device), device) for p in settings.precisions}
        solvers = {precision: solver for precision, (solver, _) in built.items()}
        times = window_times(solvers, WARM_UP + WINDOW * settings.trials, settings.trials, device)
        for precision, (solver, peak) in built.items():
            name = f"full_order_{size_name(particles)}"
            case = Case(bench="full_order", name=name, particles=particles, precision=precision)
            ms = figures.add(case, "step", times[precision])
            figures.add(case, "peak memory", peak, "MiB")
            looks = look_times(solver, settings.trials)
            share = 100.0 * figures.add(case, "watch", looks) / ms
            figures.say(f"{name} {precision}: {ms:.4g} ms a step, {share:.2g} % of it the watch")
            add_passes(figures, case, solver, speed)


def look_times(solver: FullOrderMPM, trials: int) -> list[float]:
    """[trials] time of a look at J, |v| Δt/Δx, contact and energy, over the steps between two looks [ms]."""
    wait = synchronizer(solver.device)
    times = [elapsed_ms(solver.check, wait) / solver.check_every for _ in range(trials + 1)]
    return times[1:]  # the first one compiles nothing, but finds cold caches


def add_passes(figures: Measurements, case: Case, solver: FullOrderMPM, speed: float) -> None:
    """Add the passes of a solver's step, beside what a copy of `speed` [B/s] takes; ends the solver's use."""
    for part, (ms, size) in pass_times(solver).items():
        add_pass(figures, case, part, ms, size, 1e3 * size / speed)


def add_pass(figures: Measurements, case: Case, part: str, ms: float, size: float, floor: float) -> None:
    """Add a pass's time [ms], the bytes it reads and writes, and the time that these take a copy [ms]."""
    figures.add(case, "time", ms, part=part)
    figures.add(case, "moved", size / 2**20, "MiB", part)
    figures.add(case, "floor", floor, part=part)


def pass_times(solver: FullOrderMPM) -> dict[str, tuple[float, int]]:
    """Median time [ms] of each pass of a step over memory, in order, and the bytes it has to read and write.

    A value counts once however often it is read, a node of the grid once for all its particles. A pass that
    is repeated on its own is a step of nothing: the solver's state is of no use afterwards.
    """
    P, H = len(solver.state), solver.material.history_size
    s, step, device = solver.state, solver.grid_step, str(solver.device)
    solver.p2g()
    nodes = BLOCK**3 * int(solver.grid.listed.numpy()[0])
    values = {
        "clear": 3 * P + 4 * nodes,  # x; the nodes
        "p2g": 26 * P + 8 * nodes,  # x, v, C, τ, m, V; the nodes, there and back
        "grid": 8 * nodes,
        "g2p_stress": (14 + H) * P + 4 * nodes + (33 + H) * P,  # x, F_e, h, μ̂, λ; v_i; x, v, C, F_e, h, τ
    }
    calls = {
        "clear": lambda: step.clear(s.x.rows),
        "p2g": lambda: step.scatter(s.x.rows, s.v.rows, s.C.rows, s.tau.rows, solver.mass, solver.volume0),
        "grid": step.update,
        "g2p_stress": solver.g2p_stress,
    }
    passes = {}
    for name, call in calls.items():
        solver.p2g()  # the pass before has left nothing that has a meaning
        if name == "g2p_stress":
            step.update()
        passes[name] = pass_time(call, device), np.dtype(solver.precision.numpy).itemsize * values[name]
    return passes
