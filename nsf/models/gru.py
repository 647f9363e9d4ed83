"""`model=gru`: a gated recurrent network from parameters and forcing to latent vectors."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from nsf.errors import InstabilityError
from nsf.models.drawn import Drawn
from nsf.models.inputs import Inputs, Lessons, Validation
from nsf.models.latent import LatentModel
from nsf.progress import Progress
from nsf.recurrence.engine import between
from nsf.scalars import number

_RATE, _STEEPEST = 3e-3, 1.0  # of Adam, along a cosine; length at which the gradient is cut
_EACH = 0.02  # share of each coordinate in the loss, beside how far particles move
_LOOKS = 10  # times that the validation runs are looked at


@dataclass(frozen=True)
class GRU(Drawn, LatentModel):
    """x̂ − x̂₀ at each stride by a gated recurrent network that sees parameters, gravity and solids.

    Attributes:
        width: hidden units; descents: steps of Adam; batch: whole runs of each.

    Source: Cho et al. 2014, "Learning phrase representations using RNN encoder–decoder".
    """

    width: int = 128
    descents: int = 2000
    batch: int = 64

    def __post_init__(self):
        super().__post_init__()
        for name in ("width", "descents", "batch"):
            number(f"model.{name}", getattr(self, name), least=1, whole=True)

    @override
    def fit(self, manifold, lessons: Lessons, validation: Validation | None, seed: int) -> dict[str, Any]:
        stride, device = self.stride_of(lessons.xhat.shape[1] - 1), manifold.X.device
        u = torch.as_tensor(lessons.inputs.in_strides(stride))
        moved = torch.as_tensor(lessons.xhat[:, ::stride] - lessons.xhat[:, :1])[:, 1:].double()
        scales = {"mean": u.mean((0, 1)), "scale": _spread(u), "moved": _spread(moved)}
        weight = (torch.as_tensor(validation.moves) * scales["moved"]).square()
        u, moved = (u - scales["mean"]) / scales["scale"], moved / scales["moved"]
        how = (v.float().to(device) for v in (u, moved, weight / weight.sum() + _EACH / len(weight)))
        best, least = None, np.inf
        for net in self._descent(*how, seed):
            fitted = {"net": net, "stride": stride} | scales
            error = validation.error(self.run(fitted, validation.inputs))
            if error < least:
                best, least = fitted, error
        if best is None:
            raise InstabilityError(
                "no network that was fitted is finite at validation runs; raise model.runs"
            )
        return best

    def _descent(self, u: Tensor, moved: Tensor, weight: Tensor, seed: int) -> Iterator[dict[str, Tensor]]:
        """Weights in the course of a descent to paths [B, N, r] from inputs [B, N, m]."""
        torch.manual_seed(seed)
        net = self._net(u.shape[2], moved.shape[2]).to(u.device)
        draw, size = torch.Generator().manual_seed(seed), min(self.batch, len(u))
        adam = torch.optim.Adam(net.parameters(), _RATE)
        cosine = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.descents)
        with Progress("teach: fit", self.descents, "descents") as progress:
            for n in range(1, self.descents + 1):
                rows = torch.randint(len(u), (size,), generator=draw).to(u.device)
                loss = (weight * (_path(net, u[rows]) - moved[rows]).square()).sum(-1).mean()
                adam.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(net.parameters(), _STEEPEST)
                adam.step()
                cosine.step()
                progress.advance(1)
                if n % max(1, self.descents // _LOOKS) == 0 or n == self.descents:
                    yield {name: value.detach().cpu().clone() for name, value in net.state_dict().items()}

    @override
    def run(self, fitted: dict[str, Any], inputs: Inputs) -> np.ndarray:
        u = torch.as_tensor(inputs.in_strides(fitted["stride"]))
        net = self._net(u.shape[2], len(fitted["moved"]))
        net.load_state_dict(fitted["net"])
        with torch.no_grad():
            moved = _path(net, ((u - fitted["mean"]) / fitted["scale"]).float()).double() * fitted["moved"]
        start = torch.as_tensor(inputs.start)[:, None]
        nodes = torch.cat([start, start + moved], 1)
        return between(nodes, torch.as_tensor(inputs.first * fitted["stride"]), fitted["stride"]).numpy()

    def _net(self, inputs: int, latents: int) -> torch.nn.ModuleList:
        gru = torch.nn.GRU(inputs, self.width, batch_first=True)
        return torch.nn.ModuleList([gru, torch.nn.Linear(self.width, latents)])


def _path(net: torch.nn.ModuleList, u: Tensor) -> Tensor:
    """[B, N, r] of inputs [B, N, m]."""
    return net[1](net[0](u)[0])


def _spread(values: Tensor) -> Tensor:
    """Deviation [k] of [B, N, k]; 1 of what hardly varies."""
    spread = values.flatten(0, 1).std(0)
    return torch.where(spread > 1e-9 * values.abs().amax((0, 1)), spread, 1.0)
