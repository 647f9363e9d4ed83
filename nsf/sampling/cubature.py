"""Weighted sample particles: a cubature of the projection's sums (an answer to the paper's future work)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # loads a part on its first use
import torch
from typing_extensions import override

from nsf.errors import ConfigError, ProjectionError
from nsf.sampling.sampler import EquationSolver, Sampler, SampleSpan
from nsf.scalars import number

_EXACT = 1e-9  # residual over target at which a cubature counts as exact
_STILL = 1e-6  # root mean square motion in a step over Δx, below which a body counts as at rest


#: Q [m, k] and R [k, k] of columns, as these join and leave: to factorise anew each time would take longest.
Factors = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class CubatureSampler(Sampler):
    """Few particles, with weights under which their projection approximates that of all particles.

    From a state of the training the full-order step moves every particle to x_p, and the projection on all
    of them takes a Gauss-Newton step from the sums Σ J_pᵀ J_p and Σ J_pᵀ (x_p − g(X_p, x̂)), J_p = ∂g/∂x̂.
    S and its positive weights are found so that the weighted sums over S come near to both in many states,
    by least squares with a growing set of particles. No random number is drawn. |S| may end below `size`,
    when fewer particles give the sums exactly; a smaller sample is not a part of a larger. A span of time
    learns from the states of its own time.

    Attributes:
        size: |S| at most.
        states: number of training states, evenly spread over those of the span.

    Raises:
        ConfigError: states is not a positive whole number.

    Source: An, Kim and James 2008, optimizing cubature for efficient integration of subspace deformations;
        here for the normal equations of the inversion (paper section 5.3) in place of a force, and with
        every particle a candidate at each turn.
    """

    states: int = 64

    def __post_init__(self):
        super().__post_init__()
        number("sampler.states", self.states, 1, whole=True)

    @override
    def span_of(self, region, end, manifold, device="cpu", solver_at=None):
        candidates = region.candidates(manifold.X.cpu().numpy())
        rows = training_rows(manifold, region.start, end, self.states)
        equations = normal_equations(manifold, rows, candidates, solver_at)
        among = self.among(equations)
        chosen, weights = nonnegative_fit(equations.columns[:, among], equations.target, region.size)
        order = np.argsort(chosen)
        return SampleSpan(region.start, candidates[among][chosen][order], weights[order])

    def among(self, equations: "Equations") -> np.ndarray | slice:
        """Which of the candidates may be taken; all of them."""
        return slice(None)


class Equations(NamedTuple):
    """Shares of particles in sums over all of them.

    Attributes:
        columns: [m, c] of each candidate.
        target: [m] sums over all particles.
        cells: [c, 3] cell of the grid, between its nodes, in which each candidate is at rest.
    """

    columns: torch.Tensor
    target: torch.Tensor
    cells: np.ndarray


def training_rows(manifold, start: float, end: float, count: int) -> torch.Tensor:
    """At most `count` rows of the training latents, evenly spread over those with t/T in [start, end).

    Neither the first nor the last frame of a trajectory is among them: a step needs the latent before it,
    and begins before the end.

    Raises:
        ConfigError: there is none.
    """
    t, trajectory = manifold.training_times, manifold.training_trajectories
    inner = torch.zeros(len(t), dtype=torch.bool, device=t.device)
    inner[1:-1] = trajectory[:-2] == trajectory[2:]
    rows = torch.nonzero(inner & (t >= start * t.max()) & (t < end * t.max())).flatten()
    if not len(rows):
        raise ConfigError(f"no training state lies in [{start:g}, {end:g}) of T; a cubature needs one")
    return rows[torch.linspace(0, len(rows) - 1, min(count, len(rows))).round().long()]


@torch.no_grad()
def normal_equations(
    manifold,
    rows: torch.Tensor,
    candidates: np.ndarray,
    solver_at: Callable[[Mapping[str, float]], EquationSolver],
) -> Equations:
    """Each particle's share in the normal equations of one projection step from training states.

    A state has r equations of the right-hand side and r (r + 1)/2 of the matrix, in the latent coordinates
    in which Σ_P JᵀJ is the identity, so that they do not depend on the coordinates; both sums have norm one,
    but for the right-hand side's of a body at rest. States from which a step is not finite, as those of a
    method that diverges may be, are left out.

    Args:
        manifold: trained fields.
        rows: [k] of its training latents.
        candidates: [c] particle indices.
        solver_at: problem parameters → reduced solver whose sample is every particle.

    Returns:
        r + r (r + 1)/2 of them for each state that counts.

    Raises:
        ProjectionError: no step is finite.
    """
    columns, target, solver, parameters = [], [], None, None
    for row in rows.tolist():
        if parameters is None or not torch.equal(parameters, manifold.training_parameters[row]):
            parameters = manifold.training_parameters[row]
            values = dict(zip(manifold.parameter_names, parameters.tolist(), strict=True))
            solver = solver_at(values)
        previous, xhat = manifold.training_latents[row - 1 : row + 1]
        step = round(float(manifold.training_times[row]) / solver.dt)
        error, J = solver.equations_at(step, xhat, previous)
        if not error.isfinite().all():
            continue
        chosen = torch.as_tensor(candidates, device=error.device)
        least = _STILL * solver.dx * len(error) ** 0.5
        for shares in _shares(error.double(), J.double(), least):
            columns.append(shares[chosen].T)
            target.append(shares.sum(0))
    if not columns:
        raise ProjectionError(
            f"of the steps from {len(rows)} training states none is finite; a cubature has nothing to learn "
            "from; choose another sampler"
        )
    cells = np.floor(manifold.X.cpu().numpy()[candidates] / solver.dx).astype(int)
    return Equations(torch.cat(columns), torch.cat(target), cells)


def _shares(error: torch.Tensor, J: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Shares [P, r] in the right-hand side and [P, r (r + 1)/2] in the matrix; error [P, 3], J [P, 3, r].

    The right-hand side is divided by the norm of its sum, the motion on the manifold, at least `least` [m].
    """
    r = J.shape[2]
    L = torch.linalg.cholesky(torch.einsum("pir,pis->rs", J, J))
    # J L⁻ᵀ: the Jacobian in the coordinates Lᵀ x̂, in which the sum of JᵀJ is the identity.
    J = torch.linalg.solve_triangular(L.T, J, upper=True, left=False)
    right = torch.einsum("pir,pi->pr", J, error)
    row, column = torch.triu_indices(r, r, device=J.device)
    # Twice what is off the diagonal, in squares, so that the norm is that of the whole matrix.
    factor = torch.where(row == column, 1.0, 2.0).to(J).sqrt()
    matrix = factor * torch.einsum("pir,pis->prs", J, J)[:, row, column]
    return right / torch.linalg.vector_norm(right.sum(0)).clamp_min(least), matrix / r**0.5


