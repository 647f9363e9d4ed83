"""Reduced runs of several cases, driven by Lightning's `Trainer.predict`."""

from collections.abc import Callable, Sequence

import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader

from nsf.data import Case
from nsf.deployment.levels import Levels
from nsf.deployment.rollout import Rollout, rollouts
from nsf.deployment.trust import Trust
from nsf.dynamics import ReducedBatch
from nsf.progress import Progress, quiet_lightning


class Deployment(pl.LightningModule):
    """Lightning module whose prediction step is a reduced run a case.

    Args:
        batch_at, cases: as for `deploy`.
        trust: the estimate of whether to believe a run.
        until_distrusted, levels: as for `rollouts`.
        progress: told of each run done.

    Attributes:
        runs: done so far; Lightning would take apart what a step returns.
    """

    def __init__(
        self,
        batch_at: Callable[[Sequence[Case], str], ReducedBatch],
        cases: Sequence[Case],
        trust: Trust,
        until_distrusted: bool,
        progress: Progress,
        levels: Levels | None = None,
    ):
        super().__init__()
        self._batch_at, self._cases, self._progress = batch_at, cases, progress
        self._how = trust, until_distrusted, levels
        self.runs: list[Rollout] = []

    def predict_step(self, batch: torch.Tensor, batch_idx: int) -> int:
        """Run the cases of some indices [B] from t = 0 to T; they take their steps together. How many."""
        cases = [self._cases[index] for index in batch.tolist()]
        runs = rollouts(self._batch_at(cases, str(self.device)), cases, *self._how)
        for _ in runs:
            self._progress.advance()
        self.runs += runs
        return len(runs)


def deploy(
    batch_at: Callable[[Sequence[Case], str], ReducedBatch],
    cases: Sequence[Case],
    device: str,
    trust: Trust,
    until_distrusted: bool = False,
    batch: int = 1,
    levels: Levels | None = None,
) -> list[Rollout]:
    """Reduced runs of every case, with a progress bar.

    Args:
        batch_at: some cases and device name → their runs at t = 0.
        cases: problem parameters of each run.
        device: `cpu`, `cuda` or `cuda:N`.
        trust, until_distrusted, levels: as for `rollouts`.
        batch: most cases that take their steps together.

    Raises:
        KeyboardInterrupt: passed on; Lightning would exit with code 1.
    """
    loader = DataLoader(torch.arange(len(cases)), batch_size=batch, num_workers=0)
    cuda = torch.device(device).type == "cuda"
    with quiet_lightning(), Progress("deploy", len(cases), "runs") as progress:
        trainer = pl.Trainer(
            accelerator="gpu" if cuda else "cpu",
            devices=[torch.device(device).index or 0] if cuda else 1,
            logger=False,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=False,
            inference_mode=False,  # torch's inference tensors could not be updated in place between steps
        )
        try:
            deployment = Deployment(batch_at, cases, trust, until_distrusted, progress, levels)
            trainer.predict(deployment, loader, return_predictions=False)
        except SystemExit as stop:
            raise KeyboardInterrupt from stop
    return deployment.runs
