"""The reduced-order solver: time-stepping in the latent space (paper section 5)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Self

import numpy as np
import torch

from nsf.data import hash_of_positions
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.interop import on_torch_stream, torch_device, torch_dtype
from nsf.dynamics.latent import Decoder, LatentRecord, LatentState, LatentTrajectory
from nsf.dynamics.projection import GaussNewton, Taylor, check_projector
from nsf.dynamics.stepping import Phased, Stepping, build_phases
from nsf.dynamics.stress import Method
from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.manifold import Restriction
from nsf.mpm import BoundaryArrays, precision_of
from nsf.mpm.device import warp_device
from nsf.mpm.shape import DEGREES
from nsf.sampling.sampler import RandomSampler, SamplePhase, Sampler, check_well_posed

NSF = Method("nsf", neural_stress=True, neural_affine=True)
#: Positions decoded at once when every particle is asked for [values].
_CHUNK = 2**25


class ReducedRun(Phased):
    """A reduced simulation apart from its steps: where it starts, what it was given, and what it leaves.

    `ReducedMPM` takes the steps of one, `ReducedBatch` those of several at once.

    Args:
        manifold: trained fields.
        scene: the scene at its problem parameters.
        phases: sample particles by phase of time.
        parameters: problem parameters by name.
        method: which of τ and C come from fields.
        projector: `GaussNewton` or `Taylor`.
        integration: how N is found.
        precision: `fp64` or `fp32`.
        device: `cpu`, `cuda`, `cuda:N` or `auto`.
        dt_multiplier: deployment step in units of the scene's Δt (paper section 6.1: 1.5).
        sets: particle sets of each phase, as `sets` of an earlier solver of the same manifold and
            samples gives them; searched for when None.
        xhat: [r] latent vector at t = 0; that of the undeformed body without stress when None.
        velocity: [P, 3] initial velocity [m/s]; the scene's when None.

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
        phases: Sequence[SamplePhase],
        parameters: Mapping[str, float],
        method: Method = NSF,
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
        for phase in phases:
            check_well_posed(len(phase.particles), manifold.latent_dim)
        self.manifold, self.scene, self.method, self.projector = manifold, scene, method, projector
        self.integration, self.phases, self.given = integration, phases, dict(parameters)
        self.precision, self.device = precision_of(precision), warp_device(device)
        self.dtype, self.torch_device = torch_dtype(self.precision), torch_device(self.device)
        self.dt = scene.dt * dt_multiplier
        self.total_steps = reduced_steps(scene.steps, dt_multiplier)
        self.geometry, self.transfer, self.gravity = scene.grid, scene.transfer, scene.gravity
        self.scene_particles = scene.particles()
        P = len(self.scene_particles)
        manifold.check_particles(hash_of_positions(self.scene_particles.X))
        self.search = NeighbourSearch(self.geometry, self.transfer.shape, self.precision, self.device)

        def tensor(values):
            return torch.as_tensor(np.asarray(values), dtype=self.dtype, device=self.torch_device)

        missing = [name for name in manifold.parameter_names if name not in parameters]
        if missing:
            raise ConfigError(
                f"parameters {dict(parameters)} lack {missing}, which the stress field was trained on"
            )
        self.parameters = tensor([parameters[name] for name in manifold.parameter_names])
        # On the host: a phase takes the rows that it needs.
        velocity = _shaped("velocity", scene.initial_velocity() if velocity is None else velocity, (P, 3))
        self.initial_velocity = torch.as_tensor(velocity, dtype=self.dtype)
        if xhat is None:  # a scene begins undeformed and free of stress
            X = torch.as_tensor(self.scene_particles.X, device=manifold.X.device)[None]
            xhat = manifold.encode(X, X.new_zeros(*X.shape[:2], 6))[0].cpu()
        start = tensor(_shaped("xhat", xhat, (manifold.latent_dim,)))
        self.record = LatentRecord(start, self.total_steps, projector.iterations)
        self.steps_taken = 0
        self._starts = [round(p.start * self.total_steps) for p in phases]
        self.sets = self._sets_of(phases) if sets is None else list(sets)
        self._index = 0  # among the runs that advance together

    @classmethod
    def of_scene(
        cls,
        scene,
        manifold,
        parameters: Mapping[str, float] | None = None,
        sample: int | Sequence[int] | Sampler | Sequence[SamplePhase] | None = None,
        **options,
    ) -> Self:
        """That of a scene.

        Args:
            scene: an `nsf.scenes.Scene`.
            manifold: trained fields.
            parameters: `{name: value}`; the configured value by default.
            sample: particle indices, a number (drawn at random), a `Sampler`, the `phases` of an earlier
                solver, or None for the scene's number.
            **options: further arguments of the constructor.
        """
        name = scene.parameters.name
        if not parameters:
            parameters = {name: _configured(scene)}
        scene = scene.with_parameters(parameters)
        if sample is None:
            sample = int(scene.config.scene.reduced.sample)
        if isinstance(sample, int | np.integer):
            check_well_posed(int(sample), manifold.latent_dim)
            sample = RandomSampler(size=int(sample))
        if isinstance(sample, Sampler):
            device = torch_device(warp_device(options.get("device", "auto")))
            everyone = np.arange(len(manifold.X))
            whole = ParticleSets(everyone, everyone, None)
            as_deployed = {k: options[k] for k in ("method", "precision", "device") if k in options}
            phases = sample.phases_of(
                manifold,
                device,
                lambda training: ReducedMPM.of_scene(
                    scene, manifold, training, everyone, sets=[whole], **as_deployed
                ),
            )
        elif len(sample) and isinstance(sample[0], SamplePhase):
            phases = list(sample)
        else:
            phases = [SamplePhase(0.0, _indices(sample, len(manifold.X)))]
        return cls(manifold, scene, phases, parameters, **options)

    def _sets_of(self, phases: Sequence[SamplePhase]) -> list[ParticleSets]:
        """Particle sets of each phase; supersets go over the training trajectories, decoded from latents."""
        P = len(self.scene_particles)
        if self.integration.strategy == "search":
            return [
                ParticleSets(p.particles, np.append(p.particles, np.delete(np.arange(P), p.particles)), None)
                for p in phases
            ]
        everything = self.decoder()
        latents = self.manifold.training_latents.to(self.torch_device, self.dtype)
        fraction = self.manifold.training_times.to(self.torch_device) / (self.scene.dt * self.scene.steps)
        rows = max(1, _CHUNK // (3 * P))
        ends = [p.start for p in phases[1:]] + [1.0]
        slack = 2.0 / self.scene.steps  # a phase also meets the frames just before and after it
        found = []
        for phase, end in zip(phases, ends, strict=True):
            of_phase = latents[(fraction >= phase.start - slack) & (fraction <= end + slack)]
            frames = (everything.position(chunk) for chunk in of_phase.split(rows))
            found.append(self.search.superset(frames, phase.particles, self.integration.margin))
        return found

    def stress_of(self, at, mu: torch.Tensor, lam: torch.Tensor) -> Callable[[torch.Tensor], torch.Tensor]:
        """The method's source of τ [n, 3, 3] [Pa] at restricted points."""
        return self.method.stress_of(
            at, self.parameters, self.scene.material, mu, lam, self.precision, self.device
        )

    def affine_of(self, at) -> Callable[[torch.Tensor], torch.Tensor | None]:
        """The method's source of C [n, 3, 3] [1/s] at restricted points; gives None for C = 0."""
        return self.method.affine_of(at, self.parameters)

    def decoder(self, particles: np.ndarray | None = None, at: Restriction | None = None) -> Decoder:
        """The fields at particles, as the method takes them.

        Args:
            particles: [n] their indices; every particle by default.
            at: fields of the same particles, as of another decoder's `at`; restricted anew if None.
        """
        constants = self.scene_particles
        if particles is None:
            particles = np.arange(len(constants))
        if at is None:
            at = self.manifold.restrict(particles, dtype=self.dtype, device=self.torch_device)

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values[particles], dtype=self.dtype, device=self.torch_device)

        stress = self.stress_of(at, tensor(constants.mu), tensor(constants.lam))
        return Decoder(at, stress, self.affine_of(at))

    def sets_at(self, step: int) -> ParticleSets:
        """S, N and I of the step that starts `step` steps after t = 0."""
        return self._phase_at(step).sets

    @property
    def state(self) -> LatentState:
        """The latent state; `state.numpy()` decodes every particle."""
        return LatentState(self)

    @property
    def xhat(self) -> torch.Tensor:
        """[r] latent vector, on the device."""
        return self.record.now

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.steps_taken * self.dt

    @property
    def integration_mean(self) -> float:
        """Mean |N| over the steps taken; before them, how many there may be."""
        ends = [*self._starts[1:], self.total_steps]
        taken = [
            max(0, min(self.steps_taken, end) - start) for start, end in zip(self._starts, ends, strict=True)
        ]
        if not self.steps_taken:
            return float(len(self.sets[0].integration))
        sizes = (p.mean_sizes[self._index] for p in self._phases)
        return sum(n * size for n, size in zip(taken, sizes, strict=True)) / self.steps_taken

    @property
    def sample_size(self) -> int:
        """|S| of the first phase."""
        return len(self.sets[0].sample)

    def trajectory(self) -> LatentTrajectory:
        """Everything recorded up to now, on the host."""
        return self.record.trajectory(self.steps_taken, self.dt, self.projector.tolerance)

    def left_grid(self, since: int = 1) -> int:
        """First step that ended with a sample particle off the grid, or non-finite; −1 when none did.

        Only steps from `since` on are looked at.
        Such a particle no longer takes part in a step, so what follows is no reduced model of anything;
        the full-order solver stops there. For after a run.
        """
        for n in range(since, self.steps_taken + 1):
            x = self._phase_at(n - 1).at_sample.position(self.record.xhat[n])
            if not bool(self._on_grid(x).all()):
                return n
        return -1

    def _on_grid(self, x: torch.Tensor) -> torch.Tensor:
        """[n] whether the stencils of particles at x [n, 3] lie on the grid; False where x is not finite."""
        reach = 0.5 * (DEGREES[self.transfer.shape] - 1) * self.geometry.dx  # of a stencil below its particle
        upper = torch.tensor(self.geometry.upper, dtype=self.dtype, device=self.torch_device) - reach
        return ((x >= reach) & (x < upper)).all(1)

    def needed_outside(self, steps: int | None = None) -> int:
        """Most particles and nodes that a step needed and the superset lacks, or that were off the grid.

        Looks at the first `steps` steps, or at all that were taken.
        Decodes every particle at every step; for after a run. The transfers pass over what is off
        the grid, so it counts here; so does a node of a sample particle that is not stored.

        Source: paper section 5.4, b.
        """
        if self.integration.strategy == "search":
            return 0
        everything = self.decoder()
        worst = 0
        for n in range(self.steps_taken if steps is None else steps):
            phase = self._phase_at(n)
            x = everything.position(self.record.xhat[n])
            sample = torch.as_tensor(phase.sets.sample, device=self.torch_device)
            needed = self.search.needed(x, sample)
            needed[torch.as_tensor(phase.sets.integration, device=self.torch_device)] = False
            marked = self.search.no_nodes(self.torch_device)
            self.search.mark_nodes(x[sample].contiguous(), marked)
            marked[torch.as_tensor(phase.sets.nodes, device=self.torch_device).long()] = 0
            lost = ~self._on_grid(x)
            worst = max(worst, int(needed.sum()) + int(marked.sum()) + int(lost.sum()))
        return worst


