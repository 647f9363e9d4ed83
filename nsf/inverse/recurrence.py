"""Whole runs of taught operators as one differentiable function, with derivatives forward and backward.

The compiled loop takes the steps. Their slopes are torch's own, of `StepOperators.acceleration` at all steps
of the run together, so that a tangent or a gradient goes through the run as one small product a step. For 400
steps of two runs this takes 45 ms in fp64 on one thread of a CPU, torch's forward differentiation 4,600.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.function import once_differentiable

from nsf.dynamics.interop import on_torch_stream
from nsf.dynamics.latent import LatentRecord
from nsf.engines.operators.model import StepOperators
from nsf.engines.operators.recurrence import Recurrence
from nsf.mpm import precision_of

_ROWS = 2**14  # steps of runs whose slopes are in memory together


def with_jacobian(of: Callable[[Tensor], Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
    """Values [B, m] of a function of rows u [B, n], and their derivatives [B, m, n], in one pass forward."""
    B, n = u.shape
    rows = u[:, None].expand(B, n, n).reshape(-1, n)
    ways = torch.eye(n, dtype=u.dtype, device=u.device).expand(B, n, n).reshape(-1, n)
    with torch.no_grad(), forward_ad.dual_level():
        values, slopes = forward_ad.unpack_dual(
            of(forward_ad.make_dual(rows.contiguous(), ways.contiguous()))
        )
    slopes = torch.zeros_like(values) if slopes is None else slopes
    return values.view(B, n, -1)[:, 0], slopes.view(B, n, -1).transpose(1, 2)


def differentiable_run(
    model: StepOperators, xhat: Tensor, change: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor
) -> Tensor:
    """Latent vectors [N + 1, B, r] of runs, differentiable in all but the weights.

    Args:
        model: the operators, without a memory, in fp64.
        xhat, change: [B, r] x̂_0 and what stands for d at t = 0.
        mu: [B, n].
        gravity: [N, B, 3] or [N, 1, 3] [m/s²]; solids: [N, B, f] or [N, 1, f], states of the colliders.
    """
    return _Run.apply(model, xhat, change, mu, gravity, solids)


class _Run(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, model: StepOperators, *values: Tensor) -> Tensor:
        ctx.model = model
        run = _run(model, *values)
        ctx.save_for_backward(run, *values)
        ctx.save_for_forward(run, *values)
        return run

    @staticmethod
    def jvp(ctx: Any, _: None, *ways: Tensor | None) -> Tensor:
        values = ctx.saved_tensors
        ways = [torch.zeros_like(v) if way is None else way for v, way in zip(values[1:], ways, strict=True)]
        return _tangent(ctx.model, *values, *ways)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_gradients(ctx.model, *ctx.saved_tensors, gradient)


def _run(
    model: StepOperators, xhat: Tensor, change: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor
) -> Tensor:
    """The run by the compiled loop; arguments as for `differentiable_run`."""
    steps, device = len(gravity), wp.device_from_torch(xhat.device)
    with on_torch_stream(device):
        record = LatentRecord(xhat.detach(), steps, 1)
        acting = gravity.transpose(0, 1), solids.transpose(0, 1)
        loop = Recurrence(model, mu, *acting, record, precision_of("fp64"), device)
        loop.begin(xhat, change)
        loop.advance(steps)
    return record.xhat.transpose(0, 1).contiguous()


def _tangent(model, run, xhat, change, mu, gravity, solids, dx, dd, *ways: Tensor) -> Tensor:
    """The derivative [N + 1, B, r] of a run along a change of what it was given."""
    states = _states(run, change)
    acting = [values.expand(*states[0].shape[:2], -1) for values in (mu, gravity, solids, *ways)]
    along, found = [], [dx]
    for part in _parts(states[0]):
        of_x, of_d, *rest = _slopes(model, *(v[part] for v in (*states, *acting[:3])))
        forced = sum((J @ way[part, ..., None])[..., 0] for J, way in zip(rest, acting[3:], strict=True))
        along += zip(torch.cat([of_x, of_d], -1), forced, strict=True)
    for slope, forced in along:
        dd = dd + (slope @ torch.cat([dx, dd], -1)[..., None])[..., 0] + forced
        dx = dx + dd
        found.append(dx)
    return torch.stack(found)


def _gradients(model, run, xhat, change, mu, gravity, solids, gradient: Tensor) -> Sequence[Tensor]:
    """Gradients in x̂_0, d_0, μ, gravity and solids, of that in a run [N + 1, B, r]."""
    states, r = _states(run, change), run.shape[-1]
    given = [values.detach().requires_grad_() for values in (mu, gravity, solids)]
    acting = [values.detach().expand(*states[0].shape[:2], -1) for values in (mu, gravity, solids)]
    of_x, of_d = gradient[-1], torch.zeros_like(change)
    for part in reversed(_parts(states[0])):
        slopes = torch.cat(_slopes(model, *(v[part] for v in (*states, *acting)), wanted=2), -1)
        of_changes = []
        for slope, seen in zip(slopes.flip(0), gradient[:-1][part].flip(0), strict=True):
            of_change = of_d + of_x  # x̂_{n+1} = x̂_n + d_{n+1}
            back = (of_change[..., None, :] @ slope)[..., 0, :]
            of_x, of_d = seen + of_x + back[..., :r], of_change + back[..., r:]
            of_changes.append(of_change)
        with torch.enable_grad():
            forces = given[0], given[1][part], model.collider_state(given[2][part])
            model.acceleration(*(v[part] for v in states), *forces).backward(torch.stack(of_changes[::-1]))
    return of_x, of_d, *(values.grad for values in given)


def _states(run: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
    """x̂_n and d_n [N, B, r] at each step."""
    return run[:-1], torch.cat([change[None], torch.diff(run[:-1], dim=0)])


def _parts(states: Tensor) -> list[slice]:
    """Consecutive steps of [N, B, r] whose slopes fit into memory together."""
    size = max(1, _ROWS // states.shape[1])
    return [slice(n, n + size) for n in range(0, len(states), size)]


def _slopes(model: StepOperators, *values: Tensor, wanted: int = 5) -> list[Tensor]:
    """Jacobians [n, B, r, k] of d' − d in the first ones of x̂, d, μ, gravity and solids [n, B, k]."""
    with torch.enable_grad():
        x, d, mu, gravity, solids = values = [v.detach().requires_grad_() for v in values]
        out = model.acceleration(x, d, mu, gravity, model.collider_state(solids))
        rows = [
            torch.autograd.grad(out[..., i].sum(), values[:wanted], retain_graph=True, materialize_grads=True)
            for i in range(out.shape[-1])
        ]
    return [torch.stack(row, -2) for row in zip(*rows, strict=True)]
