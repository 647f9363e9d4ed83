"""Network inversion on a manifold that is known in closed form (paper section 5.3)."""

import math

import pytest
import torch

from nsf.dynamics import STOP_REASONS, GaussNewton, ProjectionResult, Taylor, stop_reasons
from nsf.dynamics.latent import LatentRecord
from nsf.errors import ConfigError

R = 2


class Bent:
    """g(X, x̂) = A x̂ + bend · sin(B x̂) at 5 points, with its exact Jacobian."""

    def __init__(self, bend=0.3):
        generator = torch.Generator().manual_seed(0)
        draw = {"generator": generator, "dtype": torch.float64}
        self.A, self.B = torch.randn(5, 3, R, **draw), torch.randn(5, 3, R, **draw)
        self.bend = bend

    def position(self, xhat):
        return self.A @ xhat + self.bend * torch.sin(self.B @ xhat)

    def position_and_jacobian(self, xhat):
        slope = self.bend * torch.cos(self.B @ xhat)
        return self.position(xhat), self.A + slope[..., None] * self.B


class Scalar:
    """One point whose x is f(x̂): steps and stops can be worked out by hand."""

    def __init__(self, f, slope):
        self._f, self._slope = f, slope

    def position(self, xhat):
        zero = torch.zeros((), dtype=xhat.dtype)
        return torch.stack([self._f(xhat[0]), zero, zero])[None]

    def position_and_jacobian(self, xhat):
        jacobian = torch.zeros(1, 3, 1, dtype=xhat.dtype)
        jacobian[0, 0, 0] = self._slope(xhat[0])
        return self.position(xhat), jacobian


def reason(result, tolerance):
    return stop_reasons(result.residuals[None], result.updates[None], tolerance)[0]


def rms(points):
    return points.square().sum(-1).mean().sqrt()


@pytest.fixture
def start():
    return torch.tensor([0.2, -0.1], dtype=torch.float64)


@pytest.fixture
def goal():
    return torch.tensor([0.35, 0.15], dtype=torch.float64)


def test_gauss_newton_converges_quadratically(start, goal):
    """The target lies on the manifold, so each error is at most a constant times the last one's square."""
    at = Bent()
    errors = [float((start - goal).norm())]
    for iterations in (1, 2, 3):
        xhat = GaussNewton(iterations, tolerance=1e-14).solve(at, at.position(goal), start).xhat
        errors.append(float((xhat - goal).norm()))
    orders = [math.log(errors[k + 1] / errors[k]) / math.log(errors[k] / errors[k - 1]) for k in (1, 2)]
    assert errors[-1] < 1e-7
    assert min(orders) > 1.7


def test_history_of_residuals_and_updates(start, goal):
    at, iterations = Bent(), 4
    target = at.position(goal)
    result = GaussNewton(iterations, tolerance=1e-9).solve(at, target, start)
    assert (result.residuals.shape, result.updates.shape) == ((5,), (4,))
    assert result.residuals[0] == pytest.approx(float(rms(at.position(start) - target)))
    assert result.residuals[-1] == pytest.approx(float(rms(at.position(result.xhat) - target)), abs=1e-14)
    assert (result.residuals.diff()[:2] < 0).all()
    first = GaussNewton(1).solve(at, target, start)
    assert result.updates[0] == pytest.approx(float((first.xhat - start).norm()))


