"""Cubature of the projection: weighted sample particles that stand for all (the paper's future work)."""

import re

import numpy as np
import pytest
import torch

import nsf
from nsf.dynamics import ParticleSets
from nsf.errors import ConfigError, ProjectionError
from nsf.sampling import CellSampler, CubatureSampler, SampleSpan
from nsf.sampling.cells import added_up
from nsf.sampling.cubature import nonnegative_fit, normal_equations, training_rows

ANGLE = {"friction_angle": 26.0}
EVERYONE = np.arange(500)
STATES = 9


@pytest.fixture(scope="module")
def solver_at(chain, tiny_manifold):
    """Problem parameters → the reduced solver whose sample is every particle."""
    sets = [ParticleSets(EVERYONE, EVERYONE, None)]
    return lambda parameters: nsf.reduced(
        chain.scene, tiny_manifold, parameters, EVERYONE, device="cpu", sets=sets
    )


@pytest.fixture(scope="module")
def equations(tiny_manifold, solver_at):
    return normal_equations(
        tiny_manifold, training_rows(tiny_manifold, 0.0, 1.0, STATES), EVERYONE, solver_at
    )


@pytest.fixture(scope="module")
def span_of(tiny_manifold, solver_at):
    """Size and settings → the first phase."""
    return lambda size, **settings: CubatureSampler(size, states=STATES, **settings).spans_of(
        tiny_manifold, solver_at=solver_at
    )[0]


def residual(equations, phase) -> float:
    """How far the weighted sums over S are from those over every particle, relative."""
    columns, target = equations.columns, equations.target
    weighted = columns[:, torch.as_tensor(phase.particles)] @ torch.as_tensor(phase.weights)
    return float((weighted - target).norm() / target.norm())


# -- the equations --------------------------------------------------------------------------------------


def test_training_rows_are_inside_trajectories_and_in_their_time(tiny_manifold):
    """25 frames each of three trajectories: neither the first nor the last can be stepped from."""
    rows = training_rows(tiny_manifold, 0.0, 1.0, 1000)
    assert rows.tolist() == [25 * k + frame for k in range(3) for frame in range(1, 24)]
    late = training_rows(tiny_manifold, 0.5, 0.75, 1000)
    assert late.tolist() == [25 * k + frame for k in range(3) for frame in range(12, 18)]
    few = training_rows(tiny_manifold, 0.0, 1.0, 7)
    assert len(few) == 7
    assert set(few.tolist()) < set(rows.tolist())
    with pytest.raises(ConfigError, match=re.escape("no training state lies in [0.51, 0.52) of T")):
        training_rows(tiny_manifold, 0.51, 0.52, 5)


def test_both_sums_of_a_state_have_norm_one(equations):
    """And the matrix's is the identity, over √r."""
    columns, target, _ = equations
    assert columns.shape == (STATES * 14, 500)
    torch.testing.assert_close(columns.sum(1), target)
    for state in target.view(STATES, 14):
        right, matrix = state.split([4, 10])
        assert float(right.norm()) == pytest.approx(1.0)
        row, column = torch.triu_indices(4, 4)
        torch.testing.assert_close(matrix, (row == column).double() / 2.0)


class Still:
    """A whole body of two latents in which some particles never move, and the others move by `motion` [m]."""

    dt, dx = 0.005, 0.02

    def __init__(self, motion):
        generator = torch.Generator().manual_seed(2)
        self.J = torch.randn(40, 3, 2, generator=generator, dtype=torch.float64)
        self.J[:10] = 0.0
        self.error = motion * torch.randn(40, 3, generator=generator, dtype=torch.float64)

    def equations_at(self, step, xhat, previous):
        return self.error, self.J


