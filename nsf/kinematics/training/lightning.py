"""One phase of training under Lightning: its data, its module, its callbacks and its trainer.

Imported once a phase begins: Lightning takes longer to load than most commands to end.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.plugins import TorchCheckpointIO
from torch import Tensor
from torch.optim import Adam, Optimizer
from torch.utils.data import DataLoader, Sampler
from typing_extensions import override

from nsf.data import Snapshots, archives
from nsf.errors import InstabilityError
from nsf.gpu import tf32, without_collection
from nsf.kinematics.training.phases import CHECKPOINT, PHASES, Fit, seed_of
from nsf.kinematics.training.schedules import Trainer, muon_and_adam
from nsf.progress import Progress, quiet_lightning

# Steps of a block: enough to hide what Lightning does between two, and about 40 checkpoints a phase.
SHORTEST_BLOCK, LONGEST_BLOCK, BLOCKS = 50, 500, 40
MUON = 5.0  # times the schedule's rate with Muon, of all weights; 0.002 is a rate for Adam alone
EAGER_STEPS = 3  # before a capture, as torch asks


def descend(
    fit: Fit,
    schedule: Trainer,
    snapshots: Snapshots,
    seed: int,
    folder: Path,
    loggers: Callable[[Path], Sequence[Any]],
    say: Callable[[str], object],
) -> dict[str, Any]:
    """Train one phase, from the checkpoint in `folder` if there is one, and it is whole.

    Args:
        fit: the phase; its network is on the device to train on, and left on the host.
        schedule: its steps, batches and rates.
        snapshots: of the training cases, on that device.
        seed: of batches and noise.
        folder: of the phase.
        loggers, say: as for `train`.

    Returns:
        `state` of the network on the host; `steps`; `loss`, the mean of the last block; and `seconds` that
        the steps took, those before an interrupt included.

    Raises:
        KeyboardInterrupt: on an interrupt; the next call goes on from the last whole block.
        InstabilityError: the loss is not finite.
    """
    module, checkpoint = FieldTraining(fit, schedule, snapshots, seed), folder / CHECKPOINT
    data = SnapshotData(snapshots, module.steps)
    with Progress(f"train {fit.name}", module.steps, "steps") as progress:
        options = {
            "max_epochs": len(data.blocks),
            "plugins": _InItsFolder(),
            "callbacks": [StepProgress(progress), BlockCheckpoint(checkpoint)],
            "logger": list(loggers(folder)),
            "log_every_n_steps": 1,
        }
        with trainer_on(snapshots.X.device, **options) as trainer:
            resumed = None if archives.kept(checkpoint, say) is None else checkpoint
            trainer.fit(module, data, ckpt_path=resumed, weights_only=True)
    state = {key: value.cpu() for key, value in fit.network.state_dict().items()}
    return {"state": state, "steps": module.steps, "loss": module.loss, "seconds": module.seconds}


@contextlib.contextmanager
def trainer_on(device: str | torch.device, **options: Any) -> Iterator[pl.Trainer]:
    """A Lightning trainer of one device, without Lightning's own output and checkpoints.

    Args:
        device: `cpu`, `cuda` or `cuda:N`.
        **options: further arguments of the trainer.

    Raises:
        KeyboardInterrupt: on an interrupt in the block, for which Lightning would exit with code 1.
    """
    device = torch.device(device)
    with quiet_lightning():
        trainer = pl.Trainer(
            accelerator="gpu" if device.type == "cuda" else "cpu",
            devices=[device.index or 0] if device.type == "cuda" else 1,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            **options,
        )
        try:
            yield trainer
        except SystemExit as stop:
            raise KeyboardInterrupt from stop


class SnapshotData(pl.LightningDataModule):
    """Snapshots in blocks of optimiser steps: an epoch is a block, from its first step to its end.

    Frames and particles are drawn within a step, where the snapshots lie, by its number (`Trainer.batch`), so
    that a resumed training, which goes on with an epoch, sees what an undisturbed one does. A loader of
    frames with a `training_step` a batch took 44 % longer with 150 particles and 3 % with 2,000 (10.0 and
    6.9 ms, 18.6 and 18.0 ms a step of field=mlp; medians in one process, on one core). On a GPU Lightning's
    millisecond is longer than a step that is replayed (`FieldTraining`).

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
        return DataLoader(self.blocks, batch_size=None, sampler=_EpochSampler())


class _EpochSampler(Sampler[int]):
    """The number of the epoch, which Lightning sets."""

    epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    @override
    def __iter__(self) -> Iterator[int]:
        yield self.epoch

    def __len__(self) -> int:
        return 1


