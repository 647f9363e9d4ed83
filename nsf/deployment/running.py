"""Runs of several cases to the end of their scene, by Lightning's `Trainer.predict`."""

import time
from collections.abc import Callable, Sequence

import pytorch_lightning as pl
from torch.utils.data import DataLoader

from nsf.data import Case
from nsf.deployment.rollout import LATENT, Rollout
from nsf.deployment.trust import Trust
from nsf.dynamics import ReducedBatch, ReducedMPM
from nsf.kinematics.training.lightning import trainer_on
from nsf.progress import Progress
from nsf.timing import synchronizer

#: Cases and device name → their runs at t = 0.
BatchAt = Callable[[Sequence[Case], str], ReducedBatch]
Stepped = Callable[[], object]
"""Called when a batch has taken its first step."""


class Deployment(pl.LightningModule):
    """Runs the cases of a batch from t = 0 to T in its prediction step; they take their steps together.

    Args:
        batch_at, cases, trust, stepped: as for `deploy`.
        progress: advances with each run.

    Attributes:
        rollouts: of the cases so far; Lightning would take apart what a step returns.
    """

    def __init__(
        self, batch_at: BatchAt, cases: Sequence[Case], trust: Trust, stepped: Stepped, progress: Progress
    ):
        super().__init__()
        self._batch_at, self._cases, self._trust, self._progress = batch_at, cases, trust, progress
        self._stepped = stepped
        self.rollouts: list[Rollout] = []

    def predict_step(self, indices: list[int], batch_idx: int) -> int:
        """Run the cases of some indices; returns how many."""
        cases = [self._cases[index] for index in indices]
        self.rollouts += rollouts(self._batch_at(cases, str(self.device)), cases, self._trust, self._stepped)
        self._progress.advance(len(cases))
        return len(cases)


def deploy(
    batch_at: BatchAt,
    cases: Sequence[Case],
    device: str,
    trust: Trust,
    batch: int = 1,
    stepped: Stepped = lambda: None,
) -> list[Rollout]:
    """Reduced runs of every case, with a progress bar.

    Args:
        batch_at: makes the runs of some cases.
        cases: problem parameters of each run.
        device: `cpu`, `cuda` or `cuda:N`.
        trust: bounds the errors of the runs.
        batch: most cases that take their steps together.
        stepped: called after the first step of each batch.

    Raises:
        KeyboardInterrupt: on an interrupt.
    """
    loader = DataLoader(range(len(cases)), batch_size=batch, collate_fn=list)
    # torch's inference tensors could not be updated in place between steps.
    options = {"logger": False, "inference_mode": False}
    with Progress("deploy", len(cases), "runs") as progress, trainer_on(device, **options) as trainer:
        deployment = Deployment(batch_at, cases, trust, stepped, progress)
        trainer.predict(deployment, loader, return_predictions=False)
    return deployment.rollouts


def rollouts(
    batch: ReducedBatch, cases: Sequence[Case], trust: Trust, stepped: Stepped = lambda: None
) -> list[Rollout]:
    """Run a batch to the end of its scene.

    Args:
        batch: at t = 0.
        cases: problem parameters of each run, for the record.
        trust: bounds the errors of the runs.
        stepped: called after the first step.
    """
    share = _timed_run(batch, stepped) / len(batch)
    return [_rollout_of(run, case, trust, share) for run, case in zip(batch.runs, cases, strict=True)]


def _rollout_of(run: ReducedMPM, case: Case, trust: Trust, seconds: float) -> Rollout:
    """The record of a run at its end."""
    latent, diverged, latent_only = run.trajectory(), run.left_grid(), run.span.latent_only
    signal = trust.signal_of(run)
    return Rollout(
        case=case,
        t=latent.t,
        xhat=latent.xhat,
        residuals=latent.residuals,
        stops=[LATENT] * run.steps_taken if latent_only else latent.stops,
        signal=signal,
        verdict=trust.of_run(run, signal, diverged),
        sample=run.sample_size,
        integration_mean=run.integration_mean,
        needed_outside=run.needed_outside() if diverged < 0 else 0,
        seconds=seconds,
        diverged=diverged,
        stress=None if latent.stress is None or not latent.stress.shape[1] else latent.stress,
    )


def _timed_run(batch: ReducedBatch, stepped: Stepped) -> float:
    """Take every step; gives their time [s], the first, which compiles, as the mean of the others."""
    batch.step(1)
    wait = synchronizer(batch.device)
    wait()
    stepped()
    started, steps = time.perf_counter(), batch.total_steps
    batch.step(steps - 1)
    wait()
    return (time.perf_counter() - started) * steps / max(1, steps - 1)
