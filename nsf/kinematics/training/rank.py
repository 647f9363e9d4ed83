"""Which of several processes that train a field this one is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import distributed

from nsf.kinematics.training.phases import seed_of

SEED_STREAM = 1 << 10  # the number of no phase, so that the seed of a rank is that of no step


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
