"""Network inversion: the latent vector of given sample positions (paper section 5.3)."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch

from nsf.errors import ConfigError

#: Named reasons to stop, in the order of the codes that `stop_reasons` gives.
STOP_REASONS = ("converged", "max_iterations", "stagnated", "diverged")


@dataclass
class ProjectionResult:
    """Outcome of one inversion; tensors on the device, nothing read back.

    Attributes:
        xhat: [r] latent vector.
        residuals: [k + 1] RMS distance [m] of g(X_S, x̂) to the target, before each iteration and at the end;
            weighted where the particles are.
        updates: [k] Euclidean length of each latent update; 0 where none was needed.
    """

    xhat: torch.Tensor
    residuals: torch.Tensor
    updates: torch.Tensor


class Latents(Protocol):
    """What the steps before left, from which an inversion may begin.

    Attributes:
        now, before: [r] x̂_n and x̂_{n−1}.
    """

    now: torch.Tensor
    before: torch.Tensor

    @property
    def predicted(self) -> torch.Tensor:
        """[r] x̂_{n+1} on the parabola through the last three."""


class Projector(Protocol):
    """What a reduced run asks of a projector, which may be one's own.

    Attributes:
        iterations: k, the most that `solve` takes; its residuals are k + 1, its updates k.
        tolerance: [1] on ‖Δx̂‖², below which an iteration counts as the last.
    """

    iterations: int
    tolerance: float

    def start(self, record: Latents) -> torch.Tensor:
        """[r] x̂ that the iteration starts from; see `GaussNewton.start`."""

    def solve(
        self, at, target: torch.Tensor, xhat: torch.Tensor, weights: torch.Tensor | None = None
    ) -> ProjectionResult:
        """The x̂ whose g(X_S, x̂) is nearest to the target [s, 3] [m]; see `GaussNewton.solve`."""


def check_projector(projector) -> None:
    """Whether a projector, which may be one's own, has all that a reduced run asks of it.

    Raises:
        ConfigError: it lacks one of `start`, `solve`, `iterations` and `tolerance` of `GaussNewton`.
    """
    missing = [n for n in ("start", "solve", "iterations", "tolerance") if not hasattr(projector, n)]
    if missing:
        raise ConfigError(
            f"{type(projector).__name__} is no projector: it lacks {', '.join(missing)}; "
            "nsf.dynamics.GaussNewton has what one needs"
        )


#: Gauss-Newton that has not ended by then never does.
_MOST_ITERATIONS = 1000


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton on Σ w_p ‖g(X_p, x̂) − x_p‖² over S.

    The paper starts it at x̂_n, this on the parabola through the last three latent vectors.

    Attributes:
        iterations: most iterations (the paper needs 2-3).
        tolerance: an update (x̂ has unit variance) is the last one where its square does not exceed this. A
            further one would be of the order of that square where S can reach its target; as S leaves the
            manifold in a step, it is a share of the update, mostly a few thousandths, instead.

    Raises:
        ConfigError: a value outside its range.

    Source: paper section 5.3, eq. "network_inversion"; Nocedal and Wright 1999, section 10.3.
    """

    iterations: int = 3
    tolerance: float = 1e-4

    def __post_init__(self):
        if not 1 <= self.iterations <= _MOST_ITERATIONS:
            raise ConfigError(f"projector.iterations={self.iterations} must be from 1 to {_MOST_ITERATIONS}")
        if not self.tolerance > 0:
            raise ConfigError(f"projector.tolerance={self.tolerance} must be positive")

    def start(self, record: Latents) -> torch.Tensor:
        """Where the inversion begins, by what the steps before it left."""
        return record.predicted

    def solve(
        self, at, target: torch.Tensor, xhat: torch.Tensor, weights: torch.Tensor | None = None
    ) -> ProjectionResult:
        """Invert the deformation field.

        Args:
            at: the fields restricted to S.
            target: [s, 3] positions x_S [m].
            xhat: [r] start.
            weights: [s] w_p, of mean one; None for all one, as in the paper.
        """
        residuals, updates = [], []
        active = torch.ones((), dtype=torch.bool, device=xhat.device)
        for _ in range(self.iterations):
            error, J = _equations(at, target, xhat, weights)
            update = _normal_equations(J, error)
            residuals.append(_rms(error))
            updates.append(torch.where(active, torch.linalg.vector_norm(update), 0.0))
            xhat = torch.where(active, xhat + update, xhat)
            active = active & (updates[-1] ** 2 > self.tolerance)
        residuals.append(_rms(_weighted(target - at.position(xhat), weights)))
        return ProjectionResult(xhat, torch.stack(residuals), torch.stack(updates))


