"""Whole runs of a recurrence as one differentiable function, with derivatives forward and backward.

The compiled loop takes the strides. Their slopes are torch's own, of `Form.step` at all strides of the run
together, so that a tangent or a gradient goes through the run as one small product a stride.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.function import once_differentiable

from nsf.dynamics.interop import on_torch_stream
from nsf.mpm import precision_of
from nsf.recurrence.descent import of_strides
from nsf.recurrence.engine import between
from nsf.recurrence.form import Form, State
from nsf.recurrence.loop import Loop

_ROWS = 2**14  # strides of runs whose slopes are in memory together


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
    form: Form, xhat: Tensor, change: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor
) -> Tensor:
    """Latent vectors [N k + 1, B, r] of runs of N strides of k steps, differentiable in all but the weights.

    Args:
        form: the recurrence, in fp64.
        xhat, change: [B, r] x̂_0 and what stands for d at t = 0, of a stride.
        mu: [B, n].
        gravity: [N k, B, 3] or [N k, 1, 3] [m/s²]; solids: [N k, B, f] or [N k, 1, f], states of the
            colliders; each at every step.
    """
    acting = (of_strides(values, form.stride) for values in (gravity, solids))
    nodes = _Run.apply(form, xhat, change, mu, *acting).mean(1)
    return between(nodes.movedim(0, -2), change, form.stride).movedim(-2, 0)


def member_runs(
    form: Form, xhat: Tensor, change: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor
) -> Tensor:
    """Latent vectors [N + 1, M, B, r] of each member at strides; arguments as for `differentiable_run`."""
    return _run(form, xhat, change, mu, *(of_strides(values, form.stride) for values in (gravity, solids)))[0]


class _Run(torch.autograd.Function):
    """x̂ [N + 1, M, B, r] of each member at every stride."""

    @staticmethod
    def forward(ctx: Any, form: Form, *values: Tensor) -> Tensor:
        ctx.form = form
        xhat, stress = _run(form, *values)
        ctx.save_for_backward(xhat, stress, *values)
        ctx.save_for_forward(xhat, stress, *values)
        return xhat

    @staticmethod
    def jvp(ctx: Any, _: None, *ways: Tensor | None) -> Tensor:
        values = ctx.saved_tensors
        ways = [torch.zeros_like(v) if way is None else way for v, way in zip(values[2:], ways, strict=True)]
        return _tangent(ctx.form, *values, *ways)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_gradients(ctx.form, *ctx.saved_tensors, gradient)


def _run(form: Form, xhat: Tensor, change: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor):
    """x̂ [N + 1, M, B, r] and ŝ [N + 1, M, B, n_s] by the compiled loop; arguments as for `_Run`."""
    device = wp.device_from_torch(xhat.device)
    with on_torch_stream(device):
        acting = gravity.transpose(0, 1), solids.transpose(0, 1)
        loop = Loop(form, mu, *acting, precision_of("fp64"), device)
        loop.begin(form.begin(xhat, change))
        loop.advance(0, len(gravity))
    return tuple(path.permute(2, 0, 1, 3).contiguous() for path in (loop.xhat, loop.stress))


def _tangent(form: Form, path, stress, xhat, change, mu, gravity, solids, dx, dd, *ways: Tensor) -> Tensor:
    """The derivative [N + 1, M, B, r] of a run along a change of what it was given."""
    states, r = _states(path, stress, change), path.shape[-1]
    dx, dd, ds = form.begin(dx, dd)
    acting = [v.expand(len(path) - 1, *path.shape[1:3], -1) for v in _broadcast(mu, gravity, solids, *ways)]
    along, tangents = [], [dx]
    for part in _parts(path):
        slopes = _slopes(form, *(v[part] for v in (*states, *acting[:3])))
        forced = sum(
            (J @ way[part, ..., None])[..., 0] for J, way in zip(slopes[3:], acting[3:], strict=True)
        )
        along += zip(torch.cat(slopes[:3], -1), forced, strict=True)
    for slope, forced in along:
        off = (slope @ torch.cat([dx, dd, ds], -1)[..., None])[..., 0] + forced
        dd, ds = dd + off[..., :r], ds + off[..., r:]
        dx = dx + dd
        tangents.append(dx)
    return torch.stack(tangents)


def _gradients(
    form: Form, path, stress, xhat, change, mu, gravity, solids, gradient: Tensor
) -> Sequence[Tensor]:
    """Gradients in x̂_0, d_0, μ, gravity and solids, of that in a run [N + 1, M, B, r]."""
    states, r = _states(path, stress, change), path.shape[-1]
    forces = [values.detach().requires_grad_() for values in (mu, gravity, solids)]
    acting = [v.expand(len(path) - 1, *path.shape[1:3], -1) for v in _broadcast(mu, gravity, solids)]
    of_x, of_d, of_s = gradient[-1], torch.zeros_like(gradient[-1]), torch.zeros_like(stress[0])
    for part in reversed(_parts(path)):
        inputs = [v[part] for v in (*states, *acting)]
        slopes = torch.cat(_slopes(form, *inputs, wanted=3), -1)
        of_steps = []
        for slope, seen in zip(slopes.flip(0), gradient[:-1][part].flip(0), strict=True):
            of_change = of_d + of_x  # x̂_{n+1} = x̂_n + d_{n+1}
            of_steps.append(torch.cat([of_change, of_s], -1))
            back = (of_steps[-1][..., None, :] @ slope)[..., 0, :]
            of_x, of_d = seen + of_x + back[..., :r], of_change + back[..., r : 2 * r]
            of_s = of_s + back[..., 2 * r :]
        with torch.enable_grad():
            now = [v if len(v) == 1 else v[part] for v in _broadcast(*forces)]
            _changes(form, *inputs[:3], *now).backward(torch.stack(of_steps[::-1]))
    return of_x.sum(0), of_d.sum(0), *(values.grad for values in forces)


def _broadcast(*values: Tensor) -> list[Tensor]:
    """Views [N or 1, 1, B or 1, ·] of values [B, ·] and [N, B or 1, ·]."""
    return [v[None, None] if v.ndim == 2 else v[:, None] for v in values]


def _states(path: Tensor, stress: Tensor, change: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x̂_n, d_n [N, M, B, r] and ŝ_n [N, M, B, n_s] at the start of each stride."""
    first = change.expand(path.shape[1:])[None]
    return path[:-1], torch.cat([first, torch.diff(path[:-1], dim=0)]), stress[:-1]


