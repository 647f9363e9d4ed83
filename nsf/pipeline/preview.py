"""A run before any work: its stages and their states, its size, and the time and space that it will take."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from omegaconf import OmegaConf
from rich.markup import escape
from rich.table import Table

from nsf import config as configuration
from nsf.data.case import PROGRAM, Case, with_unit
from nsf.manifest import CHAIN
from nsf.pipeline.chain import Pipeline
from nsf.pipeline.durations import START, Interval, crowding, due, interval, times, work_of
from nsf.runs import Run
from nsf.storage import bytes_text

#: Values of cases that a plan lists one by one; of more it has the ranges.
_MOST_VALUES = 8
_HEADINGS = ("stage", "state", "run", "time", "disk", "measured")


@dataclass(frozen=True)
class Stage:
    """A stage of some jobs before their work.

    Attributes:
        name: of the stage.
        runs: that it has, each once; missing: how many are to be made.
        time: of these [s]; size: bytes of their files, 0.0 where no like run was ever made.
    """

    name: str
    runs: tuple[Run, ...]
    missing: int
    time: Interval
    size: float = 0.0

    @property
    def state(self) -> str:
        """As a reader sees it."""
        count = len(self.runs) or 1  # a page is no run
        if not self.missing:
            return "there" if count == 1 else f"all {count} there"
        return "to do" if count == 1 else f"{self.missing} of {count} to do"


def plans(jobs: Sequence[Sequence[str]]) -> list[Pipeline]:
    """Each job checked as before its work, where it has any.

    Raises:
        NSFError: of every kind that a run begins with.
    """
    pipelines = []
    for job in jobs:
        config = configuration.load(job)
        pipeline = Pipeline(config)
        _ = pipeline.held_out
        if not all(run.complete for stage in ("simulate", "evaluate") for run in pipeline.runs_of(stage)):
            pipeline.check()
        pipelines.append(pipeline)
    return pipelines


def stages_table(pipelines: Sequence[Pipeline]) -> Table:
    """State, expected time and room of every stage of some jobs, whose common runs count once."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    if len(pipelines) > 1:
        table.caption = f"{len(pipelines)} jobs, one after the other; runs that they share are made once"
        table.caption_justify = "left"
    stages = stages_of(pipelines)
    due = [stage for stage in stages if stage.missing]
    guessed = not any(stage.time.like for stage in due)
    rows = [_row(stage, guessed) for stage in stages]
    if due:
        size = bytes_text(sum(stage.size for stage in due))
        rows.append(["in all", "", "", time_of(due), size, "a guess" if guessed else ""])
    columns = [column for column in zip(_HEADINGS, *rows, strict=True) if any(column[1:])]
    for heading, *_ in columns:
        side = "right" if heading in ("time", "disk") else "left"
        table.add_column(heading, justify=side, no_wrap=heading == "run")
    for cells in zip(*(column[1:] for column in columns), strict=True):
        table.add_row(*map(escape, cells))
    return table


def time_of(stages: Sequence[Stage]) -> str:
    """The expected time of a command that does all of some stages, as `0.6–5.9 min`."""
    due = [stage.time for stage in stages if stage.missing]
    low, high = sum(time.low for time in due), sum(time.high for time in due)
    return _span(Interval(low + START / 2, high + 2 * START * crowding()))


def _row(stage: Stage, guessed: bool) -> list[str]:
    """Name, state, hash, time, room of a stage, and what its time rests on unless all are guesses."""
    if not stage.missing:
        return [stage.name, stage.state, stage.runs[0].hash if len(stage.runs) == 1 else "", "", "", ""]
    size = bytes_text(stage.size) if stage.size else ""
    like = "" if guessed else stage.time.like or "a guess"
    return [stage.name, stage.state, "", _span(stage.time), size, like]


def stages_of(pipelines: Sequence[Pipeline]) -> list[Stage]:
    """The stages that some jobs have, in order."""
    done, stages = times(pipelines[0].training.root), []
    for name in (*CHAIN, "report"):
        runs = [] if name == "report" else [run for one in pipelines for run in one.runs_of(name)]
        runs = tuple(dict.fromkeys(runs))
        if not runs and name != "report":
            continue
        chains = [*pipelines, *(more for one in pipelines for more in one.calibrating if name == "deploy")]
        work, sizes = {}, {}
        for one in chains:
            work |= (expected := due(one, name))
            sizes |= dict.fromkeys(expected, _size(one, name))
        missing = sum(not run.complete for run in runs) if runs else len(work)
        time = interval(work_of(pipelines[0], name, work.values()), done) if work else Interval(0, 0)
        stages.append(Stage(name, runs, missing, time, sum(sizes.values())))
    return stages


def _size(pipeline: Pipeline, stage: str) -> float:
    """Bytes of a run of a stage: of a trajectory, or those of earlier runs of the scene."""
    if stage == "simulate":
        return trajectory_bytes(pipeline)
    if stage == "report":
        return 0.0
    there = [run for run in Run.find(stage, pipeline.scene.name, pipeline.training.root) if run.complete]
    return statistics.median(map(_bytes, there)) if there else 0.0