def test_least_squares_when_the_target_is_off_the_manifold(start, goal):
    """At the solution the error is orthogonal to the tangent space."""
    at = Bent()
    away = 0.05 * torch.randn(5, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    target = at.position(goal) + away
    xhat = GaussNewton(40, tolerance=1e-14).solve(at, target, start).xhat
    position, jacobian = at.position_and_jacobian(xhat)
    assert torch.einsum("pc,pcr->r", target - position, jacobian).abs().max() < 1e-9
    assert rms(target - position) > 1e-2


class Repeated(Bent):
    """Its first point twice and its second three times."""

    def __init__(self):
        super().__init__()
        times = torch.tensor([2, 3, 1, 1, 1])
        self.A, self.B = (values.repeat_interleave(times, 0) for values in (self.A, self.B))


@pytest.mark.parametrize("projector", [GaussNewton(2), Taylor()], ids=["gauss_newton", "taylor"])
def test_weights_count_points(projector, start, goal):
    """A point of weight two is two points, in the latent vector and in the residuals."""
    at, repeated = Bent(), Repeated()
    away = 0.05 * torch.randn(5, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    times = torch.tensor([2, 3, 1, 1, 1])
    target = at.position(goal) + away
    weights = times / times.double().mean()
    one = projector.solve(at, target, start, weights)
    other = projector.solve(repeated, target.repeat_interleave(times, 0), start)
    plain = projector.solve(at, target, start)
    for name in ("xhat", "residuals", "updates"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name))
    assert (one.xhat - plain.xhat).norm() > 1e-4  # otherwise the test shows nothing


def test_the_start_lies_on_the_parabola_through_the_last_three():
    """As the record holds them; before there are three, on the line through two, and at first on x̂_0."""
    record = LatentRecord(torch.tensor([1.0, -2.0], dtype=torch.float64), 6, 1)
    path = [torch.tensor([1.0 + 0.3 * n + 0.5 * n * n, -2.0 + n - 0.1 * n * n]).double() for n in range(6)]
    nothing = torch.zeros(2).double(), torch.zeros(1).double()
    assert torch.equal(GaussNewton().start(record), path[0])
    for n in range(1, 5):
        record.add(ProjectionResult(path[n], *nothing))
        expected = path[n + 1] if n > 1 else 2.0 * path[1] - path[0]
        torch.testing.assert_close(GaussNewton().start(record), expected)
        assert torch.equal(Taylor().start(record), path[n])
    record.restart()  # what was recorded stays, and is of no account
    assert torch.equal(GaussNewton().start(record), path[0])
    record.add(ProjectionResult(path[2], *nothing))
    torch.testing.assert_close(GaussNewton().start(record), 2.0 * path[2] - path[0])


def test_converged(start, goal):
    at = Bent()
    result = GaussNewton(6).solve(at, at.position(goal), start)
    assert reason(result, 1e-6) == "converged"


def test_after_convergence_nothing_changes(start):
    """The first update is already below the tolerance: further iterations leave x̂ alone."""
    at = Bent()
    target = at.position(start) + 0.01
    one, many = (GaussNewton(k, tolerance=10.0).solve(at, target, start) for k in (1, 5))
    assert torch.equal(one.xhat, many.xhat)
    assert reason(many, 10.0) == "converged"


def test_the_last_update_is_that_whose_square_does_not_exceed_the_tolerance(start, goal):
    at = Bent()
    target = at.position(goal)
    lengths = GaussNewton(4, tolerance=1e-30).solve(at, target, start).updates
    for last in (0, 1):
        square = float(lengths[last] ** 2)
        for tolerance, taken in ((1.01 * square, last + 1), (0.99 * square, last + 2)):
            found = GaussNewton(4, tolerance).solve(at, target, start).xhat
            of_so_many = [GaussNewton(k, 1e-30).solve(at, target, start).xhat for k in range(1, 5)]
            assert [torch.equal(found, xhat) for xhat in of_so_many].index(True) + 1 == taken


def test_max_iterations(start, goal):
    at = Bent()
    result = GaussNewton(1).solve(at, at.position(goal), start)
    assert reason(result, 1e-6) == "max_iterations"
    assert result.residuals[-1] < result.residuals[0]


def test_stagnated():
    """arctan: Newton overshoots from beyond 1.39, so the residual grows."""
    at = Scalar(torch.arctan, lambda x: 1.0 / (1.0 + x * x))
    start = torch.tensor([1.5], dtype=torch.float64)
    result = GaussNewton(2).solve(at, torch.zeros(1, 3, dtype=torch.float64), start)
    assert result.residuals[-1] > result.residuals[0]
    assert reason(result, 1e-6) == "stagnated"


def test_diverged():
    """A point that does not move with x̂ makes the equations singular."""
    at = Scalar(lambda x: 0.0 * x, lambda x: 0.0 * x)
    start = torch.tensor([0.5], dtype=torch.float64)
    result = GaussNewton(2).solve(at, torch.ones(1, 3, dtype=torch.float64), start)
    assert not torch.isfinite(result.xhat).all()
    assert reason(result, 1e-6) == "diverged"


def test_reasons_are_named_row_by_row():
    nan, inf = float("nan"), float("inf")
    residuals = torch.tensor([[1.0, 0.1], [1.0, 0.1], [1.0, 2.0], [1.0, nan], [inf, 1.0]])
    updates = torch.tensor([[1e-7], [0.1], [0.1], [0.1], [0.1]])
    found = stop_reasons(residuals, updates, 1e-6)
    assert found == ["converged", "max_iterations", "stagnated", "diverged", "diverged"]
    assert set(found) == set(STOP_REASONS)


def test_taylor_is_the_first_gauss_newton_iteration(start, goal):
    at = Bent()
    target = at.position(goal)
    taylor, newton = Taylor().solve(at, target, start), GaussNewton(1).solve(at, target, start)
    assert torch.equal(taylor.xhat, newton.xhat)
    assert torch.equal(taylor.updates, newton.updates)
    assert (taylor.residuals.shape, taylor.updates.shape) == ((2,), (1,))
    position, jacobian = at.position_and_jacobian(start)
    linear = position + jacobian @ (taylor.xhat - start)
    assert taylor.residuals[1] == pytest.approx(float(rms(linear - target)))


def test_on_a_linear_manifold_one_iteration_is_exact(start, goal):
    at = Bent(bend=0.0)
    for projector in (Taylor(), GaussNewton(1)):
        xhat = projector.solve(at, at.position(goal), start).xhat
        torch.testing.assert_close(xhat, goal, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("build", "quoted"),
    [
        (lambda: GaussNewton(iterations=0), r"projector\.iterations=0 must be from 1 to 1000"),
        (lambda: GaussNewton(iterations=10**9), r"projector\.iterations=1000000000 must be from 1 to 1000"),
        (lambda: GaussNewton(tolerance=0.0), r"projector\.tolerance=0\.0 must be positive"),
        (lambda: GaussNewton(tolerance=float("nan")), r"projector\.tolerance=nan must be positive"),
    ],
)
def test_values_out_of_range(build, quoted):
    with pytest.raises(ConfigError, match=quoted):
        build()