def _parts(path: Tensor) -> list[slice]:
    """Consecutive strides of [N + 1, M, B, r] whose slopes fit into memory together."""
    size = max(1, _ROWS // (path.shape[1] * path.shape[2]))
    return [slice(n, n + size) for n in range(0, len(path) - 1, size)]


def _changes(
    form: Form, x: Tensor, d: Tensor, s: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor
) -> Tensor:
    """d' − d and ŝ' − ŝ [n, M, B, r + n_s] of states and of μ, gravity and solids [n, M, B, ·]."""
    members_first = [values.transpose(0, 1) for values in (x, d, s, mu, gravity, form.collider_state(solids))]
    after = form.step(State(*members_first[:3]), *members_first[3:])
    changes = after.change - members_first[1], after.stress - members_first[2]
    return torch.cat(changes, -1).transpose(0, 1)


def _slopes(form: Form, *values: Tensor, wanted: int = 6) -> list[Tensor]:
    """Jacobians [n, M, B, r + n_s, ·] of `_changes` in the first ones of its arguments [n, M, B, ·]."""
    with torch.enable_grad():
        values = [v.detach().clone().requires_grad_() for v in values]
        out = _changes(form, *values)
        rows = [
            torch.autograd.grad(out[..., i].sum(), values[:wanted], retain_graph=True, materialize_grads=True)
            for i in range(out.shape[-1])
        ]
    return [torch.stack(row, -2) for row in zip(*rows, strict=True)]
