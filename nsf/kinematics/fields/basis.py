"""`field=basis`: linear modes of the snapshots with a nonlinear closure of the latent vector.

    g(X, xhat)    = X + ū(X) + Σ_k b_k(X) a_k,   a = [σ · xhat ; closure(xhat)]
    h(X, xhat, μ) = Σ_k t_k(X) d_k(xhat, μ),   l(X, xhat, μ) = C̄(X) + Σ_k c_k(X) b_k(xhat, μ)

or with `affine=rate`, since C is a velocity gradient, and a state may be passed at different speeds,

    l(X, xhat, dx̂/dt, μ) = C̄(X) + Σ_k c_k(X) [b_k(xhat, μ) + Σ_j M_kj(xhat, μ) dx̂_j/dt]

b, t, c are POD modes of x, tau and C; xhat is the first r coefficients of x over their deviation σ, so
encoding is a dot product. The small networks see xhat alone and run once a step, not once a particle. This is
not in the paper, whose fields are `mlp`; it takes their place in every equation of sections 4 and 5.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from nsf.data import Snapshots
from nsf.errors import ConfigError
from nsf.kinematics.blocks import coordinates
from nsf.kinematics.fields import pod
from nsf.kinematics.fields.modal import (
    ModalFactors,
    ModalField,
    ModalRestriction,
    PlacedFields,
    RestrictedField,
    at_rate,
)
from nsf.kinematics.fields.networks import Committee, FullyConnected, zero_at_rest
from nsf.kinematics.interpolation import Interpolation, interpolation
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.phases import MOST_DEEP, MOST_MEMBERS, TARGETS, Fit, per_phase
from nsf.scalars import number
from nsf.schemas import Number

AFFINE = ("latent", "rate")
ENCODED_ENTRIES = 1 << 26  # values encoded at once

# Reach of `zero_at_rest` over the noise of training: at a hundredth of the noise nothing is taken any more.
_REACH = 0.002
_LEAST_NOISE = 0.01  # [deviations of x̂] taken where training has less


@dataclass(frozen=True)
class BasisField:
    """Modes and the networks of their coefficients.

    Attributes:
        modes: K of x, tau and C: one for all, [x, tau=C] or [x, tau, C]; cut to the snapshots' rank.
        beta: hidden widths over d (3, 6, 9) of the closure and the two heads, given like `modes`.
        depth: hidden layers of each network.
        members: networks of each phase, trained side by side on noise of their own, and averaged; deployed as
            one network of that many times the width, of stress of twice as many (`zero_at_rest`).
        noise: deviation of the noise added to xhat in training, in units of xhat's deviation. It keeps the
            Jacobian and the heads regular beside the training trajectories.
        noise_floor: ε; with σ the deviations of the coordinates, the noise on coordinate k has the deviation
            √(noise² + (ε max σ / σ_k)²), in units of σ_k. Not in the paper; for errors of the sample's
            positions, which are large in units of a weak σ_k.
        head_parameters: the heads see the (standardised) problem parameters beside xhat.
        affine: `latent`: C follows from xhat, as in the paper; `rate`: from xhat and dx̂/dt.
        rate_noise: deviation of the noise on dx̂/dt in training with `affine=rate`, in units of dx̂/dt's
            deviation. Where xhat tells dx̂/dt to within the noise, as along one path, C is left to b(xhat, μ).
    """

    modes: int | Sequence[int] = (48, 64, 64)
    beta: int | Sequence[int] = (48, 48, 32)
    depth: int = 3
    members: int = 1
    noise: float = 0.01
    noise_floor: float = 0.003
    head_parameters: bool = True
    affine: str = "latent"
    rate_noise: float = 0.1

    def __post_init__(self) -> None:
        if self.affine not in AFFINE:
            raise ConfigError(f"field.affine={self.affine} is unknown; choose {' or '.join(AFFINE)}")
        number("rate_noise", self.rate_noise, 0)
        per_phase("modes", self.modes)
        per_phase("beta", self.beta)
        number("depth", self.depth, 1, whole=True, most=MOST_DEEP)
        number("members", self.members, 1, whole=True, most=MOST_MEMBERS)
        number("noise", self.noise, 0)
        number("noise_floor", self.noise_floor, 0)

    @property
    def manifold(self) -> type[BasisManifold]:
        """The class of the manifolds that `build` makes; a field that builds on this one has its own."""
        return BasisManifold

    def prepare(self, snapshots: Snapshots, latent_dim: int) -> dict[str, Any]:
        """POD coefficients [M, K] of x, tau and C.

        Raises:
            ConfigError: latent_dim exceeds `modes`, or the rank of the displacements.
        """
        counts = per_phase("modes", self.modes)
        if latent_dim > counts[0]:
            raise ConfigError(
                f"latent_dim={latent_dim} exceeds the {counts[0]} displacement modes; choose"
                f" field.modes > {latent_dim} or latent_dim <= {counts[0]}"
            )
        prepared = {
            name: pod.decompose(snapshots, name, count).cpu()
            for count, (name, _) in zip(counts, TARGETS.values(), strict=True)
        }
        rank = prepared["x"].shape[1]
        if latent_dim > rank:
            raise ConfigError(
                f"latent_dim={latent_dim} exceeds the rank {rank} of {snapshots.M} displacement snapshots;"
                f" choose latent_dim <= {rank} or simulate more cases"
            )
        return prepared

    def build(
        self, snapshots: Snapshots, prepared: dict[str, Any], latent_dim: int, generator: torch.Generator
    ) -> BasisManifold:
        """The manifold with its modes, and untrained networks drawn from `generator`."""
        hyperparameters = {
            "particles": snapshots.P,
            "frames": snapshots.M,
            "modes": [prepared[name].shape[1] for name, _ in TARGETS.values()],
            "beta": list(per_phase("beta", self.beta)),
            "depth": self.depth,
            "members": self.members,
            "noise": self.noise,
            "noise_floor": self.noise_floor,
            "head_parameters": self.head_parameters,
            "affine": self.affine,
            "free_at_rest": self.depth > 1 and _begin_free(snapshots),
        }
        manifold = self.manifold(
            latent_dim, snapshots.x_sha256, list(snapshots.parameter_names), hyperparameters
        )
        manifold.describe(snapshots)
        for phase, (name, _) in TARGETS.items():
            field = manifold.fields[phase]
            coefficients = prepared[name].to(snapshots.X.device)
            for particles, mean, modes in pod.modes(snapshots, name, coefficients):
                origin = manifold.X[particles].to(mean) if phase == "deformation" else 0
                field.mean[particles], field.modes[particles] = mean - origin, modes.float()
            if field.network is not None:
                field.network.initialise(generator)
            field.calibrate(coefficients)
        coefficients = prepared["x"][:, :latent_dim]
        manifold.training_latents.copy_(coefficients / manifold.fields["deformation"].leading)
        return manifold

    def fits(self, manifold: BasisManifold, snapshots: Snapshots, prepared: dict[str, Any]) -> Iterator[Fit]:
        """Closure and heads, each to its coefficients over one common scale.

        As the modes are orthonormal, such a loss is the mean squared error of the field over its variance.
        """
        if manifold.takes_rate:
            rates = _latent_rates(manifold, snapshots)
            manifold.training_rates.copy_(rates)
            deviation = rates.square().mean(0).sqrt()
            manifold.fields["affine"].rate.copy_(torch.where(deviation > 0, deviation, 1.0))
        for phase, (name, _) in TARGETS.items():
            field = manifold.fields[phase]
            if field.network is not None:
                targets = prepared[name].to(field.scale)[:, field.leading.numel() :] / field.scale
                yield Fit(phase, field.network, self._loss(manifold, phase, targets.float()), pointwise=False)

    def _loss(self, manifold: BasisManifold, phase: str, targets: Tensor) -> Callable[..., Tensor]:
        field, network = manifold.fields[phase], manifold.fields[phase].network
        latents = manifold.training_latents.float()
        parameters = manifold.standard_parameters(manifold.training_parameters.float())
        rates = (manifold.training_rates / field.rate).float() if field.rates else None
        noise = (self.noise**2 + manifold.floor.square()).sqrt().float()
        spread = manifold.spread.float()

        def loss(rows: Tensor | slice, particles: Tensor | slice, generator: torch.Generator) -> Tensor:
            xhat = latents[rows]
            # A committee's members each see noise of their own.
            shape = xhat.shape if self.members == 1 else (self.members, *xhat.shape)
            inputs = (xhat + noise * torch.randn(shape, generator=generator, device=xhat.device)) / spread
            if manifold.takes_parameters(phase):
                inputs = torch.cat([inputs, parameters[rows].expand(*shape[:-1], -1)], -1)
            outputs = network(inputs)
            if rates is None:
                return (outputs - targets[rows]).square().mean()
            # The mean over all noise on dx̂/dt, whose square M passes on: nothing is drawn.
            passed_on = field.rates * outputs[..., targets.shape[1] :].square().mean()
            coefficients_at_rate = at_rate(outputs, rates[rows])
            return (coefficients_at_rate - targets[rows]).square().mean() + self.rate_noise**2 * passed_on

        return loss


def _latent_rates(manifold: Manifold, snapshots: Snapshots) -> Tensor:
    """dx̂/dt of every training snapshot, [M, r] float64 [1/s], as a reduced step finds it.

    That is the backward difference (x̂_n − x̂_{n−1})/Δt of steps. As particles move by x_n = x_{n−1} + Δt v_n
    and x̂ is affine in x, the frame's velocities give it, also where the step before is not stored.
    """
    still, rates = manifold.encode(torch.zeros_like(manifold.X)[None]), []
    for rows in torch.arange(snapshots.M).split(max(1, ENCODED_ENTRIES // manifold.X.numel())):
        rates.append(manifold.encode(snapshots.gather("v", rows, slice(None))) - still)
    return torch.cat(rates)


def _layered(network: nn.Module | None) -> bool:
    return isinstance(network, FullyConnected | Committee)


def _begin_free(snapshots: Snapshots) -> bool:
    """Whether every training run begins free of stress; at X, as every run does."""
    first = torch.nonzero(snapshots.frame == 0).flatten()
    return len(first) > 0 and not any(snapshots.gather("tau", row[None], slice(None)).any() for row in first)


def _slope(local: Interpolation, values: Tensor) -> Tensor:
    """∂/∂X of a field [P, 3, ...] at points [n, 9, ...]."""
    return local.gradient(values).movedim(-1, 2).flatten(1, 2)


class BasisManifold(Manifold):
    """Modal fields of x, tau and C."""

    HYPERPARAMETERS: ClassVar[Mapping] = {
        **Manifold.HYPERPARAMETERS,
        "modes": [Number(0, whole=True)],
        "depth": Number(1, MOST_DEEP, whole=True),  # else a file has many built
        "members": Number(1, MOST_MEMBERS, whole=True),
        "noise": Number(0),
        "noise_floor": Number(0),
        "affine": re.compile("|".join(AFFINE)),
        "free_at_rest": bool,
    }

    def __init__(self, latent_dim, x_sha256, parameter_names, hyperparameters):
        super().__init__(latent_dim, x_sha256, parameter_names, hyperparameters)
        self.takes_rate = hyperparameters["affine"] == "rate"
        if self.takes_rate:
            shape = hyperparameters["frames"], latent_dim
            self.register_buffer("training_rates", torch.zeros(shape, dtype=torch.float64))
        self.fields = nn.ModuleDict()
        self._particle_slopes: tuple[Tensor, Tensor] | None = None
        layout = zip(TARGETS.items(), hyperparameters["modes"], hyperparameters["beta"], strict=True)
        for (phase, (_, d)), modes, beta in layout:
            inputs = latent_dim + (len(self.parameter_names) if self.takes_parameters(phase) else 0)
            leading = latent_dim if phase == "deformation" else 0
            self.fields[phase] = ModalField(
                hyperparameters["particles"],
                d,
                modes,
                leading,
                inputs,
                beta * d,
                hyperparameters["depth"],
                hyperparameters["members"],
                latent_dim if phase == "affine" and self.takes_rate else 0,
            )

    @property
    def floor(self) -> Tensor:
        """ε max σ / σ_k [r], dimensionless (`noise_floor`)."""
        leading = self.fields["deformation"].leading
        return self.hyperparameters["noise_floor"] * leading.max() / leading

    @property
    def spread(self) -> Tensor:
        """Deviation [r] of coordinates in units of σ with the floor's noise; networks see x̂ over it."""
        return (1 + self.floor.square()).sqrt()

    @property
    def rest_latent(self) -> Tensor:
        """xhat [r] of the particles at X."""
        return self.encode(self.X[None])[0]

    @property
    def layered(self) -> bool:
        """Whether every network is one of layers with SiLU, or a mean of such, as `factors` takes apart."""
        return all(field.network is None or _layered(field.network) for field in self.fields.values())

    def frees(self, phase: str) -> bool:
        """Whether the phase's coefficients are made zero at rest (`zero_at_rest`)."""
        free = phase == "stress" and self.hyperparameters["free_at_rest"]
        return free and _layered(self.fields[phase].network)

    @override
    @torch.no_grad()
    def encode(self, x: Tensor) -> Tensor:
        self.check_frames(x)
        field = self.fields["deformation"]
        origin = self.X + field.mean
        rows = (field.modes[..., : self.latent_dim].double() / field.leading).flatten(0, 1)
        blocks = x.split(max(1, ENCODED_ENTRIES // origin.numel()))
        return torch.cat([coordinates((block.to(origin) - origin).flatten(1), rows) for block in blocks])

    @override
    @torch.no_grad()
    def restrict(self, particles=None, X=None, dtype=torch.float64, device="cpu") -> ModalRestriction:
        rows, points = self.points(particles, X)
        points = points.to(self.X.device)
        like = torch.empty(0, dtype=dtype, device=device)
        # Made where needed: those of many members are large, and most callers take that of x alone.
        network = functools.cache(lambda phase: self._deployed(phase, like))
        local = functools.cache(lambda: interpolation(points.to(device), self.X.to(device)))
        place = local().value if rows is None else (lambda values: values[rows])
        fields = PlacedFields(
            lambda phase: self.fields[phase].at(
                place, points if phase == "deformation" else 0, network(phase), like
            )
        )

        def gradient() -> RestrictedField:
            base = torch.eye(3, dtype=points.dtype, device=points.device).flatten()
            return self.fields["deformation"].at(
                lambda values: _slope(local(), values), base, network("deformation"), like
            )

        takes_parameters = self.takes_parameters("stress")
        return ModalRestriction(fields, gradient, self.latent_dim, takes_parameters, self.takes_rate)

    @torch.no_grad()
    def factors(self, name: str, particles, dtype: torch.dtype, device: torch.device | str) -> ModalFactors:
        """A field at particles as its factors, which a restriction multiplies out.

        Args:
            name: `deformation`, `stress`, `affine`, or `gradient` for ∂g/∂X, whose coefficients are the
                deformation's.
            particles: [n] indices.
            dtype, device: of the mean and the network.
        """
        rows, points = self.points(particles, None)
        like = torch.empty(0, dtype=dtype, device=device)
        phase = "deformation" if name == "gradient" else name
        field = self.fields[phase]
        if name == "gradient":
            base = torch.eye(3, dtype=points.dtype, device=points.device).flatten()
            mean, table = self._slopes(device)
        else:
            base = points if name == "deformation" else 0
            mean, table = field.mean, field.modes
        network, scale = self._deployed(phase, like), float(field.scale)
        members = self.hyperparameters["members"] * (2 if self.frees(phase) else 1)
        mean = (base + mean[rows]).to(like)
        return ModalFactors(mean, table, rows, field.leading, scale, network, members, field.rates)

    def _slopes(self, device: torch.device | str) -> tuple[Tensor, Tensor]:
        """∂/∂X of the deformation's mean [P, 9] and of its modes [P, 9, K], in fp32, at the particles.

        Computed on `device`, once: every solver of the baseline takes them.
        """
        if self._particle_slopes is None:
            field, X = self.fields["deformation"], self.X.to(device)
            local = interpolation(X, X)
            mean, modes = (_slope(local, values.to(device)) for values in (field.mean, field.modes))
            self._particle_slopes = mean, modes.float()
        self._particle_slopes = tuple(values.to(self.X.device) for values in self._particle_slopes)
        return self._particle_slopes

    def _deployed(self, phase: str, like: Tensor) -> FullyConnected | None:
        """The phase's network from (xhat, μ) to coefficients in the field's unit."""
        field = self.fields[phase]
        if field.network is None:
            return None
        inputs = self.standardisation(phase, torch.zeros_like(self.spread), self.spread)
        scale, dtype = field.output_scale, torch.float64 if self.frees(phase) else like.dtype
        network = field.network.in_raw_units(*inputs, torch.zeros_like(scale), scale, dtype, self.X.device)
        if self.frees(phase):
            noise = max(self.hyperparameters["noise"], _LEAST_NOISE)
            reach = _REACH * (noise**2 + self.floor.square()).sqrt()
            members = self.hyperparameters["members"]
            network = zero_at_rest(network, members, self.rest_latent, reach)
        return network.to(like)
