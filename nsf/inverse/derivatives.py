"""Values and derivatives of a batched function in one pass forward."""

import torch
from torch import Tensor
from torch.autograd import forward_ad


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