def scene_table(pipeline: Pipeline) -> Table:
    """Particles, grid, resolution and step of a scene, and its cases."""
    from nsf.mpm.stability import largest_stable_dt, multiplied_step_warning
    from nsf.scenes.resolution import resolution_warnings, thinnest

    scene = pipeline.scene
    case = pipeline.split.cases[0]
    at = scene.at(case)
    stable = min(
        largest_stable_dt(one.particles(), one.initial_velocity(), one.dx)
        for one in map(scene.at, pipeline.split.cases)
    )
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    rows = {
        "scene": f"{scene.name}, {pipeline.config.scale} scale",
        "particles": f"{scene.particle_count:,}",
        "grid": f"{' × '.join(map(str, scene.grid.nodes))} nodes, Δx = {scene.dx:.4g} m",
        "steps": f"{scene.steps:,} of Δt = {scene.dt:.4g} s; up to {stable:.3g} s is stable",
    }
    for name, thickness in thinnest(at).items():
        if math.isfinite(cells := thickness / scene.dx):
            rows[f"thinnest of {name}"] = f"{cells:.2g} cells"
    parts = {part: getattr(pipeline.split, part) for part in ("train", "validation", "test")}
    if len(case) == 1:
        rows |= {part: _values_of(cases) for part, cases in parts.items()}
    else:
        counts = ", ".join(f"{len(cases)} {part}" for part, cases in parts.items())
        rows["cases"] = f"{counts}; {_ranges_of(pipeline.split.cases)}"
    rows["memory"] = _memory(pipeline)
    c = pipeline.config
    rows["deployed"] = f"on {pipeline.device}, model {pipeline.configured.name}, r {c.latent_dim}"
    warnings = [
        *resolution_warnings(at),
        multiplied_step_warning(c.deploy.dt_multiplier, scene.dt, stable),
    ]
    for key, value in [*rows.items(), *(("warning", line) for line in warnings if line)]:
        table.add_row(key, escape(value))
    return table


def _values_of(cases: Sequence[Case]) -> str:
    """How many cases of one parameter, and their values; its range where these are many."""
    if len(cases) <= _MOST_VALUES:
        return f"{len(cases)}: " + "; ".join(case.text for case in cases) if cases else "none"
    return f"{len(cases)}: {_ranges_of(cases)}"


def _ranges_of(cases: Sequence[Case]) -> str:
    """The range of each parameter of some cases, but for the numbers of programs."""
    columns = zip(*(case.numbers for case in cases), strict=True)
    ranges = zip_longest(cases[0].names, columns, cases[0].units, fillvalue="")
    texts = [
        f"{name} {min(v):.4g} to {with_unit(f'{max(v):.4g}', unit)}"
        for name, v, unit in ranges
        if name != PROGRAM
    ]
    return ", ".join(texts)


def scenes(pipelines: Sequence[Pipeline]) -> list[Pipeline]:
    """One job for each scene and size."""
    first = {(p.scene.name, p.scene.particle_count, p.scene.dt): p for p in reversed(pipelines)}
    return list(first.values())[::-1]


def composed(pipeline: Pipeline) -> str:
    """The whole configuration, every reference in it resolved, as yaml."""
    return OmegaConf.to_yaml(pipeline.config, resolve=True)


def trajectory_bytes(pipeline: Pipeline) -> float:
    """Of one trajectory on disk."""
    from nsf.mpm.recording import frame_bytes

    return pipeline.stored_frames * frame_bytes(pipeline.scene.particle_count, pipeline.stored)


def _memory(pipeline: Pipeline) -> str:
    """Memory that a full-order run and the training's data take."""
    from nsf.data.snapshots import resident_bytes
    from nsf.mpm import precision_of
    from nsf.mpm.solver import bytes_on_device

    scene, resident = pipeline.scene, pipeline.config.data.resident
    how = precision_of(pipeline.config.precision)
    solver = bytes_on_device(scene.particle_count, scene.grid, scene.material, how)
    frames = len(pipeline.split.train) * pipeline.stored_frames
    kept = "" if resident else ", from disk"
    data = bytes_text(resident_bytes(frames, scene.particle_count))
    return f"{bytes_text(solver)} of a full-order run; {data} of {frames:,} training frames{kept}"


def _bytes(run: Run) -> int:
    return sum(output["bytes"] for output in run.manifest.get("outputs", ()))


def _span(time: Interval) -> str:
    """Both ends of an interval in the unit of the upper one, outwards to two figures."""
    unit, name = next(
        (u, n) for u, n in ((3600, "h"), (60, "min"), (1, "s")) if time.high >= 1.5 * u or u == 1
    )
    low, high = time.low / unit, time.high / unit
    digit = 1 if high < 10 and unit > 1 else 0
    return f"{math.floor(low * 10**digit) / 10**digit:g}–{math.ceil(high * 10**digit) / 10**digit:g} {name}"
