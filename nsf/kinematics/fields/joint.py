"""`field=joint`: the modes of `basis` with a latent vector that encodes positions and stress together.

A latent vector of positions alone is one of shapes: where the same shape is met with different stresses, as
in loading and unloading, no h(X, xhat) tells them apart. Here xhat are the leading coefficients of the joint
snapshots

    [ (x − x̄)/s_x ; √w τ/s_τ ],    s² the mean square of each part, summed over particles,

over their root mean square. As before, g(X, xhat) is linear in xhat plus a closure: its leading modes are the
parts of the joint modes that are displacements, and the closure's those of the displacements they leave out.
So the inversion is as before, r unknowns and 3|S| equations; but a direction of xhat that is mostly stress
moves few particles, and is told by positions as badly as it moves them. At small scale that outweighs the
gain: on metal and bread the stress of encoded frames comes out nearer than with `basis`, and reduced runs
on these and on sand end further off (experiments/path_dependent.yaml).

Source: an answer to the future work of Zong et al. 2023, a path-dependent latent space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from nsf.data import Snapshots
from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.fields import pod
from nsf.kinematics.fields.basis import BasisField, BasisManifold, coefficients
from nsf.kinematics.training.phases import TARGETS, per_phase

_PHASES = ("deformation", "stress")  # whose fields x̂ encodes


@dataclass(frozen=True)
class JointField(BasisField):
    """Modes, their networks, and what stress weighs in the latent vector.

    Attributes:
        stress_weight: w of the mean square of stress in a joint snapshot, where that of displacements
            from their mean is one.
            Small, as the inversion sees positions alone: the more stress weighs, the less they tell of xhat.

    Raises:
        ConfigError: stress_weight is not positive.
    """

    stress_weight: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stress_weight > 0:
            raise ConfigError(
                f"field.stress_weight={self.stress_weight} must be positive; or use field=basis"
            )

    @property
    @override
    def manifold(self) -> type[JointManifold]:
        return JointManifold

    @override
    def prepare(self, snapshots: Snapshots, latent_dim: int) -> dict[str, Any]:
        """As of `basis`, but for the coefficients of x: first those of the joint snapshots.

        Raises:
            ConfigError: as there, or the snapshots do not move or bear no stress.
        """
        prepared = super().prepare(snapshots, latent_dim)
        grams = {name: pod.gram(snapshots, name, d) for name, d in map(TARGETS.get, _PHASES)}
        energies = {name: float(gram.diagonal().sum()) for name, gram in grams.items()}
        of_none = {"x": "the same", "tau": "zero"}
        for name, energy in energies.items():
            if not energy > 0:
                raise ConfigError(f"{name} is {of_none[name]} in every snapshot; field=joint needs more")
        weights = {"x": 1 / energies["x"], "tau": self.stress_weight / energies["tau"]}
        latent = pod.leading(sum(weights[name] * gram for name, gram in grams.items()), latent_dim)
        # What displacements are left beside those that go with the latents.
        Q = latent / latent.square().sum(0).sqrt()
        left = grams["x"] - Q @ (Q.T @ grams["x"])
        left = left - (left @ Q) @ Q.T
        closed = pod.leading((left + left.T) / 2, per_phase("modes", self.modes)[0] - latent_dim)
        unresolved = max(0.0, float(left.diagonal().sum() - closed.square().sum()) / energies["x"])
        prepared["x"] = {"coefficients": torch.cat([latent, closed], 1).cpu(), "unresolved": unresolved}
        prepared["weights"] = weights
        return prepared

    @override
    def build(
        self, snapshots: Snapshots, prepared: dict[str, Any], latent_dim: int, generator: torch.Generator
    ) -> JointManifold:
        """The manifold with its modes and its encoder, and untrained networks."""
        manifold = super().build(snapshots, prepared, latent_dim, generator)
        latent = prepared["x"]["coefficients"][:, :latent_dim].to(snapshots.X.device)
        scale = manifold.fields["deformation"].leading
        for encoder, (name, components) in zip(
            (manifold.of_x, manifold.of_tau), map(TARGETS.get, _PHASES), strict=True
        ):
            for particles, _, modes in pod.modes(snapshots, name, components, latent):
                encoder[particles] = (modes * (prepared["weights"][name] / scale.to(modes))).float()
        return manifold


class JointManifold(BasisManifold):
    """Modal fields whose latent vector is of positions and stress.

    Attributes:
        of_x: [P, 3, r] 1/m, of_tau: [P, 6, r] 1/Pa: x̂ is the sum of their products with the deviations.
    """

    def __init__(self, latent_dim, x_sha256, parameter_names, hyperparameters):
        super().__init__(latent_dim, x_sha256, parameter_names, hyperparameters)
        P = hyperparameters["particles"]
        self.register_buffer("of_x", torch.zeros(P, 3, latent_dim))
        self.register_buffer("of_tau", torch.zeros(P, 6, latent_dim))

    @override
    @torch.no_grad()
    def encode(self, x: Tensor, tau: Tensor | None = None) -> Tensor:
        self.check_frames(x)
        if tau is None or tau.shape != (*x.shape[:2], 6):
            found = None if tau is None else tuple(tau.shape)
            raise ShapeError(
                f"stress has shape {found}; field=joint encodes it with the positions: "
                f"pass tau {(*x.shape[:2], 6)}"
            )
        origin = self.X + self.fields["deformation"].mean
        stress = self.fields["stress"].mean
        return coefficients(x, origin, self.of_x) + coefficients(tau, stress, self.of_tau)
