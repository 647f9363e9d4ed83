"""Checks of a pipeline before any work: all that its stages need is built, and a bad value refused."""

from collections.abc import Mapping

from nsf import config as configuration
from nsf.data import Case
from nsf.errors import ConfigError
from nsf.mpm.stability import check_colliders, check_time_step
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.checks import check_memory, check_physics
from nsf.storage import require_folder, require_space

#: What this process has checked; the jobs of a sweep ask the same thing again and again, for seconds.
_PASSED: set[str] = set()


def check(pipeline) -> None:
    """Refuse a pipeline that could not be worked off.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.

    Raises:
        ConfigError: a value is refused; names it.
        InstabilityError: Δt is unstable in a case.
    """
    from nsf.sampling.cubature import CubatureSampler  # with torch, which takes more than a second to load
    from nsf.sampling.sampler import check_well_posed

    c = pipeline.config
    with configuration.naming_the_missing():
        field, sampler, integration = pipeline.field, pipeline.sampler, pipeline.integration
        _ = pipeline.trainer, pipeline.projector
        check_batched(c.deploy.batch, field, integration.strategy)
        if pipeline.sources.carried:
            _check_carried(c.deploy.batch, sampler)
        if c.data.every > 1 and isinstance(sampler, CubatureSampler):
            raise ConfigError(
                f"sampler=cubature learns from steps, and data.every={c.data.every} stores not each; set "
                "data.every=1, or sampler=random"
            )
        X = pipeline.scene.particles().X
        for region in sampler.regions:
            check_well_posed(region.size, c.latent_dim)
            region.candidates(X)
        check_cases(pipeline)


def check_batched(size: int, field, strategy: str) -> None:
    """Refuse a batch of runs that do not step together.

    Raises:
        ConfigError: says what a batch needs.
    """
    if size == 1:
        return
    from nsf.kinematics.fields.basis import BasisField

    if not isinstance(field, BasisField):
        raise ConfigError(
            f"deploy.batch={size} needs field=basis, whose steps are taken in coefficients; "
            "set deploy.batch=1"
        )
    if strategy != "superset":
        raise ConfigError(f"deploy.batch={size} needs integration=superset; set it, or deploy.batch=1")


def _check_carried(batch: int, sampler) -> None:
    """Refuse what asks for a step that x̂ and its last change determine: particles carry their stress."""
    if batch != 1:
        raise ConfigError(
            f"deploy.batch={batch} needs compiled steps, and those with stress=particles are not; "
            "set deploy.batch=1, or stress=field affine=field"
        )
    if len(sampler.regions) > 1:
        raise ConfigError(
            f"the sampler has {len(sampler.regions)} samples in a run, and stress=particles takes "
            "one; set sampler.phases=[], or another sampler"
        )


def check_cases(pipeline) -> None:
    """Build the scene in every case: a value out of range fails before any work.

    Raises:
        ConfigError: a value is refused; names it.
        InstabilityError: Δt is unstable in a case.
    """
    needed, multiplier = pipeline.needed(), pipeline.config.deploy.dt_multiplier
    signature = repr((pipeline.scene, pipeline.deployed, needed, multiplier))
    if signature in _PASSED:
        return
    for case, scene in needed:
        scene = scene.at(case)
        check_physics(scene)
        check_time_step(scene.particles(), scene.initial_velocity(), scene.dx, scene.dt)
        for factor in (1.0, multiplier):
            check_colliders(scene.solids, scene.grid, factor * scene.dt)
    _PASSED.add(signature)


def check_room(pipeline, runs: Mapping[Run, tuple[Case, Scene]]) -> None:
    """Refuse trajectories that fit neither into memory nor, all together, on the disk.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        runs: that are to be made, at least one, each with its case and scene.

    Raises:
        ConfigError: names the bytes of memory that are needed and available.
        StorageError: names the bytes of the disk.
    """
    from nsf.mpm.recording import frame_bytes

    stored = pipeline.stored
    for _, scene in runs.values():
        check_memory(scene, pipeline.config.precision, pipeline.device, stored)
    folder = next(iter(runs)).path.parent
    require_folder(folder)
    every = pipeline.config.data.every
    size = sum((s.steps // every + 1) * frame_bytes(s.particle_count, stored) for _, s in runs.values())
    require_space(folder / f"{len(runs)} trajectories", size)
