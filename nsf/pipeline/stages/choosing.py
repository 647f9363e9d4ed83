"""The choice of `model=auto`: each candidate by itself at the validation cases."""

import contextlib

import numpy as np

from nsf.data import Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.deployment import Rollout, rollout_file
from nsf.errors import ConfigError
from nsf.evaluation import compare
from nsf.models.auto import Measured

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
    run, manifold = alone.deploy(), alone.manifold().to(alone.device)
    errors, seconds = [], []
    for index, case in enumerate(alone.held_out):
        rollout = Rollout.open(run.file(rollout_file(index)), manifold.latent_dim)
        with contextlib.closing(Trajectory.open(alone.truth(case).require().file(TRAJECTORY))) as truth:
            solver = alone.solver_at(manifold, case)
            errors.append(compare(solver, truth, rollout, "validation", _SHOWN).displacement_error)
        seconds.append(rollout.seconds)
    return Measured(name, float(np.mean(errors)), float(np.mean(seconds)))
