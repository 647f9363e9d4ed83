"""Reduced simulations of one model that take their steps together."""

from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.solver import ReducedRun
from nsf.dynamics.stepping import Stepping, build_phases
from nsf.errors import ConfigError
from nsf.mpm import BoundaryArrays
from nsf.sampling.sampler import SamplePhase, Sampler
from nsf.timing import StageTimer


class ReducedBatch(Stepping):
    """Steps the latent vectors of B simulations in the same kernel launches.

    They are of one manifold, one sample and one grid. What a problem parameter or a start may change is each
    one's own: μ of the heads, initial velocity and latent vector, mass, elastic moduli, gravity, colliders
    and, where τ comes from ∂g/∂X, the law's constants. Nothing that one does reaches another, and each takes
    the steps of a `ReducedMPM` of its own, but for round-off.

    Args:
        runs: the simulations at t = 0; afterwards each is asked for its own state and trajectory.

    Attributes:
        runs: as given.
        steps_taken, total_steps, device: of all.

    Raises:
        ConfigError: the fields or the projector cannot be stepped in coefficients; N is searched for; two
            runs differ in what a batch shares, names the first such thing and the parameters; a run has steps
            of its own.
    """

    def __init__(self, runs: Sequence[ReducedRun]):
        if not runs:
            raise ConfigError("a batch needs at least one run")
        self.runs = tuple(runs)
        first = self.runs[0]
        _check_steps(first)
        for run in self.runs:
            if run.steps_taken or run._phases:
                raise ConfigError("a run of a batch must be a ReducedRun at t = 0 that no other solver steps")
            _check_alike(first, run)
        self.device, self.total_steps, self.steps_taken = first.device, first.total_steps, 0
        starts = torch.stack([run.record.now for run in self.runs])
        self.record = LatentRecord(starts, self.total_steps, first.projector.iterations)
        colliders = chain.from_iterable(run.scene.colliders for run in self.runs)
        self.boundaries = BoundaryArrays(tuple(colliders), first.scene.walls, first.precision, first.device)
        self._phases = build_phases(self.runs, self.record, self.boundaries)
        self._starts = first._starts
        for index, run in enumerate(self.runs):
            run._index, run._phases, run.record = index, self._phases, self.record.of(index)
        self._enter(self._phases[0])

    @classmethod
    def of_scene(
        cls,
        scene,
        manifold,
        parameters: Sequence[Mapping[str, float]],
        sample: int | Sequence[int] | Sampler | Sequence[SamplePhase] | None = None,
        xhat: Sequence | None = None,
        velocity: Sequence | None = None,
        **options,
    ) -> "ReducedBatch":
        """A batch of one scene.

        Args:
            scene: an `nsf.scenes.Scene`.
            manifold: trained fields.
            parameters: `{name: value}` of each simulation.
            sample, options: as for `ReducedMPM.of_scene`.
            xhat, velocity: [B, r] and [B, P, 3], as for `ReducedRun`; None in place of one for its default.

        Raises:
            ConfigError: no parameters, or another number of xhat or velocity; and see `ReducedBatch`.
        """
        states = []
        for name, values in (("xhat", xhat), ("velocity", velocity)):
            values = [None] * len(parameters) if values is None else list(values)
            if len(values) != len(parameters):
                raise ConfigError(f"{name} is given for {len(values)} of {len(parameters)} simulations")
            states.append([{name: value} for value in values])
        runs: list[ReducedRun] = []
        for values, *state in zip(parameters, *states, strict=True):
            if runs:  # the sample and the sets depend on the manifold alone: found once
                sample, options = runs[0].phases, options | {"sets": runs[0].sets}
            own = {key: value for part in state for key, value in part.items()}
            runs.append(ReducedRun.of_scene(scene, manifold, values, sample, **options, **own))
        return cls(runs)

    def __len__(self) -> int:
        return len(self.runs)

    @property
    def xhat(self) -> torch.Tensor:
        """[B, r] latent vectors, on the device."""
        return self.record.now

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays and fields take on the device."""
        return sum(phase.nbytes for phase in self._phases) + self.record.nbytes

    @override
    def restart(self) -> None:
        super().restart()
        self._tell()

    @override
    def step(self, n: int = 1) -> None:
        super().step(n)
        self._tell()

    @override
    def timed_step(self, timer: StageTimer) -> None:
        super().timed_step(timer)
        self._tell()

    def _tell(self) -> None:
        for run in self.runs:
            run.steps_taken = self.steps_taken


def _check_steps(run: ReducedRun) -> None:
    """Refuse a model whose steps several simulations cannot share."""
    from nsf.dynamics.modal import steps_in_coefficients  # which needs this package

    if not steps_in_coefficients(run.manifold, run.projector, run.precision, run.device):
        raise ConfigError(
            f"field={run.manifold.field} with {type(run.projector).__name__} evaluates its fields for one "
            "simulation at a time; a batch needs field=basis, networks that a block of the GPU holds, and "
            "projector=gauss_newton or taylor; else set deploy.batch=1"
        )
    if run.integration.strategy != "superset":
        raise ConfigError(
            f"integration={run.integration.strategy} needs a whole grid for each simulation; a batch needs "
            "integration=superset, else set deploy.batch=1"
        )


def _check_alike(first: ReducedRun, other: ReducedRun) -> None:
    """Refuse a run that differs from the first in what a batch shares."""

    def same(of) -> bool:
        return of(first) == of(other)

    shared = {
        "the manifold": first.manifold is other.manifold,
        "the method": same(lambda run: run.method),
        "the projector": same(lambda run: run.projector),
        "the precision": same(lambda run: run.precision.name),
        "the device": same(lambda run: str(run.device)),
        "the grid": same(lambda run: run.geometry),
        "the transfer": same(lambda run: run.transfer),
        "the domain's walls": same(lambda run: run.scene.walls),
        "the number of colliders": same(lambda run: len(run.scene.colliders)),
        "Δt or the number of steps": same(lambda run: (run.dt, run.total_steps)),
        "the sample": _same_sample(first, other),
        "the law": first.method.neural_stress
        or same(lambda run: run.scene.material.functions(run.precision)),
    }
    differing = [name for name, alike in shared.items() if not alike]
    if differing:
        (name, one), (_, value) = (_parameter(run) for run in (first, other))
        raise ConfigError(
            f"simulations of a batch share {differing[0]}, which differs between {name}={one:g} and "
            f"{name}={value:g}; step them one by one, with deploy.batch=1"
        )


def _same_sample(first: ReducedRun, other: ReducedRun) -> bool:
    def arrays(run: ReducedRun) -> list:
        found = [[phase.start, phase.particles, phase.weights] for phase in run.phases]
        return found + [[sets.integration, sets.nodes] for sets in run.sets]

    one, two = arrays(first), arrays(other)
    if [len(part) for part in one] != [len(part) for part in two]:
        return False
    pairs = zip(chain(*one), chain(*two), strict=True)
    return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


def _parameter(run: ReducedRun) -> tuple[str, float]:
    """Name and value of a run's problem parameter."""
    name = run.scene.parameters.name
    return name, float(run.given[name])
