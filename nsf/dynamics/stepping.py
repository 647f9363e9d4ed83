"""Steps through the phases of time, of one reduced run or of several that advance together."""

from collections.abc import Callable, Sequence
from functools import partial

import torch

from nsf.dynamics.interop import captured, on_torch_stream
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.phase import DecodedPhase, Phase, SearchingPhase, Setting, Stages
from nsf.errors import ConfigError
from nsf.mpm import BoundaryArrays, Grid, GridStep
from nsf.timing import StageTimer, untimed


class Phased:
    """What has phases of time, and the step at which each begins."""

    _phases: Sequence[Phase] = ()
    _starts: Sequence[int] = ()

    def _phase_at(self, step: int) -> Phase:
        return self._phases[max(i for i, start in enumerate(self._starts) if start <= step)]


class Stepping(Phased):
    """Takes steps, each from a captured graph where that can be.

    Attributes:
        steps_taken, total_steps: taken, and those to the end of the scene.
        device: Warp device.
        record: of the latent vectors; boundaries: colliders and walls.
    """

    steps_taken: int
    total_steps: int
    record: LatentRecord
    boundaries: BoundaryArrays

    def restart(self) -> None:
        """Go back to t = 0; captured graphs stay good."""
        self.steps_taken = 0
        self.record.restart()
        with on_torch_stream(self.device):
            self.boundaries.start_from(0)
        self._enter(self._phases[0])

    def step(self, n: int = 1) -> None:
        """Advance by n steps of Δt.

        Raises:
            ConfigError: the steps would pass the scene's end.
        """
        if self.steps_taken + n > self.total_steps:
            raise ConfigError(
                f"{self.steps_taken} + {n} steps pass the end of the scene, {self.total_steps} steps"
            )
        with torch.no_grad():
            for _ in range(n):
                self._step(self._advance)

    def timed_step(self, timer: StageTimer) -> None:
        """One step, stage by stage under a timer; captured anew where steps are captured."""
        with torch.no_grad():
            self._step(partial(self._advance_timed, timer))

    @property
    def stages(self) -> Stages:
        """One step, stage by stage, in order."""
        return self._phase.stages

    def _step(self, advance: Callable[[], None]) -> None:
        phase = self._phase_at(self.steps_taken)
        if phase is not self._phase:
            self._enter(phase)
        advance()
        self.steps_taken += 1

    def _enter(self, phase: Phase) -> None:
        """Give the phase the state one step back, which the backward difference needs."""
        self._phase = phase
        with torch.no_grad():
            phase.enter(first=self.steps_taken == 0)  # the first velocity is the initial one

    def _advance(self) -> None:
        phase = self._phase
        if not self.device.is_cuda or not phase.capturable:
            self._run_stages()
        elif phase.graph is None:
            # The first step runs uncaptured, so that kernels and libraries are loaded.
            self._run_stages()
            with captured(self.device) as graph:
                self._run_stages()
            phase.graph = graph
        else:
            phase.graph.replay()

    def _advance_timed(self, timer: StageTimer) -> None:
        if self._phase.graph is None:
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


def build_phases(runs: Sequence, record: LatentRecord, boundaries: BoundaryArrays) -> list[Phase]:
    """The phases of runs that advance together.

    Args:
        runs: `ReducedRun`s that differ in parameters, gravity, colliders, law and start alone; several can
            be stepped in coefficients.
        record: theirs, of one or of several.
        boundaries: colliders and walls; of several runs those of each, one by one.
    """
    from nsf.dynamics.modal import ModalPhase, steps_in_coefficients  # which needs this package

    run = runs[0]
    setting = Setting(
        [each.scene_particles for each in runs], [each.initial_velocity for each in runs], record,
        run.projector, run.dt, run.precision, run.dtype, run.torch_device,
    )  # fmt: skip
    gravity = [each.gravity for each in runs]
    modal = steps_in_coefficients(run.manifold, run.projector, run.precision, run.device)

    def build(sets, weights) -> Phase:
        grid = Grid(run.geometry, run.precision, run.device, sets.nodes, copies=len(runs))
        step = GridStep(grid, boundaries, run.transfer, gravity, run.dt, run.precision, run.device)
        if modal:
            parameters = torch.stack([each.parameters for each in runs])
            materials = [each.scene.material for each in runs]
            return ModalPhase(
                setting, sets, step, run.transfer.shape, run.manifold, run.method, parameters, materials,
                weights,
            )  # fmt: skip
        at = run.manifold.restrict(particles=sets.integration, dtype=run.dtype, device=run.torch_device)
        search = run.integration.strategy == "search"
        decoded = partial(SearchingPhase, search=run.search) if search else DecodedPhase
        return decoded(setting, sets, step, at, run.stress_of, run.affine_of, weights)

    return [build(sets, phase.weights) for sets, phase in zip(run.sets, run.phases, strict=True)]
