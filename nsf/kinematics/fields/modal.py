"""A field of `field=basis`: its mean, and modes times coefficients, most of which a small network gives."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from typing_extensions import override

from nsf.errors import ShapeError
from nsf.gpu import tf32
from nsf.kinematics.blocks import TILE, frames_at_once, tf32_error
from nsf.kinematics.fields.networks import Committee, FullyConnected
from nsf.kinematics.manifold import Restriction
from nsf.kinematics.training.phases import joined, shaped

_CONSTANT = 1e-6  # deviation over size of coefficients below which they are taken to be constant
#: Values of a product from which on tensor cores save more time than it takes to see how far they are off.
_MANY = 2**28


def at_rate(outputs: Tensor, rate: Tensor) -> Tensor:
    """Coefficients b + M dx̂/dt [..., K] from outputs [..., (1 + r) K], b and then the r columns of M.

    Args:
        outputs: of a network.
        rate: dx̂/dt [..., r], in the unit that M is over.
    """
    rows = outputs.unflatten(-1, (1 + rate.shape[-1], -1))
    return (rows[..., :1, :] + rate.unsqueeze(-2) @ rows[..., 1:, :]).squeeze(-2)


class ModalField(nn.Module):
    """mean(X) + Σ_k modes_k(X) a_k with a = [leading · xhat ; scale · network(inputs)].

    For the deformation this is the displacement x − X. With `rates` the network gives b and M of `at_rate`,
    M over the deviations `rate` of dx̂/dt.

    Args:
        particles, components: P and c.
        modes: K.
        leading: how many coefficients are latents themselves (r for g, 0 for h and l).
        inputs, width, depth: of the network; there is none if no coefficient is left to it.
        members: networks whose mean it is.
        rates: r if the coefficients depend on dx̂/dt, else 0.
    """

    def __init__(
        self,
        particles: int,
        components: int,
        modes: int,
        leading: int,
        inputs: int,
        width: int,
        depth: int,
        members: int,
        rates: int = 0,
    ):
        super().__init__()
        self.register_buffer("mean", torch.zeros(particles, components, dtype=torch.float64))
        self.register_buffer("modes", torch.zeros(particles, components, modes))
        self.register_buffer("leading", torch.ones(leading, dtype=torch.float64))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))
        self.rates = rates
        if rates:
            self.register_buffer("rate", torch.ones(rates, dtype=torch.float64))
        closed = modes - leading
        widths = (inputs, *[width] * depth, closed * (1 + rates))
        self.network: FullyConnected | Committee | None = None
        if closed:
            several = members > 1
            self.network = Committee(members, widths, "silu") if several else FullyConnected(widths, "silu")

    def calibrate(self, coefficients: Tensor) -> None:
        """Take scales and the network's last bias from the coefficients [M, K] of the training snapshots."""
        leading, closed = coefficients.tensor_split([self.leading.numel()], 1)
        self.leading.copy_(leading.square().mean(0).sqrt())
        if closed.numel():
            mean, size = closed.mean(0), closed.square().mean().sqrt()
            deviation = (closed - mean).square().mean().sqrt()
            # Coefficients that never change deviate by round-off, which is no scale.
            self.scale.copy_(torch.where(deviation > _CONSTANT * size, deviation, size))
            if isinstance(self.network, FullyConnected | Committee):
                with torch.no_grad():  # else training would have to find the mean of modes about zero
                    self.network.output_bias[..., : len(mean)] = mean / self.scale

    @property
    def output_scale(self) -> Tensor:
        """Factors [(1 + r) K] that bring outputs of the network to the field's unit."""
        closed = self.scale.expand(self.modes.shape[2] - len(self.leading))
        if not self.rates:
            return closed
        return torch.cat([closed, (self.scale / self.rate).repeat_interleave(len(closed))])

    def at(
        self,
        place: Callable[[Tensor], Tensor],
        base: Tensor | float,
        network: FullyConnected | None,
        like: Tensor,
    ) -> RestrictedField:
        """base + the field where `place` takes its mean and modes, in dtype and device as `like`."""
        unscaled = self.modes.shape[2] - len(self.leading)
        factors = torch.cat([self.leading, self.leading.new_ones(unscaled)]).to(like)
        return RestrictedField(
            (base + place(self.mean)).to(like),
            place(self.modes).to(like) * factors,
            len(self.leading),
            network,
            self.rates,
        )


