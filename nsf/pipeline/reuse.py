"""Parts of a chain that are there already: results, trajectories that nothing needs, and the report."""

from collections.abc import Sequence
from pathlib import Path

from nsf.results.question import Question, unchanged
from nsf.runs import Run


def evaluated(pipeline, stage: str = "evaluate") -> Run:
    """The complete run of a stage, of this device or another: it may have been brought here.

    Raises:
        MissingRunError: there is none; says how far it came.
    """
    for device in dict.fromkeys((pipeline.device, "cuda:0", "cpu")):
        (run,) = pipeline.on(device).runs_of(stage)
        if run.complete:
            return run
    return pipeline.runs_of(stage)[0].require()


def complete(pipeline, stages: Sequence[str]) -> bool:
    """Whether some stages have nothing to do."""
    later = [stage for stage in stages if stage != "simulate"]
    if "simulate" in stages:
        spare = pipeline.spare(later) if later else set()
        if not all(run.complete or run.id in spare for run in pipeline.runs_of("simulate")):
            return False
    if not all(run.complete for stage in later if stage != "report" for run in pipeline.runs_of(stage)):
        return False
    return "report" not in stages or pipeline.kept_report() is not None


def spare(pipeline, later: Sequence[str]) -> set[str]:
    """Trajectories, by id, that later stages need not read, as their results are there."""
    truths = {pipeline.truth(case).id for case in pipeline.held_out}
    read = [run for name in ("evaluate", "superresolve") if name in later for run in pipeline.runs_of(name)]
    over = "evaluate" in later and all(run.complete for run in read)
    trained = {run.id for run in pipeline.training_data}
    needed = (set() if over else truths) | (set() if pipeline.training.complete else trained)
    return (truths | trained) - needed


def reported(pipeline) -> list[Run]:
    """Every evaluated variant of this scene at these held-out trajectories."""
    truths = {pipeline.truth(case).id for case in pipeline.held_out}
    return [
        run
        for run in Run.find("evaluate", pipeline.scene.name, root=pipeline.root)
        if run.complete and truths == {p for p in run.parents if p.startswith("simulate/")}
    ]


def kept_report(pipeline) -> Path | None:
    """The page of the report, if nothing that it shows has changed since it was written."""
    if runs := pipeline.reported():
        return unchanged(pipeline.report_folder, runs, question_of(pipeline), pipeline.evaluation)
    return None


def question_of(pipeline) -> Question:
    """The question that the report of a pipeline answers."""
    return Question(pipeline.config.report.name, pipeline.config.scene.title)
