"""Fully connected networks with a hand-propagated forward derivative."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def _push_elu(tangents: Tensor, z: Tensor) -> Tensor:
    return torch.ops.aten.elu_backward(tangents, 1.0, 1.0, 1.0, False, z)


# name → (activation, its tangent map t ↦ act'(z) t). For a pointwise function the forward derivative is the
# same product as the backward one, so torch's fused backward kernels serve; they broadcast z over tangents.
ACTIVATIONS = {"elu": (F.elu, _push_elu), "silu": (F.silu, torch.ops.aten.silu_backward)}


def xavier(layer: nn.Linear | nn.Conv1d, generator: torch.Generator) -> None:
    """Xavier-uniform weights and zero biases, drawn from `generator` (paper, Training Details)."""
    nn.init.xavier_uniform_(layer.weight, generator=generator)
    nn.init.zeros_(layer.bias)


class FullyConnected(nn.Module):
    """Linear layers of the given widths with an activation between them.

    Args:
        widths: (inputs, hidden..., outputs), dimensionless counts.
        activation: a key of `ACTIVATIONS`.
    """

    def __init__(self, widths: Sequence[int], activation: str):
        super().__init__()
        self.activation, self.push = ACTIVATIONS[activation]
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in itertools.pairwise(widths))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every weight from `generator`."""
        for layer in self.layers:
            xavier(layer, generator)

    @property
    def width(self) -> int:
        """Values the widest layer holds for one row of input."""
        return max(layer.out_features for layer in self.layers)

    def forward(self, inputs: Tensor) -> Tensor:
        """[..., inputs] → [..., outputs]."""
        for layer in self.layers[:-1]:
            inputs = self.activation(layer(inputs))
        return self.layers[-1](inputs)

    def forward_and_tangents(self, inputs: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
        """The outputs and their derivative along each tangent, in one pass and without autograd.

        Args:
            inputs: [..., inputs].
            tangents: [d, inputs], the same directions for every row.

        Returns:
            outputs [..., outputs] and derivatives [..., d, outputs].
        """
        for layer in self.layers[:-1]:
            z = layer(inputs)
            tangents = self.push(F.linear(tangents, layer.weight), z.unsqueeze(-2))
            inputs = self.activation(z)
        last = self.layers[-1]
        outputs, tangents = last(inputs), F.linear(tangents, last.weight)
        return outputs, tangents.expand(*outputs.shape[:-1], *tangents.shape[-2:])

    def in_raw_units(
        self,
        input_mean: Tensor,
        input_std: Tensor,
        output_mean: Tensor,
        output_std: Tensor,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> FullyConnected:
        """A frozen copy for raw inputs and outputs: the standardisation is folded into the end layers.

        The copy computes output_mean + output_std · net((inputs − input_mean) / input_std). Folding is done
        in double precision before the cast to `dtype`.
        """
        raw = copy.deepcopy(self).double().requires_grad_(False)
        first, last = raw.layers[0], raw.layers[-1]
        mean, std, shift, scale = (
            value.to(first.weight) for value in (input_mean, input_std, output_mean, output_std)
        )
        first.weight.div_(std)
        first.bias.sub_(first.weight @ mean)
        last.weight.mul_(scale[:, None])
        last.bias.mul_(scale).add_(shift)
        return raw.to(dtype=dtype, device=device)
