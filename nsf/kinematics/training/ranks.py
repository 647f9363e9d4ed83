"""Training of one field in several processes: each has a device, and a shard of the snapshots on it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import distributed

from nsf.data import Snapshots
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.phases import seed_of
from nsf.kinematics.training.schedules import Trainer
from nsf.workers import results, working

SEED_STREAM = 1 << 10  # the number of no phase, so that the seed of a rank is that of no step
_TIMEOUT = timedelta(hours=6)  # rank 0 reads all snapshots once, while the others wait


@dataclass(frozen=True)
class Rank:
    """One of the processes that train a field together; by default the only one.

    Each takes every step with a part of its batch, drawn from the process's own shard, and all apply the mean
    of their gradients, so that their weights stay the same.

    Attributes:
        number: 0 … count − 1; the first one keeps what is found.
        count: of the processes.
    """

    number: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it is this process that writes."""
        return self.number == 0

    @property
    def alone(self) -> bool:
        """Whether there are no other processes."""
        return self.count == 1

    @property
    def shard(self) -> tuple[int, int]:
        """The share of the snapshots, for `Snapshots`."""
        return self.number, self.count

    def seed(self, seed: int) -> int:
        """Seed of the process's own batches and noise."""
        return seed if self.alone else seed_of(seed, SEED_STREAM, self.number)

    def wait(self) -> None:
        """Wait until every process has come here."""
        if not self.alone:
            distributed.barrier()

    def mean(self, value: float, device: torch.device) -> float:
        """Mean of a value over the processes."""
        if self.alone:
            return value
        total = torch.tensor(value, dtype=torch.float64, device=device)
        distributed.all_reduce(total)
        return float(total) / self.count


ALONE = Rank()


def train_together(
    trajectories: Sequence[Path],
    train: Callable[..., tuple[Manifold, dict[str, float]]],
    trainer: Trainer,
    device: str,
    resident: bool | str = "auto",
) -> tuple[Manifold, dict[str, float]]:
    """Train in `trainer.devices` processes under Lightning's DDP, on the first GPUs or on the CPU.

    Resumed after an interrupt, it ends with the same bits on up to two devices; on more, what is left of the
    steps adds gradients in another order.

    Args:
        trajectories: files of the training parameter values.
        train: `nsf.kinematics.training.train.train` with all arguments but `snapshots`, `trainer`, `device`
            and `rank`; it is pickled.
        trainer: the schedule of all processes together.
        device: "cpu" or "cuda:0".
        resident: as for `Snapshots`, of each process's shard.

    Returns:
        As `train`, from the first process.

    Raises:
        NSFError: what the first process to fail raised, of every kind that `train` raises.
        LaunchError: a process died.
    """
    with TemporaryDirectory() as folder:
        ranks = [Rank(number, trainer.devices) for number in range(trainer.devices)]
        shared = (folder, trajectories, train, trainer, device, resident)
        calls = [partial(run_rank, rank, *shared) for rank in ranks]
        # With this variable Lightning starts no processes of its own.
        environments = [{"LOCAL_RANK": str(rank.number)} for rank in ranks]
        with working(calls, environments) as workers:
            return results(workers)[0]


def run_rank(
    rank: Rank, folder: str, trajectories, train, trainer: Trainer, device: str, resident: bool | str, tell
) -> tuple[Manifold, dict[str, float]]:
    """Train as one of several processes, which find each other in an empty folder; see `train_together`."""
    own = torch.device("cuda", rank.number) if device.startswith("cuda") else torch.device(device)
    if own.type == "cuda":
        torch.cuda.set_device(own)
    else:
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // rank.count))
    distributed.init_process_group(
        "nccl" if own.type == "cuda" else "gloo",
        store=distributed.FileStore(os.path.join(folder, "ranks"), rank.count),
        rank=rank.number,
        world_size=rank.count,
        timeout=_TIMEOUT,
        device_id=own if own.type == "cuda" else None,
    )
    snapshots = Snapshots(trajectories, own, resident, rank.shard)
    found = train(snapshots=snapshots, trainer=trainer, device=own, rank=rank)
    # Not after an error: it could wait for ranks that will not come.
    distributed.destroy_process_group()
    return found