def nonnegative_fit(columns: torch.Tensor, target: torch.Tensor, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Few columns and positive weights whose sum comes near the target, in least squares.

    Each column taken is the one whose direction is nearest to the residual's; all weights are then fitted
    anew, and columns whose weight would be negative leave.

    Args:
        columns: [m, c]; target: [m].
        size: most columns.

    Returns:
        Indices [s] in the order taken and weights [s], s ≤ size.

    Source: An, Kim and James 2008, section 4; with every column a candidate it is Lawson and Hanson 1974,
        chapter 23, algorithm NNLS, on columns of norm one, stopped at `size`.
    """
    # A particle that no latent moves is never taken.
    norms = torch.linalg.vector_norm(columns, dim=0).clamp_min(torch.finfo(columns.dtype).tiny)
    goal = target.cpu().numpy()
    chosen, weights, factors, residual = [], np.zeros(0), None, target
    for _ in range(3 * size):  # Lawson and Hanson's bound; columns that left may come back
        # Not the steepest: a few particles whose x̂ moves them far would be taken for their length alone.
        cosine = columns.T @ residual / norms
        cosine[chosen] = 0.0
        best = int(cosine.argmax())
        exact = torch.linalg.vector_norm(residual) <= _EXACT * torch.linalg.vector_norm(target)
        if len(chosen) == size or exact or not cosine[best] > 0:
            break
        before, column = chosen, columns[:, best].cpu().numpy()
        factors = _joined(factors, column)
        chosen, weights, factors = _fitted(factors, goal, [*chosen, best], np.append(weights, 0.0))
        if chosen == before:
            break  # no column lowers the residual by more than round-off
        residual = target - columns[:, chosen] @ torch.as_tensor(weights, device=columns.device)
    return np.array(chosen), weights


def _joined(factors: Factors | None, column: np.ndarray) -> Factors:
    """The factors of the columns there are and of another one [m]."""
    if factors is None:
        return scipy.linalg.qr(column[:, None], mode="economic")
    return scipy.linalg.qr_insert(*factors, column, len(factors[1]), which="col")


def _fitted(
    factors: Factors, goal: np.ndarray, chosen: list[int], weights: np.ndarray
) -> tuple[list[int], np.ndarray, Factors]:
    """Least squares over the chosen columns; from feasible weights, columns leave as theirs reach zero."""
    while True:
        Q, R = factors
        fit = scipy.linalg.solve_triangular(R, Q.T @ goal)
        if (fit > 0).all():
            return chosen, fit, factors
        share = np.full(len(fit), np.inf)
        leaves = fit <= 0
        share[leaves] = weights[leaves] / (weights[leaves] - fit[leaves])
        staying = share > share.min()
        weights = (weights + share.min() * (fit - weights))[staying]
        chosen = [column for column, stays in zip(chosen, staying, strict=True) if stays]
        for at in np.flatnonzero(~staying)[::-1]:
            factors = scipy.linalg.qr_delete(*factors, at, which="col")
