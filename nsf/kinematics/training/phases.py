"""The phases of a training: g with e, then h, then l (paper section 4.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nsf.errors import ConfigError

# Phase → the snapshots' field it learns and that field's components, the paper's d of a width β·d.
TARGETS = {"deformation": ("x", 3), "stress": ("tau", 6), "affine": ("C", 9)}
PHASES = tuple(TARGETS)

CHECKPOINT = "last.ckpt"  # of a phase, in its folder


def joined(xhat: Tensor, parameters: Tensor) -> Tensor:
    """Latents [..., r] each with the problem parameters [n] (or [..., n]): [..., r + n]."""
    return torch.cat([xhat, parameters.to(xhat).expand(*xhat.shape[:-1], -1)], -1)


def shaped(phase: str, values: Tensor) -> Tensor:
    """Values [..., d] of a phase's field as it is given: C as a matrix [..., 3, 3]."""
    return values.unflatten(-1, (3, 3)) if phase == "affine" else values


@dataclass(frozen=True)
class Fit:
    """One phase: what is optimised and the loss it minimises.

    Attributes:
        name: one of `PHASES`.
        network: holds every parameter optimised in this phase.
        loss: (rows, particles, generator) ↦ scalar; rows index snapshots, particles the particles of each,
            and every random number comes from the generator.
        pointwise: a sample is one particle of one frame; else a whole snapshot, and `particles` is unused.
        fine: the loss has differences that are below the round-off of bfloat16.
    """

    name: str
    network: nn.Module
    loss: Callable[[Tensor | slice, Tensor | slice, torch.Generator], Tensor]
    pointwise: bool
    fine: bool = False


#: Units of a layer, layers, networks, steps: more of them fill memory, or take days before a slip is seen.
MOST_WIDE, MOST_DEEP, MOST_MEMBERS, MOST_STEPS = 16384, 256, 256, 10_000_000


def per_phase(key: str, value: int | Sequence[int], most: int = MOST_WIDE) -> tuple[int, int, int]:
    """A count for g, h and l, given as one for all, a pair (g, h and l) or a triple.

    Raises:
        ConfigError: another number of entries, or an entry that is no whole number from 1 to `most`.
    """
    entries = (value,) if isinstance(value, int) else tuple(value)
    if len(entries) not in (1, 2, 3) or any(not isinstance(n, int) or not 1 <= n <= most for n in entries):
        raise ConfigError(
            f"{key}={value} is not one, two or three whole numbers from 1 to {most}; "
            "give n, [g, h=l] or [g, h, l]"
        )
    return (*entries, *entries[-1:] * (3 - len(entries)))


def seed_of(*stream: int) -> int:
    """One seed out of several numbers, e.g. (seed, phase, step)."""
    state = 0
    for number in stream:
        # SplitMix64's constants: neighbouring seeds and steps land far apart.
        state = ((state ^ number) * 0xBF58476D1CE4E5B9 + 0x9E3779B97F4A7C15) % 2**63
        state ^= state >> 31
    return state


def seeded(device: torch.device | str, *stream: int) -> torch.Generator:
    """A generator that depends on the numbers given and nothing else."""
    return torch.Generator(device).manual_seed(seed_of(*stream))
