"""One step of the reduced model, from x̂_n to x̂_{n+1} (paper section 5).

This is the reference: what is written here is what a step does, for any field and any projector, on a CPU and
on a GPU. The engines compute the same, and give way to it where they cannot.
"""

from collections.abc import Sequence

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.inference import Inference
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.span import GridSpan, Stages
from nsf.sampling.sampler import SampleSpan


class Step(GridSpan):
    """Infers the particles of N from x̂, takes one MPM step of them, and finds x̂ from where S went.

    Args:
        batch: of one run.
        sample: S and its weights.
        sets: S, N and I; every particle, S first, and no nodes where N is searched at each step.

    Source: paper section 5.
    """

    def __init__(self, batch: Batch, sample: SampleSpan, sets: ParticleSets):
        one = batch.shared
        at = one.manifold.restrict(particles=sets.integration, dtype=one.dtype, device=one.torch_device)
        super().__init__(batch, sets, sets.integration, at.subset(slice(0, len(sets.sample))))
        self.record, self.projector = batch.record.of(0), one.projector
        self.inference = Inference(at, *one.sources(at, sets.integration), one.dt)
        self.weights = None
        if sample.weights is not None:
            self.weights = torch.as_tensor(
                sample.weights / np.mean(sample.weights), dtype=one.dtype, device=one.torch_device
            )

    @property
    @override
    def stages(self) -> Stages:
        return {
            "inference": self.infer,
            "transfer": self.load,
            "p2g": self.p2g,
            "g2p": self.update_g2p,
            "inversion": self.project,
            **self.closing,
        }

    def infer(self) -> None:
        """x, v, τ and C at N, of x̂_n and x̂_{n−1} (section 5.1)."""
        self.inferred = self.inference(self.record.now)

    def load(self) -> None:
        """Into the arrays that torch and Warp share."""
        for array, values in zip((self.x, self.v, self.tau, self.C), self.inferred, strict=True):
            if values is not None:
                array.copy_(values)

    def p2g(self) -> None:
        """N → grid: mass, momentum and the impulse of the stress (section 5.2)."""
        self.grid_step.p2g(*self.particles)

    def update_g2p(self) -> None:
        """Momentum → velocity at the nodes of S, boundaries included; then x and v of S (section 5.2)."""
        self.grid_step.follow()
        self.grid_step.update_g2p(self.particles.x, self.particles.v, self.s)

    def project(self) -> None:
        """x̂_{n+1}, whose g(X_S, x̂) is nearest to where S went (section 5.3)."""
        start = self.projector.start(self.record)
        self.record.add(self.projector.solve(self.at_sample, self.x[: self.s], start, self.weights))

    @override
    def enter(self, first: bool) -> None:
        super().enter(first)
        if first:
            self.inference.begin_moving(self.record.now, self.initial_velocity, self.first_rate()[0])
        else:
            self.inference.begin(self.record.before)

    @property
    @override
    def nbytes(self) -> int:
        weights = 0 if self.weights is None else self.weights.nbytes
        shared = self.at_sample.nbytes  # S is a part of N
        return super().nbytes - shared + self.inference.at.nbytes + self.inference.previous.nbytes + weights


class SearchingStep(Step):
    """S fixed, N searched at each step (paper section 5.4, a and b).

    The fields are evaluated at every particle, and those that S needs are moved to the front of the arrays.
    """

    capturable = False

    def __init__(self, batch: Batch, sample: SampleSpan, sets: ParticleSets):
        super().__init__(batch, sample, sets)
        self._search = batch.shared.search
        self._masses = self.mass.clone(), self.volume0.clone()
        self._sample_rows = torch.arange(self.s, device=self.x.device)
        self._sizes: list[int] = []

    @override
    def load(self) -> None:
        x, *_ = self.inferred
        needed = self._search.needed(x, self._sample_rows)
        needed[: self.s] = True
        rows = needed.nonzero().flatten()
        n = len(rows)
        for array, values in zip((self.x, self.v, self.tau, self.C), self.inferred, strict=True):
            array[:n] = 0.0 if values is None else values[rows]
        self.mass[:n], self.volume0[:n] = (values[rows] for values in self._masses)
        self.bind(n)
        self._sizes.append(n)

    @property
    @override
    def mean_sizes(self) -> list[float]:
        return [float(np.mean(self._sizes))] if self._sizes else super().mean_sizes


def steps_of(batch: Batch) -> Sequence[Step]:
    """The reference's step for each span of time of a batch of one run."""
    one = batch.shared
    kind = SearchingStep if one.integration.strategy == "search" else Step
    return [kind(batch, sample, sets) for sample, sets in zip(one.samples, one.sets, strict=True)]
