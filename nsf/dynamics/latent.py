"""The latent vectors of a reduced run, and how well the inversion of each step went."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch

#: Named reasons to stop, in the order of the codes that `stop_reasons` gives.
STOP_REASONS = ("converged", "max_iterations", "stagnated", "diverged")


@dataclass
class ProjectionResult:
    """Outcome of one inversion; tensors on the device, nothing read back.

    Attributes:
        xhat: [r] latent vector.
        residuals: [k + 1] RMS distance [m] of g(X_S, x̂) to the target, before each iteration and at the end;
            weighted where the particles are.
        updates: [k] Euclidean length of each latent update; 0 after the last one that counts.
    """

    xhat: torch.Tensor
    residuals: torch.Tensor
    updates: torch.Tensor


@dataclass(frozen=True)
class LatentTrajectory:
    """A reduced run on the host: with the manifold, all that it takes to share a simulation.

    Attributes:
        t: [N + 1] time [s].
        xhat: [N + 1, r] latent vectors.
        residuals: [N, k + 1] projection residuals [m]; updates: [N, k] lengths of latent updates.
        stops: [N] named stop reasons.
        stress: [N + 1, n_s] ŝ, the coordinates of τ, of a run that has them.
    """

    t: np.ndarray
    xhat: np.ndarray
    residuals: np.ndarray
    updates: np.ndarray
    stops: list[str]
    stress: np.ndarray | None = None


class LatentRecord:
    """The latent vectors and residuals of a run on the device, filled in place and without a read-back.

    Args:
        xhat: [r] latent vector at t = 0, or [B, r] those of B runs, whose arrays then begin with B.
        steps: most steps.
        iterations: k, those of the projector.

    Attributes:
        now, before: [r] x̂_n and x̂_{n−1}.
        row: [1] n, or [B].
        xhat: [steps + 1, r] latent vectors; zero where no step has been.
        residuals: [steps, k + 1] and updates: [steps, k], as in `ProjectionResult`.
        stress: [steps + 1, n_s] ŝ of a run that has them, which its engine makes; else None.
        read_back: copies a tensor to the host; an engine that knows its last write gives a `ReadBack`.
    """

    stress: torch.Tensor | None = None
    read_back: Callable[[torch.Tensor], torch.Tensor] = staticmethod(torch.Tensor.cpu)

    def __init__(self, xhat: torch.Tensor, steps: int, iterations: int):
        runs, r = xhat.shape[:-1], xhat.shape[-1]
        self.now, self.before = xhat.clone(), xhat.clone()
        self.xhat = xhat.new_zeros(*runs, steps + 1, r)
        self.xhat[..., 0, :] = xhat
        self.residuals, self.updates = (xhat.new_zeros(*runs, steps, k) for k in (iterations + 1, iterations))
        self.row = torch.zeros(runs.numel(), dtype=torch.int64, device=xhat.device)

    def of(self, run: int) -> "LatentRecord":
        """The record of one run of a batch, sharing memory."""
        record = copy(self)
        record.row = self.row[run : run + 1]
        for name in ("now", "before", "xhat", "residuals", "updates"):
            setattr(record, name, getattr(self, name)[run])
        record.stress = None if self.stress is None else self.stress[run]
        return record

    def restart(self) -> None:
        """Go back to t = 0; further rows stay until they are written over."""
        for latest in (self.now, self.before):
            latest.copy_(self.xhat[..., 0, :])
        self.row.zero_()

    @property
    def predicted(self) -> torch.Tensor:
        """[r] x̂_{n+1} on the parabola through the last three, or the line through two, or x̂_0.

        Of one run: in a batch each has its own number of steps.
        """
        change = self.now - self.before
        older = self.xhat.index_select(0, (self.row - 2).clamp_min(0))[0]
        bend = change - self.before + older
        return self.now + change + torch.where(self.row > 1, bend, 0.0)

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(a.nbytes for a in (self.xhat, self.residuals, self.updates))

    def add(self, result: ProjectionResult) -> None:
        """Record the end of one step."""
        self.before.copy_(self.now)
        self.now.copy_(result.xhat)
        self.residuals.index_copy_(0, self.row, result.residuals[None])
        self.updates.index_copy_(0, self.row, result.updates[None])
        self.row += 1
        self.xhat.index_copy_(0, self.row, result.xhat[None])

    def trajectory(
        self, steps: int, dt: float, tolerance: float, stops: list[str] | None = None
    ) -> LatentTrajectory:
        """The first steps of dt [s] on the host.

        Args:
            steps: how many.
            dt: length of each.
            tolerance: of the projector.
            stops: reasons, of steps that were not projected; None: found from residuals and updates.
        """
        residuals, updates = self.residuals[:steps].cpu(), self.updates[:steps].cpu()
        stops = stop_reasons(residuals, updates, tolerance) if stops is None else stops
        t, xhat = np.arange(steps + 1) * dt, self.xhat[: steps + 1].cpu().numpy()
        stress = None if self.stress is None else self.stress[: steps + 1].cpu().numpy()
        return LatentTrajectory(t, xhat, residuals.numpy(), updates.numpy(), stops, stress)


class LatentState:
    """The state of a reduced run; `numpy` decodes its particle fields.

    Args:
        run: a `ReducedMPM`.
    """

    def __init__(self, run):
        self._run = run

    @property
    def xhat(self) -> np.ndarray:
        """[r] latent vector."""
        return self._run.xhat.cpu().numpy()

    def __len__(self) -> int:
        return len(self._run.setup.constants)

    def numpy(self) -> dict[str, np.ndarray]:
        """Every particle's x, v [P, 3], C, tau [P, 3, 3], as of the full-order state, and xhat [r].

        C and tau are the fields', or those of ŝ, also where particles carry others (`Sources`).
        """
        run = self._run
        decoder, now = run.decoder(), run.xhat[None]
        x = decoder.position(run.xhat)
        if run.steps_taken == 0:
            v = run.setup.initial_velocity
        else:
            v = (x - decoder.position(run.record.before)) / run.dt
        C, tau = decoder.affine(now, run.rate[None])[0], decoder.stress(now, run.stress)[0]
        fields = {"x": x, "v": v, "C": C, "tau": tau}
        return {name: value.cpu().numpy() for name, value in fields.items()} | {"xhat": self.xhat}


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
