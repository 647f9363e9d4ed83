"""The optimiser steps of one phase of training."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim import Adam, Muon, Optimizer

from nsf.data import Snapshots
from nsf.gpu import without_collection
from nsf.kinematics.training.phases import PHASES, Fit, seed_of
from nsf.kinematics.training.schedules import Trainer

MUON = 5.0  # times the schedule's rate with Muon, of all weights; 0.002 is a rate for Adam alone
EAGER_STEPS = 3  # before a capture, as torch asks
CHECKPOINT = "last.ckpt"  # of a phase, in its folder


def muon_and_adam(network: nn.Module, rate: float) -> list[Optimizer]:
    """Muon for the matrices of a network and Adam for all else; one learning rate is fit for both.

    Source: Jordan et al. 2024, Muon: an optimizer for hidden layers in neural networks.
    """
    weights = list(network.parameters())
    matrices, others = ([w for w in weights if (w.ndim == 2) is flat] for flat in (True, False))
    return [
        Muon(matrices, lr=rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
        Adam(others, lr=rate),
    ]


@contextlib.contextmanager
def tf32() -> Iterator[None]:
    """Multiply matrices of fp32 on a GPU's tensor cores, with 10 bits after the leading one."""
    matmul = torch.backends.cuda.matmul
    before = matmul.fp32_precision
    matmul.fp32_precision = "tf32"
    try:
        yield
    finally:
        matmul.fp32_precision = before


@dataclass(frozen=True)
class Descent:
    """The minimisation of one phase; each step is a function of the weights, its number and the seed.

    Attributes:
        fit, schedule: the network with its loss, and the batches and rates.
        snapshots: what the loss reads.
    """

    fit: Fit
    schedule: Trainer
    snapshots: Snapshots
    seed: int
    device: torch.device

    @property
    def replayable(self) -> bool:
        """Whether every step is the same sequence of kernels, with no word from the host."""
        local = self.snapshots.resident or not self.fit.pointwise
        return self.device.type == "cuda" and self.schedule.stationary and local

    def optimizers(self) -> list[Optimizer]:
        """Adam, as in the paper, or with Muon, where the schedule has it; `Steps` sets the rate."""
        if self._by_muon:
            return muon_and_adam(self.fit.network, MUON * self.schedule.rate_at(0, 1))
        return [Adam(self.fit.network.parameters(), fused=True)]

    def rate_at(self, step: int, steps: int) -> float:
        """Learning rate at a step, of every optimizer."""
        return self.schedule.rate_at(step, steps) * (MUON if self._by_muon else 1.0)

    @property
    def _by_muon(self) -> bool:
        return self.schedule.muon and self.fit.pointwise


class Steps:
    """Takes the optimiser steps of a phase.

    On a GPU a gradient can cost more to launch than to compute (field=basis, H200: 2.5 ms against 0.4 ms), so
    after some eager steps one is captured as a CUDA graph and replayed: the same kernels and the same bits.

    Args:
        descent: the phase.
        optimizers: of its network, already in the state they start from.
        steps: how many there are in all.
    """

    def __init__(self, descent: Descent, optimizers: Sequence[Optimizer], steps: int):
        self.descent, self.optimizers, self.steps = descent, optimizers, steps
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
        descent, rate = self.descent, self.descent.rate_at(step, self.steps)
        self._generator.manual_seed(seed_of(descent.seed, PHASES.index(descent.fit.name), step))
        loss = self._gradient(step)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = rate
            optimizer.step()
        return loss

    def _gradient(self, step: int) -> Tensor:
        """Fill the gradients; returns the loss."""
        if self._eager_left > 0:
            self._eager_left -= 1
            return self._descend(step)
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            self._graph.register_generator_state(self._generator)
            with without_collection(), torch.cuda.graph(self._graph, stream=self._stream):
                self._loss = self._descend(step)
        self._graph.replay()
        return self._loss

    def _descend(self, step: int) -> Tensor:
        descent = self.descent
        fit = descent.fit
        rows, particles = descent.schedule.batch(
            step, fit, descent.snapshots.M, descent.snapshots.P, descent.seed, self._generator
        )
        fast = descent.schedule.bf16 and fit.pointwise and descent.device.type == "cuda"
        low = fast and not fit.fine
        with tf32() if fast else contextlib.nullcontext():
            # A cached cast of a weight would be a tensor of one step in the graph of all.
            with torch.autocast(descent.device.type, torch.bfloat16, enabled=low, cache_enabled=False):
                loss = fit.loss(rows, particles, self._generator)
            fit.network.zero_grad()
            loss.backward()
        return loss.detach()
