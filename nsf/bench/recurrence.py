"""A step by a recurrence beside the full-order one: single runs, and many at once."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import build, run_times, window_times
from nsf.bench.reduced import deformation_error, error_of_latents, scenes
from nsf.bench.rows import Case, Measurements
from nsf.data import Case as Parameters
from nsf.data.schema import TRAJECTORY
from nsf.dynamics import ReducedMPM
from nsf.pipeline import Pipeline
from nsf.recurrence import Loop, RecurrenceEngine, collider_states, first_change
from nsf.recurrence.descent import of_strides
from nsf.recurrence.engine import between

#: Runs at once, and the scene that they are of.
MANY, OF_MANY = 1024, "metal"


def run(figures: Measurements) -> None:
    """Each scene, and 1 024 runs of `metal` at once: at the paper's size on a GPU, at small scale on a CPU.

    Data, training and teaching are made, or reused, as by `nsf teach model=recurrence`.
    """
    for scene in scenes(figures):
        measured(_chain(scene, figures), figures, MANY if scene == OF_MANY else 0)


def _chain(scene: str, figures: Measurements) -> Pipeline:
    keys = [f"scene={scene}", f"scale={figures.settings.scale}", f"device={figures.settings.device}"]
    return Pipeline(config.load([*keys, "model=recurrence"]), say=figures.say)


def measured(chain: Pipeline, figures: Measurements, many: int = 0) -> None:
    """Add the rows of one scene in its first held-out case.

    Args:
        chain: of the scene, with `model=recurrence`.
        figures: as for `run`.
        many: runs at once, in rows of their own; 0 for none.
    """
    chain.simulate(("train",))
    chain.train()
    chain.teach()
    manifold, truth = chain.manifold(), chain.truth(chain.held_out[0]).path / TRAJECTORY
    for precision in figures.settings.precisions:
        full_ms, case, run = _compared(chain, manifold, precision, truth, figures)
        if many:
            _together(run, chain, many, full_ms, case, truth, figures)


@torch.no_grad()
def _compared(
    chain: Pipeline, manifold, precision: str, truth: Path, figures: Measurements
) -> tuple[float, Case, ReducedMPM]:
    """Add the rows of either solver in one precision, turn by turn.

    Args:
        chain, manifold: whose recurrence is run.
        precision, truth, figures: of the rows.

    Returns:
        Time of a full-order step [ms], the case of the run by recurrence, and that run at its end.
    """
    settings, device = figures.settings, figures.settings.device
    scene, held_out = chain.scene, chain.held_out[0]
    full, full_peak = build(partial(scene.full_order, held_out, precision, device), device)
    run, peak = build(partial(chain.solver_at, manifold, held_out, precision=precision), device)
    times = window_times({"full": full}, scene.steps, settings.trials, device, whole={"own": run})
    of = partial(Case, bench="recurrence", particles=scene.particle_count, precision=precision)
    case = of(name=f"full_order_{scene.name}")
    full_ms = figures.add(case, "step", times["full"])
    figures.add(case, "peak memory", full_peak, "MiB")
    case = of(name=f"recurrence_{scene.name}", sample=run.sample_size)
    delta = deformation_error(run, truth)
    _add_run(figures, case, times["own"], full_ms, delta, run.nbytes, peak, chain.taught)
    return full_ms, case, run


def _add_run(
    figures: Measurements, case: Case, ms, full_ms: float, delta: float, nbytes: int, peak, teaching
):
    """Add the figures of runs by a recurrence, alone or many at once."""
    own = figures.add(case, "step", ms)
    figures.add(case, "peak memory", peak, "MiB")
    figures.add(case, "δ", delta, "1")
    ratio = figures.add(case, "speed-up", full_ms / own, "1")
    memory = figures.add(case, "memory of a run", nbytes / 2**20, "MiB")
    figures.add(case, "teaching", teaching.metric("teach_seconds"), "s")
    figures.add(case, "runs that taught it", teaching.metric("runs"), "1")
    figures.say(
        f"{case.name} {case.precision}: {own:.4g} ms a {'simulation-' * (case.batch > 1)}step, {ratio:.4g} "
        f"times the full-order step's speed, δ {100 * delta:.3g} %, {memory:.3g} MiB"
    )


def _together(
    run: ReducedMPM,
    chain: Pipeline,
    count: int,
    full_ms: float,
    case: Case,
    truth: Path,
    figures: Measurements,
) -> None:
    """Add the rows of many runs at once, the first of which is one that has been timed alone.

    Args:
        run, case: that one.
        chain: whose recurrence is run.
        count: how many.
        full_ms: time of a full-order step [ms].
        truth: trajectory file of the first run.
        figures: gets the rows.
    """
    low, high = chain.split.box.T
    drawn = np.random.default_rng(0).uniform(low, high, (count - 1, len(low)))
    cases = [chain.held_out[0], *map(chain.scene.case, drawn)]
    many, peak = build(partial(Many, chain.recurrence(), run, cases), figures.settings.device)
    (ms,) = run_times({count: many}, figures.settings.trials, figures.settings.device).values()
    latents = run.trajectory().t, many.xhat[0], run.decoder().position
    delta = error_of_latents(*latents, truth, run.xhat)
    case = replace(case, name=f"recurrence_batch{count}", batch=count)
    _add_run(figures, case, ms / count, full_ms, delta, many.nbytes, peak, chain.taught)


class Many:
    """Runs of many cases by a recurrence, from one that is set up; all steps in one launch.

    A batch of solvers builds every scene and holds all of its particles, which takes minutes for a thousand.
    The cases may change no collider, no gravity and no start, as that of a material does not.

    Args:
        engine: the recurrence.
        run: one of its runs.
        cases: B of them.

    Attributes:
        total_steps: of each.
    """

    def __init__(self, engine: RecurrenceEngine, run: ReducedMPM, cases: Sequence[Parameters]):
        setup, self.total_steps = run.setup, run.total_steps
        form, names = engine.form, setup.manifold.parameter_names
        mu = torch.tensor([[case[name] for name in names] for case in cases], dtype=torch.float64)
        t = setup.dt * np.arange(self.total_steps)
        states = collider_states(setup.scene.solids, setup.dt, self.total_steps)
        acting = (of_strides(torch.as_tensor(v), form.stride)[None] for v in (setup.gravity.at(t), states))
        self._loop = Loop(form, mu, *acting, setup.precision, setup.device)
        stride = form.stride * setup.dt
        first = first_change(setup.manifold, setup.constants.X, setup.initial_velocity, stride)
        self._first, self._stride = first.expand(len(mu), -1), form.stride
        self._start = form.begin(setup.xhat.double().cpu().expand(len(mu), -1), self._first)
        self.restart()

    def restart(self) -> None:
        """Go back to t = 0."""
        self._done = 0
        self._loop.begin(self._start)

    def step(self, n: int = 1) -> None:
        """Take steps of all runs, a multiple of the stride."""
        self._loop.advance(self._done, n // self._stride)
        self._done += n // self._stride

    @property
    def xhat(self) -> torch.Tensor:
        """[B, N + 1, r] latent vectors at each step."""
        nodes = self._loop.xhat.mean(0)
        return between(nodes, self._first.to(nodes), self._stride)

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self._loop.nbytes
