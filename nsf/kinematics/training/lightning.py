"""One phase of training under Lightning: its data, its module and its callbacks.

Imported once a phase begins: Lightning takes longer to load than most commands to end.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.plugins import TorchCheckpointIO
from torch.utils.data import DataLoader, Sampler
from typing_extensions import override

from nsf.data import Snapshots, archives
from nsf.errors import InstabilityError
from nsf.kinematics.training.descent import CHECKPOINT, Descent, Steps
from nsf.kinematics.training.tracking import loggers
from nsf.progress import Progress, quiet_lightning

# Steps of a block: enough to hide what Lightning does between two, and about 40 checkpoints a phase.
SHORTEST_BLOCK, LONGEST_BLOCK, BLOCKS = 50, 500, 40


class SnapshotData(pl.LightningDataModule):
    """Snapshots in blocks of optimiser steps: an epoch is a block, given by its first step and its end.

    Frames and particles are drawn within a step, where the snapshots lie, by its number (`Trainer.batch`), so
    that a resumed training, which goes on with an epoch, sees what an undisturbed one does. A loader of
    frames with a `training_step` a batch took 44 % longer with 150 particles and 3 % with 2,000 (10.0 and
    6.9 ms, 18.6 and 18.0 ms a step of field=mlp; medians in one process, on one core). On a GPU Lightning's
    millisecond is longer than a step that is replayed (`Steps`).

    Args:
        snapshots: of the training cases.
        steps: of the phase.
    """

    def __init__(self, snapshots: Snapshots, steps: int):
        super().__init__()
        self.snapshots = snapshots
        size = min(max(SHORTEST_BLOCK, steps // BLOCKS), LONGEST_BLOCK)
        self.blocks = [(first, min(first + size, steps)) for first in range(0, steps, size)]

    @override
    def train_dataloader(self) -> DataLoader:
        return DataLoader(self.blocks, batch_size=None, sampler=_OfEpoch())


class _OfEpoch(Sampler[int]):
    """The number of the epoch, of which Lightning tells."""

    epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    @override
    def __iter__(self) -> Iterator[int]:
        yield self.epoch

    def __len__(self) -> int:
        return 1


class FieldTraining(pl.LightningModule):
    """Trains the network of one phase, a block of steps in every `training_step`.

    Args:
        descent: the phase.
        steps: how many.

    Attributes:
        loss: mean of the last block.
        seconds: that the steps took, those before an interrupt included.
    """

    def __init__(self, descent: Descent, steps: int):
        super().__init__()
        self.automatic_optimization = False
        self.network = descent.fit.network
        self.descent, self.steps = descent, steps
        self.loss, self.seconds = float("nan"), 0.0

    @override
    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        return self.descent.optimizers()

    @override
    def on_train_start(self) -> None:
        optimizers = self.optimizers(use_pl_optimizer=False)  # its wrapper adds a millisecond to every step
        optimizers = optimizers if isinstance(optimizers, list) else [optimizers]
        self.taker = Steps(self.descent, optimizers, self.steps)

    @override
    def training_step(self, block: tuple[int, int], index: int) -> None:
        (first, last), started = block, time.perf_counter()
        self.loss = self.taker.take(first, last)
        seconds = time.perf_counter() - started
        self.seconds += seconds
        if not self.loss < float("inf"):
            raise InstabilityError(
                f"training of the {self.descent.fit.name} field diverged: mean loss {self.loss} in steps"
                f" {first} to {last}; choose a lower trainer.learning_rate, and look for non-finite data"
            )
        rate, speed = self.descent.rate_at(last - 1, self.steps), (last - first) / seconds
        # Lightning takes `step` for the place on the axis.
        self.log_dict({"loss": self.loss, "learning_rate": rate, "steps_per_second": speed, "step": last})

    @override
    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["nsf"] = {"loss": self.loss, "seconds": self.seconds}

    @override
    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.loss, self.seconds = checkpoint["nsf"]["loss"], checkpoint["nsf"]["seconds"]


class BlockCheckpoint(pl.Callback):
    """Rewrites a checkpoint after every block.

    `ModelCheckpoint` would not: it counts steps of Lightning's wrapped optimizers, of which there are none.
    """

    def __init__(self, path: Path):
        self.path = path

    @override
    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        trainer.save_checkpoint(self.path)


class StepProgress(pl.Callback):
    """Shows the steps taken, those before an interrupt included."""

    def __init__(self, progress: Progress):
        self.progress, self.done = progress, 0

    @override
    def on_train_batch_end(self, trainer, pl_module, outputs, batch: tuple[int, int], batch_idx: int) -> None:
        _, last = batch
        self.progress.advance(last - self.done)
        self.done = last


class _InItsFolder(TorchCheckpointIO):
    """Writes a checkpoint in the folder that it belongs to; Lightning's own begins in the system's."""

    @override
    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        archives.keep(path, checkpoint)


def descend(
    descent: Descent, steps: int, folder: Path, tracking: str | None, say: Callable[[str], object]
) -> tuple[float, float]:
    """Train one phase, from the checkpoint in `folder` if there is one, and it is whole.

    Returns:
        The last block's mean loss, and the seconds that the steps took, those before an interrupt included.

    Raises:
        KeyboardInterrupt: on an interrupt; the next call goes on from the last whole block.
        InstabilityError: the loss is not finite.
    """
    checkpoint = folder / CHECKPOINT
    resumed = None if archives.kept(checkpoint, say) is None else checkpoint
    data, module = SnapshotData(descent.snapshots, steps), FieldTraining(descent, steps)
    on_gpu = descent.device.type == "cuda"
    with quiet_lightning(), Progress(f"train {descent.fit.name}", steps, "steps") as progress:
        trainer = pl.Trainer(
            accelerator="gpu" if on_gpu else "cpu",
            devices=[descent.device.index or 0] if on_gpu else 1,
            max_epochs=len(data.blocks),
            plugins=_InItsFolder(),
            callbacks=[StepProgress(progress), BlockCheckpoint(checkpoint)],
            logger=loggers(folder, tracking),
            log_every_n_steps=1,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        try:
            trainer.fit(module, data, ckpt_path=resumed, weights_only=True)
        except SystemExit as stop:
            # Lightning answers an interrupt with exit code 1; the caller is to see the interrupt.
            raise KeyboardInterrupt from stop
    return module.loss, module.seconds
