"""`field=mlp`: the paper's encoder and three multilayer perceptrons (section 4 and its appendices)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from nsf.data import Snapshots, Standardizer
from nsf.errors import ConfigError
from nsf.kinematics.fields.encoder import Encoder
from nsf.kinematics.fields.networks import ARITHMETIC, FullyConnected, TensorCores
from nsf.kinematics.manifold import Manifold, Restriction, identity
from nsf.kinematics.training.phases import PHASES, TARGETS, Fit, joined, per_phase, shaped

HIDDEN_LAYERS = 5
ENCODED_POINTS = 1 << 22  # particles of whole frames encoded at once
ACTIVATION_BYTES = 1 << 30  # of one layer, when many latents are evaluated at once


@dataclass(frozen=True)
class MlpField:
    """The paper's networks to the letter.

    Attributes:
        beta: β, the hidden layers' width over d (3, 6, 9 for g, h, l): one for all, [g, h=l] or [g, h, l].
        stress_parameters: h depends on the problem parameters too, for scenes whose μ enters the return map
            (section 4.5, last paragraph).
        arithmetic: of h and l where they are deployed on a GPU (`MlpManifold.arithmetic`); training does not
            depend on it.
        affine: `latent` alone, the paper's l(X, x̂).

    Source: Zong et al. 2023, section 4.5, appendices "Training Details" and "Network architecture", table 1.
    """

    shardable: ClassVar[bool] = True

    beta: int | Sequence[int] = (48, 72, 72)
    stress_parameters: bool = False
    arithmetic: str | None = "tf32"
    affine: str = "latent"

    def __post_init__(self) -> None:
        per_phase("beta", self.beta)
        if self.affine != "latent":
            raise ConfigError(
                f"field.affine={self.affine}: C of field=mlp is a function of the latent vector alone; "
                "choose field.affine=latent, or field=basis or joint"
            )
        if self.arithmetic not in (None, *ARITHMETIC):
            known = ", ".join(ARITHMETIC)
            raise ConfigError(f"field.arithmetic={self.arithmetic} is unknown; choose {known} or null")

    def prepare(self, snapshots: Snapshots, latent_dim: int) -> dict[str, Any]:
        """What the snapshots determine before training: mean and deviation of X, x, tau and C."""
        standard = {name: Standardizer.of(snapshots, name) for name, _ in TARGETS.values()}
        standard["X"] = Standardizer.fit([snapshots.X])
        return {name: [s.mean.cpu(), s.std.cpu()] for name, s in standard.items()}

    def build(
        self, snapshots: Snapshots, prepared: dict[str, Any], latent_dim: int, generator: torch.Generator
    ) -> MlpManifold:
        """The manifold with untrained networks drawn from `generator`."""
        hyperparameters = {
            "particles": snapshots.P,
            "frames": snapshots.M,
            "beta": list(per_phase("beta", self.beta)),
            "stress_parameters": self.stress_parameters,
        }
        manifold = MlpManifold(
            latent_dim, snapshots.x_sha256, list(snapshots.parameter_names), hyperparameters
        )
        manifold.describe(snapshots)
        for name, (mean, std) in prepared.items():
            manifold.standard[name] = Standardizer(mean, std)
        manifold.encoder.initialise(generator)
        for decoder in manifold.decoders.values():
            decoder.initialise(generator)
        return manifold

    def fits(self, manifold: MlpManifold, snapshots: Snapshots, prepared: dict[str, Any]) -> Iterator[Fit]:
        """Step 1: g and e together; steps 2 and 3: h and l on the latents of the trained encoder.

        Every target is standardised, so each loss is the mean squared error over its variance.
        """
        standard, decoders = manifold.standard, manifold.decoders

        def deformation(rows, particles, generator):
            x = standard["x"](snapshots.gather("x", rows, slice(None)))
            xhat = manifold.encoder(x)
            return error("deformation", xhat, particles, x[:, particles])

        def decoded(phase):
            name = TARGETS[phase][0]
            latents = manifold.decoder_latents(phase)[snapshots.rows]

            def loss(rows, particles, generator):
                values = standard[name](snapshots.gather(name, rows, particles))
                return error(phase, latents[rows], particles, values)

            return loss

        def error(phase, latents, particles, values):
            X = standard["X"](manifold.X[particles].float())
            predicted = decoders[phase](pair(X, latents))
            return (predicted.float() - values).square().mean()

        both = nn.ModuleList([manifold.encoder, decoders["deformation"]])
        yield Fit("deformation", both, deformation, pointwise=True)
        manifold.encode_training(snapshots.whole)
        for phase in PHASES[1:]:
            yield Fit(phase, decoders[phase], decoded(phase), pointwise=True)


def pair(X: Tensor, latents: Tensor) -> Tensor:
    """Every point [n, 3] with every latent [F, r]: [F, n, 3 + r]."""
    F, n = latents.shape[0], X.shape[0]
    return torch.cat([X.expand(F, n, X.shape[1]), latents[:, None].expand(F, n, latents.shape[1])], -1)


class MlpManifold(Manifold):
    """Encoder and decoders with the standardisation of their inputs and outputs.

    Attributes:
        arithmetic: of h and l where they are deployed on a GPU, whose own errors are far larger: a key of
            `networks.ARITHMETIC`, or None for that of g, which is the type asked for.
    """

    arithmetic: str | None = None

    def __init__(self, latent_dim, x_sha256, parameter_names, hyperparameters):
        super().__init__(latent_dim, x_sha256, parameter_names, hyperparameters)
        self.encoder = Encoder(hyperparameters["particles"], latent_dim)
        beta = dict(zip(PHASES, hyperparameters["beta"], strict=True))
        self.decoders = nn.ModuleDict()
        for phase, (_, d) in TARGETS.items():
            inputs = 3 + latent_dim + (len(self.parameter_names) if self._has_parameters(phase) else 0)
            widths = (inputs, *[beta[phase] * d] * HIDDEN_LAYERS, d)
            self.decoders[phase] = FullyConnected(widths, "elu")
        self.standard = nn.ModuleDict(
            {"X": identity(3), **{name: identity(d) for name, d in TARGETS.values()}}
        )

    def _has_parameters(self, phase: str) -> bool:
        return phase == "stress" and self.hyperparameters["stress_parameters"]

    def decoder_latents(self, phase: str) -> Tensor:
        """Training latents as the phase's decoder takes them: with standardised μ if it depends on μ."""
        inputs = [self.training_latents.float()]
        if self._has_parameters(phase):
            inputs.append(self.standard_parameters(self.training_parameters.float()))
        return torch.cat(inputs, -1)

    @torch.no_grad()
    def encode_training(self, snapshots: Snapshots) -> None:
        """Fill `training_latents` with the encoder as it is."""
        for rows in torch.arange(snapshots.M).split(self._frames_at_once()):
            block = slice(int(rows[0]), int(rows[-1]) + 1)
            self.training_latents[block] = self.encode(snapshots.gather("x", block, slice(None)))

    def _frames_at_once(self) -> int:
        return max(1, ENCODED_POINTS // self.X.shape[0])

    @override
    @torch.no_grad()
    def encode(self, x: Tensor, tau: Tensor | None = None) -> Tensor:
        self.check_frames(x)
        frames = (frames.to(self.X.device).float() for frames in x.split(self._frames_at_once()))
        return torch.cat([self.encoder(self.standard["x"](frame)).double() for frame in frames])

    @override
    def restrict(self, particles=None, X=None, dtype=torch.float64, device="cpu") -> MlpRestriction:
        _, points = self.points(particles, X)
        return MlpRestriction(
            points.to(dtype=dtype, device=device),
            {phase: self._deployed(phase, dtype, device) for phase in PHASES},
            self._has_parameters("stress"),
            self.latent_dim,
        )

    def _deployed(self, phase: str, dtype: torch.dtype, device: torch.device | str) -> nn.Module:
        """The decoder from (X [m], xhat, μ) to the field in its own unit."""
        X, parameters, values = self.standard["X"], self.standard_parameters, self.standard[TARGETS[phase][0]]
        latent = torch.zeros(self.latent_dim, device=X.mean.device)
        mean, std = [X.mean, latent], [X.std, latent + 1]
        if self._has_parameters(phase):
            mean, std = [*mean, parameters.mean], [*std, parameters.std]
        raw = self.decoders[phase].in_raw_units(
            torch.cat(mean), torch.cat(std), values.mean, values.std, dtype, device
        )
        exact = phase == "deformation" or self.arithmetic is None or torch.device(device).type != "cuda"
        return raw if exact else TensorCores(raw, self.arithmetic)


class MlpRestriction(Restriction):
    """The three decoders at points X [n, 3]; they take and give raw units."""

    def __init__(self, X: Tensor, decoders: dict[str, nn.Module], takes_parameters: bool, latent_dim: int):
        self.X, self.decoders, self.latent_dim = X, decoders, latent_dim
        self.points, self.dtype, self.device = X.shape[0], X.dtype, X.device
        inputs = torch.eye(3 + latent_dim, dtype=X.dtype, device=X.device)
        self._along_X, self._along_xhat = inputs[:3], inputs[3:]
        self._takes_parameters = takes_parameters

    @override
    def position(self, xhat):
        return self._decode("deformation", xhat)

    @override
    def position_and_jacobian(self, xhat):
        return self._derive(xhat, self._along_xhat)

    @override
    def deformation_gradient(self, xhat):
        return self._derive(xhat, self._along_X)[1]

    @override
    def stress(self, xhat, parameters):
        if self._takes_parameters:
            xhat = joined(xhat, parameters)
        return self._decode("stress", xhat)

    @override
    def affine(self, xhat, parameters, rate=None):
        return self._decode("affine", xhat).unflatten(-1, (3, 3))

    @override
    def module(self, phase):
        return PointModule(self.decoders[phase], phase, phase == "stress" and self._takes_parameters)

    @override
    def subset(self, rows):
        return MlpRestriction(self.X[rows], self.decoders, self._takes_parameters, self.latent_dim)

    def _decode(self, phase: str, latents: Tensor) -> Tensor:
        decoder = self.decoders[phase]
        parts = self._parts(latents, decoder.width)
        values = torch.cat([decoder(pair(self.X, part)) for part in parts])
        return values if latents.ndim == 2 else values[0]

    def _derive(self, xhat: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """g and its derivatives along some inputs, the last axis of the result."""
        decoder = self.decoders["deformation"]
        parts = self._parts(xhat, decoder.width * len(directions))
        pairs = [decoder.forward_and_tangents(pair(self.X, part), directions) for part in parts]
        x, derivatives = (torch.cat(values) for values in zip(*pairs, strict=True))
        derivatives = derivatives.transpose(-1, -2)
        return (x, derivatives) if xhat.ndim == 2 else (x[0], derivatives[0])

    def _parts(self, latents: Tensor, width: int) -> tuple[Tensor, ...]:
        """The batch of latents in parts whose activations fit in memory."""
        latents = latents.to(self.dtype).reshape(-1, latents.shape[-1])
        size = self.points * width * self.dtype.itemsize
        return latents.split(max(1, ACTIVATION_BYTES // max(1, size)))


class PointModule(nn.Module):
    """A decoder as a module: a function of the points too."""

    def __init__(self, decoder: FullyConnected, phase: str, takes_parameters: bool):
        super().__init__()
        self.decoder, self.phase, self.takes_parameters = decoder, phase, takes_parameters

    @override
    def forward(self, X: Tensor, xhat: Tensor, parameters: Tensor) -> Tensor:
        latents = joined(xhat, parameters) if self.takes_parameters else xhat
        return shaped(self.phase, self.decoder(pair(X, latents)))
