"""Many runs by a recurrence at once: the time of a step of one of them."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import WholeRun, build, taught, turns
from nsf.bench.reduced import error_of_latents
from nsf.bench.rows import Case, Measurements
from nsf.data import Case as Parameters
from nsf.data.schema import TRAJECTORY
from nsf.dynamics import ReducedMPM
from nsf.dynamics.interop import on_torch_stream
from nsf.pipeline import Pipeline
from nsf.recurrence import Loop, RecurrenceEngine, collider_states, first_change
from nsf.recurrence.descent import of_strides
from nsf.recurrence.engine import between

#: Runs at once, and the scene that they are of.
MANY, SCENE = 1024, "metal"


def run(figures: Measurements) -> None:
    """1 024 runs of `metal`, at the paper's size on a GPU, at small scale on a CPU.

    Data, training and teaching are made, or reused, as by `nsf teach model=recurrence`.
    """
    settings = figures.settings
    keys = [f"scene={SCENE}", f"scale={settings.scale}", f"device={settings.device}", "model=recurrence"]
    chain = Pipeline(config.load([*keys, *settings.keys]), say=figures.say)
    taught(chain)
    measured(chain, MANY, figures)


@torch.no_grad()
def measured(chain: Pipeline, count: int, figures: Measurements) -> None:
    """Add the row of each precision.

    The first run is that of the first held-out case, of which δ is told; the others fill the box of training.

    Args:
        chain: of the scene, with `model=recurrence`; taught.
        count: how many runs.
        figures: gets the rows.
    """
    settings, manifold, scene = figures.settings, chain.manifold(), chain.scene
    low, high = chain.split.box.T
    drawn = np.random.default_rng(0).uniform(low, high, (count - 1, len(low)))
    cases = [chain.held_out[0], *map(scene.case, drawn)]
    for precision in settings.precisions:
        one = chain.solver_at(manifold, cases[0], precision=precision)
        many, peak = build(partial(Many, chain.recurrence(), one, cases), settings.device)
        (ms,) = turns({count: WholeRun(many, scene.steps)}, settings.trials, settings.device).values()
        case = Case(
            bench="recurrence", name=f"recurrence_batch{count}", particles=scene.particle_count,
            sample=one.sample_size, batch=count, precision=precision,
        )  # fmt: skip
        t = one.dt * np.arange(scene.steps + 1)
        truth = chain.truth(cases[0]).path / TRAJECTORY
        delta = error_of_latents(t, many.xhat[0], one.decoder().position, truth, one.xhat)
        step = figures.add(case, "step", ms / count / scene.steps)
        figures.add(case, "peak memory", peak, "MiB")
        figures.add(case, "δ", delta, "1")
        figures.add(case, "memory of the runs", many.nbytes / 2**20, "MiB")
        figures.say(f"{case.name} {precision}: {step:.4g} ms a simulation-step, δ {100 * delta:.3g} %")


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
        self._first, self._stride, self._device = first.expand(len(mu), -1), form.stride, setup.device
        self._start = form.begin(setup.xhat.double().cpu().expand(len(mu), -1), self._first)
        self.restart()

    def restart(self) -> None:
        """Go back to t = 0."""
        self._done = 0
        self._loop.begin(self._start)

    def step(self, n: int = 1) -> None:
        """Take steps of all runs, a multiple of the stride."""
        with on_torch_stream(self._device):
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