def test_a_body_at_rest_is_told_by_its_matrix_alone(tiny_manifold):
    """Neither round-off nor nothing at all is blown up to norm one."""
    rows = training_rows(tiny_manifold, 0.0, 1.0, 3)
    for motion, at_rest in ((0.0, True), (1e-14, True), (1e-3, False)):
        body = Still(motion)
        columns, target, _ = normal_equations(tiny_manifold, rows, np.arange(40), lambda values, b=body: b)
        assert (float(target.view(3, 5)[:, :2].norm()) < 1e-5) == at_rest
        chosen, weights = nonnegative_fit(columns, target, 40)
        assert min(chosen) >= 10
        assert np.isfinite(weights).all()


def test_a_step_that_is_not_finite_is_left_out(tiny_manifold):
    """It is of the first value; if there is no other, nothing can be learnt."""
    rows = training_rows(tiny_manifold, 0.0, 1.0, 3)
    lowest = float(tiny_manifold.training_parameters.min())

    def solver_at(values):
        return Still(np.nan if values["friction_angle"] == lowest else 1e-3)

    columns, target, _ = normal_equations(tiny_manifold, rows, np.arange(40), solver_at)
    rest, of_rest, _ = normal_equations(tiny_manifold, rows[1:], np.arange(40), solver_at)
    assert torch.equal(columns, rest)
    assert torch.equal(target, of_rest)
    with pytest.raises(ProjectionError, match="of the steps from 3 training states none is finite"):
        normal_equations(tiny_manifold, rows, np.arange(40), lambda values: Still(np.nan))


def test_nonnegative_fit_meets_the_conditions_of_an_optimum():
    """Karush, Kuhn and Tucker: no slope along what is taken, none upwards along what is not."""
    draw = np.random.default_rng(3)
    columns, target = torch.tensor(draw.normal(size=(30, 80))), torch.tensor(draw.normal(size=30) * 5)
    columns[:3] = columns[:3].abs()  # so that the target lies outside their cone
    target[:3] = -4.0
    chosen, weights = nonnegative_fit(columns, target, 80)
    slope = columns.T @ (target - columns[:, chosen] @ torch.as_tensor(weights))
    assert 5 < len(chosen) < 30
    assert (weights > 0).all()
    assert float(slope[chosen].abs().max()) < 1e-9
    assert float(slope.max()) < 1e-9
    few, positive = nonnegative_fit(columns, target, 4)
    assert len(few) == len(positive) == 4


# -- the choice -----------------------------------------------------------------------------------------


def test_a_cubature_of_any_size_takes_the_step_of_every_particle(tiny_manifold, solver_at, span_of):
    """With as many particles as wanted the sums are exact, and so is the Gauss-Newton step."""
    phase = span_of(500)
    assert 14 <= len(phase.particles) <= STATES * 14
    few = torch.as_tensor(phase.particles)
    root = torch.as_tensor(phase.weights).sqrt()[:, None]
    for row in training_rows(tiny_manifold, 0.0, 1.0, STATES).tolist():
        parameters = {"friction_angle": float(tiny_manifold.training_parameters[row, 0])}
        latents = tiny_manifold.training_latents
        frame = row % 25
        error, J = solver_at(parameters).equations_at(frame, latents[row], latents[row - 1])

        def step(error, J):
            return torch.linalg.lstsq(J.flatten(0, 1), error.flatten()[:, None]).solution[:, 0]

        everyone, sample = step(error, J), step(root * error[few], root[..., None] * J[few])
        assert float((sample - everyone).norm() / everyone.norm()) < 1e-5


def test_the_residual_falls_with_size_and_beats_random_samples(equations, span_of):
    """Every one of those with equal weights, and on average those with weights fitted as well as these."""
    columns, target, _ = equations
    before = np.inf
    for size in (4, 8, 16, 32):
        ours = residual(equations, span_of(size))
        assert ours < 0.8 * before
        before, fitted = ours, []
        for seed in range(20):
            draw = np.random.default_rng(seed).permutation(500)[:size]
            assert ours < residual(equations, SampleSpan(0.0, draw, np.full(size, 500 / size)))
            chosen, weights = nonnegative_fit(columns[:, draw], target, size)
            fitted.append(residual(equations, SampleSpan(0.0, draw[chosen], weights)))
        assert ours < np.mean(fitted)


