"""`field=mlp`: the paper's encoder and three multilayer perceptrons (section 4 and its appendices).

    g(X, x̂) = X + g_θ(X, x̂),   h(X, x̂, μ) = h_θ(w(X), x̂, μ),   l likewise

w(X) is X with sines and cosines of it (`Waves`). The paper's layers, widths and activations. In place of its
hours of training g learns displacements, h and l see waves of X and the problem parameters, and x̂ has noise
in training and, once g is trained, principal axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from nsf.data import Snapshots, Standardizer
from nsf.errors import ConfigError
from nsf.kinematics.fields.decoders import MlpRestriction, Waves, pair
from nsf.kinematics.fields.encoder import Encoder
from nsf.kinematics.fields.networks import ARITHMETIC, FullyConnected, TensorCores
from nsf.kinematics.manifold import Manifold, identity
from nsf.kinematics.training.phases import PHASES, TARGETS, Fit, per_phase
from nsf.scalars import number
from nsf.schemas import Number
from nsf.vectors import spaced

HIDDEN_LAYERS = 5
MOST_OCTAVES = 7  # the last one's waves are as short as the gaps of 64 particles across a body
_LEAST = 1e-9  # of what is usual, by which to divide: a coordinate may move nothing, and values may be zero
_PROBED = 512  # particles and frames of which means over all are taken
ENCODED_POINTS = 1 << 22  # particles of whole frames encoded at once


@dataclass(frozen=True)
class MlpField:
    """The paper's networks.

    Attributes:
        beta: β, the hidden layers' width over d (3, 6, 9 for g, h, l): one for all, [g, h=l] or [g, h, l].
        octaves: of the waves of X that h and l see beside X; 0 is the paper's.
        noise, noise_floor: of x̂ in training, as of `BasisField`, where σ_k is the deviation of the
            displacement [m] by coordinate k, RMS over particles; while g is trained, noise alone, in
            deviations of the batch's x̂, and none for a batch of one frame.
        tangent: weight of the squared error of displacements from a frame to the next, over their mean
            square, beside that of displacements, while g is trained; 0 is the paper's.
        evenness: e; while h and l are trained a frame counts 1/(1 + e m), m the mean square of its
            standardised values over that of all frames, so that frames of little stress are learned too; 0 is
            the paper's.
        head_parameters: h and l see the (standardised) problem parameters; in the paper h does where μ enters
            the return map (section 4.5, last paragraph).
        arithmetic: of h and l where they are deployed on a GPU (`MlpManifold.arithmetic`); training does not
            depend on it.
        affine: `latent` alone: C does not depend on dx̂/dt.

    Source: Zong et al. 2023, section 4.5, appendices "Training Details" and "Network architecture", table 1.
    """

    beta: int | Sequence[int] = (48, 72, 72)
    octaves: int = 4
    noise: float = 0.003
    noise_floor: float = 0.003
    tangent: float = 1.0
    evenness: float = 3.0
    head_parameters: bool = True
    arithmetic: str | None = "tf32"
    affine: str = "latent"

    def __post_init__(self) -> None:
        per_phase("beta", self.beta)
        number("octaves", self.octaves, 0, whole=True, most=MOST_OCTAVES)
        for key in ("noise", "noise_floor", "tangent", "evenness"):
            number(key, getattr(self, key), 0)
        if self.affine != "latent":
            raise ConfigError(
                f"field.affine={self.affine}: C of field=mlp does not depend on the latent vector's rate; "
                "choose field.affine=latent, or field=basis"
            )
        if self.arithmetic not in (None, *ARITHMETIC):
            choices = ", ".join(ARITHMETIC)
            raise ConfigError(f"field.arithmetic={self.arithmetic} is unknown; choose {choices} or null")

    def prepare(self, snapshots: Snapshots, latent_dim: int) -> dict[str, Any]:
        """Mean and deviation of X, displacements, tau and C over the snapshots."""
        standard = {name: Standardizer.of(snapshots, name) for name in ("tau", "C")}
        standard["X"] = Standardizer.fit([snapshots.X])
        moved = Standardizer.of(snapshots, "x", origin=snapshots.X)
        # A metre counts as much along each axis, though the body may hardly move along one.
        standard["x"] = Standardizer(moved.mean, moved.std.square().mean().sqrt().expand(3))
        return {name: [s.mean.cpu(), s.std.cpu()] for name, s in standard.items()}

    def build(
        self, snapshots: Snapshots, prepared: dict[str, Any], latent_dim: int, generator: torch.Generator
    ) -> MlpManifold:
        """The manifold with untrained networks drawn from `generator`."""
        hyperparameters = {
            "particles": snapshots.P,
            "frames": snapshots.M,
            "beta": list(per_phase("beta", self.beta)),
            "octaves": self.octaves,
            "head_parameters": self.head_parameters,
        }
        manifold = MlpManifold(
            latent_dim, snapshots.x_sha256, list(snapshots.parameter_names), hyperparameters
        )
        manifold.describe(snapshots)
        for name in manifold.standard:
            manifold.standard[name] = Standardizer(*prepared[name])
        manifold.encoder.initialise(generator)
        for decoder in manifold.decoders.values():
            decoder.initialise(generator)
        return manifold

    def fits(self, manifold: MlpManifold, snapshots: Snapshots, prepared: dict[str, Any]) -> Iterator[Fit]:
        """Step 1: g and e together; steps 2 and 3: h and l on the latents of the trained encoder.

        Every target is standardised, so a loss is the mean squared error over its variance. g's has the
        tangent's besides, and frames of h and l have weights (`evenness`).
        """
        losses = _Losses(self, manifold, snapshots)
        autoencoder = nn.ModuleList([manifold.encoder, manifold.decoders["deformation"]])
        yield Fit("deformation", autoencoder, losses.deformation, pointwise=True, fine=True)
        manifold.encode_training(snapshots)
        share = manifold.turn(self.noise_floor)
        manifold.encode_training(snapshots)
        for phase in PHASES[1:]:
            yield Fit(phase, manifold.decoders[phase], losses.head(phase, share), pointwise=True)


class _Losses:
    """The losses of the phases of `field=mlp`.

    Args:
        field, manifold, snapshots: as of `MlpField.fits`.
    """

    def __init__(self, field: MlpField, manifold: MlpManifold, snapshots: Snapshots):
        self.field, self.manifold, self.snapshots = field, manifold, snapshots
        self.X, self.standard = manifold.X.float(), manifold.standard
        waves = {phase: manifold.inputs(phase, self.X)[:, 3:] for phase in PHASES}
        self.places = {phase: torch.cat([self.standard["X"](self.X), w], 1) for phase, w in waves.items()}
        self.pace = self._pace()

    def deformation(self, rows: Tensor, particles: Tensor, generator: torch.Generator) -> Tensor:
        """Of displacements, and of those from a frame to the next (`MlpField.tangent`)."""
        now = self._displaced(rows)
        xhat = self.manifold.encoder(now)
        drawn = torch.randn(xhat.shape, generator=generator, device=xhat.device)
        noisy = xhat + self.field.noise * xhat.detach().std(0, correction=0) * drawn
        decoded = self._decode("deformation", particles, noisy)
        loss = (decoded - now[:, particles]).square().mean()
        if self.field.tangent:
            frame, trajectory = self.snapshots.frame, self.snapshots.trajectory
            later = (rows + 1).clamp(max=self.snapshots.M - 1)
            goes_on = (trajectory[later] == trajectory[rows]) & (frame[later] > frame[rows])
            then = self._displaced(later)
            moved = (
                self._decode("deformation", particles, noisy + self.manifold.encoder(then) - xhat) - decoded
            )
            errors = (moved - (then - now)[:, particles]).square().mean((1, 2))
            loss = loss + self.field.tangent / self.pace * (goes_on * errors).mean()
        return loss

    def head(self, phase: str, share: Tensor) -> Callable[..., Tensor]:
        """Of h or l; `share` as `MlpManifold.turn` gives it."""
        (name, _), r = TARGETS[phase], self.manifold.latent_dim
        latents, scale = self.manifold.decoder_latents(phase), self.standard[name]
        noise = (self.field.noise**2 * share.square() + 1 - share.square()).sqrt().float()
        weights = self._weights(scale(self._few(name)))

        def loss(rows: Tensor, particles: Tensor, generator: torch.Generator) -> Tensor:
            values = scale(self.snapshots.gather(name, rows, particles))
            xhat, mu = latents[rows].tensor_split([r], 1)
            drawn = noise * torch.randn(xhat.shape, generator=generator, device=xhat.device)
            decoded = self._decode(phase, particles, torch.cat([xhat + drawn, mu], 1))
            return (weights[rows] * (decoded - values).square().mean((1, 2))).mean()

        return loss

    def _displaced(self, rows: Tensor) -> Tensor:
        """Standardised displacements [F, P, 3] of whole frames."""
        return self.standard["x"](self.snapshots.gather("x", rows, slice(None)) - self.X)

    def _decode(self, phase: str, particles: Tensor | slice, latents: Tensor) -> Tensor:
        return self.manifold.decoders[phase](pair(self.places[phase][particles], latents)).float()

    def _few(self, name: str) -> Tensor:
        """A field of the snapshots at some particles, [M, n, d]."""
        return self.snapshots.slab(name, spaced(self.snapshots.P, _PROBED))

    def _weights(self, values: Tensor) -> Tensor:
        """Weight [M] of each frame of standardised values [M, n, d], in the mean 1."""
        squares = values.square().mean((1, 2))
        weights = 1.0 / (1.0 + self.field.evenness * squares / squares.mean().clamp(min=_LEAST))
        return weights / weights.mean()

    def _pace(self) -> float:
        """Mean square of standardised displacements from a frame to the next; 1 if none moves."""
        trajectory, frame = self.snapshots.trajectory, self.snapshots.frame
        goes_on = (torch.diff(trajectory) == 0) & (torch.diff(frame) > 0)
        steps = torch.diff(self._few("x"), dim=0)[goes_on] / self.standard["x"].std
        return float(steps.square().mean()) or 1.0 if len(steps) else 1.0


class MlpManifold(Manifold):
    """Encoder and decoders with the standardisation of their inputs and outputs.

    Attributes:
        arithmetic: of h and l where they are deployed on a GPU, whose own errors are far larger: a key of
            `networks.ARITHMETIC`, or None for that of g, the `dtype` of the restriction.
    """

    HYPERPARAMETERS: ClassVar[Mapping] = {
        **Manifold.HYPERPARAMETERS,
        "octaves": Number(0, MOST_OCTAVES, whole=True),
    }

    arithmetic: str | None = None

    def __init__(self, latent_dim, x_sha256, parameter_names, hyperparameters):
        super().__init__(latent_dim, x_sha256, parameter_names, hyperparameters)
        self.encoder = Encoder(hyperparameters["particles"], latent_dim)
        beta = dict(zip(PHASES, hyperparameters["beta"], strict=True))
        self.decoders = nn.ModuleDict()
        for phase, (_, d) in TARGETS.items():
            inputs = 3 + 6 * self._octaves(phase) + latent_dim
            inputs += len(self.parameter_names) if self.takes_parameters(phase) else 0
            widths = (inputs, *[beta[phase] * d] * HIDDEN_LAYERS, d)
            self.decoders[phase] = FullyConnected(widths, "elu")
        self.standard = nn.ModuleDict(
            {"X": identity(3), **{name: identity(d) for name, d in TARGETS.values()}}
        )

    def _octaves(self, phase: str) -> int:
        return 0 if phase == "deformation" else self.hyperparameters["octaves"]

    @property
    def waves(self) -> Waves:
        """The waves of X that h and l see."""
        return Waves(self.standard["X"].mean, self.standard["X"].std, self.hyperparameters["octaves"])

    def inputs(self, phase: str, X: Tensor) -> Tensor:
        """X [n, 3] m and, of h and l, its waves."""
        return self.waves(X) if self._octaves(phase) else X

    def decoder_latents(self, phase: str) -> Tensor:
        """Training latents as the phase's decoder takes them: with standardised μ if it depends on μ."""
        inputs = [self.training_latents.float()]
        if self.takes_parameters(phase):
            inputs.append(self.standard_parameters(self.training_parameters.float()))
        return torch.cat(inputs, -1)

    @torch.no_grad()
    def turn(self, floor: float) -> Tensor:
        """Turn the latent space to its principal axes, as displacements; g(X, e(x)) stays as it is.

        Over the training snapshots, coordinates of the turned space do not correlate, and the mean of JᵀJ,
        J = ∂g/∂x̂ at particles, is diagonal: they move particles independently, the first one the farthest.
        The unit of the k-th is √(σ_k² + (ε σ_1)²), with σ_k [m] the deviation of the displacement by it, RMS
        over particles. Weights are fp32, so encode the training snapshots again afterwards. Not in the paper.

        Args:
            floor: ε.

        Returns:
            [r] σ_k over its unit.
        """
        xhat = self.training_latents
        mean = xhat.mean(0)
        covariance = (xhat - mean).T @ (xhat - mean) / len(xhat)
        root = torch.linalg.cholesky(self._metric())
        squares, axes = torch.linalg.eigh(root.T @ covariance @ root)
        sigma = squares.flip(0).clamp(min=0).sqrt()
        unit = (sigma.square() + (max(floor, _LEAST) * sigma[0]).square()).sqrt()
        unit = torch.where(unit > 0, unit, 1.0)
        back = torch.linalg.solve(root.T, axes.flip(1)) * unit  # x̂ = mean + back x̂'
        back *= torch.where(back.sum(0) < 0, -1.0, 1.0)  # an axis has two directions; always the same one
        last, first = self.encoder.linear[-1], self.decoders["deformation"].layers[0]
        along = first.weight[:, 3:].double()
        first.bias.add_(along @ mean)
        first.weight[:, 3:] = (along @ back).float()
        weight, bias = last.weight.double(), last.bias.double()
        last.weight.copy_(torch.linalg.solve(back, weight))
        last.bias.copy_(torch.linalg.solve(back, bias - mean))
        return sigma / unit

    def _metric(self) -> Tensor:
        """Mean of JᵀJ [r, r] m² over particles and training snapshots, positive definite."""
        at = self.restrict(torch.as_tensor(spaced(len(self.X), _PROBED)), device=self.X.device)
        rows = torch.as_tensor(spaced(len(self.training_latents), _PROBED))
        jacobians = (at.position_and_jacobian(xhat)[1] for xhat in self.training_latents[rows])
        metric = sum(torch.einsum("ncj,nck->jk", J, J) for J in jacobians) / (at.points * len(rows))
        least = _LEAST**2 * metric.trace().clamp(min=_LEAST)  # a coordinate may move nothing
        return metric + least * torch.eye(len(metric)).to(metric)

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
    def encode(self, x: Tensor) -> Tensor:
        self.check_frames(x)
        X = self.X.float()
        frames = (frames.to(X) - X for frames in x.split(self._frames_at_once()))
        return torch.cat([self.encoder(self.standard["x"](frame)).double() for frame in frames])

    @override
    def restrict(self, particles=None, X=None, dtype=torch.float64, device="cpu") -> MlpRestriction:
        _, points = self.points(particles, X)
        points = points.to(dtype=dtype, device=device)
        waved = self.waves(points) if self.hyperparameters["octaves"] else points
        return MlpRestriction(
            {phase: points if phase == "deformation" else waved for phase in PHASES},
            {phase: self._deployed(phase, dtype, device) for phase in PHASES},
            self.waves,
            self.hyperparameters["head_parameters"],
            self.latent_dim,
        )

    def _deployed(self, phase: str, dtype: torch.dtype, device: torch.device | str) -> nn.Module:
        """The decoder from (X [m] and its waves, xhat, μ) to displacement, tau or C in their own unit."""
        X, values = self.standard["X"], self.standard[TARGETS[phase][0]]
        plain = X.mean.new_zeros(6 * self._octaves(phase) + self.latent_dim)
        inputs = self.standardisation(phase, torch.cat([X.mean, plain]), torch.cat([X.std, plain + 1]))
        raw = self.decoders[phase].in_raw_units(*inputs, values.mean, values.std, dtype, device)
        exact = phase == "deformation" or self.arithmetic is None or torch.device(device).type != "cuda"
        return raw if exact else TensorCores(raw, self.arithmetic)
