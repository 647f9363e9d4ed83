"""A step by operators beside the full-order one: single runs, many at once, and frames of many particles."""

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import build, name_of, run_times, window_times
from nsf.bench.reduced import SCENES, deformation_error, error_of_latents, scale_of
from nsf.bench.rows import Result, Row, Settings, commit, size_name
from nsf.bench.scaling import at_size, carried_over, frames_of, positions_after
from nsf.data import Case
from nsf.data.schema import TRAJECTORY
from nsf.deployment import Levels, Trust
from nsf.dynamics import ReducedBatch, ReducedMPM
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.setup import first_changes
from nsf.engines import Operators
from nsf.engines.operators.recurrence import Recurrence
from nsf.engines.operators.states import collider_states
from nsf.evaluation import metrics
from nsf.pipeline import Pipeline
from nsf.pipeline.stages.deployment import calibrated, levels_of
from nsf.pipeline.stages.teaching import OPERATORS
from nsf.scenes import Scene
from nsf.timing import synchronizer

#: Runs at once, and the scene that they are of.
MANY, OF_MANY = 1024, "metal"
#: Particles of the sand column whose frames are decoded.
PARTICLES = {"cuda": 4_000_000, "cpu": 20_000}
#: x̂ [r] → positions [P, 3] [m] of all particles.
Decode = Callable[[torch.Tensor], torch.Tensor]


