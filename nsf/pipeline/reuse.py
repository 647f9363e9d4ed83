"""Stages whose results are there: said so, and passed over, without anything that making them would need."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from nsf.errors import MissingRunError
from nsf.results.question import Question, unchanged
from nsf.runs import Run

Say = Callable[[str], object]


def done(pipeline, stages: Sequence[str], say: Say) -> list[Run] | Run | Path | None:
    """The result of the last of some stages where none has anything to do; None where one has.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        stages: as of `nsf.pipeline.sweep.work`.
        say: told what is reused, as the stages themselves would.
    """
    trajectories = pipeline.runs_of("simulate") if "simulate" in stages else []
    later = [stage for stage in stages if stage != "simulate"]
    spare = pipeline.spare(later) if later and trajectories else set()
    if not all(run.complete or run.id in spare for run in trajectories):
        return None
    runs = {name: (pipeline.runs_of(name) or [pipeline.taught])[0] for name in later if name != "report"}
    if not all(run.complete for run in runs.values()):
        return None
    page = kept_report(pipeline) if "report" in stages else None
    if "report" in stages and page is None:
        return None
    result: list[Run] | Run | Path | None = None
    for name in stages:
        if name == "simulate":
            simulations(pipeline, trajectories, later, say)
            result = list(dict.fromkeys(trajectories))
        elif name == "report":
            result = report(pipeline, say)
        else:
            result = reused(runs[name], say)
    return result


def simulations(pipeline, runs: Iterable[Run], later: Sequence[str], say: Say) -> list[Run]:
    """The trajectories that have to be made, once it is said which are there, and what they warn of.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        runs: the trajectories.
        later: the stages that they are for, if no others: trajectories that only read are in these
            stages' results, where those are there, are not made again.
        say: told.
    """
    runs = list(dict.fromkeys(runs))
    there = [run for run in runs if run.complete]
    missing = [run for run in runs if run not in there]
    spare = pipeline.spare(later) if later and missing else set()
    needless = [run for run in missing if run.id in spare]
    if there:
        say(f"simulate: {len(there)} of {len(runs)} trajectories are there, reused")
    if needless:
        say(f"simulate: {len(needless)} of {len(runs)} trajectories are gone, and nothing needs them")
    for line in dict.fromkeys(line for run in there for line in run.manifest.get("warnings", ())):
        say(f"simulate: warning: {line}")
    return [run for run in missing if run not in needless]


def reused(run: Run, say: Say) -> Run:
    """A run that is there, once that is said."""
    say(f"{run.stage}: inputs unchanged, reused → {run.id}")
    return run


def kept_report(pipeline) -> Path | None:
    """The page of the report, if nothing that it shows has changed since it was written."""
    runs = pipeline.reported()
    return unchanged(pipeline.report_folder, runs, question(pipeline), pipeline.evaluation) if runs else None


def question(pipeline) -> Question:
    """What the report of a scene is about."""
    return Question(pipeline.config.report.name, pipeline.config.scene.title)


def report(pipeline, say: Say) -> Path:
    """The page of every evaluated variant of a scene, written anew where something has changed.

    Raises:
        MissingRunError: there is none.
    """
    runs = pipeline.reported()
    if not runs:
        raise MissingRunError(
            "no evaluate run of these held-out cases is there; run `nsf run` with the same keys"
        )
    folder = pipeline.report_folder
    if page := unchanged(folder, runs, question(pipeline), pipeline.evaluation):
        say(f"report: evaluated runs: {len(runs)}, unchanged, reused → {page}")
        return page
    from nsf.results.report import build_report

    page = build_report(runs, folder, question(pipeline), first=pipeline.evaluation)
    say(f"report: evaluated runs: {len(runs)} → {page}")
    return page
