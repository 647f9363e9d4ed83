"""Stages whose results are there: said so, and passed over, without anything that making them would need."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from nsf.errors import MissingRunError
from nsf.pipeline.names import Names
from nsf.results.question import Question, unchanged
from nsf.runs import Run

Say = Callable[[str], object]


def done(names: Names, stages: Sequence[str], say: Say) -> list[Run] | Run | Path | None:
    """The result of the last of some stages where none has anything to do; None where one has.

    Args:
        names: of the runs.
        stages: as of `nsf.pipeline.sweep.work`.
        say: told what is reused, as the stages themselves would.
    """
    kinds = {
        "train": "training", "teach": "taught", "deploy": "deployment", "evaluate": "evaluation",
        "superresolve": "superresolution",
    }  # fmt: skip
    trajectories = [names.simulation(*needed) for needed in names.needed()] if "simulate" in stages else []
    later = [stage for stage in stages if stage != "simulate"]
    spare = names.spare(later) if later and trajectories else set()
    if not all(run.complete or run.id in spare for run in trajectories):
        return None
    runs = {name: getattr(names, kinds[name]) for name in stages if name in kinds}
    if not all(run.complete for run in runs.values()):
        return None
    page = kept_report(names) if "report" in stages else None
    if "report" in stages and page is None:
        return None
    result: list[Run] | Run | Path | None = None
    for name in stages:
        if name == "simulate":
            simulations(names, trajectories, later, say)
            result = list(dict.fromkeys(trajectories))
        elif name == "report":
            result = report(names, say)
        else:
            result = reused(runs[name], say)
    return result


def simulations(names: Names, runs: Iterable[Run], later: Sequence[str], say: Say) -> list[Run]:
    """The trajectories that have to be made, once it is said which are there, and what they warn of.

    Args:
        names: of the runs.
        runs: the trajectories.
        later: the stages that they are for, if no others: trajectories that only read are in these
            stages' results, where those are there, are not made again.
        say: told.
    """
    runs = list(dict.fromkeys(runs))
    there = [run for run in runs if run.complete]
    missing = [run for run in runs if run not in there]
    spare = names.spare(later) if later and missing else set()
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


def kept_report(names: Names) -> Path | None:
    """The page of the report, if nothing that it shows has changed since it was written."""
    runs = names.reported()
    return unchanged(names.report_folder, runs, question(names), names.evaluation) if runs else None


def question(names: Names) -> Question:
    """What the report of a scene is about."""
    return Question(names.config.report.name, names.config.scene.title)


def report(names: Names, say: Say) -> Path:
    """The page of every evaluated variant of a scene, written anew where something has changed.

    Raises:
        MissingRunError: there is none.
    """
    runs = names.reported()
    if not runs:
        raise MissingRunError(
            "no evaluate run of these held-out cases is there; run `nsf run` with the same keys"
        )
    folder = names.report_folder
    if page := unchanged(folder, runs, question(names), names.evaluation):
        say(f"report: evaluated runs: {len(runs)}, unchanged, reused → {page}")
        return page
    from nsf.results.report import build_report

    page = build_report(runs, folder, question(names), first=names.evaluation)
    say(f"report: evaluated runs: {len(runs)} → {page}")
    return page