@dataclass(frozen=True)
class Taylor:
    """First-order variant: one linearisation at x̂_n and no residual afterwards.

    x̂_{n+1} = x̂_n + J⁺ (x_S − g(X_S, x̂_n)).

    Source: Chen et al. 2023a; paper section 5.3.
    """

    iterations: ClassVar[int] = 1
    tolerance: ClassVar[float] = 0.0  # it checks nothing, so it never claims convergence

    def start(self, record: Latents) -> torch.Tensor:
        """Where the deformation field is linearised: x̂_n."""
        return record.now

    def solve(
        self, at, target: torch.Tensor, xhat: torch.Tensor, weights: torch.Tensor | None = None
    ) -> ProjectionResult:
        """Invert the linearised deformation field; arguments as for `GaussNewton.solve`."""
        error, J = _equations(at, target, xhat, weights)
        update = _normal_equations(J, error)
        left = _rms(error - J @ update)
        return ProjectionResult(
            xhat + update, torch.stack([_rms(error), left]), torch.linalg.vector_norm(update)[None]
        )


def _equations(at, target: torch.Tensor, xhat: torch.Tensor, weights) -> tuple[torch.Tensor, torch.Tensor]:
    """Error [3 s] of the positions and its Jacobian [3 s, r], rows times √w."""
    position, jacobian = at.position_and_jacobian(xhat)
    return _weighted(target - position, weights), _weighted(jacobian, weights)


def _weighted(rows: torch.Tensor, weights: torch.Tensor | None) -> torch.Tensor:
    """Values [s, 3, …] of each particle times √w, as one row a coordinate [3 s, …]."""
    if weights is not None:
        rows = rows * weights.sqrt().view(-1, *[1] * (rows.ndim - 1))
    return rows.flatten(0, 1)


def _normal_equations(J: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Solve (JᵀJ) u = Jᵀe [r] without a read-back; singular systems give non-finite values."""
    gram = (J.T @ J).double()
    update, _ = torch.linalg.solve_ex(gram, (J.T @ error).double())
    return update.to(J.dtype)


def _rms(error: torch.Tensor) -> torch.Tensor:
    """Root mean square distance per point of a flat [3 s] error."""
    return torch.linalg.vector_norm(error) * (3.0 / error.numel()) ** 0.5


def stop_reasons(residuals: torch.Tensor, updates: torch.Tensor, tolerance: float) -> list[str]:
    """Why each step's inversion stopped.

    Args:
        residuals: [n, k + 1]; updates: [n, k]; as in `ProjectionResult`, one row a step.
        tolerance: of the projector.

    Returns:
        One of `STOP_REASONS` a step: `diverged` (non-finite), `converged` (the square of an update does
        not exceed the tolerance), `stagnated` (the residual grew), else `max_iterations`.
    """
    finite = torch.isfinite(residuals).all(1) & torch.isfinite(updates).all(1)
    converged = (updates**2 <= tolerance).any(1)
    grew = residuals[:, -1] > residuals[:, 0]
    code = torch.where(~finite, 3, torch.where(converged, 0, torch.where(grew, 2, 1)))
    return [STOP_REASONS[c] for c in code.tolist()]