def test_a_cubature_out_of_cells_needs_fewer_integration_particles(
    chain, tiny_manifold, solver_at, equations
):
    """All of S is in the cells that are allowed, and weights bring the sums nearer than equal ones there."""
    few, any_cell = (
        kind(24, states=STATES, **own).spans_of(tiny_manifold, solver_at=solver_at)
        for kind, own in ((CellSampler, {"cells": 3}), (CubatureSampler, {}))
    )
    every, cell = np.unique(np.floor(tiny_manifold.X.numpy() / chain.scene.dx), axis=0, return_inverse=True)
    assert np.array_equal(np.unique(equations.cells, axis=0), every)
    assert 1 < len(set(cell.ravel()[few[0].particles])) <= 3
    others = []
    for seed in range(20):
        three = np.random.default_rng(seed).permutation(len(every))[:3]
        inside = np.flatnonzero(np.isin(cell.ravel(), three))
        chosen, weights = nonnegative_fit(equations.columns[:, inside], equations.target, 24)
        others.append(residual(equations, SampleSpan(0.0, inside[chosen], weights)))
    assert residual(equations, few[0]) < 0.7 * np.mean(others)
    sizes = []
    for phases in (few, any_cell):
        solver = nsf.reduced(chain.scene, tiny_manifold, ANGLE, phases, device="cpu")
        solver.step(6)
        sizes.append(solver.integration_mean)
    assert sizes[0] < 0.8 * sizes[1]


def test_sums_over_cells(equations):
    cell = np.unique(equations.cells, axis=0, return_inverse=True)[1].ravel()
    expected = np.stack([equations.columns[:, cell == c].numpy().sum(1) for c in range(cell.max() + 1)], 1)
    np.testing.assert_allclose(added_up(equations.columns, cell), expected, rtol=0, atol=1e-14)


def test_the_choice_is_bitwise_the_same(span_of):
    one, other = span_of(20), span_of(20)
    assert np.array_equal(one.particles, other.particles)
    assert np.array_equal(one.weights, other.weights)
    assert len(one.particles) == 20
    assert (np.diff(one.particles) > 0).all()


def test_regions_and_spans(tiny_manifold, solver_at):
    X = tiny_manifold.X.numpy()
    middle = float(np.median(X[:, 0]))
    sampler = CubatureSampler(9, lower=[middle, 0, 0], states=6, phases=[{"start": 0.5, "size": 7}])
    first, later = sampler.spans_of(tiny_manifold, solver_at=solver_at)
    assert (X[first.particles][:, 0] >= middle).all()
    assert (X[later.particles][:, 0] < middle).any()
    assert (first.start, later.start) == (0.0, 0.5)
    assert (len(first.weights), len(later.weights)) == (9, 7)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_a_scene_is_reduced_with_a_cubature(chain, tiny_manifold, precision):
    """Through the front door, with weights in every span of the run."""
    sampler = CubatureSampler(10, states=6, phases=[{"start": 0.5, "size": 8}])
    options = {"device": "cpu", "precision": precision, "dt_multiplier": 1.5}
    solver = nsf.reduced(chain.scene, tiny_manifold, ANGLE, sampler, **options)
    solver.step(solver.total_steps)
    assert solver.left_grid() == -1
    for span, sets in zip(solver.samples, solver.sets, strict=True):
        assert np.array_equal(span.particles, sets.sample)
        assert (span.weights > 0).all()


def test_refused(span_of):
    with pytest.raises(ConfigError, match=re.escape("sampler.size=501, but the scene has 500 particles")):
        span_of(501)
    for states in (0, 2.5):
        with pytest.raises(ConfigError, match=rf"sampler\.states={states}"):
            CubatureSampler(10, states=states)
    for cells in (0, 2.5):
        with pytest.raises(
            ConfigError, match=rf"sampler\.cells={cells} must be a whole number of at least 1"
        ):
            CellSampler(10, cells=cells)