class ReducedMPM(ReducedRun, Stepping):
    """Steps a latent vector: infer fields on N, one MPM step, invert on S.

    Args and errors are those of `ReducedRun`.

    Source: paper section 5.
    """

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        scene = self.scene
        self.boundaries = BoundaryArrays(scene.colliders, scene.walls, self.precision, self.device)
        self._phases = build_phases([self], self.record, self.boundaries)
        self._enter(self._phases[0])

    @property
    def nbytes(self) -> int:
        """Bytes that the solver's arrays and fields take on the device."""
        return sum(p.nbytes for p in self._phases) + self.record.nbytes

    @property
    def mode_bytes(self) -> float:
        """Bytes of the modes of one particle that a step reads; 0 where torch decodes it."""
        return self._phase.mode_bytes

    def equations_at(
        self, step: int, xhat: torch.Tensor, previous: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What the projection at the end of a step is given, linearised where it starts.

        Leaves the solver in the midst of that step.

        Args:
            step: steps before it, which set its moment.
            xhat, previous: [r] x̂_n and x̂_{n−1}.

        Returns:
            Error x_S − g(X_S, x̂_n) [s, 3] [m] and Jacobian ∂g/∂x̂ [s, 3, r] [m].
        """
        self.steps_taken = step
        self.record.now.copy_(xhat)
        self.record.before.copy_(previous)
        self._enter(self._phase_at(step))
        with torch.no_grad(), on_torch_stream(self.device):
            self.boundaries.start_from(step)
            for name, stage in self.stages.items():
                if name != "inversion":
                    stage()
            position, jacobian = self._phase.at_sample.position_and_jacobian(self.record.now)
        return self._phase.x[: self._phase.s] - position, jacobian


def reduced_steps(steps: int, dt_multiplier: float) -> int:
    """Deployment steps that reach the end of a scene of `steps` steps."""
    return int(np.ceil(steps / dt_multiplier - 1e-9))


def _configured(scene) -> float:
    from omegaconf import OmegaConf

    return float(OmegaConf.select(scene.config, scene.parameters.key))


def _indices(sample, particles: int) -> np.ndarray:
    sample = np.asarray(sample)
    if sample.ndim != 1 or not np.issubdtype(sample.dtype, np.integer) or not len(sample):
        raise ShapeError(
            "sample must be a number or a non-empty list of particle indices; "
            f"got {sample.dtype} {sample.shape}; give np.flatnonzero(mask) for a mask"
        )
    sample = np.unique(sample)
    if sample[0] < 0 or sample[-1] >= particles:
        raise ShapeError(f"sample indices {sample[0]} … {sample[-1]} must lie in [0, {particles})")
    return sample


def _shaped(name: str, values, shape: tuple[int, ...]):
    if np.shape(values) != shape:
        raise ShapeError(f"{name} must be {list(shape)}, not {list(np.shape(values))}")
    return np.asarray(values)
