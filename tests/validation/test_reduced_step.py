"""The reduced MPM step (paper section 5.2): "There is no approximation in this step"."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

import nsf
import nsf.scenes
from nsf.dynamics import GaussNewton, Integration, NeighbourSearch, Taylor
from nsf.dynamics.integration import particle_sets
from nsf.dynamics.interop import as_matrices, as_scalars, as_vectors
from nsf.engines import ENGINES
from nsf.mpm import FP64, BoundaryArrays, Forcing, Grid, GridStep
from nsf.sampling import RandomSampler

STEPS = 40
# A plate that turns as it pushes the column, and a ball that comes later.
MOVING = (
    "+scene.colliders.plate={_target_: nsf.mpm.Cuboid, centre: [0.36, 0.5, 0.25], size: [0.1, 0.3, 0.3],"
    " kind: separate, friction: 0.3, motion: {_target_: nsf.mpm.Motion, times: [0.02, 0.3],"
    " translations: [[0, 0, 0], [0.12, 0.02, 0]],"
    " angles: [0, 20], axis: [0, 1, 0.5], pivot: [0.36, 0.5, 0.13]}}",
    "+scene.colliders.ball={_target_: nsf.mpm.Sphere, centre: [0.57, 0.5, 0.3], radius: 0.07, kind: slip,"
    " since: 0.06, motion: {_target_: nsf.mpm.Motion,"
    " times: [0, 0.2], translations: [[0, 0, 0], [0, 0, -0.1]]}}",
)


@pytest.fixture(scope="module", params=["apic", "pic", "moving"])
def mid_run(request):
    """A sand column in mid-collapse and its state one full-order step later."""
    overrides = MOVING if request.param == "moving" else [f"transfer={request.param}"]
    scene = nsf.load_scene("sand", overrides)
    solver = scene.full_order({"friction_angle": 30.0}, device="cpu")
    solver.step(STEPS)
    before = {name: torch.tensor(value) for name, value in solver.state.numpy().items()}
    solver.step(1)
    return scene, before, torch.tensor(solver.state.numpy()["x"])


def moved_sample(scene, state, rows, sample, nodes, steps=STEPS, dt=None):
    """Positions [s, 3] of the sample particles after step number `steps` over `rows`, the sample first."""
    constants = scene.particles()
    chosen = {name: state[name][rows].contiguous() for name in ("x", "v", "C", "tau")}
    mass, volume0 = (torch.tensor(getattr(constants, k)[rows]) for k in ("mass", "volume0"))
    device = wp.get_device("cpu")
    boundaries = BoundaryArrays(scene.solids, scene.walls, FP64, device)
    grid = Grid(scene.grid, FP64, device, nodes=nodes)
    forcing = Forcing([scene.gravity], boundaries, FP64, device)
    step = GridStep(grid, forcing, scene.transfer, dt or scene.dt, FP64, device)
    boundaries.steps.fill_(steps)
    vectors = [as_vectors(chosen[k], FP64) for k in ("x", "v")]
    matrices = [as_matrices(chosen[k], FP64) for k in ("C", "tau")]
    step.p2g(*vectors, *matrices, as_scalars(mass), as_scalars(volume0))
    step.follow()
    step.update_g2p(*vectors, len(sample))
    return chosen["x"][: len(sample)]


def sets_of(scene, x, sample):
    search = NeighbourSearch(scene.grid, scene.transfer.shape, FP64, wp.get_device("cpu"))
    marked = search.no_nodes(x.device)
    search.mark_nodes(x[sample].contiguous(), marked)
    return particle_sets(sample, search.integration_mask(x, torch.as_tensor(sample)), marked)


@pytest.mark.parametrize("sparse", [False, True])
def test_integration_particles_move_the_sample_as_all_particles_do(mid_run, sparse):
    scene, before, after = mid_run
    sample = np.sort(np.random.default_rng(1).permutation(len(after))[:4])
    sets = sets_of(scene, before["x"], sample)
    assert 4 < len(sets.integration) < 0.8 * len(after)  # otherwise the test shows nothing
    moved = moved_sample(scene, before, sets.integration, sample, sets.nodes if sparse else None)
    assert (moved - after[sample]).abs().max() <= 1e-12


def test_a_dropped_particle_is_seen(mid_run):
    scene, before, after = mid_run
    sample = np.sort(np.random.default_rng(1).permutation(len(after))[:4])
    sets = sets_of(scene, before["x"], sample)
    # The particle nearest to a sample particle is certainly needed.
    others = sets.integration[4:]
    nearest = others[(before["x"][others] - before["x"][sample[0]]).norm(dim=1).argmin()]
    rows = sets.integration[sets.integration != nearest]
    moved = moved_sample(scene, before, rows, sample, None)
    assert (moved - after[sample]).abs().max() > 1e-9


def test_every_needed_particle_is_flagged_and_no_other(mid_run):
    """Section 5.4 a and b by brute force over nodes and weights."""
    scene, before, _ = mid_run
    x, dx = before["x"].numpy(), scene.dx
    sample = np.array([3, 700, 1900])

    def stencil(points):
        base = np.floor(points / dx - 0.5).astype(int)
        return {
            tuple(b + np.array([i, j, k])) for b in base for i in range(3) for j in range(3) for k in range(3)
        }

    nodes = stencil(x[sample])
    expected = np.array([bool(stencil(p[None]) & nodes) for p in x])
    needed = sets_of(scene, before["x"], sample).integration
    assert set(needed) == set(np.flatnonzero(expected))


@pytest.mark.parametrize("mid_run", ["moving"], indirect=True)
def test_moving_colliders_are_felt_at_their_time(mid_run):
    """Otherwise the test above shows nothing of them."""
    scene, before, after = mid_run
    every = np.arange(len(after))
    assert (moved_sample(scene, before, every, every, None) - after).abs().max() <= 1e-12
    late = moved_sample(scene, before, every, every, None, steps=STEPS + 1)
    assert (late - after).abs().max() > 1e-6


@pytest.mark.parametrize("multiplier", [1.0, 1.5])
@pytest.mark.parametrize("strategy", ["superset", "search"])
@pytest.mark.parametrize("engine", [engine.name for engine in ENGINES])
def test_a_reduced_run_meets_moving_colliders_in_every_span(
    engine, strategy, multiplier, tiny, tiny_manifold
):
    """S moves as in a step over every particle, with its Δt, at any time and after a change of sample."""
    scene = nsf.load_scene("sand", [*tiny[1:], *MOVING]).at({"friction_angle": 26.0})
    sampler = RandomSampler(20, phases=[{"start": 0.5, "size": 8}])
    solver = nsf.reduced(
        scene,
        tiny_manifold,
        {"friction_angle": 26.0},
        sampler,
        device="cpu",
        integration=Integration(strategy),
        dt_multiplier=multiplier,
        projector=GaussNewton(tolerance=1e-14),
        engine=engine,
    )
    half = round(0.5 * solver.total_steps)
    sizes, felt = set(), 0.0
    for n in range(solver.total_steps):
        if n in (3, half - 1, half, half + 4):
            state = {name: torch.tensor(value) for name, value in solver.state.numpy().items()}
            span = solver.together.span_at(n)
            sample, others = span.sets.sample, np.arange(len(solver.state))
            rows = np.concatenate([sample, np.setdiff1d(others, sample)])
            expected = moved_sample(scene, state, rows, sample, None, n, solver.dt)
            still = replace(scene, colliders=dict(list(scene.colliders.items())[:1]))
            without = moved_sample(still, state, rows, sample, None, n, solver.dt)
            felt = max(felt, (without - expected).abs().max())
            solver.step()
            # What G2P gave is there until the next step.
            off = (span.x[: span.s] - expected).abs().max()
            assert off <= 1e-11  # [m] the inversion ends before round-off
            sizes.add(len(sample))
        else:
            solver.step()
    assert sizes == {20, 8}
    assert felt > 1e-5  # otherwise the test shows nothing


@pytest.mark.parametrize("strategy", ["superset", "search"])
def test_a_step_started_from_latents_is_the_one_of_the_run(strategy, tiny, tiny_manifold):
    """At its moment, which moving colliders feel, and with its sample: the same Gauss-Newton step."""
    scene = nsf.load_scene("sand", [*tiny[1:], *MOVING]).at({"friction_angle": 26.0})
    sampler = RandomSampler(20, phases=[{"start": 0.5, "size": 8}])
    options = {"device": "cpu", "integration": Integration(strategy), "projector": Taylor()}
    run, other = (
        nsf.reduced(scene, tiny_manifold, {"friction_angle": 26.0}, sampler, **options) for _ in range(2)
    )
    run.step(20)
    latents = torch.as_tensor(run.trajectory().xhat)
    for n in (14, 11, 3, 19):
        error, J = other.equations_at(n, latents[n], latents[n - 1])
        assert len(error) == (20 if n < 12 else 8)
        update = torch.linalg.lstsq(J.flatten(0, 1), error.flatten()[:, None]).solution[:, 0]
        torch.testing.assert_close(latents[n] + update, latents[n + 1], rtol=0, atol=1e-7)  # fp32 tangents
