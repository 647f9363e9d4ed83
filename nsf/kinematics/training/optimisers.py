"""How networks are moved downhill, whatever they learn."""

from __future__ import annotations

from torch import nn
from torch.optim import Adam, Muon, Optimizer


def muon_and_adam(network: nn.Module, rate: float) -> list[Optimizer]:
    """Muon for the matrices of a network and Adam for all else; one rate is fit for both.

    Args:
        network: whose parameters are moved.
        rate: learning rate, dimensionless.

    Source: Jordan et al. 2024, Muon: an optimizer for hidden layers in neural networks.
    """
    weights = list(network.parameters())
    matrices, others = ([w for w in weights if (w.ndim == 2) is flat] for flat in (True, False))
    return [
        Muon(matrices, lr=rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
        Adam(others, lr=rate),
    ]