@dataclass(frozen=True)
class RestrictedField:
    """mean + modes · a at n points; a = [xhat (the leading coefficients) ; network(inputs)].

    Attributes:
        mean: [n, c]; modes: [n, c, K], both in the unit of the field.
        rates: r where the network gives b and M of `at_rate`, else 0.
    """

    mean: Tensor
    modes: Tensor
    leading: int
    network: FullyConnected | None
    rates: int = 0

    def subset(self, rows: slice) -> RestrictedField:
        """The same field at some of the points, sharing memory."""
        return replace(self, mean=self.mean[rows], modes=self.modes[rows])

    def values(self, inputs: Tensor, rate: Tensor | None = None) -> Tensor:
        """[..., inputs] and, where there are `rates`, dx̂/dt [..., r] → [..., n, c].

        Raises:
            ShapeError: dx̂/dt is missing.
        """
        a = self._coefficients(inputs, rate)
        return F.linear(a, self.modes.flatten(0, 1), self.mean.flatten()).unflatten(-1, self.mean.shape)

    def blocks(self, inputs: Tensor, tolerance: float = 0.0) -> Iterator[Tensor]:
        """`values` [f, n, c] of inputs [F, ·], all blocks of frames in one memory.

        A block is one product on a GPU; many values are made in tf32, where that is off by no more than
        `tolerance` of modes times coefficients. On the CPU it is one for each part of the points whose modes
        stay in the cache.
        """
        modes, mean = self.modes.flatten(0, 1), self.mean.flatten()
        (values, K), frames = modes.shape, inputs.shape[0]
        size = max(1, min(frames, frames_at_once(values, mean.dtype, mean.device)))
        with torch.no_grad():
            a, memory = self._coefficients(inputs), mean.new_empty(size, values)
            tensor_cores = tolerance > 0 and mean.is_cuda and mean.dtype == torch.float32
            tensor_cores &= frames * values >= _MANY
            fast = tensor_cores and tf32_error(a[:: max(1, frames // 16)], modes) <= tolerance
        width = values if mean.is_cuda else max(1, TILE // K)
        tiles = [slice(start, start + width) for start in range(0, values, width)]
        for part in a.split(size):
            block = memory[: part.shape[0]]
            with torch.no_grad(), tf32() if fast else contextlib.nullcontext():
                for rows in tiles:
                    torch.addmm(mean[rows], part, modes[rows].T, out=block[:, rows])
            yield block.unflatten(-1, self.mean.shape)

    def _coefficients(self, inputs: Tensor, rate: Tensor | None = None) -> Tensor:
        a = [inputs[..., : self.leading]] if self.leading or self.network is None else []
        if self.network is not None:
            outputs = self.network(inputs)
            a.append(at_rate(outputs, self._checked(rate)) if self.rates else outputs)
        return torch.cat(a, -1) if len(a) > 1 else a[0]

    def _checked(self, rate: Tensor | None) -> Tensor:
        if rate is None:
            raise ShapeError(
                "C of this manifold depends on the rate of the latent vector (field.affine=rate); "
                "pass rate=, dx̂/dt in 1/s of the shape of xhat"
            )
        return rate.to(self.modes)

    def values_and_jacobian(self, xhat: Tensor, identity: Tensor) -> tuple[Tensor, Tensor]:
        """[..., r] and the identity [r, r] → [..., n, c] and [..., n, c, r], in one product."""
        a, along = xhat, identity.expand(*xhat.shape[:-1], *identity.shape)
        if self.network is not None:
            closed, closed_along = self.network.forward_and_tangents(xhat, identity)
            a, along = torch.cat([a, closed], -1), torch.cat([along, closed_along], -1)
        rows = F.linear(torch.cat([a.unsqueeze(-2), along], -2), self.modes.flatten(0, 1))
        rows = rows.unflatten(-1, self.mean.shape)
        return rows[..., 0, :, :] + self.mean, rows[..., 1:, :, :].movedim(-3, -1)


class PlacedFields(dict):
    """Restricted fields by phase, each made on first use: most callers use that of the deformation alone."""

    def __init__(self, make: Callable[[str], RestrictedField]):
        self._make = make

    def __missing__(self, phase: str) -> RestrictedField:
        self[phase] = self._make(phase)
        return self[phase]


@dataclass(frozen=True)
class ModalFactors:
    """A field at n points, mean + modes · [leading · xhat ; network(xhat, μ)].

    Attributes:
        mean: [n, c] in the unit of the field.
        table: [P, c, K] modes of every particle as trained, in fp32, where the manifold is.
        rows: [n] of the points among them.
        leading: σ [r] of the coefficients that are latents; [0] for h and l.
        scale: of the others, with which the network's last layer was multiplied.
        network: of the others, in raw units; None if there is none.
        members: how many networks it is a sum of.
        rates: r where the network gives b and M of `at_rate`, else 0.
    """

    mean: Tensor
    table: Tensor
    rows: Tensor
    leading: Tensor
    scale: float
    network: FullyConnected | None
    members: int
    rates: int = 0

    @property
    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weights [out, in] and biases [out] of the network, without the zeros between its members.

        The first layer's rows and the last one's columns are member by member; in between, row o of a member
        has the weights of that member's inputs alone.
        """
        layers = [] if self.network is None else list(self.network.layers)
        pairs = []
        for n, layer in enumerate(layers):
            W = layer.weight
            if 0 < n < len(layers) - 1:
                blocks = W.unflatten(0, (self.members, -1)).unflatten(2, (self.members, -1))
                W = blocks.diagonal(dim1=0, dim2=2).permute(2, 0, 1).flatten(0, 1)
            pairs.append((W, layer.bias))
        return pairs


class ModalModule(nn.Module):
    """A restricted field as a module: its tensors are buffers."""

    def __init__(self, field: RestrictedField, phase: str, takes_parameters: bool):
        super().__init__()
        self.register_buffer("mean", field.mean)
        self.register_buffer("modes", field.modes)
        self.leading, self.network, self.rates = field.leading, field.network, field.rates
        self.phase, self.takes_parameters = phase, takes_parameters

    @override
    def forward(self, xhat: Tensor, parameters: Tensor) -> Tensor:
        return self._values(xhat, parameters)

    def _values(self, xhat: Tensor, parameters: Tensor, rate: Tensor | None = None) -> Tensor:
        field = RestrictedField(self.mean, self.modes, self.leading, self.network, self.rates)
        inputs = joined(xhat, parameters) if self.takes_parameters else xhat
        return shaped(self.phase, field.values(inputs, rate))


class RateModule(ModalModule):
    """A restricted field that depends on dx̂/dt."""

    @override
    def forward(self, xhat: Tensor, parameters: Tensor, rate: Tensor) -> Tensor:
        return self._values(xhat, parameters, rate)


class ModalRestriction(Restriction):
    """Modes at n points.

    Args:
        fields: by phase.
        gradient: makes ∂g/∂X, a field of 9 components; called when first needed.
        takes_parameters: whether h and l see the problem parameters.
        takes_rate: whether l sees dx̂/dt.
    """

    def __init__(
        self,
        fields: Mapping[str, RestrictedField],
        gradient: Callable[[], RestrictedField],
        latent_dim: int,
        takes_parameters: bool,
        takes_rate: bool,
    ):
        self.fields, self.latent_dim, self.takes_rate = fields, latent_dim, takes_rate
        mean = fields["deformation"].mean
        self.points, self.dtype, self.device = len(mean), mean.dtype, mean.device
        self._make_gradient = gradient
        self._takes_parameters = takes_parameters
        self._identity = torch.eye(latent_dim, dtype=self.dtype, device=self.device)

    @override
    def position(self, xhat):
        return self.fields["deformation"].values(xhat.to(self.dtype))

    @override
    def positions(self, xhat, tolerance=0.0):
        return self.fields["deformation"].blocks(xhat.to(self.device, self.dtype), tolerance)

    @override
    def position_and_jacobian(self, xhat):
        return self.fields["deformation"].values_and_jacobian(xhat.to(self.dtype), self._identity)

    @override
    def deformation_gradient(self, xhat):
        return self._gradient.values(xhat.to(self.dtype)).unflatten(-1, (3, 3))

    @functools.cached_property
    def _gradient(self) -> RestrictedField:
        return self._make_gradient()

    @override
    def stress(self, xhat, parameters):
        return self.fields["stress"].values(self._inputs(xhat, parameters))

    @override
    def stress_of(self, coordinates):
        modes = self.fields["stress"].modes[..., : coordinates.shape[-1]]
        return torch.einsum("...k,nck->...nc", coordinates.to(modes), modes)

    @override
    def affine(self, xhat, parameters, rate=None):
        return self.fields["affine"].values(self._inputs(xhat, parameters), rate).unflatten(-1, (3, 3))

    @override
    def module(self, phase):
        kind = RateModule if phase == "affine" and self.takes_rate else ModalModule
        return kind(self.fields[phase], phase, phase != "deformation" and self._takes_parameters)

    @override
    def subset(self, rows):
        fields = PlacedFields(lambda phase: self.fields[phase].subset(rows))
        flags = self._takes_parameters, self.takes_rate
        return ModalRestriction(fields, lambda: self._gradient.subset(rows), self.latent_dim, *flags)

    def _inputs(self, xhat: Tensor, parameters: Tensor) -> Tensor:
        xhat = xhat.to(self.dtype)
        return joined(xhat, parameters) if self._takes_parameters else xhat
