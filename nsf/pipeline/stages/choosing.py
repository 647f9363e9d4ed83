"""The choice of `model=auto`: each candidate by itself at the validation cases."""

import numpy as np

from nsf.data import Trajectory
from nsf.errors import ConfigError
from nsf.evaluation import compare
from nsf.models.auto import Measured
from nsf.pipeline.stages.calibration import rollouts_of

#: Pictures are not asked for here.
_SHOWN = (1, 2)


def measure_candidates(pipeline) -> list[Measured]:
    """The candidates of a pipeline at its validation cases; the pipeline then has chosen one.

    Without validation cases nothing is measured, and the projected model is taken.

    Raises:
        ConfigError: no candidate can run.
    """
    if not pipeline.split.validation:
        pipeline.say(
            "deploy: model=auto takes projected, as there are no validation cases to choose by; set "
            "scene.design.validation"
        )
        pipeline.choose("projected")
        return []
    measured = [_measured(pipeline, name) for name in pipeline.configured.of]
    chosen = pipeline.configured.choose(measured)
    pipeline.choose(chosen)
    for one in measured:
        figures = one.refused or f"{100 * one.error:.3g} % off at validation cases, {one.seconds:.3g} s a run"
        pipeline.say(f"deploy: candidate {one.name}: {figures}")
    pipeline.say(
        f"deploy: model=auto takes {chosen}, the cheapest within {pipeline.configured.slack:g} times the "
        "smallest error"
    )
    return measured


def _measured(pipeline, name: str) -> Measured:
    """A candidate at the validation cases, by a deploy run of its own."""
    try:
        alone = pipeline.alone(name).check()
    except ConfigError as error:
        return Measured(name, refused=str(error))
    alone.deploy()
    manifold, errors, seconds = alone.manifold().to(alone.device), [], []
    for case, rollout in zip(alone.held_out, rollouts_of(alone, manifold), strict=True):
        with Trajectory.of(alone.truth(case).require()) as truth:
            solver = alone.solver_at(manifold, case)
            errors.append(compare(solver, truth, rollout, "validation", _SHOWN).displacement_error)
        seconds.append(rollout.seconds)
    return Measured(name, float(np.mean(errors)), float(np.mean(seconds)))
