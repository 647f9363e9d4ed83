"""One phase of training as a Lightning module: blocks of optimiser steps that can be resumed to the bit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.plugins import TorchCheckpointIO
from pytorch_lightning.plugins.environments import LightningEnvironment
from pytorch_lightning.strategies import DDPStrategy
from torch import Tensor
from typing_extensions import override

from nsf.errors import InstabilityError
from nsf.kinematics.training.phases import PHASES, Fit, seed_of
from nsf.kinematics.training.ranks import ALONE, Rank
from nsf.kinematics.training.schedules import Trainer
from nsf.kinematics.training.tracking import loggers
from nsf.progress import Progress, quiet_lightning
from nsf.storage import writing

# Steps of one training_step: enough to hide Lightning's millisecond, and about 40 checkpoints a phase.
SHORTEST_BLOCK, LONGEST_BLOCK, BLOCKS = 50, 500, 40
EAGER_STEPS = 3  # before a capture, as torch asks
CHECKPOINT = "last.ckpt"


@dataclass(frozen=True)
class Descent:
    """What one phase minimises, and how; each step is a function of the weights, its number and the seed.

    Attributes:
        fit, schedule: the network with its loss, and the batches and rates.
        frames, particles: M and P of the snapshots.
        resident: the snapshots lie on the device.
        rank: which of several processes this is; `schedule`, `frames` and `seed` are its own.
    """

    fit: Fit
    schedule: Trainer
    frames: int
    particles: int
    resident: bool
    seed: int
    device: torch.device
    rank: Rank = ALONE

    @property
    def replayable(self) -> bool:
        """Whether every step is the same sequence of kernels, with no word from the host or other devices."""
        local = (self.resident or not self.fit.pointwise) and self.rank.alone
        return self.device.type == "cuda" and self.schedule.stationary and local

    def optimizer(self) -> torch.optim.Optimizer:
        """Adam, as in the paper; `Steps` sets its rate."""
        return torch.optim.Adam(
            self.fit.network.parameters(), fused=True, capturable=self.device.type == "cuda"
        )


class Steps:
    """Takes the optimiser steps of a phase.

    On a GPU a step can cost more to launch than to compute (field=basis, H200: 2.5 ms against 0.4 ms), so
    after some eager steps one is captured as a CUDA graph and replayed: the same kernels and the same bits.

    Args:
        descent: the phase.
        optimizer: of its network, already in the state it starts from.
        steps: how many there are in all.
        backward: fills the gradients of a loss.
    """

    def __init__(
        self,
        descent: Descent,
        optimizer: torch.optim.Optimizer,
        steps: int,
        backward: Callable[[Tensor], None] = Tensor.backward,
    ):
        self.descent, self.optimizer, self.steps, self.backward = descent, optimizer, steps, backward
        self._rate = torch.zeros((), device=descent.device)
        for group in optimizer.param_groups:
            group["lr"] = self._rate
        self._generator = torch.Generator(descent.device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_left = EAGER_STEPS if descent.replayable else steps
        # Capture wants the steps before it on its own stream.
        self._stream = torch.cuda.Stream(descent.device) if descent.replayable else None

    def take(self, first: int, last: int) -> float:
        """Take the steps first, ..., last − 1; returns their mean loss."""
        total = torch.zeros((), device=self.descent.device)
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(self.descent.device))
        with torch.cuda.stream(self._stream):
            for step in range(first, last):
                total += self._take(step)
            return float(total) / (last - first)

    def _take(self, step: int) -> Tensor:
        descent = self.descent
        self._rate.fill_(descent.schedule.rate_at(step, self.steps))
        self._generator.manual_seed(seed_of(descent.seed, PHASES.index(descent.fit.name), step))
        if self._eager_left > 0:
            self._eager_left -= 1
            return self._descend(step)
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            self._graph.register_generator_state(self._generator)
            with torch.cuda.graph(self._graph, stream=self._stream):
                self._loss = self._descend(step)
        self._graph.replay()
        return self._loss

    def _descend(self, step: int) -> Tensor:
        descent = self.descent
        rows, particles = descent.schedule.batch(
            step, descent.fit, descent.frames, descent.particles, descent.seed, self._generator
        )
        low = descent.schedule.bf16 and descent.fit.pointwise and descent.device.type == "cuda"
        # A cached cast of a weight would be a tensor of one step in the graph of all.
        with torch.autocast(descent.device.type, torch.bfloat16, enabled=low, cache_enabled=False):
            loss = descent.fit.loss(rows, particles, self._generator)
        self.optimizer.zero_grad()
        self.backward(loss)
        self.optimizer.step()
        return loss.detach()


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
    def configure_optimizers(self) -> torch.optim.Optimizer:
        return self.descent.optimizer()

    @override
    def on_train_start(self) -> None:
        # Lightning's wrapper of the optimizer adds a millisecond to every step.
        # Through Lightning where it has to exchange gradients, which costs a little.
        backward = Tensor.backward if self.descent.rank.alone else self.manual_backward
        self.taker = Steps(self.descent, self.optimizers(use_pl_optimizer=False), self.steps, backward)
        self.progress.advance(self.step)

    @override
    def training_step(self, batch: Any, index: int) -> None:
        first, last, started = self.step, min(self.step + self.block, self.steps), time.perf_counter()
        self.loss = self.descent.rank.mean(self.taker.take(first, last), self.descent.device)
        self.step, self.seconds = last, self.seconds + time.perf_counter() - started
        if not self.loss < float("inf"):
            raise InstabilityError(
                f"training of the {self.descent.fit.name} field diverged: mean loss {self.loss} in steps"
                f" {first} to {last}; choose a lower trainer.learning_rate, and look for non-finite data"
            )
        self.progress.advance(last - first)
        metrics = {
            "loss": self.loss,
            "learning_rate": self.descent.schedule.rate_at(last - 1, self.steps),
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
    shown = descent.rank.first
    with quiet_lightning(), Progress(f"train {descent.fit.name}", steps, "steps", shown) as progress:
        module = FieldTraining(descent, steps, checkpoint, progress)
        trainer = pl.Trainer(
            **_placement(descent),
            plugins=_BesideTheLast(),
            max_epochs=-1,
            enable_checkpointing=False,  # ModelCheckpoint counts the steps of Lightning's wrapped optimizer
            logger=loggers(folder, tracking) if descent.rank.first else False,
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


def _placement(descent: Descent) -> dict[str, Any]:
    """On which devices, and how, Lightning trains."""
    device, rank = descent.device, descent.rank
    accelerator = "gpu" if device.type == "cuda" else "cpu"
    if rank.alone:
        return {"accelerator": accelerator, "devices": [device.index or 0] if accelerator == "gpu" else 1}
    together = DDPStrategy(cluster_environment=LightningEnvironment())
    return {"accelerator": accelerator, "devices": rank.count, "strategy": together}
