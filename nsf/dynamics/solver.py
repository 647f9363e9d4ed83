"""The reduced-order solver, of one run or of several that take their steps together (paper section 5)."""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from nsf.dynamics.batch import Batch
from nsf.dynamics.inference import Decoder
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.interop import captured, on_torch_stream
from nsf.dynamics.latent import LatentState, LatentTrajectory
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import Span, Stages
from nsf.errors import ConfigError
from nsf.kinematics.manifold import Restriction
from nsf.mpm import Hand
from nsf.timing import StageTimer, untimed


class ReducedBatch:
    """Steps the latent vectors of B runs together; one run is a batch of one.

    Nothing that one run does reaches another, and each takes the steps that it would take alone, but for
    round-off.

    Args:
        setups: the inputs of each run; see `Batch` for what they share.
        engine: takes the steps, an `nsf.engines.Engine`.
        why: the reason for its choice; for the record.

    Attributes:
        batch: setups, record of the latent vectors, forcing.
        engine, why: name of the engine, and the reason.
        steps_taken, total_steps: so far, and to the end of the scene.
        dt: step [s]; device: Warp device.

    Raises:
        ConfigError: see `Batch.of`.

    Source: paper section 5.
    """

    def __init__(self, setups: Sequence[Setup], engine, why: str = ""):
        self.batch = Batch.of(setups)
        self._engine, self.engine, self.why = engine, engine.name, why
        shared = self.batch.shared
        self.dt, self.total_steps, self.device = shared.dt, shared.total_steps, shared.device
        self.steps_taken = 0
        self._starts, self._spans = shared.starts, engine.spans(self.batch)
        self._enter(self._spans[0])

    def __len__(self) -> int:
        return len(self.batch)

    @property
    def runs(self) -> tuple["ReducedMPM", ...]:
        """Each run, with its own state and trajectory."""
        return tuple(ReducedMPM(self, index) for index in range(len(self)))

    def hand(self, index: int = 0) -> Hand:
        """The forcing of one of the runs, which may be set between steps."""
        names = tuple(self.batch.setups[index].scene.colliders)
        return Hand(self.batch.forcing, lambda: self.time, index, names)

    def alone(self, index: int) -> "ReducedBatch":
        """One of the runs, at t = 0 and in a batch of its own."""
        return ReducedBatch([self.batch.setups[index]], self._engine, self.why)

    @property
    def xhat(self) -> torch.Tensor:
        """[B, r] latent vectors, on the device."""
        return self.batch.record.now

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays and fields take on the device."""
        return sum(span.nbytes for span in self._spans) + self.batch.record.nbytes

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.steps_taken * self.dt

    @property
    def span(self) -> Span:
        """The span of time that takes the steps now."""
        return self._span

    def span_at(self, step: int) -> Span:
        """The span of time that takes the step which starts `step` steps after t = 0."""
        return self._spans[max(i for i, start in enumerate(self._starts) if start <= step)]

    def steps_by_span(self, since: int = 0) -> list[tuple[int, Span]]:
        """Each span of time with how many steps it took, from step `since` on."""
        ends = [*self._starts[1:], self.total_steps]
        parts = zip(self._starts, ends, self._spans, strict=True)
        return [(max(0, min(self.steps_taken, end) - max(start, since)), span) for start, end, span in parts]

    def restart(self) -> None:
        """Go back to t = 0, and to the scene's own forcing; captured graphs stay good."""
        self.batch.record.restart()
        self.batch.forcing.release()
        self.resume(0)

    def resume(self, step: int) -> None:
        """Go on from the latent vectors of the record as the end of so many steps."""
        self.steps_taken = step
        with on_torch_stream(self.device):
            self._enter(self.span_at(step))
            self.batch.forcing.start_from(step)

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt.

        Raises:
            ConfigError: the steps would pass the scene's end.
        """
        if self.steps_taken + n > self.total_steps:
            raise ConfigError(
                f"{self.steps_taken} + {n} steps pass the end of the scene, {self.total_steps} steps"
            )
        last = self.steps_taken + n
        with torch.no_grad():
            while self.steps_taken < last:
                self._begin_step()
                if self._span.latent_only:
                    steps = min(last, self._end_of_span()) - self.steps_taken
                    with on_torch_stream(self.device):
                        self._span.take(steps)
                else:
                    steps = 1
                    self._advance()
                self.steps_taken += steps

    def timed_step(self, timer: StageTimer) -> None:
        """One step, stage by stage under a timer; captured anew where steps are captured."""
        with torch.no_grad():
            self._begin_step()
            self._advance_timed(timer)
            self.steps_taken += 1

    @property
    def stages(self) -> Stages:
        """One step, stage by stage, in order."""
        return self._span.stages

    def _begin_step(self) -> None:
        """Be in the span of time that the next step is of."""
        span = self.span_at(self.steps_taken)
        if span.latent_only:
            self._span = span
        elif span is not self._span:
            self._enter(span)

    def _end_of_span(self) -> int:
        """Step with which the next span of time begins, or the scene's end."""
        return min([start for start in self._starts if start > self.steps_taken], default=self.total_steps)

    def _enter(self, span: Span) -> None:
        """Give the span the state one step back, which the backward difference needs."""
        self._span = span
        with torch.no_grad():
            span.enter(first=self.steps_taken == 0)  # the first velocity is the initial one

    def _advance(self) -> None:
        span = self._span
        if not self.device.is_cuda or not span.capturable:
            self._run_stages()
        elif span.graph is None:
            # The first step runs uncaptured, so that kernels and libraries are loaded.
            self._run_stages()
            with captured(self.device) as graph:
                self._run_stages()
            span.graph = graph
        else:
            span.graph.replay()

    def _advance_timed(self, timer: StageTimer) -> None:
        if self._span.graph is None:
            self._run_stages(timer)
        else:
            with captured(self.device) as graph:
                self._run_stages(timer.captured)
            graph.replay()
            timer.add_launch()

    def _run_stages(self, timer: Callable = untimed) -> None:
        with on_torch_stream(self.device):
            for name, stage in self.stages.items():
                with timer(name):
                    stage()


