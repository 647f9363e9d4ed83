"""The reduced solvers of a pipeline: its manifold, and runs of its models that are ready to step."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from nsf.data.case import Case
from nsf.scenes import Scene

if TYPE_CHECKING:
    from nsf.dynamics import ReducedBatch, ReducedMPM
    from nsf.engines import Engine
    from nsf.kinematics.manifold import Manifold
    from nsf.recurrence import RecurrenceEngine


def manifold(pipeline) -> "Manifold":
    """The trained manifold.

    Raises:
        MissingRunError: it is not trained.
    """
    from nsf.kinematics.fields.mlp import MlpField
    from nsf.kinematics.manifold import Manifold

    manifold = Manifold.load(pipeline.training.require().file("manifold.pt"))
    if isinstance(pipeline.field, MlpField):
        manifold.arithmetic = pipeline.field.arithmetic
    return manifold


def solver_at(
    pipeline,
    manifold: "Manifold",
    case: Case,
    device: str | None = None,
    precision: str | None = None,
    engine: "str | Engine | None" = None,
) -> "ReducedMPM":
    """The reduced solver of a case, at t = 0; device, precision and model as configured."""
    return pipeline.batch_at(manifold, [case], device, precision, engine).runs[0]


def batch_at(
    pipeline,
    manifold: "Manifold",
    cases: Sequence[Case],
    device: str | None = None,
    precision: str | None = None,
    engine: "str | Engine | None" = None,
    scene: Scene | None = None,
) -> "ReducedBatch":
    """Reduced runs of several cases that take their steps together, likewise.

    By the configured model, of the scene that is deployed, unless an engine or a scene is given.
    """
    from nsf.engines import moves_particles, reduced_batch

    if engine is None:
        engine = pipeline.model.engine(pipeline, manifold)
    batch = reduced_batch(
        scene or pipeline.deployed,
        manifold,
        cases,
        pipeline._samples or pipeline.sampler,
        engine=engine,
        sources=pipeline.sources,
        projector=pipeline.projector,
        integration=pipeline.integration,
        precision=precision or pipeline.config.precision,
        device=device or pipeline.device,
        dt_multiplier=pipeline.config.deploy.dt_multiplier,
        # As the sample, these depend on the manifold and the sampler alone: found once for all cases.
        sets=pipeline._sets if moves_particles(engine) else None,
    )
    pipeline._samples = batch.batch.shared.samples
    if moves_particles(engine):
        pipeline._sets = batch.batch.shared.sets
    return batch


def recurrence(pipeline) -> "RecurrenceEngine":
    """The recurrence that was taught.

    Raises:
        MissingRunError: none was.
    """
    if pipeline._taught is None:
        from nsf.pipeline.stages.teaching import RECURRENCE
        from nsf.recurrence import RecurrenceEngine

        pipeline._taught = RecurrenceEngine.load(pipeline.taught.require().file(RECURRENCE))
    return pipeline._taught


def fitted(pipeline, manifold: "Manifold") -> Any:
    """The fit of a model of latent vectors, from its file where it learns.

    Raises:
        MissingRunError: it was not taught.
    """
    if pipeline._fitted is None:
        from nsf.pipeline.stages.teaching import fitted, loaded

        pipeline._fitted = loaded(pipeline.taught) if pipeline.model.learns else fitted(pipeline, manifold)
    return pipeline._fitted
