"""How fast the latent vectors of training change."""

from __future__ import annotations

import torch
from torch import Tensor

from nsf.data import Snapshots
from nsf.kinematics.manifold import Manifold


def latent_rates(manifold: Manifold, snapshots: Snapshots) -> Tensor:
    """dx̂/dt of every training snapshot, [M, r] float64 [1/s], as a reduced step finds it.

    The backward difference (x̂_n − x̂_{n−1})/Δt along each trajectory, whose frames are its steps. Before the
    first frame the body came with its velocity: there x̂_{n−1} is that of x − Δt v.

    Args:
        manifold: with its training latents.
        snapshots: those of training, all rows.
    """
    latents = manifold.training_latents
    t = snapshots.t.to(latents)
    first = torch.cat([torch.ones_like(t[:1]), torch.diff(t)]) <= 0
    first[0] = True
    rates = torch.diff(latents, dim=0, prepend=latents[:1])
    rates[1:] /= torch.diff(t)[:, None]
    rows = first.nonzero().flatten()
    dt = snapshots.trajectories[0].dt
    x, v = (snapshots.gather(name, rows, slice(None)).double() for name in ("x", "v"))
    rates[rows] = ((manifold.encode(x) - manifold.encode(x - dt * v)) / dt).to(rates)
    return rates
