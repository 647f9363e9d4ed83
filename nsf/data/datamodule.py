"""Snapshots for a Lightning trainer, and the numbers of the steps to take."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytorch_lightning as lightning
import torch

from nsf.data.snapshots import Snapshots
from nsf.data.trajectory import Trajectory


class SnapshotDataModule(lightning.LightningDataModule):
    """Opens trajectories on the trainer's device and counts steps.

    A batch is no more than a step's number: the module draws the step's rows
    and particles from `snapshots` by (seed, step) alone, so that a resumed
    training is bitwise the uninterrupted one. Under several processes it
    folds its rank into the seed, for Lightning cannot shard data that lie on
    the device.

    The whole training is one epoch of `steps` batches (`Trainer(max_epochs=1)`).

    Args:
        paths: trajectory files of the training values.
        steps: number of `training_step` calls.
        resident: as in `Snapshots`.

    Attributes:
        snapshots: available after `setup`, and still after the training.
    """

    snapshots: Snapshots

    def __init__(self, paths: Sequence[str | Path], steps: int, resident: bool | str = "auto") -> None:
        super().__init__()
        self.paths = [Path(path) for path in paths]
        self.steps = steps
        self.resident = resident

    def setup(self, stage: str | None = None) -> None:
        """Open the files; a second call does nothing.

        Raises:
            SchemaError: a file is unusable, or files do not belong together.
        """
        if not hasattr(self, "snapshots"):
            device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
            trajectories = [Trajectory.open(path) for path in self.paths]
            self.snapshots = Snapshots(trajectories, device=device, resident=self.resident)

    def train_dataloader(self) -> "_Steps":
        """Step numbers 0, 1, .. `steps` - 1, going on where a resumed trainer stood."""
        return _Steps(self)


class _Steps:
    """Numbers of the steps still to take; a plain iterable, which Lightning does not shard.

    Resumed within an epoch, Lightning counts the batches done but begins its loader anew.
    """

    def __init__(self, module: SnapshotDataModule) -> None:
        self._module = module

    def __len__(self) -> int:
        return self._module.steps

    def __iter__(self) -> Iterator[int]:
        # A generator: the trainer's progress is restored only just before the first number is asked for.
        trainer = self._module.trainer
        start = trainer.fit_loop.epoch_loop.batch_progress.current.ready if trainer else 0
        yield from range(start, len(self))
