"""Reduced runs that take their steps together; one run is a batch of one."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import torch

from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.setup import Setup
from nsf.errors import ConfigError
from nsf.mpm import BoundaryArrays, Forcing


@dataclass(frozen=True)
class Batch:
    """B runs that take their steps together: setups, latent vectors and forcing, for whichever engine.

    The runs share manifold, sample and grid. They may differ by what a problem parameter or a start changes:
    μ of the heads, initial velocity and latent vector, mass, elastic moduli, gravity, colliders and, where τ
    comes from ∂g/∂X, the law's constants.

    Attributes:
        setups: [B] of the runs.
        record: latent vectors of all.
        forcing: gravity, colliders and walls; those of each run, one run after the other.
    """

    setups: tuple[Setup, ...]
    record: LatentRecord
    forcing: Forcing

    @classmethod
    def of(cls, setups: Sequence[Setup]) -> "Batch":
        """The runs of some setups, at t = 0.

        Raises:
            ConfigError: there is none; or two differ in what a batch shares: names the first such thing and
                the parameters.
        """
        if not setups:
            raise ConfigError("a batch needs at least one run")
        first = setups[0]
        for other in setups[1:]:
            _check_alike(first, other)
        starts = torch.stack([setup.xhat for setup in setups])
        record = LatentRecord(starts, first.total_steps, first.projector.iterations)
        colliders = tuple(chain.from_iterable(setup.scene.solids for setup in setups))
        boundaries = BoundaryArrays(colliders, first.scene.walls, first.precision, first.device)
        gravities = [setup.gravity for setup in setups]
        return cls(tuple(setups), record, Forcing(gravities, boundaries, first.precision, first.device))

    def __len__(self) -> int:
        return len(self.setups)

    @property
    def shared(self) -> Setup:
        """The first setup, for what is the same in all."""
        return self.setups[0]


def _check_alike(first: Setup, other: Setup) -> None:
    """Refuse a run that differs from the first in what a batch shares."""

    def same(of) -> bool:
        return of(first) == of(other)

    shared = {
        "the manifold": first.manifold is other.manifold,
        "where τ and C come from": same(lambda setup: setup.sources),
        "the projector": same(lambda setup: setup.projector),
        "the precision": same(lambda setup: setup.precision.name),
        "the device": same(lambda setup: str(setup.device)),
        "the grid": same(lambda setup: setup.geometry),
        "the transfer": same(lambda setup: setup.transfer),
        "the domain's walls": same(lambda setup: setup.scene.walls),
        "the number of colliders": same(lambda setup: len(setup.scene.colliders)),
        "Δt or the number of steps": same(lambda setup: (setup.dt, setup.total_steps)),
        "the sample": _same_sample(first, other),
        "the law": first.sources.neural_stress
        or same(lambda setup: setup.scene.material.functions(setup.precision)),
    }
    differing = [name for name, alike in shared.items() if not alike]
    if differing:
        cases = (", ".join(f"{k}={v:g}" for k, v in setup.values.items()) for setup in (first, other))
        raise ConfigError(
            f"runs of a batch share {differing[0]}, which differs between {' and '.join(cases)}; "
            "step them one by one, with deploy.batch=1"
        )


def _same_sample(first: Setup, other: Setup) -> bool:
    """Whether two setups hold the same sample and particle sets, not copies of them."""
    ours, theirs = ([*setup.samples, *setup.sets] for setup in (first, other))
    return len(ours) == len(theirs) and all(map(operator.is_, ours, theirs))
