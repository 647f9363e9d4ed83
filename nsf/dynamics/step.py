"""One step of the reduced model, from x̂_n to x̂_{n+1} (paper section 5).

    5.1  inference  x = g(X, x̂_n), v = (x − g(X, x̂_{n−1})) / Δt, τ = h(X, x̂_n, μ), C = l(X, x̂_n, μ) at N
    5.2  P2G, G2P   N → grid, boundaries, grid → S: positions x_S at the end of the step
    5.3  inversion  x̂_{n+1} = argmin Σ_S w_p ‖g(X_p, x̂) − x_p‖²
    5.4  S is the sample, N its integration particles: all that share a grid node with one of S

`Step.stages` has these in order. This text is the reference for any field and any projector, on a CPU and on
a GPU: the engines compute the same, and leave steps that they cannot compute to it.
"""

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.inference import Inference
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.span import GridSpan, Stages
from nsf.sampling.sampler import SampleSpan


class Step(GridSpan):
    """Infers the particles of N from x̂, takes one MPM step of them, and finds the x̂ of where S went.

    Args:
        batch: of one run.
        sample: S and its weights.
        sets: S, N and the nodes I of S; every particle, S first, and no nodes where each step searches N.

    Source: paper section 5.
    """

    def __init__(self, batch: Batch, sample: SampleSpan, sets: ParticleSets):
        setup, N = batch.shared, sets.integration
        at_integration = setup.manifold.restrict(particles=N, dtype=setup.dtype, device=setup.torch_device)
        at_sample = at_integration.subset(slice(0, len(sets.sample)))
        super().__init__(batch, sets, N, at_sample)
        self.record, self.projector = batch.record.of(0), setup.projector
        self.inference = Inference(at_integration, *setup.sources_at(at_integration, N), setup.dt)
        self.weights = None
        if sample.weights is not None:
            weights = sample.weights / np.mean(sample.weights)
            self.weights = torch.as_tensor(weights, dtype=setup.dtype, device=setup.torch_device)

    @property
    @override
    def stages(self) -> Stages:
        return {
            "inference": self.infer,
            "transfer": self.load,
            "p2g": self.p2g,
            "g2p": self.update_g2p,
            "inversion": self.project,
        }

    def infer(self) -> None:
        """x, v, τ and C at N, of x̂_n and x̂_{n−1} (section 5.1)."""
        self.inferred = self.inference(self.record.now)

    def load(self) -> None:
        """Copy x, v, τ and C into the arrays that torch and Warp share."""
        for array, values in zip((self.x, self.v, self.tau, self.C), self.inferred, strict=True):
            if values is not None:
                array.copy_(values)

    def p2g(self) -> None:
        """N → grid: mass, momentum and the impulse of the stress (sections 3 and 5.2)."""
        self.grid_step.p2g(*self.particles)

    def update_g2p(self) -> None:
        """Momentum → velocity and boundaries at the nodes of S; then x and v of S by G2P (section 5.2)."""
        self.grid_step.follow()
        self.grid_step.update_g2p(self.particles.x, self.particles.v, self.s)

    def project(self) -> None:
        """x̂_{n+1}, whose g(X_S, x̂) is nearest to where S went (section 5.3)."""
        start = self.projector.start(self.record)
        self.record.add(self.projector.solve(self.at_sample, self.x[: self.s], start, self.weights))

    @override
    def enter(self, first: bool) -> None:
        if first:
            self.inference.begin(self.record.now, self.initial_velocity, self.first_rate()[0])
        else:
            self.inference.begin(self.record.before)

    @property
    @override
    def nbytes(self) -> int:
        weights = 0 if self.weights is None else self.weights.nbytes
        fields = self.inference.at.nbytes - self.at_sample.nbytes  # S is a part of N
        return super().nbytes + fields + self.inference.previous.nbytes + weights


class SearchingStep(Step):
    """S fixed, N searched at each step (paper section 5.4, a and b).

    The fields are evaluated at every particle, and the rows of N are moved to the front of the arrays.
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
        in_N = self._search.integration_mask(x, self._sample_rows)
        in_N[: self.s] = True
        rows = in_N.nonzero().flatten()
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
