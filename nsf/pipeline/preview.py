"""A run before any work: its stages and their states, its size, and the time and space that it will take."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import OmegaConf
from rich.markup import escape
from rich.table import Table

from nsf import config as configuration
from nsf.pipeline.chain import Pipeline
from nsf.runs import Run
from nsf.storage import bytes_text

STAGES = ("simulate", "train", "teach", "deploy", "evaluate")
#: Key whose value runs of a stage must share for their times to be compared.
_ALIKE = {"train": "field", "deploy": "model"}


@dataclass
class Expected:
    """Time and space of the runs of a stage that are to be made.

    Attributes:
        runs: how many there are in all; made: how many are there already.
        seconds, size: of those that are to be made [s, byte]; NaN where nothing like them was ever made.
        samples: how many runs that rests on; like: which.
    """

    runs: int
    made: int
    seconds: float = math.nan
    size: float = math.nan
    samples: int = 0
    like: str = ""

    @property
    def state(self) -> str:
        """As a reader sees it."""
        if self.made == self.runs:
            return "there" if self.runs == 1 else f"all {self.runs} there"
        return "to be made" if self.runs == 1 else f"{self.runs - self.made} of {self.runs} to be made"


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
        table.caption = f"{len(pipelines)} jobs; runs that they share are made once"
        table.caption_justify = "left"
    for heading, side in (
        ("stage", "left"), ("state", "left"), ("run", "left"), ("time", "right"), ("disk", "right"),
        ("as in", "left"),
    ):  # fmt: skip
        table.add_column(heading, justify=side, no_wrap=heading == "run")
    seconds, size = 0.0, 0.0
    for stage in STAGES:
        runs = {run: pipeline for pipeline in pipelines for run in pipeline.runs_of(stage)}
        if not runs:
            continue
        estimate = expected(stage, runs)
        if estimate.made < estimate.runs:
            seconds, size = seconds + estimate.seconds, size + estimate.size
        only = next(iter(runs)).hash if len(runs) == 1 else ""
        cost = ["", "", ""]
        if estimate.made < estimate.runs:
            none = "nothing like it was made here"
            like = f"{estimate.samples} {estimate.like}" if estimate.samples else none
            cost = [_time(estimate.seconds), _size(estimate.size), like]
        table.add_row(stage, estimate.state, only, *map(escape, cost))
    if seconds:
        table.add_row("in all", "", "", _time(seconds), _size(size), "")
    return table


def expected(stage: str, runs: dict[Run, Pipeline]) -> Expected:
    """Time and space of runs of a stage, by those of its kind that are there, at best of the same scene."""
    missing = {run: pipeline for run, pipeline in runs.items() if not run.complete}
    estimate = Expected(len(runs), len(runs) - len(missing))
    if not missing:
        return estimate
    there = [run for run in Run.find(stage, root=next(iter(runs)).root) if run.complete]
    seconds, size = 0.0, 0.0
    for run, pipeline in missing.items():
        alike = [r for r in there if r.manifest.get("device") == pipeline.device and _kind(r) == _kind(run)]
        near = [r for r in alike if r.scene == run.scene] or alike
        estimate.samples = len(near)
        of = run.scene if near and near[0].scene == run.scene else "other scenes"
        estimate.like = f"run{'s' * (len(near) > 1)} of {of}"
        if stage == "simulate":
            stored = trajectory_bytes(pipeline)
            rates = [r.manifest["seconds"] / _bytes(r) for r in near if _bytes(r)]
            seconds += statistics.median(rates) * stored if rates else math.nan
            size += stored
        else:
            seconds += statistics.median(r.manifest["seconds"] for r in near) if near else math.nan
            size += statistics.median(map(_bytes, near)) if near else math.nan
    estimate.seconds, estimate.size = seconds, size
    return estimate


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
        cells = thickness / scene.dx
        rows[f"thinnest of {name}"] = "2 cells or more" if math.isinf(cells) else f"{cells:.2g} cells"
    for part in ("train", "validation", "test"):
        cases = getattr(pipeline.split, part)
        rows[part] = f"{len(cases)}: " + "; ".join(case.text for case in cases) if cases else "none"
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
    kept = "" if resident is True else ", from disk" if not resident else ", from disk where they do not fit"
    data = bytes_text(resident_bytes(frames, scene.particle_count))
    return f"{bytes_text(solver)} of a full-order run; {data} of {frames:,} training frames{kept}"


def _kind(run: Run) -> str:
    """Values that runs of a stage share whose times can be compared."""
    value = run.config.get(_ALIKE.get(run.stage, ""))
    return str(value.get("_target_") if isinstance(value, dict) else value)


def _bytes(run: Run) -> int:
    return sum(output["bytes"] for output in run.manifest.get("outputs", ()))


def _time(seconds: float) -> str:
    if math.isnan(seconds):
        return "unknown"
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"


def _size(size: float) -> str:
    return "unknown" if math.isnan(size) else bytes_text(size)
