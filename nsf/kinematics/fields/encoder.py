"""The convolutional encoder e of the paper."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nsf.kinematics.fields.networks import xavier

KERNEL, STRIDE, CHANNELS = 6, 4, 3
LONGEST = 12  # convolutions stop once the length is at most this
HIDDEN = 32


def convolved_lengths(particles: int) -> list[int]:
    """Lengths of the sequence before and after each convolution, [P, ..., at most 12].

    Source: Zong et al. 2023, appendix "Network architecture": kernel 6, stride 4 "until the length of the 1D
    output vector reaches or below 12".
    """
    lengths = [particles]
    while lengths[-1] > LONGEST:
        lengths.append((lengths[-1] - KERNEL) // STRIDE + 1)
    return lengths


class Encoder(nn.Module):
    """e: displacements of all particles in a frame → xhat.

    One-dimensional convolutions along the particle index with x, y, z as channels, the result in one row,
    Linear → 32, Linear → r, with ELU between the layers.

    Args:
        particles: P.
        latent_dim: r.

    Source: Zong et al. 2023, appendix "Network architecture".
    """

    def __init__(self, particles: int, latent_dim: int):
        super().__init__()
        lengths = convolved_lengths(particles)
        self.convolutions = nn.ModuleList(nn.Conv1d(CHANNELS, CHANNELS, KERNEL, STRIDE) for _ in lengths[1:])
        self.linear = nn.ModuleList(
            [nn.Linear(CHANNELS * lengths[-1], HIDDEN), nn.Linear(HIDDEN, latent_dim)]
        )

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every weight from `generator`."""
        for layer in [*self.convolutions, *self.linear]:
            xavier(layer, generator)

    def forward(self, x: Tensor) -> Tensor:
        """Standardised displacements [F, P, 3] → latents [F, r]."""
        features = x.transpose(1, 2)
        for convolution in self.convolutions:
            features = F.elu(convolution(features))
        hidden, last = self.linear
        return last(F.elu(hidden(features.flatten(1))))
