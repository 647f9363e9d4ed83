"""Runs of several cases to the end of their scene, by Lightning's `Trainer.predict`."""

import time
from collections.abc import Callable, Sequence

import pytorch_lightning as pl
from torch.utils.data import DataLoader

from nsf.data import Case
from nsf.deployment.fallback import Fallback, Stepped, full_order_step
from nsf.deployment.rollout import LATENT, LATENT_MODEL, Rollout
from nsf.deployment.trust import Trust, first_distrusted
from nsf.dynamics import ReducedBatch
from nsf.kinematics.training.lightning import trainer_on
from nsf.progress import Progress
from nsf.timing import synchronizer

#: Cases and device name → their runs at t = 0.
BatchAt = Callable[[Sequence[Case], str], ReducedBatch]
#: Steps between looks at the trust of runs that are to be handed over: a look reads back, and steps taken
#: after the last believed one are lost.
_LOOK = 20


class Deployment(pl.LightningModule):
    """Runs the cases of a batch from t = 0 to T in its prediction step; they take their steps together.

    Args:
        batch_at, cases, trust, fallback: as for `deploy`.
        progress: advances with each run.

    Attributes:
        rollouts: of the cases so far; Lightning would take apart what a step returns.
    """

    def __init__(
        self, batch_at: BatchAt, cases: Sequence[Case], trust: Trust, fallback: Fallback, progress: Progress
    ):
        super().__init__()
        self._batch_at, self._cases, self._progress = batch_at, cases, progress
        self._trust, self._fallback = trust, fallback
        self.rollouts: list[Rollout] = []

    def predict_step(self, indices: list[int], batch_idx: int) -> int:
        """Run the cases of some indices; returns how many."""
        cases = [self._cases[index] for index in indices]
        batch = self._batch_at(cases, str(self.device))
        self.rollouts += rollouts(batch, cases, self._trust, self._fallback)
        self._progress.advance(len(cases))
        return len(cases)


def deploy(
    batch_at: BatchAt,
    cases: Sequence[Case],
    device: str,
    trust: Trust,
    fallback: Fallback = Fallback(),
    batch: int = 1,
) -> list[Rollout]:
    """Reduced runs of every case, with a progress bar.

    Args:
        batch_at: makes the runs of some cases.
        cases: problem parameters of each run.
        device: `cpu`, `cuda` or `cuda:N`.
        trust: the estimate of whether to believe a run.
        fallback: who goes on with a run that is no longer believed.
        batch: most cases that take their steps together.

    Raises:
        KeyboardInterrupt: on an interrupt.
    """
    loader = DataLoader(range(len(cases)), batch_size=batch, collate_fn=list)
    # torch's inference tensors could not be updated in place between steps.
    options = {"logger": False, "inference_mode": False}
    with Progress("deploy", len(cases), "runs") as progress, trainer_on(device, **options) as trainer:
        deployment = Deployment(batch_at, cases, trust, fallback, progress)
        trainer.predict(deployment, loader, return_predictions=False)
    return deployment.rollouts


def rollouts(
    batch: ReducedBatch, cases: Sequence[Case], trust: Trust, fallback: Fallback = Fallback()
) -> list[Rollout]:
    """Run a batch to the end of its scene.

    Args:
        batch: at t = 0.
        cases: problem parameters of each run, for the record.
        trust: the estimate of whether to believe a run.
        fallback: who goes on with a run that is no longer believed; the time of that step counts too. With
            `full` runs of projected steps end soon after none of them is believed.
    """
    until_distrusted = trust if fallback.to == "full" else None
    if fallback.projected is None:
        seconds = _timed_run(batch, until_distrusted)
        ended = [Stepped(run) for run in batch.runs]
    else:
        projected = fallback.projected_runs(cases)  # built before the clock starts, as `batch` is
        seconds, started = _timed_run(batch, None), time.perf_counter()
        ended = fallback.apply(batch, projected, trust)
        seconds += time.perf_counter() - started
        del projected  # particles that a step needed outside are looked for at every particle
    share = seconds / len(batch)
    return [_rollout_of(run, case, trust, fallback, share) for run, case in zip(ended, cases, strict=True)]


def _rollout_of(stepped: Stepped, case: Case, trust: Trust, fallback: Fallback, seconds: float) -> Rollout:
    """The record of a run at its end, cut after its first distrusted step if it is handed over."""
    solver, by, estimate = stepped
    steps, latent, diverged, handed_over = solver.steps_taken, solver.trajectory(), solver.left_grid(), -1
    ratios = trust.of_run(solver, diverged)
    distrusted = first_distrusted(ratios)
    if fallback.to == "full" and distrusted >= 0:
        diverged, steps = -1, distrusted
        handed_over = full_order_step(latent.t, distrusted, solver.scene.dt)
    believed = steps if handed_over < 0 else handed_over
    stops = latent.stops[:steps]
    if by is not None:
        by = by[:steps]
        stops = [LATENT if who == LATENT_MODEL else stop for who, stop in zip(by, stops, strict=True)]
    return Rollout(
        case=case,
        t=latent.t[: steps + 1],
        xhat=latent.xhat[: steps + 1],
        residuals=latent.residuals[:steps],
        stops=stops,
        trust=ratios[: steps + 1],
        away=trust.cases.of(case),
        sample=solver.sample_size,
        integration_mean=solver.integration_mean,
        needed_outside=solver.needed_outside(believed) if diverged < 0 else 0,
        seconds=seconds,
        diverged=diverged,
        handed_over=handed_over,
        estimate=None if estimate is None else estimate[: steps + 1],
        by=by,
        stress=None if latent.stress is None or not latent.stress.shape[1] else latent.stress[: steps + 1],
    )


def _timed_run(batch: ReducedBatch, trust: Trust | None) -> float:
    """Take every step, or with an estimate of trust stop soon after it believes none of the runs any more.

    Returns:
        Wall time [s] of the steps; the first, which compiles, loads and captures, counts as the others' mean.
    """
    batch.step(1)
    wait = synchronizer(batch.device)
    wait()
    believed, since, started = batch.runs, 1, time.perf_counter()
    block = batch.total_steps if trust is None else _LOOK
    while batch.steps_taken < batch.total_steps and believed:
        batch.step(min(block, batch.total_steps - batch.steps_taken))
        if trust is not None:
            believed = [
                run for run in believed if first_distrusted(trust.of_run(run, run.left_grid(since))) < 0
            ]
            since = batch.steps_taken + 1
    wait()
    steps = batch.steps_taken
    return (time.perf_counter() - started) * steps / max(1, steps - 1)
