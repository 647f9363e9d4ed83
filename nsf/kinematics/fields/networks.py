"""Fully connected networks with a hand-propagated forward derivative."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nsf.kinematics.training.tensor_cores import tf32


def _push_elu(tangents: Tensor, z: Tensor) -> Tensor:
    return torch.ops.aten.elu_backward(tangents, 1.0, 1.0, 1.0, False, z)


# name → (activation, its tangent map t ↦ act'(z) t). For a pointwise function the forward derivative is the
# same product as the backward one, so torch's fused backward kernels serve; they broadcast z over tangents.
ACTIVATIONS = {"elu": (F.elu, _push_elu), "silu": (F.silu, torch.ops.aten.silu_backward)}


# What tensor cores multiply, by the type of the values between layers: 10 and 7 bits after the leading one.
ARITHMETIC = {"tf32": torch.float32, "bf16": torch.bfloat16}


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
        self.kind = activation
        self.activation, self.push = ACTIVATIONS[activation]
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in itertools.pairwise(widths))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every weight from `generator`."""
        for layer in self.layers:
            xavier(layer, generator)

    @property
    def widths(self) -> tuple[int, ...]:
        """(inputs, hidden..., outputs)."""
        return self.layers[0].in_features, *(layer.out_features for layer in self.layers)

    @property
    def width(self) -> int:
        """Values the widest layer holds for one row of input."""
        return max(self.widths[1:])

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


class TensorCores(nn.Module):
    """A network whose hidden layers are multiplied on a GPU's tensor cores, for what needs few digits.

    The end layers are in fp32: inputs in raw units may differ in their last digits alone.

    Args:
        network: in raw units; its layers are taken over.
        arithmetic: a key of `ARITHMETIC`.
    """

    def __init__(self, network: FullyConnected, arithmetic: str):
        super().__init__()
        self.activation, self.width, self.low = network.activation, network.width, ARITHMETIC[arithmetic]
        first, *hidden, last = network.layers
        self.ends = nn.ModuleList([first, last]).float()
        self.hidden = nn.ModuleList(hidden).to(self.low)

    def forward(self, inputs: Tensor) -> Tensor:
        """[..., inputs] → [..., outputs], of the inputs' type."""
        first, last = self.ends
        z = self.activation(first(inputs.float())).to(self.low)
        with tf32():
            for layer in self.hidden:
                z = self.activation(layer(z))
        return last(z.float()).to(inputs.dtype)


class Committee(nn.Module):
    """Equal networks that differ in their first weights; what is deployed is their mean.

    One fit of a small network to few trajectories errs between them by chance; the mean of several errs less.
    The members' layers are stacked, so that a step of training is as many kernels as for one.

    Args:
        members: how many.
        widths, activation: of each, as for `FullyConnected`.
    """

    def __init__(self, members: int, widths: Sequence[int], activation: str):
        super().__init__()
        self.widths, self.activation = tuple(widths), activation
        pairs = list(itertools.pairwise(widths))
        self.weights = nn.ParameterList(torch.zeros(members, o, i) for i, o in pairs)
        self.biases = nn.ParameterList(torch.zeros(members, 1, o) for _, o in pairs)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every weight from `generator`, as `xavier` does."""
        for weight, bias in zip(self.weights, self.biases, strict=True):
            nn.init.zeros_(bias)
            for member in weight:
                nn.init.xavier_uniform_(member, generator=generator)

    def forward(self, inputs: Tensor) -> Tensor:
        """[members, n, inputs], rows of its own for each member → [members, n, outputs]."""
        act, _ = ACTIVATIONS[self.activation]
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in hidden:
            inputs = act(torch.baddbmm(b, inputs, w.mT))
        return torch.baddbmm(bias, inputs, weight.mT)

    def mean(self) -> FullyConnected:
        """The members' mean as one network in double precision: side by side, averaged by the last layer."""
        layers = list(zip(self.weights, self.biases, strict=True))
        each = [[(w[n], b[n, 0]) for w, b in layers] for n in range(len(self.weights[0]))]
        return beside(each, [1 / len(each)] * len(each), self.activation)

    def in_raw_units(self, *standardisation, **place) -> FullyConnected:
        """The mean, frozen, for raw inputs and outputs; arguments as for `FullyConnected.in_raw_units`."""
        return self.mean().in_raw_units(*standardisation, **place)


class FromRest(nn.Module):
    """network(x̂, μ) − network(x̂₀, μ): zero at x̂₀ whatever μ is.

    Args:
        network: what is trained; its first inputs are x̂.
        latent_dim: r.

    Attributes:
        rest: x̂₀ [r] in the unit of the network's inputs.
    """

    def __init__(self, network: FullyConnected | Committee, latent_dim: int):
        super().__init__()
        self.network = network
        self.register_buffer("rest", torch.zeros(latent_dim, dtype=torch.float64))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every weight from `generator`."""
        self.network.initialise(generator)

    @property
    def widths(self) -> tuple[int, ...]:
        """(inputs, hidden..., outputs)."""
        return self.network.widths

    def forward(self, inputs: Tensor) -> Tensor:
        """[..., inputs] → [..., outputs]."""
        rest = self.rest.to(inputs).expand(*inputs.shape[:-1], -1)
        rest = torch.cat([rest, inputs[..., len(self.rest) :]], -1)
        return self.network(inputs) - self.network(rest)

    @torch.no_grad()
    def in_raw_units(
        self,
        input_mean: Tensor,
        input_std: Tensor,
        output_mean: Tensor,
        output_std: Tensor,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> FullyConnected:
        """The difference as one network of twice the width; arguments as of `FullyConnected.in_raw_units`."""
        standardisation = input_mean, input_std, torch.zeros_like(output_mean), output_std
        raw = self.network.in_raw_units(*standardisation, dtype=torch.float64, device=self.rest.device)
        first, *later = [(layer.weight, layer.bias) for layer in raw.layers]
        r = len(self.rest)
        rest = self.rest * input_std[:r].to(self.rest) + input_mean[:r].to(self.rest)
        along, across = first[0].split([r, first[0].shape[1] - r], 1)
        still = torch.cat([torch.zeros_like(along), across], 1), first[1] + along @ rest
        both = beside([[first, *later], [still, *later]], [1, -1], raw.kind)
        both.layers[-1].bias.copy_(output_mean)
        return both.requires_grad_(False).to(dtype=dtype, device=device)


@torch.no_grad()
def beside(
    networks: Sequence[Sequence[tuple[Tensor, Tensor]]], shares: Sequence[float], activation: str
) -> FullyConnected:
    """Σ_k share_k network_k as one network in double precision, whose hidden layers are side by side.

    Args:
        networks: weights [out, in] and biases [out] of each one's layers, of which all have two or more.
        shares: one for each network.
        activation: a key of `ACTIVATIONS`.
    """
    first, *hidden, last = [list(zip(*layer, strict=True)) for layer in zip(*networks, strict=True)]
    weights = [torch.cat(first[0]), *(torch.block_diag(*W) for W, _ in hidden)]
    biases = [torch.cat(b) for _, b in (first, *hidden)]
    weights.append(torch.cat([share * W for share, W in zip(shares, last[0], strict=True)], 1))
    biases.append(sum(share * b for share, b in zip(shares, last[1], strict=True)))
    merged = FullyConnected((weights[0].shape[1], *(len(b) for b in biases)), activation)
    merged.to(weights[0].device, torch.float64)
    for layer, weight, bias in zip(merged.layers, weights, biases, strict=True):
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)
    return merged