class ReducedMPM:
    """One reduced run, with the interface of `FullOrderMPM` and its latent vectors.

    The runs of a batch take their steps together.

    Args:
        together: the batch that it is of.
        index: which of its runs.

    Attributes:
        setup: the inputs of the run; scene, manifold, device, dt, total_steps, samples and sets are the
            setup's; dx: grid spacing [m].
        record: latent vectors, residuals and updates, on the device.
    """

    def __init__(self, together: ReducedBatch, index: int = 0):
        self.together, self.index = together, index
        self.setup, self.record = together.batch.setups[index], together.batch.record.of(index)
        self.scene, self.manifold, self.device = self.setup.scene, self.setup.manifold, self.setup.device
        self.dt, self.dx, self.total_steps = together.dt, self.setup.geometry.dx, together.total_steps
        self.samples, self.sets = self.setup.samples, self.setup.sets

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt, with the runs that it advances with; see `ReducedBatch.step`."""
        self.together.step(n)

    def timed_step(self, timer: StageTimer) -> None:
        """One step, stage by stage under a timer."""
        self.together.timed_step(timer)

    def restart(self) -> None:
        """Go back to t = 0."""
        self.together.restart()

    @property
    def stages(self) -> Stages:
        """One step, stage by stage, in order."""
        return self.together.stages

    @property
    def steps_taken(self) -> int:
        """Number of steps taken."""
        return self.together.steps_taken

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.together.time

    @property
    def forcing(self) -> Hand:
        """Gravity and colliders, which may be set between steps."""
        return self.together.hand(self.index)

    def acting_gravity(self, t: np.ndarray) -> np.ndarray:
        """[n, 3] gravity [m/s²] at times t [n] [s], of the scene's programs or the hand in their place."""
        return self.together.batch.forcing.gravities[self.index].at(t)

    @property
    def engine(self) -> str:
        """Name of the engine that takes the steps."""
        return self.together.engine

    @property
    def latents(self) -> np.ndarray:
        """x̂ [N + 1, r] up to now, on the host."""
        return self.record.read_back(self.record.xhat[: self.steps_taken + 1]).numpy()

    @property
    def members(self) -> np.ndarray | None:
        """x̂ [M, n + 1, r] of members of its model at each of the span's strides; None of a single one."""
        members = self.span.members(self.steps_taken)
        return None if members is None else members[:, self.index].double().numpy()

    @property
    def nbytes(self) -> int:
        """Bytes that the solver's arrays and fields take on the device, of the whole batch."""
        return self.together.nbytes

    @property
    def state(self) -> LatentState:
        """The latent state; `state.numpy()` decodes every particle."""
        return LatentState(self)

    @property
    def xhat(self) -> torch.Tensor:
        """[r] latent vector, on the device."""
        return self.record.now

    @property
    def stress(self) -> torch.Tensor | None:
        """[1, n_s] ŝ now, on the device, of a run that has it."""
        held = self.record.stress
        return None if held is None else held[self.steps_taken][None]

    @property
    def rate(self) -> torch.Tensor:
        """[r] dx̂/dt [1/s] as the next step takes it, on the device."""
        return (self.xhat - self.record.before) / self.dt if self.steps_taken else self.first_rate

    @property
    def first_rate(self) -> torch.Tensor:
        """[r] dx̂/dt [1/s] at t = 0, see `Span.first_rate`."""
        return self.together.span_at(0).first_rate()[self.index]

    def trajectory(self) -> LatentTrajectory:
        """Everything recorded up to now, on the host."""
        # Of latent vectors alone nothing was projected, so nothing stopped.
        stops = [self.engine] * self.steps_taken if self.span.latent_only else None
        return self.record.trajectory(self.steps_taken, self.dt, self.setup.projector.tolerance, stops)

    @property
    def sample_size(self) -> int:
        """|S| of the first span of time."""
        return len(self.sets[0].sample)

    @property
    def integration_mean(self) -> float:
        """Mean |N| over the steps taken; before them, how many there may be."""
        if not self.steps_taken:
            return float(len(self.sets[0].integration))
        spans = self.together.steps_by_span()
        return sum(n * span.mean_sizes[self.index] for n, span in spans) / self.steps_taken

    @property
    def span(self) -> Span:
        """The span of time that takes the steps now: its S, N and arrays."""
        return self.together.span

    def decoder(self, particles: np.ndarray | None = None, at: Restriction | None = None) -> Decoder:
        """The fields at particles [n], or at all, as the method takes them; see `Setup.decoder`."""
        return self.setup.decoder(particles, at)

    def sets_at(self, step: int) -> ParticleSets:
        """S, N and I of the step that starts `step` steps after t = 0."""
        return self.together.span_at(step).sets

    def left_grid(self, since: int = 1) -> int:
        """First step from `since` on that ended with a particle of S off the grid or not finite; −1: none.

        Such a particle no longer takes part in a step, so further steps are no reduced model of anything; the
        full-order solver stops there. Call it after a run: it decodes S at every step.
        """
        first = since
        for count, span in self.together.steps_by_span(since - 1):
            for x in span.at_sample.positions(self.record.xhat[first : first + count]):
                lost = ~self.setup.search.on_grid(x).all(1)
                if bool(lost.any()):
                    return first + int(lost.int().argmax())
                first += len(x)
        return -1

    def needed_outside(self) -> int:
        """Most particles and nodes that a step needed and the superset lacks, or that were off the grid.

        The transfers pass over what is off the grid, and over nodes that are not stored, so both count. Call
        it after a run: it decodes every particle at each step.

        Source: paper section 5.4, b.
        """
        if self.sets[0].nodes is None or self.span.latent_only:
            return 0
        search, worst, n = self.setup.search, 0, 0
        for block in self.decoder().positions(self.record.xhat[: self.steps_taken]):
            for x in block:
                worst = max(worst, search.missing(x, self.sets_at(n)))
                n += 1
        return worst

    def equations_at(
        self, step: int, xhat: torch.Tensor, previous: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The equations that the projection at the end of a step solves, linearised at x̂_n.

        Only of a batch of one, which is left in the midst of that step.

        Args:
            step: steps before it, which set its moment.
            xhat, previous: [r] x̂_n and x̂_{n−1}.

        Returns:
            Error x_S − g(X_S, x̂_n) [s, 3] [m] and Jacobian ∂g/∂x̂ [s, 3, r] [m].
        """
        self.record.now.copy_(xhat)
        self.record.before.copy_(previous)
        self.together.resume(step)
        span = self.together.span
        with torch.no_grad(), on_torch_stream(self.device):
            for name, stage in span.stages.items():
                if name == "inversion":
                    break
                stage()
            position, jacobian = span.at_sample.position_and_jacobian(self.record.now)
        return span.x[: span.s] - position, jacobian
