"""Calibrates error bounds: runs of validation cases, compared with their full-order runs.

These runs are a deployment of their own, made once for a model and used again. They are compared at a few
hundred particles and some fifty frames.
"""

from collections.abc import Sequence

import numpy as np
import torch

from nsf.data import Case, Trajectory
from nsf.deployment import Band, Calibration, Reach, Rollout, Trust, Usual, rollout_file
from nsf.deployment.bound import FLOOR, rms
from nsf.kinematics.manifold import Manifold
from nsf.models.drawn import Drawn
from nsf.pipeline.stages.encoding import encoded_runs
from nsf.recurrence.solids import collider_states
from nsf.scenes import Scene, Values
from nsf.vectors import at_times, spaced

#: Why a run of a validation case has no bound.
CALIBRATES = "validation cases say how large errors are"
_FRAMES = 51


def calibrated(pipeline, manifold: Manifold) -> Trust:
    """The bounds of the errors of a pipeline's runs.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`, whose validation cases are deployed (`Pipeline.validating`).
        manifold: trained fields.

    Raises:
        MissingRunError: they are not deployed, or the full-order run of one is gone.
    """
    trust = Trust.of(manifold, 0.01 * pipeline.config.trust.limit)
    validating = pipeline.validating
    rollouts = [] if validating is None else rollouts_of(validating, manifold)
    reach = _reach(pipeline, manifold, trust, rollouts)
    if not rollouts:
        at_validation = pipeline.config.deploy.split == "validation"
        trust = Trust.of(manifold, trust.limit, reach)
        trust.unknown = CALIBRATES if at_validation else Trust.unknown
        return trust
    rollouts = [one for one in rollouts if _tells(one, reach, trust)] or rollouts
    calibration = _calibration(validating, manifold, trust, rollouts)
    return trust.calibrated(reach, [rollout.case.parameters for rollout in rollouts], calibration)


def _tells(rollout: Rollout, reach: Reach, trust: Trust) -> bool:
    """Whether a validation run counts: one that left what was taught does not, one that diverged does."""
    states = rollout.xhat @ trust.metric
    return rollout.diverged >= 0 or not reach.of_states(states).any()


def rollouts_of(pipeline, manifold: Manifold) -> list[Rollout]:
    """The reduced runs of a pipeline's held-out cases.

    Raises:
        MissingRunError: they are not deployed.
    """
    run, count = pipeline.deployment.require(), len(pipeline.held_out)
    return [Rollout.open(run.file(rollout_file(index)), manifold.latent_dim) for index in range(count)]


def _calibration(validating, manifold: Manifold, trust: Trust, rollouts: Sequence[Rollout]) -> Calibration:
    """Errors of runs of validation cases, beside what these runs say of themselves."""
    (particles, at), rows = manifold.at_some(), []
    for rollout in rollouts:
        with Trajectory.of(validating.truth(rollout.case).require()) as truth:
            frames = spaced(truth.frames, _FRAMES)
            t = truth.t[frames]
            x = truth.read("x", frames=frames.tolist(), particles=particles)
            X = truth.X[particles]
        with torch.no_grad():
            xhat = torch.as_tensor(at_times(t, rollout.t, rollout.xhat)).to(at.device, at.dtype)
            off = at.position(xhat).double().cpu().numpy() - x
        errors = np.sqrt(np.square(off).sum(2).mean(1))
        if rollout.diverged >= 0:
            errors[:] = np.inf
        moved = np.sqrt(np.square(x - X).sum(2).mean(1))
        signal = np.interp(t, rollout.t, rollout.signal)
        rows.append((errors, moved, signal, np.full(len(t), rms(trust.moved(rollout.xhat)))))
    values = (np.stack(values) for values in zip(*rows, strict=True))
    return Calibration.of(t, *values, floor=FLOOR[validating.forced])


def _reach(pipeline, manifold: Manifold, trust: Trust, rollouts: Sequence[Rollout]) -> Reach:
    """Parameters, forcing and latent states of training runs, and of drawn ones."""
    scene = pipeline.scene
    latents, stored = manifold.training_latents.double().cpu().numpy(), pipeline.config.data.every
    along = latents.reshape(len(pipeline.split.train), -1, latents.shape[1])
    runs, t = [scene.at(case) for case in pipeline.split.train], scene.dt * np.arange(scene.steps)
    if scene.forcing.gravity:  # what programs may add, rather than what those of training did
        acting, reach = (
            np.array([[run.base_gravity] for run in runs]),
            scene.forcing.reach(scene.base_gravity, scene.duration),
        )
    else:
        acting, reach = np.stack([run.acting_gravity.at(t) for run in runs]), 0.0
    solids = np.stack([collider_states(run.solids, scene.dt, scene.steps) for run in runs])
    if isinstance(pipeline.model, Drawn) and pipeline.encoding.complete:
        lessons = encoded_runs(pipeline, manifold)
        latents = np.concatenate([latents, lessons.xhat.reshape(-1, latents.shape[1])])
        along, stored = lessons.xhat, 1
        acting = acting if scene.forcing.gravity else lessons.inputs.gravity
        solids = lessons.inputs.solids
    elif isinstance(pipeline.model, Drawn):
        pipeline.say("deploy: the encoded runs are gone; runs are held to those of training alone")
    gravity = acting.mean((0, 1))
    return Reach(
        names=tuple(manifold.parameter_names),
        box=_box(scene, manifold),
        gravity=gravity,
        radius=reach + float(np.linalg.norm(acting - gravity, axis=-1).max()),
        solids=Band.of_solids(solids, scene.dt) if scene.forcing.colliders else None,
        states=Band.of_states(latents @ trust.metric, [rollout.xhat @ trust.metric for rollout in rollouts]),
        usual=Usual.of(along @ trust.metric, stored) if pipeline.forced else None,
        changed=", ".join(pipeline.config.deploy.changes or ()),
    )


def _box(scene: Scene, manifold: Manifold) -> np.ndarray:
    """[n, 2] ranges of the parameters: those of training, and all that a design draws cases from."""
    parameters = manifold.training_parameters.double().cpu().numpy()
    box = np.stack([parameters.min(0), parameters.max(0)], 1)
    for ends, name in zip(box, manifold.parameter_names, strict=True):
        drawn = scene.parameters[name].range
        if drawn is not None and not isinstance(scene.design, Values):
            ends[:] = min(ends[0], drawn[0]), max(ends[1], drawn[1])
    return box


def beyond(pipeline, trust: Trust, case: Case, encoded: np.ndarray) -> bool:
    """Whether a case leads beyond what was taught, by its inputs or by the states of its full-order run.

    Args:
        pipeline: whose deployment it is; trust: of that.
        case: of the run.
        encoded: [F, r] latent vectors of the full-order frames.
    """
    scene = pipeline.deployed.at(case)
    solids = collider_states(scene.solids, scene.dt, scene.steps)
    gravity = scene.acting_gravity.at(scene.dt * np.arange(scene.steps))
    outside = trust.reach.of_inputs(case.parameters, gravity, solids, scene.dt)
    return bool(outside) or bool(trust.reach.of_states(encoded @ trust.metric, every=1).any())
