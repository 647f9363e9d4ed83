"""The recurrence: one stride of a run as a map of its latent state, affine in change, gravity and stress.

With d = x̂ₙ − x̂ₙ₋₁, problem parameters μ, gravity g, the state c of what moves, and ŝ, the coordinates of τ:

    d'   = d + B(x̂, μ, c) d + f(x̂, μ, c) + G(x̂, μ, c) g + A(x̂, μ, c) ŝ
    x̂ₙ₊₁ = x̂ₙ + d'
    ŝₙ₊₁ = ŝₙ + H(x̂, μ, c, ŝ, d') d' + k(x̂, μ, c, ŝ, d')

A stride is one or several steps of the full-order run; its length squared is in f, G and A. Without ŝ
there is no A, H and k. docs/method.md derives it. Not in the paper, which leaves a latent stress to future
work (section 7, "Path-dependent plasticity").
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import silu


@dataclass(frozen=True)
class Sizes:
    """Sizes of a recurrence.

    Attributes:
        latents: r; stress: n_s, of ŝ; parameters: n, of μ.
        features: of collider states; states: C, of c, the combinations of these that vary.
        gravity: whether there is any.
        width: of both hidden layers of each network.
        members: M networks of each kind, whose runs are averaged.
    """

    latents: int
    stress: int
    parameters: int
    features: int
    states: int
    gravity: bool
    width: int
    members: int = 1

    @property
    def terms(self) -> int:
        """Columns of [B f G A]: what a change of d is affine in, and 1."""
        return self.latents + 1 + 3 * self.gravity + self.stress

    @property
    def layers(self) -> dict[str, tuple[int, int]]:
        """Inputs and outputs of each network: `motion` gives [B f G A], `stress` gives [H k]."""
        seen = self.latents + self.parameters + self.states
        sizes = {"motion": (seen, self.latents * self.terms)}
        if self.stress:
            sizes["stress"] = seen + self.stress + self.latents, self.stress * (self.latents + 1)
        return sizes


class State(NamedTuple):
    """Where runs are, for each member: x̂ₙ, d = x̂ₙ − x̂ₙ₋₁ [M, ..., r] and ŝₙ [M, ..., n_s]."""

    xhat: Tensor
    change: Tensor
    stress: Tensor


class Layers(nn.Module):
    """M networks of two hidden SiLU layers side by side; the last layer is zero at the start.

    Args:
        members, inputs, width, outputs: M and the sizes of layers.
        seed: of the first member's weights; each further member's is the next number.
    """

    def __init__(self, members: int, inputs: int, width: int, outputs: int, seed: int = 0):
        super().__init__()
        sizes = [(inputs, width), (width, width), (width, outputs)]
        self.weights = nn.ParameterList(torch.zeros(members, *size) for size in sizes)
        self.biases = nn.ParameterList(torch.zeros(members, size[1]) for size in sizes)
        if self.weights[0].is_meta:
            return
        for member in range(members):
            generator = torch.Generator().manual_seed(seed + member)
            for weight, bias in list(zip(self.weights, self.biases, strict=True))[:-1]:
                for values in (weight.data[member], bias.data[member]):
                    values.uniform_(-1.0, 1.0, generator=generator).mul_(weight.shape[1] ** -0.5)

    def forward(self, inputs: Tensor) -> Tensor:
        """Outputs [M, ..., outputs] of inputs [M, ..., inputs]."""
        values = inputs.flatten(1, -2)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.baddbmm(bias[:, None], silu(values) if layer else values, weight)
        return values.unflatten(1, inputs.shape[1:-1])


class Form(nn.Module):
    """The recurrence of M members.

    All inputs are standardised, and outputs are in units of the runs that taught it; the scales are buffers.

    Args:
        sizes: of the networks.
        dt: step of the full-order run [s].
        stride: how many of them one step of the recurrence covers.
        seed: of the weights.

    Attributes:
        x_mean, x_scale: [r] of x̂; mu_mean, mu_scale: [n] of μ; s_mean, s_scale: [n_s] of ŝ.
        c_mean: [features], c_matrix: [features, C]: of collider states (`solids.principal`).
        d_scale, a_scale: [r] deviations of d and of d' − d; t_scale: [n_s] of ŝₙ₊₁ − ŝₙ.
        g_mean: [3], g_scale: [] [m/s²].
    """

    def __init__(self, sizes: Sizes, dt: float, stride: int = 1, seed: int = 0):
        super().__init__()
        self.sizes, self.dt, self.stride = sizes, dt, stride
        self.networks = nn.ModuleDict(
            {
                name: Layers(sizes.members, inputs, sizes.width, outputs, seed)
                for name, (inputs, outputs) in sizes.layers.items()
            }
        )
        r, n_s, n = sizes.latents, sizes.stress, sizes.parameters
        buffers = {
            "x_mean": torch.zeros(r), "x_scale": torch.ones(r), "d_scale": torch.ones(r),
            "a_scale": torch.ones(r), "mu_mean": torch.zeros(n), "mu_scale": torch.ones(n),
            "s_mean": torch.zeros(n_s), "s_scale": torch.ones(n_s), "t_scale": torch.ones(n_s),
            "c_mean": torch.zeros(sizes.features), "c_matrix": torch.zeros(sizes.features, sizes.states),
            "g_mean": torch.zeros(3), "g_scale": torch.ones(()),
        }  # fmt: skip
        for name, value in buffers.items():
            self.register_buffer(name, value)

    def collider_state(self, features: Tensor) -> Tensor:
        """c [..., C] of collider states [..., features] (`solids.collider_states`)."""
        return (features - self.c_mean) @ self.c_matrix

    def step(self, state: State, parameters: Tensor, gravity: Tensor, c: Tensor) -> State:
        """The state after a stride.

        Args:
            state: of M members; B runs and whatever else stand between M and the last axis.
            parameters: μ [..., n]; gravity: [..., 3] [m/s²] and c: [..., C], means over the stride; each may
                lack leading axes.
        """
        inputs = self.standard_inputs(parameters, gravity, c)
        return self.in_units(self.advance(self.standard(state), *inputs, self.ratios))

    def advance(self, z: Tensor, seen: Tensor, terms: Tensor, ratios: Sequence[Tensor]) -> Tensor:
        """The standardised state z = [x̂; d; ŝ] after a stride; of `standard`, `standard_inputs`, `ratios`."""
        x, d, s = self._parts(z)
        seen, terms = (values.expand(*x.shape[:-1], -1) for values in (seen, terms))
        of_change, of_place, of_stress = ratios
        d = torch.addcmul(d, of_change, self._applied("motion", [x, seen], [d, terms, s]))
        return torch.cat([torch.addcmul(x, of_place, d), d, self._stressed(x, d, s, seen, of_stress)], -1)

    def standard(self, state: State) -> Tensor:
        """The state with zero mean and in units of its deviation, z [..., 2 r + n_s]."""
        x, d, s = state
        parts = (x - self.x_mean) / self.x_scale, d / self.d_scale, (s - self.s_mean) / self.s_scale
        return torch.cat(parts, -1)

    def in_units(self, z: Tensor) -> State:
        """The state of a standardised one."""
        x, d, s = self._parts(z)
        return State(self.x_mean + self.x_scale * x, self.d_scale * d, self.s_mean + self.s_scale * s)

    def standard_inputs(self, parameters: Tensor, gravity: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised [μ; c] [..., n + C] and [1; g] [..., 4], or [1] without gravity."""
        g = (gravity - self.g_mean) / self.g_scale
        one = torch.ones_like(g[..., :1])
        return self._seen(parameters, c), torch.cat([one, g], -1) if self.sizes.gravity else one

    @property
    def ratios(self) -> tuple[Tensor, Tensor, Tensor]:
        """Units of d' − d over those of d, of d over x̂ and of ŝₙ₊₁ − ŝₙ over ŝ; [r], [r] and [n_s]."""
        return self.a_scale / self.d_scale, self.d_scale / self.x_scale, self.t_scale / self.s_scale

    def next_stress(
        self, xhat: Tensor, change: Tensor, stress: Tensor, parameters: Tensor, c: Tensor
    ) -> Tensor:
        """ŝₙ₊₁ of x̂ₙ, d' and ŝₙ; other arguments as for `step`."""
        x, d, s = self._parts(self.standard(State(xhat, change, stress)))
        seen = self._seen(parameters, c).expand(*x.shape[:-1], -1)
        return self.s_mean + self.s_scale * self._stressed(x, d, s, seen, self.ratios[2])

    def _stressed(self, x: Tensor, d: Tensor, s: Tensor, seen: Tensor, ratio: Tensor) -> Tensor:
        """Standardised ŝₙ₊₁."""
        if not self.sizes.stress:
            return s
        terms = [d, torch.ones_like(d[..., :1])]
        return torch.addcmul(s, ratio, self._applied("stress", [x, seen, s, d], terms))

    def _parts(self, z: Tensor) -> Sequence[Tensor]:
        """x̂, d and ŝ of a standardised state."""
        return z.split([self.sizes.latents, self.sizes.latents, self.sizes.stress], -1)

    def _seen(self, parameters: Tensor, c: Tensor) -> Tensor:
        """Standardised [μ; c] [..., n + C]."""
        mu = (parameters - self.mu_mean) / self.mu_scale
        lead = torch.broadcast_shapes(mu.shape[:-1], c.shape[:-1])
        return torch.cat([mu.expand(*lead, -1), c.expand(*lead, -1)], -1)

    def _applied(self, name: str, seen: list[Tensor], terms: list[Tensor]) -> Tensor:
        """The matrix of a network [M, ..., rows, columns] times the terms [M, ..., columns]."""
        terms = torch.cat(terms, -1)
        matrix = self.networks[name](torch.cat(seen, -1)).unflatten(-1, (-1, terms.shape[-1]))
        return (matrix @ terms.unsqueeze(-1)).squeeze(-1)

    def run(self, start: State, parameters: Tensor, gravity: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """x̂ [N + 1, M, B, r] and ŝ [N + 1, M, B, n_s] of N strides.

        Args:
            start: of M members and B runs.
            parameters: μ [B, n]; gravity: [N, B, 3]; c: [N, B, C]; B may be 1.
        """
        inputs, states = self.standard_inputs(parameters, gravity, c), [self.standard(start)]
        for seen, terms in zip(*inputs, strict=True):
            states.append(self.advance(states[-1], seen, terms, self.ratios))
        run = self.in_units(torch.stack(states))
        return run.xhat, run.stress

    def begin(self, xhat: Tensor, change: Tensor, stress: Tensor | None = None) -> State:
        """The state of all members at t = 0: x̂ and d [B, r], and ŝ [B, n_s], 0 by default."""
        if stress is None:
            stress = xhat.new_zeros(*xhat.shape[:-1], self.sizes.stress)
        return State(*(v.expand(self.sizes.members, *v.shape) for v in (xhat, change, stress)))

    @torch.no_grad()
    def in_raw_units(self) -> dict[str, list[tuple[Tensor, Tensor]]]:
        """Weights [M, inputs, outputs] and biases [M, outputs] of the networks with all scales in them.

        Inputs are x̂, μ, c and, of `stress`, ŝ and d'; outputs are the rows of [B f G A] and of [H k], which
        apply to [d; 1; g; ŝ] and to [d'; 1].
        """
        zero, one = torch.zeros_like, torch.ones_like
        c = self.x_mean.new_zeros(self.sizes.states)
        unit = self.x_mean.new_ones(1)
        means, scales = [self.x_mean, self.mu_mean, c], [self.x_scale, self.mu_scale, one(c)]
        terms = [zero(self.d_scale), zero(unit)], [self.d_scale, unit]
        if self.sizes.gravity:
            terms[0].append(self.g_mean)
            terms[1].append(self.g_scale.expand(3))
        terms[0].append(self.s_mean)
        terms[1].append(self.s_scale)
        layers = {"motion": _raw(self.networks["motion"], (means, scales), terms, self.a_scale)}
        if self.sizes.stress:
            seen = [*means, self.s_mean, zero(self.d_scale)], [*scales, self.s_scale, self.d_scale]
            terms = [zero(self.d_scale), zero(unit)], [self.d_scale, unit]
            layers["stress"] = _raw(self.networks["stress"], seen, terms, self.t_scale)
        return layers


def _raw(network: Layers, seen, terms, rows: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Layers for inputs and terms as they are, which the network has less their means and over their scales.

    Args:
        network: M networks.
        seen, terms: means and scales of the inputs, and of what outputs apply to, [d; 1; …].
        rows: scale of each row of the outputs' matrix.
    """
    (mean, scale), (t_mean, t_scale) = (tuple(torch.cat(part) for part in both) for both in (seen, terms))
    (W, b), middle, (V, v) = zip(network.weights, network.biases, strict=True)
    first = W / scale[:, None]
    one = len(terms[0][0])  # the column of 1 comes after those of d

    def outputs(values: Tensor) -> Tensor:
        matrix = rows[:, None] * values.unflatten(-1, (len(rows), -1)) / t_scale
        matrix[..., one] -= matrix @ t_mean
        return matrix.flatten(-2)

    return [(first, b - mean @ first), middle, (outputs(V), outputs(v))]
