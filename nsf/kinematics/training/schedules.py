"""How long, with which learning rates and on which batches a field is trained."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.optim import Adam, Muon, Optimizer
from typing_extensions import override

from nsf.errors import ConfigError
from nsf.kinematics.training.phases import MOST_STEPS, PHASES, Fit, per_phase, seeded
from nsf.scalars import number

# A field fitted to whole snapshots sees all of them in a step, up to so many; of more, so many drawn anew.
MOST_AT_ONCE, DRAWN = 6000, 2048
BATCH_STREAM = 1 << 20  # keeps the epochs' permutations apart from the steps' generators


class Trainer(ABC):
    """A schedule; every choice is a pure function of the step (and seed), so that training can be resumed.

    Attributes:
        frames_per_batch: snapshots that a step sees.
        bf16: on a GPU, evaluate a field fitted to points in bfloat16 in training; in tf32 if `fine`.
        stationary: batches have one shape and know the step through the generator alone, so a step can be
            captured once and replayed.
        muon: a field fitted to points is moved by Muon and Adam at five times the rate, not by Adam alone.
    """

    frames_per_batch: int
    bf16: bool = False
    stationary: ClassVar[bool] = False
    muon: ClassVar[bool] = False

    @abstractmethod
    def steps_of(self, phase: str, frames: int) -> int:
        """Optimiser steps of a phase on so many snapshots."""

    @abstractmethod
    def rate_at(self, step: int, steps: int) -> float:
        """Learning rate of Adam at a step."""

    @abstractmethod
    def batch(
        self, step: int, fit: Fit, frames: int, particles: int, seed: int, generator: torch.Generator
    ) -> tuple[Tensor | slice, Tensor | slice]:
        """Snapshots (rows) and particles of a step."""


@dataclass(frozen=True)
class PaperTrainer(Trainer):
    """The paper's schedule to the letter.

    Attributes:
        learning_rates: used one after the other.
        epochs_deformation, epochs_stress, epochs_affine: epochs at each learning rate.
        frames_per_batch: k; a batch holds k whole frames, k·|P| points. The paper takes the largest k that
            fits in memory, at most 32.

    Source: Zong et al. 2023, appendix "Training Details".
    """

    learning_rates: Sequence[float] = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5)
    epochs_deformation: int = 300
    epochs_stress: int = 600
    epochs_affine: int = 600
    frames_per_batch: int = 32

    def __post_init__(self) -> None:
        if not self.learning_rates or min(self.learning_rates) <= 0:
            raise ConfigError(
                f"learning_rates={list(self.learning_rates)} must be positive; the paper has 1e-3 … 5e-5"
            )
        for key in ("epochs_deformation", "epochs_stress", "epochs_affine", "frames_per_batch"):
            number(key, getattr(self, key), 1, whole=True)

    def _batches(self, frames: int) -> int:
        return math.ceil(frames / self.frames_per_batch)

    @override
    def steps_of(self, phase: str, frames: int) -> int:
        return len(self.learning_rates) * getattr(self, f"epochs_{phase}") * self._batches(frames)

    @override
    def rate_at(self, step: int, steps: int) -> float:
        return self.learning_rates[step * len(self.learning_rates) // steps]

    @override
    def batch(
        self, step: int, fit: Fit, frames: int, particles: int, seed: int, generator: torch.Generator
    ) -> tuple[Tensor, slice]:
        epoch, batch = divmod(step, self._batches(frames))
        order = seeded(generator.device, seed, BATCH_STREAM + PHASES.index(fit.name), epoch)
        rows = torch.randperm(frames, generator=order, device=generator.device)
        return rows[batch * self.frames_per_batch : (batch + 1) * self.frames_per_batch], slice(None)


@dataclass(frozen=True)
class FastTrainer(Trainer):
    """Cosine decay to zero.

    A field fitted to points (mlp) sees random particles of random frames in a step; one fitted to whole
    snapshots (basis) sees all of them in every step, or 2,048 at random where they are more than 6,000.

    Attributes:
        steps: optimiser steps of g, h and l, one number for all, [g, h=l] or [g, h, l].
        learning_rate: at the first step; a field fitted to points has five times as much (`muon`).
        frames_per_batch, particles_per_batch: points of a step, for a field fitted to points.
        bf16: on a GPU, evaluate a field fitted to points in bfloat16 in training; in tf32 if `fine`.
    """

    stationary: ClassVar[bool] = True
    muon: ClassVar[bool] = True

    steps: int | Sequence[int]
    learning_rate: float = 2e-3
    frames_per_batch: int = 32
    particles_per_batch: int = 8192
    bf16: bool = True

    def __post_init__(self) -> None:
        per_phase("steps", self.steps, MOST_STEPS)
        if not self.learning_rate > 0:
            raise ConfigError(
                f"learning_rate={self.learning_rate} must be positive; choose for example 0.002"
            )
        for key in ("frames_per_batch", "particles_per_batch"):
            number(key, getattr(self, key), 1, whole=True)

    @override
    def steps_of(self, phase: str, frames: int) -> int:
        return per_phase("steps", self.steps, MOST_STEPS)[PHASES.index(phase)]

    @override
    def rate_at(self, step: int, steps: int) -> float:
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * step / steps))

    @override
    def batch(
        self, step: int, fit: Fit, frames: int, particles: int, seed: int, generator: torch.Generator
    ) -> tuple[Tensor | slice, Tensor | slice]:

        def draw(population: int, count: int) -> Tensor:
            return torch.randint(population, (count,), generator=generator, device=generator.device)

        if not fit.pointwise:
            return slice(None) if frames <= MOST_AT_ONCE else draw(frames, DRAWN), slice(None)

        return draw(frames, self.frames_per_batch), draw(particles, self.particles_per_batch)


def muon_and_adam(network: nn.Module, rate: float) -> list[Optimizer]:
    """Muon for the matrices of a network and Adam for all else; one learning rate is fit for both.

    Source: Jordan et al. 2024, Muon: an optimizer for hidden layers in neural networks.
    """
    weights = list(network.parameters())
    matrices, vectors = ([w for w in weights if (w.ndim == 2) is flat] for flat in (True, False))
    return [
        Muon(matrices, lr=rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
        Adam(vectors, lr=rate),
    ]
