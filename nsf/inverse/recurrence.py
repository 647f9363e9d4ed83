"""Whole runs of taught operators as one differentiable function, with derivatives forward and backward.

torch's own forward differentiation takes a millisecond a step, most of it in Python for operands that have no
tangent. Tangents are carried along by hand here, in as many operations as the steps themselves have.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.function import once_differentiable
from torch.nn.functional import silu

from nsf.engines.operators.model import StepOperators


def with_jacobian(of, u: Tensor) -> tuple[Tensor, Tensor]:
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


class Recurrence:
    """Runs of operators at raw inputs.

    Args:
        operators: on their device, in fp64.
    """

    def __init__(self, operators: StepOperators):
        (W, self.b), (self.V, self.c), (self.U, self.e) = operators.raw_layers()
        self.r, n = operators.sizes.latents, operators.sizes.parameters
        self.of_x, self.of_mu, self.of_states = W.split([self.r, n, W.shape[1] - self.r - n], 1)
        self.gravity = operators.sizes.gravity

    def __call__(self, xhat: Tensor, change: Tensor, mu: Tensor, gravity: Tensor, solids: Tensor) -> Tensor:
        """Latent vectors [N + 1, B, r], differentiable in all that is given.

        Args:
            xhat, change: [B, r] x̂_0 and what stands for d at t = 0.
            mu: [B, n].
            gravity: [N, B, 3] or [N, 1, 3] [m/s²]; solids: [N, B, f] or [N, 1, f], states of the colliders.
        """
        given = self.of_mu @ mu.mT, solids @ self.of_states.mT + self.b
        return _Run.apply(self, xhat, change, given[0].mT + given[1], gravity)

    def steps(self, xhat: Tensor, change: Tensor, given: Tensor, gravity: Tensor) -> Tensor:
        """The run [N + 1, B, r]; `given` [N, B, width] is what inputs but x̂ add to the first layer."""
        found = [xhat]
        for row, g in zip(given, gravity, strict=True):
            out = torch.addmm(
                self.e, silu(torch.addmm(self.c, silu(row + xhat @ self.of_x.mT), self.V.mT)), self.U.mT
            )
            change = change + self._acceleration(out, change, g)
            xhat = xhat + change
            found.append(xhat)
        return torch.stack(found)

    def tangents(self, values: tuple[Tensor, ...], ways: tuple[Tensor, ...]) -> Tensor:
        """The derivative [N + 1, B, r] of `steps` at its arguments along a change [same shapes] of them."""
        (x, d, given, gravity), (dx, dd, d_given, d_gravity) = values, ways
        found, W, V, U = [dx], self.of_x.mT, self.V.mT, self.U.mT
        for row, g, d_row, dg in zip(given, gravity, d_given, d_gravity, strict=True):
            one, slope = _silu(row + x @ W)
            two, slope_two = _silu(torch.addmm(self.c, one, V))
            out = torch.addmm(self.e, two, U)
            d_out = ((((d_row + dx @ W) * slope) @ V) * slope_two) @ U
            # The acceleration is linear in the outputs, and in d and g together.
            d_own = self._acceleration(d_out, d, g) + self._linear(out, dd, dg)
            d = d + self._acceleration(out, d, g)
            dd = dd + d_own
            x, dx = x + d, dx + dd
            found.append(dx)
        return torch.stack(found)

    def _acceleration(self, out: Tensor, change: Tensor, g: Tensor) -> Tensor:
        """d' − d [B, r] = B d + Δt² (f + G g) of the network's outputs."""
        r = self.r
        return self._linear(out, change, g) + out[:, r * r : r * r + r]

    def _linear(self, out: Tensor, change: Tensor, g: Tensor) -> Tensor:
        """B d + Δt² G g [B, r]."""
        r = self.r
        found = torch.bmm(out[:, : r * r].unflatten(1, (r, r)), change[:, :, None])[..., 0]
        if self.gravity:
            found = found + (out[:, r * r + r :].unflatten(1, (r, 3)) * g[:, None]).sum(-1)
        return found


def _silu(h: Tensor) -> tuple[Tensor, Tensor]:
    """SiLU and its slope."""
    share = torch.sigmoid(h)
    value = h * share
    return value, share + value * (1.0 - share)


class _Run(torch.autograd.Function):
    """`Recurrence.steps`, with `Recurrence.tangents` as its forward derivative."""

    @staticmethod
    def forward(ctx: Any, recurrence: Recurrence, *values: Tensor) -> Tensor:
        ctx.recurrence = recurrence
        ctx.save_for_backward(*values)
        ctx.save_for_forward(*values)
        return recurrence.steps(*values)

    @staticmethod
    def jvp(ctx: Any, _: None, *ways: Tensor | None) -> Tensor:
        values = ctx.saved_tensors
        ways = (torch.zeros_like(v) if way is None else way for v, way in zip(values, ways, strict=True))
        return ctx.recurrence.tangents(values, tuple(ways))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[1:]
        values = [v.detach().requires_grad_(n) for v, n in zip(ctx.saved_tensors, needed, strict=True)]
        with torch.enable_grad():
            run = ctx.recurrence.steps(*values)
        asked = [v for v in values if v.requires_grad]
        found = iter(torch.autograd.grad(run, asked, gradient))
        return None, *(next(found) if v.requires_grad else None for v in values)
