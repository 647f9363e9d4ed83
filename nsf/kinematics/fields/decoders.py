"""The paper's networks at fixed points, as a deployed model evaluates them (`field=mlp`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from typing_extensions import override

from nsf.kinematics.manifold import Restriction
from nsf.kinematics.training.phases import joined, shaped

ACTIVATION_BYTES = 1 << 30  # of one layer, when many latents are evaluated at once
_WAVE = 1.5  # [rad per deviation of X] of the longest wave: about one across a body


@dataclass(frozen=True)
class Waves:
    """X with its sines and cosines, so that a network tells near particles apart.

    Of octave k = 0, 1, ... they are those of ω 2^k (X − mean)/std, ω = 1.5.

    Attributes:
        mean, std: [3] m of the particles at rest.
        octaves: how many.
    """

    mean: Tensor
    std: Tensor
    octaves: int

    def __call__(self, X: Tensor) -> Tensor:
        """X [n, 3] m and its waves, [n, 3 + 6 octaves]."""
        standard = (X - self.mean.to(X)) / self.std.to(X)
        angles = [_WAVE * 2**k * standard for k in range(self.octaves)]
        return torch.cat([X, *map(torch.sin, angles), *map(torch.cos, angles)], 1)


def pair(X: Tensor, latents: Tensor) -> Tensor:
    """Every point [n, 3] with every latent [F, r]: [F, n, 3 + r]."""
    F, n = latents.shape[0], X.shape[0]
    return torch.cat([X.expand(F, n, X.shape[1]), latents[:, None].expand(F, n, latents.shape[1])], -1)


class MlpRestriction(Restriction):
    """The three decoders at n points; they take and give raw units.

    Args:
        inputs: of each phase's decoder at the points, X [n, 3] first.
        decoders: by phase; that of the deformation gives displacements.
        waves: with which h and l see other points.
        takes_parameters: whether h and l see the problem parameters.
    """

    def __init__(
        self,
        inputs: Mapping[str, Tensor],
        decoders: Mapping[str, nn.Module],
        waves: Waves,
        takes_parameters: bool,
        latent_dim: int,
    ):
        self.inputs, self.decoders, self.latent_dim = inputs, decoders, latent_dim
        self.X = inputs["deformation"]
        self.points, self.dtype, self.device = len(self.X), self.X.dtype, self.X.device
        directions = torch.eye(3 + latent_dim, dtype=self.dtype, device=self.device)
        self._along_X, self._along_xhat = directions[:3], directions[3:]
        self._waves, self._takes_parameters = waves, takes_parameters

    @override
    def position(self, xhat):
        return self.X + self._decode("deformation", xhat)

    @override
    def position_and_jacobian(self, xhat):
        displacement, jacobian = self._derive(xhat, self._along_xhat)
        return self.X + displacement, jacobian

    @override
    def deformation_gradient(self, xhat):
        return self._along_X[:, :3] + self._derive(xhat, self._along_X)[1]

    @override
    def stress(self, xhat, parameters):
        return self._decode("stress", self._latents(xhat, parameters))

    @override
    def affine(self, xhat, parameters, rate=None):
        return self._decode("affine", self._latents(xhat, parameters)).unflatten(-1, (3, 3))

    @override
    def module(self, phase):
        head = phase != "deformation"
        waves = self._waves if head and self._waves.octaves else None
        return PointModule(self.decoders[phase], phase, waves, head and self._takes_parameters)

    @override
    def subset(self, rows):
        inputs = {phase: values[rows] for phase, values in self.inputs.items()}
        return MlpRestriction(inputs, self.decoders, self._waves, self._takes_parameters, self.latent_dim)

    def _latents(self, xhat: Tensor, parameters: Tensor) -> Tensor:
        return joined(xhat, parameters) if self._takes_parameters else xhat

    def _decode(self, phase: str, latents: Tensor) -> Tensor:
        decoder = self.decoders[phase]
        parts = self._parts(latents, decoder.width)
        values = torch.cat([decoder(pair(self.inputs[phase], part)) for part in parts])
        return values if latents.ndim == 2 else values[0]

    def _derive(self, xhat: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The displacement and its derivatives along some inputs, the last axis of the result."""
        decoder = self.decoders["deformation"]
        parts = self._parts(xhat, decoder.width * len(directions))
        pairs = [decoder.forward_and_tangents(pair(self.X, part), directions) for part in parts]
        u, derivatives = (torch.cat(values) for values in zip(*pairs, strict=True))
        derivatives = derivatives.transpose(-1, -2)
        return (u, derivatives) if xhat.ndim == 2 else (u[0], derivatives[0])

    def _parts(self, latents: Tensor, width: int) -> tuple[Tensor, ...]:
        """The batch of latents in parts whose activations fit in memory."""
        latents = latents.to(self.dtype).reshape(-1, latents.shape[-1])
        size = self.points * width * self.dtype.itemsize
        return latents.split(max(1, ACTIVATION_BYTES // max(1, size)))


class PointModule(nn.Module):
    """A decoder as a module: a function of the points too."""

    def __init__(self, decoder: nn.Module, phase: str, waves: Waves | None, takes_parameters: bool):
        super().__init__()
        self.decoder, self.phase, self.waves, self.takes_parameters = decoder, phase, waves, takes_parameters

    @override
    def forward(self, X: Tensor, xhat: Tensor, parameters: Tensor) -> Tensor:
        latents = joined(xhat, parameters) if self.takes_parameters else xhat
        points = self.waves(X) if self.waves else X
        values = shaped(self.phase, self.decoder(pair(points, latents)))
        return X + values if self.phase == "deformation" else values