class FieldTraining(pl.LightningModule):
    """Trains the network of one phase, a block of optimiser steps in every `training_step`.

    Each step is a function of the weights, its number and the seed. On a GPU a gradient can cost more to
    launch than to compute (field=basis, H200: 2.5 ms against 0.4 ms), so after some eager steps one is
    captured as a CUDA graph and replayed: the same kernels and the same bits.

    Args:
        fit, schedule, snapshots, seed: as for `descend`.

    Attributes:
        steps: of the phase.
        loss: mean of the last block.
        seconds: that the steps took, those before an interrupt included.
    """

    def __init__(self, fit: Fit, schedule: Trainer, snapshots: Snapshots, seed: int):
        super().__init__()
        self.automatic_optimization = False
        self.phase, self.network = fit, fit.network
        self.schedule, self.snapshots, self.seed = schedule, snapshots, seed
        self.steps = schedule.steps_of(fit.name, snapshots.M)
        self.loss, self.seconds = float("nan"), 0.0

    @property
    def replayable(self) -> bool:
        """Whether every step is the same sequence of kernels, with no word from the host."""
        local = self.snapshots.resident or not self.phase.pointwise
        return self.device.type == "cuda" and self.schedule.stationary and local

    @override
    def configure_optimizers(self) -> list[Optimizer]:
        """Adam, as in the paper, or with Muon, where the schedule has it; each step sets the rate."""
        if self._by_muon:
            return muon_and_adam(self.network, self.rate_at(0))
        return [Adam(self.network.parameters(), fused=True)]

    def rate_at(self, step: int) -> float:
        """Learning rate at a step, of every optimizer."""
        return self.schedule.rate_at(step, self.steps) * (MUON if self._by_muon else 1.0)

    @property
    def _by_muon(self) -> bool:
        return self.schedule.muon and self.phase.pointwise

    @override
    def on_train_start(self) -> None:
        optimizers = self.optimizers(use_pl_optimizer=False)  # its wrapper adds a millisecond to every step
        self.begin(optimizers if isinstance(optimizers, list) else [optimizers])

    def begin(self, optimizers: Sequence[Optimizer]) -> None:
        """Make ready for steps by optimizers that are in the state to start from."""
        self._optimizers, self._generator = optimizers, torch.Generator(self.device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_steps = EAGER_STEPS if self.replayable else self.steps
        # Capture wants the steps before it on its own stream.
        self._stream = torch.cuda.Stream(self.device) if self.replayable else None

    @override
    def training_step(self, block: tuple[int, int], index: int) -> None:
        (first, last), started = block, time.perf_counter()
        self.loss = self.take(first, last)
        seconds = time.perf_counter() - started
        self.seconds += seconds
        if not self.loss < float("inf"):
            raise InstabilityError(
                f"training of the {self.phase.name} field diverged: mean loss {self.loss} in steps"
                f" {first} to {last}; choose a lower trainer.learning_rate, and look for non-finite data"
            )
        rate, speed = self.rate_at(last - 1), (last - first) / seconds
        # Lightning takes `step` for the place on the axis.
        values = {"loss": self.loss, "learning_rate": rate, "steps_per_second": speed}
        self.log_dict({f"{self.phase.name}/{name}": value for name, value in values.items()} | {"step": last})

    def take(self, first: int, last: int) -> float:
        """Take the steps first, ..., last − 1; returns their mean loss."""
        total = torch.zeros((), device=self.device)
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(self._stream):
            for step in range(first, last):
                total += self._step(step)
            return float(total) / (last - first)

    def _step(self, step: int) -> Tensor:
        """Take one step; returns its loss."""
        self._generator.manual_seed(seed_of(self.seed, PHASES.index(self.phase.name), step))
        loss, rate = self._gradient(step), self.rate_at(step)
        for optimizer in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = rate
            optimizer.step()
        return loss

    def _gradient(self, step: int) -> Tensor:
        """Fill the gradients, eagerly or by the captured graph; returns the loss."""
        if self._eager_steps > 0:
            self._eager_steps -= 1
            return self._backpropagate(step)
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            self._graph.register_generator_state(self._generator)
            with without_collection(), torch.cuda.graph(self._graph, stream=self._stream):
                self._captured_loss = self._backpropagate(step)
        self._graph.replay()
        return self._captured_loss

    def _backpropagate(self, step: int) -> Tensor:
        fit, snapshots = self.phase, self.snapshots
        rows, particles = self.schedule.batch(step, fit, snapshots.M, snapshots.P, self.seed, self._generator)
        fast = self.schedule.bf16 and fit.pointwise and self.device.type == "cuda"
        low = fast and not fit.fine
        with tf32() if fast else contextlib.nullcontext():
            # A cached cast of a weight would be a tensor of one step in the graph of all.
            with torch.autocast(self.device.type, torch.bfloat16, enabled=low, cache_enabled=False):
                loss = fit.loss(rows, particles, self._generator)
            fit.network.zero_grad()
            loss.backward()
        return loss.detach()

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
