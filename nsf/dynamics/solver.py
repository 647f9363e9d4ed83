"""The reduced-order solver: time-stepping in the latent space (paper section 5)."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch

from nsf.data import hash_of_positions
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.interop import captured, on_torch_stream, torch_device, torch_dtype
from nsf.dynamics.latent import Decoder, LatentRecord, LatentState, LatentTrajectory
from nsf.dynamics.modal import ModalPhase, steps_in_coefficients
from nsf.dynamics.phase import DecodedPhase, Phase, SearchingPhase, Setting, Stages
from nsf.dynamics.projection import GaussNewton, Taylor
from nsf.dynamics.sampling import RandomSampler, SamplePhase, Sampler, check_well_posed
from nsf.dynamics.stress import Method
from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.manifold import Restriction
from nsf.mpm import BoundaryArrays, Grid, GridStep, precision_of
from nsf.mpm.device import warp_device
from nsf.mpm.shape import DEGREES
from nsf.timing import StageTimer, untimed

NSF = Method("nsf", neural_stress=True, neural_affine=True)
#: Positions decoded at once when every particle is asked for [values].
_CHUNK = 2**25


class ReducedMPM:
    """Steps a latent vector: infer fields on N, one MPM step, invert on S.

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

    Raises:
        ProjectionError: |S| < r/3.
        SchemaError: the manifold was trained for other particles.
        ConfigError, DeviceError: a value or device is refused.

    Source: paper section 5.
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
    ):
        if not dt_multiplier > 0:
            raise ConfigError(f"dt_multiplier={dt_multiplier} must be positive")
        for phase in phases:
            check_well_posed(len(phase.particles), manifold.latent_dim)
        self.manifold, self.scene, self.method, self.projector = manifold, scene, method, projector
        self.integration, self.phases = integration, phases
        self.precision, self.device = precision_of(precision), warp_device(device)
        self.dtype, self.torch_device = torch_dtype(self.precision), torch_device(self.device)
        self.dt = scene.dt * dt_multiplier
        self.total_steps = reduced_steps(scene.steps, dt_multiplier)
        self.geometry, self.transfer, self.gravity = scene.grid, scene.transfer, scene.gravity
        self.boundaries = BoundaryArrays(scene.colliders, scene.walls, self.precision, self.device)
        self.scene_particles = scene.particles()
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
        self.initial_velocity = tensor(scene.initial_velocity())
        # A scene begins undeformed and free of stress.
        X = torch.as_tensor(self.scene_particles.X)[None]
        start = tensor(manifold.encode(X, X.new_zeros(*X.shape[:2], 6))[0].cpu())
        self.record = LatentRecord(start, self.total_steps, projector.iterations)
        self.steps_taken = 0
        self._setting = Setting(
            self.scene_particles, self.initial_velocity, self.record, projector, self.dt, self.precision,
            self.dtype, self.torch_device,
        )  # fmt: skip
        self._starts = [round(p.start * self.total_steps) for p in phases]
        self.sets = self._sets_of(phases) if sets is None else list(sets)
        self._phases = [self._build_phase(s, p.weights) for s, p in zip(self.sets, phases, strict=True)]
        self._enter(self._phases[0])

    @classmethod
    def of_scene(
        cls,
        scene,
        manifold,
        parameters: Mapping[str, float] | None = None,
        sample: int | Sequence[int] | Sampler | Sequence[SamplePhase] | None = None,
        **options,
    ) -> "ReducedMPM":
        """The reduced solver of a scene.

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
                lambda training: cls.of_scene(
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

    def _build_phase(self, sets: ParticleSets, weights: np.ndarray | None) -> Phase:
        grid = Grid(self.geometry, self.precision, self.device, nodes=sets.nodes)
        step = GridStep(
            grid, self.boundaries, self.transfer, self.gravity, self.dt, self.precision, self.device
        )
        if steps_in_coefficients(self.manifold, self.projector, self.precision, self.device):
            return ModalPhase(
                self._setting, sets, step, self.transfer.shape, self.manifold, self.method, self.parameters,
                self.scene.material, weights,
            )  # fmt: skip
        at = self.manifold.restrict(particles=sets.integration, dtype=self.dtype, device=self.torch_device)
        search = self.integration.strategy == "search"
        build = partial(SearchingPhase, search=self.search) if search else DecodedPhase
        return build(self._setting, sets, step, at, self.stress_of, self.affine_of, weights)

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
            return float(self._phase.size)
        return sum(n * p.mean_size for n, p in zip(taken, self._phases, strict=True)) / self.steps_taken

    @property
    def sample_size(self) -> int:
        """|S| of the first phase."""
        return len(self._phases[0].sets.sample)

    @property
    def nbytes(self) -> int:
        """Bytes that the solver's arrays and fields take on the device."""
        return sum(p.nbytes for p in self._phases) + self.record.nbytes + self.initial_velocity.nbytes

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt.

        Raises:
            ConfigError: the steps would pass the scene's end.
        """
        if self.steps_taken + n > self.total_steps:
            raise ConfigError(
                f"{self.steps_taken} + {n} steps pass the end of the scene, {self.total_steps} steps"
            )
        with torch.no_grad():
            for _ in range(n):
                self._step(self._advance)

    def timed_step(self, timer: StageTimer) -> None:
        """One step, stage by stage under a timer; never from a captured graph."""
        with torch.no_grad():
            self._step(lambda: self._run_stages(timer))

    def _step(self, advance: Callable[[], None]) -> None:
        phase = self._phase_at(self.steps_taken)
        if phase is not self._phase:
            self._enter(phase)
        advance()
        self.steps_taken += 1

    def _phase_at(self, step: int):
        return self._phases[max(i for i, start in enumerate(self._starts) if start <= step)]

    def _enter(self, phase: Phase) -> None:
        """Give the phase the state one step back, which the backward difference needs."""
        self._phase = phase
        with torch.no_grad():
            phase.enter(first=self.steps_taken == 0)  # the first velocity is the initial one

    def _advance(self) -> None:
        phase = self._phase
        if not self.device.is_cuda or not phase.capturable:
            self._run_stages()
        elif phase.graph is None:
            # The first step runs uncaptured, so that kernels and libraries are loaded.
            self._run_stages()
            with captured(self.device) as graph:
                self._run_stages()
            phase.graph = graph
        else:
            phase.graph.replay()

    def _run_stages(self, timer: Callable = untimed) -> None:
        with on_torch_stream(self.device):
            for name, stage in self.stages.items():
                with timer(name):
                    stage()

    @property
    def stages(self) -> Stages:
        """One step, stage by stage, in order."""
        return self._phase.stages

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
