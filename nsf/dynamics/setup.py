"""A reduced run before its first step: fields, scene, sample and start, checked and on the device."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from nsf.data import hash_of_positions
from nsf.dynamics.inference import AffineSource, Decoder, StressSource
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.dynamics.projection import GaussNewton, Taylor, check_projector
from nsf.dynamics.sources import Sources
from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.manifold import Restriction
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device
from nsf.sampling.sampler import SampleSpan, check_well_posed


class Setup:
    """The inputs of a reduced run: fields, scene, sample, start, and how steps are taken.

    Args:
        manifold: trained fields.
        scene: the scene at its problem parameters.
        samples: sample particles by span of time.
        parameters: problem parameters by name.
        sources: where τ and C come from; the paper's fields by default.
        projector: `GaussNewton`, `Taylor`, or a class of the user with the members of `Projector`.
        integration: how N is found.
        precision: `fp64` or `fp32`.
        device: `cpu`, `cuda`, `cuda:N` or `auto`.
        dt_multiplier: deployment step in units of the scene's Δt (paper section 6.1: 1.5).
        sets: particle sets of each span, those of an earlier run of the same manifold and samples; searched
            for when None.
        xhat: [r] latent vector at t = 0; that of the undeformed body without stress when None.
        velocity: [P, 3] initial velocity [m/s]; the scene's when None.

    Attributes:
        dt, total_steps: step [s] and number of steps to the end of the scene.
        starts: step with which each span begins; values: the problem parameters by name.
        constants: every particle of the scene; initial_velocity: [P, 3] theirs [m/s], on the host.
        gravity: over the run, as the scene's programs have it.
        xhat: [r] x̂_0; parameters: [n_parameters] μ; both on the device.

    Raises:
        ProjectionError: |S| < r/3.
        SchemaError: the manifold was trained for other particles.
        ShapeError: xhat or velocity has another shape.
        ConfigError, DeviceError: a value, a projector or a device is refused.
    """

    def __init__(
        self,
        manifold,
        scene,
        samples: Sequence[SampleSpan],
        parameters: Mapping[str, float],
        sources: Sources = Sources(),
        projector: GaussNewton | Taylor = GaussNewton(),
        integration: Integration = Integration(),
        precision: str = "fp64",
        device: str = "auto",
        dt_multiplier: float = 1.0,
        sets: Sequence[ParticleSets] | None = None,
        xhat: np.ndarray | None = None,
        velocity: np.ndarray | None = None,
    ):
        if not dt_multiplier > 0:
            raise ConfigError(f"dt_multiplier={dt_multiplier} must be positive")
        check_projector(projector)
        for sample in samples:
            check_well_posed(len(sample.particles), manifold.latent_dim)
        self.manifold, self.scene, self.sources, self.projector = manifold, scene, sources, projector
        self.integration, self.samples, self.values = integration, samples, dict(parameters)
        self.precision, self.device = precision_of(precision), warp_device(device)
        self.dtype, self.torch_device = torch_dtype(self.precision), torch_device(self.device)
        self.dt = scene.dt * dt_multiplier
        self.total_steps = reduced_steps(scene.steps, dt_multiplier)
        self.starts = [round(sample.start * self.total_steps) for sample in samples]
        self.geometry, self.transfer, self.gravity = scene.grid, scene.transfer, scene.acting_gravity
        self.constants = scene.particles()
        P = len(self.constants)
        manifold.check_particles(hash_of_positions(self.constants.X))
        self.search = NeighbourSearch(self.geometry, self.transfer.shape, self.precision, self.device)

        def tensor(values):
            return torch.as_tensor(np.asarray(values), dtype=self.dtype, device=self.torch_device)

        missing = [name for name in manifold.parameter_names if name not in parameters]
        if missing:
            raise ConfigError(
                f"parameters {dict(parameters)} lack {missing}, which the stress field was trained on"
            )
        self.parameters = tensor([parameters[name] for name in manifold.parameter_names])
        # On the host: a span takes the rows that it needs.
        velocity = _shaped("velocity", scene.initial_velocity() if velocity is None else velocity, (P, 3))
        self.initial_velocity = torch.as_tensor(velocity, dtype=self.dtype)
        if xhat is None:  # a scene begins undeformed
            X = torch.as_tensor(self.constants.X, device=manifold.X.device)
            xhat = manifold.encode(X[None])[0].cpu()
        self.xhat = tensor(_shaped("xhat", xhat, (manifold.latent_dim,)))
        self.sets = self._search_sets() if sets is None else list(sets)

    def _search_sets(self) -> list[ParticleSets]:
        """Particle sets of each span, over the training trajectories decoded from their latents."""
        P = len(self.constants)
        if self.integration.strategy == "search" or self.sources.carried:
            return [
                ParticleSets(s.particles, np.append(s.particles, np.delete(np.arange(P), s.particles)), None)
                for s in self.samples
            ]
        decoder = self.decoder()
        latents = self.manifold.training_latents.to(self.torch_device, self.dtype)
        fraction = self.manifold.training_times.to(self.torch_device) / (self.scene.dt * self.scene.steps)
        ends = [sample.start for sample in self.samples[1:]] + [1.0]
        # A span also meets the frames just before and after it.
        slack = 2.0 * self._frame_every() / self.scene.steps
        sets = []
        for sample, end in zip(self.samples, ends, strict=True):
            of_span = latents[(fraction >= sample.start - slack) & (fraction <= end + slack)]
            frames = decoder.positions(of_span)
            sets.append(self.search.superset(frames, sample.particles, self.integration.margin))
        return sets

    def _frame_every(self) -> int:
        """Steps from a training frame to the next."""
        between = torch.diff(self.manifold.training_times, prepend=self.manifold.training_times[:1]).amax()
        return max(1, round(float(between) / self.scene.dt))

    def sources_at(self, at: Restriction, particles: np.ndarray) -> tuple[StressSource, AffineSource]:
        """The sources of τ and C at particles [n], to which the fields are restricted."""
        mu, lam = (
            torch.as_tensor(values[particles], dtype=self.dtype, device=self.torch_device)
            for values in (self.constants.mu, self.constants.lam)
        )
        law = self.scene.material, mu, lam, self.precision, self.device
        return self.sources.stress_of(at, self.parameters, *law), self.sources.affine_of(at, self.parameters)

    def decoder(self, particles: np.ndarray | None = None, at: Restriction | None = None) -> Decoder:
        """The fields at particles, as the run takes them.

        Args:
            particles: [n] their indices; every particle by default.
            at: fields of the same particles, as of another decoder's `at`; restricted anew if None.
        """
        if particles is None:
            particles = np.arange(len(self.constants))
        if at is None:
            at = self.manifold.restrict(particles, dtype=self.dtype, device=self.torch_device)
        return Decoder(at, *self.sources_at(at, particles))


def first_change(jacobian: torch.Tensor, velocity: torch.Tensor, dt: float) -> torch.Tensor:
    """The change d = x̂_n − x̂_{n−1} before the first step: the least squares of (∂g/∂x̂) d = v₀ Δt over S.

    Args:
        jacobian: ∂g/∂x̂ [..., s, 3, r] [m] at x̂_0.
        velocity: v₀ [..., s, 3] [m/s].
        dt: step [s].

    Returns:
        [..., r]; zero for a body at rest.
    """
    rows, target = jacobian.flatten(-3, -2), (dt * velocity).flatten(-2)
    return torch.linalg.lstsq(rows, target[..., None], driver="gels").solution[..., 0]


def first_changes(at_sample: Restriction, sample: np.ndarray, setups: Sequence[Setup]) -> torch.Tensor:
    """[B, r] `first_change` of some runs, in fp64 on the host.

    Args:
        at_sample: the manifold restricted to S.
        sample: [s] indices of S.
        setups: of the runs.
    """
    rows, changes = torch.as_tensor(sample).long(), []
    with torch.no_grad():
        for setup in setups:
            _, jacobian = at_sample.position_and_jacobian(setup.xhat)
            velocity = setup.initial_velocity[rows].to("cpu", torch.float64)
            changes.append(first_change(jacobian.to(velocity), velocity, setup.dt))
    return torch.stack(changes)


def reduced_steps(steps: int, dt_multiplier: float) -> int:
    """Deployment steps that reach the end of a scene of `steps` steps."""
    return int(np.ceil(steps / dt_multiplier - 1e-9))


def _shaped(name: str, values, shape: tuple[int, ...]):
    if np.shape(values) != shape:
        raise ShapeError(f"{name} must be {list(shape)}, not {list(np.shape(values))}")
    return np.asarray(values)
