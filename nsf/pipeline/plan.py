"""What a configuration asks for: everything that its stages need, checked, and the run of each stage."""

from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig

from nsf import config as configuration
from nsf.data import Case
from nsf.dynamics import Sources
from nsf.errors import ConfigError
from nsf.kinematics.fields.basis import BasisField
from nsf.models import Recurrence
from nsf.mpm import FP32, FP64, Precision
from nsf.mpm.recording import frame_bytes
from nsf.mpm.stability import check_colliders, check_time_step
from nsf.pipeline.names import Names
from nsf.runs import Run
from nsf.sampling.sampler import check_well_posed
from nsf.scenes import Scene
from nsf.scenes.checks import check_memory, check_physics
from nsf.storage import require_folder, require_space

#: Precision of stored frames by the name of their type.
_STORED = {"float32": FP32, "float64": FP64}
#: What this process has checked; the jobs of a sweep ask the same thing again and again, for seconds.
_PASSED: set[str] = set()


class Plan(Names):
    """The stages of one configuration, everything that they need built and checked before any work.

    Args:
        config, root: as for `Names`.

    Attributes:
        field, trainer, sampler, projector, integration: as the configuration has them.
        sources: where a projected step takes τ and C from.

    Raises:
        ConfigError: a value is missing or refused; names it.
        InstabilityError: Δt is unstable in a case.
    """

    def __init__(self, config: DictConfig, root: Path | None = None):
        super().__init__(config, root)
        with configuration.naming_the_missing():
            self._build()

    def _build(self) -> None:
        """Build and check everything, so that a bad value is refused before any work."""
        c = self.config
        for name in ("field", "trainer", "sampler", "projector", "integration"):
            setattr(self, name, configuration.build(c[name], name))
        self.sources = Sources(c.stress, c.affine)
        check_batched(c, self.field, self.integration.strategy)
        if self.sources.carried:
            self._check_carried()
        for model in [self.configured, *(getattr(self.configured, "of", None) or {}).values()]:
            if isinstance(model, Recurrence) and model.of_runs and model.teaching.symmetry:
                model.teaching.symmetry.images(self.scene)  # refuses planes that the scene has not
        X = self.scene.particles().X
        for region in self.sampler.regions:
            check_well_posed(region.size, c.latent_dim)
            region.candidates(X)
        self._check_cases()

    def _check_carried(self) -> None:
        """Refuse what asks for a step that x̂ and its last change determine: particles carry their stress."""
        if (size := self.config.deploy.batch) != 1:
            raise ConfigError(
                f"deploy.batch={size} needs compiled steps, and those with stress=particles are not; "
                "set deploy.batch=1, or stress=field affine=field"
            )
        if len(self.sampler.regions) > 1:
            raise ConfigError(
                f"the sampler has {len(self.sampler.regions)} samples in a run, and stress=particles takes "
                "one; set sampler.phases=[], or another sampler"
            )

    def _check_cases(self) -> None:
        """Build the scene in every case: a value out of range fails before any work."""
        asked = repr((self.scene, self.deployed, self.needed(), self.config.deploy.dt_multiplier))
        if asked in _PASSED:
            return
        for case, scene in self.needed():
            scene = scene.at(case)
            grid = scene.grid
            check_physics(scene)
            check_time_step(scene.particles(), scene.initial_velocity(), grid.dx, scene.dt)
            for multiplier in (1.0, self.config.deploy.dt_multiplier):
                check_colliders(scene.solids, grid, multiplier * scene.dt)
        _PASSED.add(asked)

    def check_room(self, runs: Mapping[Run, tuple[Case, Scene]]) -> None:
        """Refuse trajectories that fit neither into memory nor, all together, on the disk.

        Args:
            runs: that are to be made, at least one, each with its case and scene.

        Raises:
            ConfigError: names the bytes of memory that are needed and available.
            StorageError: names the bytes of the disk.
        """
        for _, scene in runs.values():
            check_memory(scene, self.config.precision, self.device, self.stored)
        folder = next(iter(runs)).path.parent
        require_folder(folder)
        frames = sum((s.steps + 1) * frame_bytes(s.particle_count, self.stored) for _, s in runs.values())
        require_space(folder / f"{len(runs)} trajectories", frames)

    @property
    def stored(self) -> Precision:
        """Precision of the frames of trajectories."""
        return _STORED[self.config.data.dtype]


def check_batched(c: DictConfig, field, strategy: str) -> None:
    """Refuse a batch of runs that do not step together.

    Raises:
        ConfigError: says what a batch needs.
    """
    if (size := c.deploy.batch) == 1:
        return
    if not isinstance(field, BasisField):
        raise ConfigError(
            f"deploy.batch={size} needs field=basis, whose steps are taken in coefficients; "
            "set deploy.batch=1"
        )
    if strategy != "superset":
        raise ConfigError(f"deploy.batch={size} needs integration=superset; set it, or deploy.batch=1")
