"""One phase of training as a Lightning module: blocks of optimiser steps that can be resumed to the bit.

Imported once a phase begins: Lightning takes longer to load than most commands to end.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.plugins import TorchCheckpointIO
from typing_extensions import override

from nsf.errors import InstabilityError
from nsf.kinematics.training.descent import CHECKPOINT, Descent, Steps
from nsf.kinematics.training.tracking import loggers
from nsf.progress import Progress, quiet_lightning
from nsf.storage import writing

# Steps of one training_step: enough to hide Lightning's millisecond, and about 40 checkpoints a phase.
SHORTEST_BLOCK, LONGEST_BLOCK, BLOCKS = 50, 500, 40


class FieldTraining(pl.LightningModule):
    """Trains the network of one phase; every `training_step`, an epoch to Lightning, is a block of steps.

    Args:
        descent: the phase.
        steps: how many.
        checkpoint: rewritten after every block.
        progress: told of the steps done.
    """

    def __init__(self, descent: Descent, steps: int, checkpoint: Path, progress: Progress):
        super().__init__()
        self.automatic_optimization = False
        self.network = descent.fit.network
        self.descent, self.steps = descent, steps
        self.checkpoint, self.progress = checkpoint, progress
        self.block = min(max(SHORTEST_BLOCK, steps // BLOCKS), LONGEST_BLOCK)
        self.step, self.loss, self.seconds = 0, float("nan"), 0.0

    @override
    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        return self.descent.optimizers()

    @override
    def on_train_start(self) -> None:
        # Lightning's wrapper of the optimizer adds a millisecond to every step.
        found = self.optimizers(use_pl_optimizer=False)
        optimizers = found if isinstance(found, list) else [found]
        self.taker = Steps(self.descent, optimizers, self.steps)
        self.progress.advance(self.step)

    @override
    def training_step(self, batch: Any, index: int) -> None:
        first, last, started = self.step, min(self.step + self.block, self.steps), time.perf_counter()
        self.loss = self.taker.take(first, last)
        self.step, self.seconds = last, self.seconds + time.perf_counter() - started
        if not self.loss < float("inf"):
            raise InstabilityError(
                f"training of the {self.descent.fit.name} field diverged: mean loss {self.loss} in steps"
                f" {first} to {last}; choose a lower trainer.learning_rate, and look for non-finite data"
            )
        self.progress.advance(last - first)
        metrics = {
            "loss": self.loss,
            "learning_rate": self.descent.rate_at(last - 1, self.steps),
            "steps_per_second": (last - first) / (time.perf_counter() - started),
        }
        for logger in self.loggers:
            logger.log_metrics(metrics, step=last)
            logger.save()
        self.trainer.should_stop = last == self.steps

    @override
    def on_train_epoch_end(self) -> None:
        self.trainer.save_checkpoint(self.checkpoint)

    @override
    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["nsf"] = {"step": self.step, "loss": self.loss, "seconds": self.seconds}

    @override
    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        kept = checkpoint["nsf"]
        self.step, self.loss, self.seconds = kept["step"], kept["loss"], kept["seconds"]


class _BesideTheLast(TorchCheckpointIO):
    """Writes a checkpoint in the folder that it belongs to; Lightning's own begins in the system's."""

    @override
    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        with writing(path) as partial, partial.open("wb") as file:
            torch.save(checkpoint, file)


def descend(descent: Descent, steps: int, folder: Path, tracking: str | None) -> tuple[float, float]:
    """Train one phase, from the checkpoint in `folder` if there is one.

    Returns:
        The last block's mean loss, and the seconds that the steps took, those before an interrupt included.

    Raises:
        KeyboardInterrupt: on an interrupt; the next call goes on from the last whole block.
        InstabilityError: the loss is not finite.
    """
    checkpoint = folder / CHECKPOINT
    resumed = checkpoint.is_file()
    on_gpu = descent.device.type == "cuda"
    with quiet_lightning(), Progress(f"train {descent.fit.name}", steps, "steps") as progress:
        module = FieldTraining(descent, steps, checkpoint, progress)
        trainer = pl.Trainer(
            accelerator="gpu" if on_gpu else "cpu",
            devices=[descent.device.index or 0] if on_gpu else 1,
            plugins=_BesideTheLast(),
            max_epochs=-1,
            enable_checkpointing=False,  # ModelCheckpoint counts the steps of Lightning's wrapped optimizer
            logger=loggers(folder, tracking),
            log_every_n_steps=1,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        try:
            trainer.fit(
                module, train_dataloaders=[0], ckpt_path=checkpoint if resumed else None, weights_only=True
            )
        except SystemExit as stop:
            # Lightning answers an interrupt with exit code 1; the caller is to see the interrupt.
            raise KeyboardInterrupt from stop
    return module.loss, module.seconds
