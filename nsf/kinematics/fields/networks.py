"""Fully connected networks with a hand-propagated forward derivative."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nsf.gpu import tf32


def _push_elu(tangents: Tensor, z: Tensor) -> Tensor:
    return torch.ops.aten.elu_backward(tangents, 1.0, 1.0, 1.0, False, z)


# name → (activation, its tangent map t ↦ act'(z) t). For a pointwise function the forward derivative is the
# same product as the backward one, so torch's fused backward kernels serve; they broadcast z over tangents.
ACTIVATIONS = {"elu": (F.elu, _push_elu), "silu": (F.silu, torch.ops.aten.silu_backward)}


# Arithmetic of tensor cores, by the type of values between layers: 10 and 7 bits after the leading one.
ARITHMETIC = {"tf32": torch.float32, "bf16": torch.bfloat16}


def xavier(layer: nn.Linear | nn.Conv1d, generator: torch.Generator) -> None:
    """Xavier-uniform weights and zero biases, drawn from `generator` (paper, Training Details)."""
    nn.init.xavier_uniform_(layer.weight, generator=generator)
    nn.init.zeros_(layer.bias)


Layer = tuple[Tensor, Tensor]  # weights [out, in] and biases [out]

#: Of `zero_at_rest`: how fast the value at rest fades, and the input to SiLU of the unit of the bias.
_FADING, _BIAS = 4.0, 4.0


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

    @property
    def output_bias(self) -> Tensor:
        """[outputs], of the last layer."""
        return self.layers[-1].bias

    def forward(self, inputs: Tensor) -> Tensor:
        """[..., inputs] → [..., outputs]."""
        *hidden, last = self.layers  # a slice would make a module; to call one takes longer than its product
        for layer in hidden:
            inputs = self.activation(F.linear(inputs, layer.weight, layer.bias))
        return F.linear(inputs, last.weight, last.bias)

    def forward_and_tangents(self, inputs: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
        """The outputs and their derivative along each tangent, in one pass and without autograd.

        Args:
            inputs: [..., inputs].
            tangents: [d, inputs], the same directions for every row.

        Returns:
            outputs [..., outputs] and derivatives [..., d, outputs].
        """
        *hidden, last = self.layers
        for layer in hidden:
            z = layer(inputs)
            tangents = self.push(F.linear(tangents, layer.weight), z.unsqueeze(-2))
            inputs = self.activation(z)
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

    @property
    def output_bias(self) -> Tensor:
        """[members, outputs], of the last layer."""
        return self.biases[-1][:, 0]

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
        networks = [[(w[n], b[n, 0]) for w, b in layers] for n in range(len(self.weights[0]))]
        return weighted_sum(networks, [1 / len(networks)] * len(networks), self.activation)

    def in_raw_units(self, *standardisation, **place) -> FullyConnected:
        """The mean, frozen, for raw inputs and outputs; arguments as for `FullyConnected.in_raw_units`."""
        return self.mean().in_raw_units(*standardisation, **place)


@torch.no_grad()
def zero_at_rest(raw: FullyConnected, members: int, rest: Tensor, reach: Tensor) -> FullyConnected:
    """The network, but zero at x̂₀ whatever μ is, and as before from a few times `reach` on.

    Of each member N = W silu(z) + b, with z what its last hidden layer has before SiLU, the value at rest is
    subtracted, which fades as x̂ leaves x̂₀:

        N(x̂, μ) − W silu(z(x̂₀, μ) − K ρ) − b silu(c − K ρ)/silu(c),   ρ = Σ_k t_k tanh(t_k/2),

    with t = (x̂ − x̂₀)/reach, K = `_FADING` and c = `_BIAS`. This is a network of SiLU layers too, so that
    the code that evaluates `raw` evaluates it: silu(t) + silu(−t) = t tanh(t/2), and silu(ρ) − silu(−ρ) = ρ.

    Args:
        raw: of inputs (x̂, μ), with two hidden layers or more, each of the members side by side.
        members: how many networks it is a sum of.
        rest: x̂₀ [r].
        reach: [r], of the unit of x̂.

    Returns:
        A network of twice as many members in double precision.
    """
    layers, networks = [(layer.weight.double(), layer.bias.double()) for layer in raw.layers], []
    for n in range(members):
        member = _member(layers, members, n)
        faded = _value_at_rest(member, rest, reach)
        networks += [[_padded(layer, like) for layer, like in zip(member, faded, strict=True)], faded]
    return weighted_sum(networks, [1] * len(networks), raw.kind).requires_grad_(False)


def _value_at_rest(layers: Sequence[Layer], rest: Tensor, reach: Tensor) -> list[Layer]:
    """The network that `zero_at_rest` adds to a member: minus its value at rest, which fades with ρ."""
    (first, b_first), *hidden, (W, b) = layers[:-1]
    r, (out, b_out) = len(rest), layers[-1]
    slopes = torch.cat([torch.diag(1 / reach), torch.diag(-1 / reach)])
    added = [
        _widened(first, b_first + first[:, :r] @ rest, F.pad(slopes, (0, first.shape[1] - r)), -slopes @ rest)
    ]
    added[0][0][: len(first), :r] = 0  # x̂ is x̂₀ there
    # Weights that give ρ from the layer before: of silu(±t_k), r each, and later of silu(±ρ).
    distance = torch.ones(1, 2 * r).to(rest)
    for V, c in hidden:
        units = F.pad(torch.cat([distance, -distance]), (len(V), 0))
        added.append(_widened(F.pad(V, (0, distance.shape[1])), c, units, c.new_zeros(2)))
        distance = torch.tensor([[1.0, -1.0]]).to(rest)
    faded = torch.cat([W, -_FADING * distance.expand(len(W), -1)], 1)
    bias = F.pad(-_FADING * distance, (W.shape[1], 0))
    added.append(_widened(faded, b, bias, b.new_tensor([_BIAS])))
    share = -b_out / F.silu(b_out.new_tensor(_BIAS))
    return [*added, (torch.cat([-out, share[:, None]], 1), torch.zeros_like(b_out))]


def _widened(W: Tensor, b: Tensor, units: Tensor, bias: Tensor) -> Layer:
    """A layer with further units."""
    return torch.cat([W, units]), torch.cat([b, bias])


def _padded(layer: Layer, like: Layer) -> Layer:
    """A layer with zeros up to the size of another."""
    (W, b), (V, c) = layer, like
    return F.pad(W, (0, V.shape[1] - W.shape[1], 0, len(V) - len(W))), F.pad(b, (0, len(c) - len(b)))


def _member(layers: Sequence[Layer], members: int, n: int) -> list[Layer]:
    """Layers of one of the networks that `layers` hold side by side; of the last bias its share."""
    biases = [b.unflatten(0, (members, -1))[n] for _, b in layers[:-1]]
    blocks = [layers[0][0].unflatten(0, (members, -1))[n]]
    for W, _ in layers[1:-1]:
        blocks.append(W.unflatten(0, (members, -1)).unflatten(2, (members, -1))[n, :, n])
    blocks.append(layers[-1][0].unflatten(1, (members, -1))[:, n])
    return list(zip(blocks, [*biases, layers[-1][1] / members], strict=True))


@torch.no_grad()
def weighted_sum(
    networks: Sequence[Sequence[Layer]], shares: Sequence[float], activation: str
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