def run(settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """Each scene, 1 024 runs of `metal` at once, and the sand column with 4 million particles.

    At the paper's size on a GPU; on a CPU at small scale, and with 20 000 particles. Data, training and
    teaching are made, or reused, as by `nsf teach model=recurrence`. Where `scenes` or `particles` are given,
    these are all.
    """
    for scene in settings.scenes or (() if settings.particles else SCENES):
        measured(_chain(scene, settings, say), settings, found, say, MANY if scene == OF_MANY else 0)
    if settings.particles or not settings.scenes:
        kind = "cuda" if settings.device.startswith("cuda") else "cpu"
        for particles in settings.particles or (PARTICLES[kind],):
            measured_decoded(_chain("sand", settings, say), particles, settings, found, say)


def _chain(scene: str, settings: Settings, say: Callable[[str], object]) -> Pipeline:
    asked = [f"scene={scene}", f"scale={scale_of(settings.device)}", f"device={settings.device}"]
    return Pipeline(config.load([*asked, "model=recurrence"]), say=say)


def measured(
    chain: Pipeline, settings: Settings, found: Result, say: Callable[[str], object], many: int = 0
) -> None:
    """Add the rows of one scene in its first held-out case.

    Args:
        chain: of the scene, with `model=recurrence`.
        settings, found, say: as for `run`.
        many: runs at once, in rows of their own; 0 for none.
    """
    _taught(chain)
    manifold, truth = chain.manifold(), chain.truth(chain.held_out[0]).path / TRAJECTORY

    def decode(run: ReducedMPM) -> Decode:
        return run.decoder().position

    def error(run: ReducedMPM, position: Decode) -> float:
        return deformation_error(run, truth)

    for precision in settings.precisions:
        of = chain, manifold, chain.scene, chain.scene.name, precision
        run = _compared(*of, decode, error, settings, found, say)
        if many:
            _together(run, chain, many, found.rows[-2:], truth, settings, found, say)


def measured_decoded(
    chain: Pipeline, particles: int, settings: Settings, found: Result, say: Callable[[str], object]
) -> None:
    """Add the rows of one scene with another number of particles, in its first held-out case.

    A step by operators does not depend on the particles. So the run is that of the chain's own scene, and
    its frames are decoded at the particles asked for. The full-order run is theirs, on a finer grid and in
    shorter steps (`scaling.at_size`), each of which counts as one by operators.

    Args:
        chain: of the scene, with `model=recurrence` and `field=basis`.
        particles: P.
        settings, found, say: as for `run`.
    """
    _taught(chain)
    scene, manifold, case = at_size(chain.scene, particles), chain.manifold(), chain.held_out[0]
    fields, steps = carried_over(chain.manifold(), scene, settings.device), frames_of(scene.steps)
    full = scene.full_order(case, max(settings.precisions), settings.device)
    truth = positions_after(full, steps)
    del full  # its arrays are on the device

    def decode(run: ReducedMPM) -> Decode:
        like = {"dtype": run.setup.dtype, "device": run.setup.torch_device}
        return fields.restrict(np.arange(particles), **like).position

    def error(run: ReducedMPM, position: Decode) -> float:
        latent, errors, norms = run.trajectory(), [], []
        between = [np.interp(scene.dt * steps, latent.t, column) for column in latent.xhat.T]
        for xhat, x in zip(torch.as_tensor(np.stack(between, 1)).to(run.xhat), truth, strict=True):
            found = position(xhat)
            errors.append(metrics.frame_squares((found - x.to(found))[None]))
            norms.append(metrics.frame_squares(x.to(found)[None]))
        return metrics.relative(torch.cat(errors), torch.cat(norms))

    for precision in settings.precisions:
        of = chain, manifold, scene, size_name(particles), precision
        _compared(*of, decode, error, settings, found, say)


def _taught(chain: Pipeline) -> None:
    """Make, or reuse, all that a run needs."""
    chain.simulate(("train",))
    chain.train()
    chain.teach()


@torch.no_grad()
def _compared(
    chain: Pipeline,
    manifold,
    scene: Scene,
    name: str,
    precision: str,
    decode: Callable[[ReducedMPM], Decode],
    error: Callable[[ReducedMPM, Decode], float],
    settings: Settings,
    found: Result,
    say: Callable[[str], object],
) -> ReducedMPM:
    """Add a row of either solver in one precision, turn by turn; gives the run by operators, at its end.

    Args:
        chain: whose operators are run.
        manifold: theirs.
        scene: of the full-order step.
        name: the end of both cases.
        decode: run → positions of all particles.
        error: run and these → δ.
    """
    device, case = settings.device, chain.held_out[0]
    taught = chain.taught
    full, full_peak = build(partial(scene.full_order, case, precision, device), device)
    run, peak = build(partial(chain.solver_at, manifold, case, precision=precision), device)
    times = window_times({"full": full}, scene.steps, settings.trials, device, whole={"own": run})
    ms, own = _times_of(times["full"]), _times_of(times["own"])
    position = decode(run)
    row = partial(
        Row, bench="operators", particles=scene.particle_count, precision=precision, device=name_of(device),
        commit=commit(),
    )  # fmt: skip
    found.rows.append(row(case=f"full_order_{name}", peak_mib=full_peak, **ms))
    found.rows.append(
        row(
            case=f"operators_{name}", sample=run.sample_size, peak_mib=peak, **own,
            speed_up=ms["ms_median"] / own["ms_median"], delta=error(run, position),
            run_mib=run.nbytes / 2**20, decode_ms=_decode_ms(position, run.xhat, settings),
            checked_ms=_checked_ms(chain, manifold, run, precision, settings),
            teach_seconds=taught.metric("teach_seconds"), teacher_steps=int(taught.metric("teacher_steps")),
        )
    )  # fmt: skip
    _tell(found.rows[-1], "a step", say)
    return run


def _together(
    run: ReducedMPM,
    chain: Pipeline,
    count: int,
    beside: list[Row],
    truth,
    settings: Settings,
    found: Result,
    say: Callable[[str], object],
) -> None:
    """Add the row of many runs at once, the first of which is one that has been timed alone.

    Args:
        run: that one.
        chain: whose operators are run.
        count: how many.
        beside: rows of the full-order step and of the run alone.
        truth: trajectory file of the first run.
    """
    full, alone = beside
    low, high = chain.split.box.T
    drawn = np.random.default_rng(0).uniform(low, high, (count - 1, len(low)))
    model = Operators.load(chain.taught.file(OPERATORS)).model
    many, peak = build(
        partial(Many, model, run, [chain.held_out[0], *map(chain.scene.case, drawn)]), settings.device
    )
    (ms,) = run_times({count: many}, settings.trials, settings.device).values()
    delta = error_of_latents(run.trajectory().t, many.record.xhat[0], run.decoder(), truth)
    own = _times_of(ms / count)
    found.rows.append(
        Row(
            bench="operators", case=f"operators_batch{count}", particles=alone.particles, sample=alone.sample,
            precision=alone.precision, device=alone.device, commit=alone.commit, batch=count, peak_mib=peak,
            **own, delta=delta, speed_up=full.ms_median / own["ms_median"], run_mib=many.nbytes / 2**20,
            teach_seconds=alone.teach_seconds, teacher_steps=alone.teacher_steps,
        )
    )  # fmt: skip
    _tell(found.rows[-1], "a simulation-step", say)


class Many:
    """Runs by operators of many cases, from one that is set up; all steps in one launch.

    A batch of solvers builds every scene and holds all of its particles, which takes minutes for a thousand.
    The cases may change no collider, no gravity and no start, as that of a material does not.

    Args:
        model: the operators.
        run: one of their runs.
        cases: B of them.

    Attributes:
        record: of the runs, on the device; total_steps: of each.
    """

    def __init__(self, model, run: ReducedMPM, cases: Sequence[Case]):
        setup, span, self.total_steps = run.setup, run.together.span_at(0), run.total_steps
        self.record = LatentRecord(setup.xhat.expand(len(cases), -1), self.total_steps, 1)
        names = setup.manifold.parameter_names
        mu = torch.tensor([[case[name] for name in names] for case in cases], dtype=torch.float64)
        gravity = torch.as_tensor(setup.gravity.at(setup.dt * np.arange(self.total_steps))[None])
        states = collider_states(setup.scene.colliders, setup.dt, self.total_steps)[None]
        given = mu, gravity, torch.as_tensor(states), self.record, setup.precision, setup.device
        self._recurrence = Recurrence(model, *given)
        first = first_changes(span.at_sample, span.sets.sample, [setup])
        self._first = first.to(self.record.xhat.device).expand(len(mu), -1)
        self.restart()

    def restart(self) -> None:
        """Go back to t = 0."""
        self.record.restart()
        self._recurrence.begin(self.record.now, self._first)

    def step(self, n: int = 1) -> None:
        """Take steps of all runs."""
        self._recurrence.advance(n)

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self._recurrence.nbytes + self.record.nbytes


class Checked:
    """Runs by operators, and what `nsf deploy` does to know how far to believe them, for `run_times`.

    Args:
        run: by operators, alone in its batch.
        levels: how it is watched.
        projected: the same run by projected steps, built as well before a clock starts.
        trust: the estimate of whether to believe it.

    Attributes:
        total_steps: of the run.
    """

    def __init__(self, run: ReducedMPM, levels: Levels, projected: ReducedBatch, trust: Trust):
        self._run, self._looked_at = run, partial(levels.watched, run.together, projected, trust)
        self.restart, self.total_steps = run.restart, run.total_steps

    def step(self, n: int) -> None:
        """Take the steps of the whole run and check them."""
        self._run.step(n)
        self._looked_at()


def _checked_ms(chain: Pipeline, manifold, run: ReducedMPM, precision: str, settings: Settings) -> float:
    """Median time [ms] of a step of checked runs; where projected steps go on with one, with these."""
    levels, trust = levels_of(chain, manifold), calibrated(chain, manifold)
    like = {"precision": precision, "engine": chain.projecting}
    projected = chain.batch_at(manifold, [chain.held_out[0]], **like)
    checked = Checked(run, levels, projected, trust)
    return float(np.median(run_times({"own": checked}, settings.trials, settings.device)["own"]))


def _times_of(ms: np.ndarray) -> dict[str, float]:
    p10, median, p90 = np.percentile(ms, [10, 50, 90]).tolist()
    return {"ms_median": median, "ms_p10": p10, "ms_p90": p90}


def _decode_ms(position: Decode, xhat: torch.Tensor, settings: Settings) -> float:
    """Median time [ms] of the positions of one frame."""
    wait, times = synchronizer(settings.device), []
    for _ in range(settings.trials + 1):  # the first one loads
        wait()
        begun = time.perf_counter()
        position(xhat)
        wait()
        times.append(1e3 * (time.perf_counter() - begun))
    return float(np.median(times[1:]))


def _tell(row: Row, what: str, say: Callable[[str], object]) -> None:
    told = f"{row.speed_up:.4g} times the full-order step's speed, δ {100 * row.delta:.3g} %"
    checked = "" if row.checked_ms is None else f", {row.checked_ms:.4g} ms with checks"
    say(f"{row.case} {row.precision}: {row.ms_median:.4g} ms {what}{checked}, {told}, {row.run_mib:.3g} MiB")
