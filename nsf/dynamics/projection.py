"""Network inversion: the latent vector that is nearest to positions of S (paper section 5.3)."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch

from nsf.dynamics.latent import LatentRecord, ProjectionResult
from nsf.errors import ConfigError


class Projector(Protocol):
    """The members that a reduced run uses of a projector, which may be a class of the user.

    Attributes:
        iterations: k, the most that `solve` takes; its residuals are k + 1, its updates k.
        tolerance: [1] on ‖Δx̂‖², below which an iteration counts as the last.
    """

    iterations: int
    tolerance: float

    def start(self, record: LatentRecord) -> torch.Tensor:
        """[r] x̂ that the iteration starts from; see `GaussNewton.start`."""

    def solve(
        self, at, target: torch.Tensor, xhat: torch.Tensor, weights: torch.Tensor | None = None
    ) -> ProjectionResult:
        """The x̂ whose g(X_S, x̂) is nearest to the target [s, 3] [m]; see `GaussNewton.solve`."""


def check_projector(projector) -> None:
    """Refuse an object that lacks members of a `Projector`.

    Raises:
        ConfigError: names them.
    """
    missing = [n for n in ("start", "solve", "iterations", "tolerance") if not hasattr(projector, n)]
    if missing:
        raise ConfigError(
            f"{type(projector).__name__} is no projector: it lacks {', '.join(missing)}; "
            "nsf.dynamics.GaussNewton has what one needs"
        )


#: More iterations never end either.
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

    def start(self, record: LatentRecord) -> torch.Tensor:
        """The x̂ from which the inversion begins."""
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

    def start(self, record: LatentRecord) -> torch.Tensor:
        """Where the deformation field is linearised: x̂_n."""
        return record.now

    def solve(
        self, at, target: torch.Tensor, xhat: torch.Tensor, weights: torch.Tensor | None = None
    ) -> ProjectionResult:
        """Invert the linearised deformation field; arguments as for `GaussNewton.solve`."""
        error, J = _equations(at, target, xhat, weights)
        update = _normal_equations(J, error)
        residual = _rms(error - J @ update)
        return ProjectionResult(
            xhat + update, torch.stack([_rms(error), residual]), torch.linalg.vector_norm(update)[None]
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
