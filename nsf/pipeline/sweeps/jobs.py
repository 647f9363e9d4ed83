"""Sweeps: the stages of many configurations, by one of Hydra's launchers."""

import itertools
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from hydra._internal.callbacks import Callbacks
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext
from omegaconf import DictConfig

from nsf import config as configuration
from nsf.canonical import content_hash
from nsf.data.schema import TRAJECTORY
from nsf.errors import ConfigError, LaunchError, NSFError
from nsf.extras import optional
from nsf.gpu import has_driver
from nsf.pipeline.chain import Pipeline
from nsf.pipeline.sweeps.chains import chain_of
from nsf.progress import label, labelled, timed
from nsf.results.folder import check_place
from nsf.runs import Run
from nsf.runs.reserved import reserved, reserving
from nsf.terminal import guard

_SUBMITTED = "*/*_submitted.pkl"  # a file of each job that Slurm took
_DIED = "its process died (killed, or out of memory or time)"


@dataclass(frozen=True)
class Failure:
    """A job without a result: the overrides that tell it from others of the sweep, and what became of it."""

    job: tuple[str, ...]
    error: str

    def __str__(self):
        return f"{' '.join(self.job) or 'the one job'}: {self.error}"


def work(config: DictConfig, stages: Sequence[str], say: Callable[[str], object] = print, group: str = ""):
    """Stages of one configuration; gives the result of the last one.

    Args:
        config: of the chain.
        stages: names, in order.
        say: called with a line for the user.
        group: name of the sweep that they are a job of, for `tracking`.

    Raises:
        NSFError: of every kind that a stage raises.
    """
    if "point" in stages:
        from nsf.results.point import plot_point

        return plot_point(config)
    pipeline = Pipeline(config, say)
    if len(stages) > 1:
        stages = _of_chain(pipeline, stages)
        _ = pipeline.held_out  # refused before hours of simulation and training, not after
    if "report" in stages:
        check_place(pipeline.report_folder)
    pipeline.group = group
    needs_others = len(stages) > 1 and not pipeline.complete(stages)
    if needs_others and not group:
        checked = pipeline.check()
        with suppress(Exception):  # a user's class may allow no estimate; what is wrong, a stage says
            from nsf.pipeline.preview import stages_of, time_of

            say(f"run: {time_of(stages_of([checked]))} to go")
    with pipeline.tracked, reserving(pipeline.inputs if needs_others else ()):
        for at, name in enumerate(stages):
            with timed(name):
                result = pipeline.simulate(stages[at + 1 :]) if name == "simulate" else pipeline.run(name)
    return result


def sweep(
    sweeps: Sequence[Sequence[str]],
    stages: Sequence[str],
    launcher: Sequence[str] = (),
    config_name: str = "config",
    say: Callable[[str], object] = print,
) -> list[Failure]:
    """Stages of every job; one that fails is recorded in its run's manifest, and does not stop the others.

    Where all of them have data.keep=held_out, the scenes come one after the other, and the training
    trajectories of a scene go once each of its jobs has gone well.

    Jobs side by side on this machine (`hydra/launcher=joblib`) see one GPU each, where all of them have
    device=auto: it is cuda:0 to them, so their runs are those of one GPU.

    Args:
        sweeps: overrides whose keys may have several values, without Hydra's own.
        stages: as of `work`.
        launcher: Hydra's overrides, as `hydra/launcher=slurm`; one job after the other by default, without
            Hydra's launchers, which compose each job anew.
        config_name: the primary file in `conf/`.
        say: told where the logs of jobs are that run elsewhere.

    Returns:
        What failed.

    Raises:
        NSFError: a value or a launcher is refused, which shows before the first job.
        MissingExtraError: the launcher is not installed.
        LaunchError: no job could be started.
    """
    launching = configuration.launching(launcher, config_name) if launcher else None
    plugin = _plugin(launching[0]) if launching else ""
    movable: list[bool] = []  # by configuration: whether it may see any one GPU
    kept: set[str] = set()  # data.keep of all
    needed: set[Run] = set()

    def check(one: DictConfig) -> None:
        movable.append(one.device == "auto")
        if "point" not in stages:
            pipeline = chain_of(one)
            kept.add(one.data.keep)
            needed.update(pipeline.inputs)
            if not pipeline.complete(_of_chain(pipeline, stages)):
                pipeline.check()

    for overrides in sweeps:
        configuration.check_sweep(overrides, config_name, check)
    jobs = configuration.jobs(sweeps, config_name)
    common = set.intersection(*map(set, jobs))
    group = f"sweep-{content_hash(list(map(list, jobs)))}" if len(jobs) > 1 else ""
    gpus = visible_gpus() if "joblib" in plugin and all(movable) else ()
    start = partial(_in_turn, stages, group, config_name)
    if launching:
        # Jobs side by side write into one terminal, or one log.
        apart = "joblib" in plugin or "submitit" in plugin
        labels = tuple(" ".join(o for o in job if o not in common) for job in jobs) if apart else ()
        task = partial(_job, stages=tuple(stages), labels=labels, group=group)
        start = partial(_launched, _launcher(launching, task, gpus), say)
    dropped = kept == {"held_out"} and {"train", "evaluate"} <= set(stages)
    errors: list[str | None] = []
    with reserving(needed), _own_processes() if len(gpus) > 1 else nullcontext():
        for scene in _scenes(jobs) if dropped else [jobs]:
            try:
                ended = start([list(job) for job in scene], len(errors))
            except LaunchError as error:
                if not errors:
                    raise
                ended = [str(error)] * len(scene)
            except KeyboardInterrupt:
                if later := len(jobs) - len(errors) - len(scene):
                    say(f"not started: the jobs of later scenes, {later}; the same command goes on with them")
                raise
            if dropped and not any(ended):
                _drop_training([Pipeline(configuration.load(job, config_name)) for job in scene], say)
            errors += ended
    return [
        Failure(tuple(override for override in job if override not in common), error)
        for job, error in zip(jobs, errors, strict=True)
        if error
    ]


def reports(overrides: Sequence[str], say: Callable[[str], object] = print) -> list[Path]:
    """The pages of a sweep's scenes, each once, as its last job has them.

    Raises:
        MissingRunError: no job of a scene was evaluated.
    """
    with timed("report"):
        return [pipeline.report() for pipeline in _reporting(overrides, say)]


def check_report_folders(overrides: Sequence[str]) -> None:
    """Refuse a place where no page of a sweep could be written, before its jobs.

    Raises:
        ConfigError: something else stands there.
        StorageError: the folder above it cannot be written.
    """
    for pipeline in _reporting(overrides):
        check_place(pipeline.report_folder)


def _reporting(overrides: Sequence[str], say: Callable[[str], object] = print) -> list[Pipeline]:
    """One for each page."""
    configs = [configuration.load(job) for job in configuration.jobs([overrides])]
    last = {(config.report.folder, config.report.name): config for config in configs}
    return [Pipeline(config, say) for config in last.values()]


def _of_chain(pipeline: Pipeline, stages: Sequence[str]) -> list[str]:
    """The stages that a configuration has."""
    return [name for name in stages if len(stages) == 1 or name != "teach" or name in pipeline.stages]


def visible_gpus() -> tuple[str, ...]:
    """The GPUs that this process may use."""
    if not has_driver():
        return ()
    from nsf.mpm import device

    return device.visible_gpus()


@contextmanager
def _own_processes() -> Iterator[None]:
    """Joblib's processes are of this block alone: those of an earlier sweep may use a GPU already."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown()
    try:
        yield
    finally:
        get_reusable_executor().shutdown()


def _on_a_gpu(task: Callable, gpus: tuple[str, ...], config: DictConfig) -> str | None:
    """A job in a process that keeps to one GPU."""
    _see_one_gpu(gpus)
    return task(config)


@cache
def _see_one_gpu(gpus: tuple[str, ...]) -> None:
    """Choose this process's GPU by the number of its first job; later ones find CUDA at work on it."""
    os.environ["CUDA_VISIBLE_DEVICES"] = gpus[HydraConfig.get().job.num % len(gpus)]


def _job(
    config: DictConfig, stages: Sequence[str], labels: Sequence[str] = (), group: str = ""
) -> str | None:
    """The error of one job that Hydra launched, in a process of its own or not, as `_ended` has it.

    Args:
        config: of the job.
        stages: as of `work`.
        labels: by the number of a job, what each of its lines begins with; none where jobs come one by one.
        group: name of the sweep.
    """
    guard()  # in a process of its own as well
    hydra = HydraConfig.get()
    with labelled(labels[hydra.job.num] if labels else ""):
        return _ended(hydra.overrides.task, lambda: configuration.checked(config), stages, group)


def _in_turn(
    stages: Sequence[str], group: str, config_name: str, jobs: Sequence[list[str]], _first: int
) -> list[str | None]:
    """The error of each job, done in this process one after the other."""
    return [_ended(job, partial(configuration.load, job, config_name), stages, group) for job in jobs]


def _ended(
    job: Sequence[str], compose: Callable[[], DictConfig], stages: Sequence[str], group: str
) -> str | None:
    """The error of a job, None where it ended well; as text, which every process can read."""
    _say(f"--- {' '.join(job)}")
    try:
        work(compose(), stages, _say, group)
    except NSFError as error:
        print(f"{label()}error: {error}", file=sys.stderr, flush=True)
        return str(error)
    except Exception as error:
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    return None


def _say(line: str) -> None:
    print(f"{label()}{line}", flush=True)


def _scenes(jobs: Sequence[tuple[str, ...]]) -> list[list[tuple[str, ...]]]:
    """The jobs of each scene, which follow each other."""
    return [list(group) for _, group in itertools.groupby(jobs, configuration.scene_of)]


def _drop_training(pipelines: Sequence[Pipeline], say: Callable[[str], object]) -> None:
    """Delete the trajectories that the jobs trained on, but for those that one of them is held to.

    Their manifests stay; `nsf simulate` makes the trajectories again. What another process makes or needs is
    left.
    """
    truths = {one.truth(case).id for one in pipelines for case in one.held_out}
    for run in {run for one in pipelines for run in one.training_data if run.id not in truths}:
        if run.id in reserved(run.root, by_others=True):
            continue
        try:
            with run.claimed() as claimed:
                if claimed:
                    (run.path / TRAJECTORY).unlink(missing_ok=True)
        except (NSFError, OSError) as error:
            say(f"warning: the trajectory of {run.id} stays: {error}")


def _plugin(config: DictConfig) -> str:
    """The package of the launcher of a configuration, which is installed.

    Raises:
        ConfigError: the configuration names something else.
        MissingExtraError: it is not installed.
    """
    target = config.hydra.launcher._target_
    plugin = ".".join(target.split(".")[:2])
    if not plugin.startswith(("hydra_plugins.", "hydra._internal")):
        raise ConfigError(
            f"hydra.launcher._target_={target} is refused; choose a launcher, as hydra/launcher=joblib"
        )
    optional(plugin, "sweep")
    return plugin


def _launcher(
    launching: tuple[DictConfig, ConfigLoader],
    task: Callable[[DictConfig], str | None],
    gpus: tuple[str, ...],
) -> Launcher:
    """Hydra's launcher of a task, each process on one GPU where there are several."""
    config, loader = launching
    context = HydraContext(config_loader=loader, callbacks=Callbacks())
    task = partial(_on_a_gpu, task, gpus) if len(gpus) > 1 else task
    return Plugins.instance().instantiate_launcher(context, task, config)


def _launched(
    launcher: Launcher, say: Callable[[str], object], jobs: list[list[str]], first: int
) -> list[str | None]:
    """The error of each job, None for one that ended well; `first` is the number of the first one."""
    kind, logs = type(launcher).__name__, Path()
    if kind == "SlurmLauncher":
        logs = Path(launcher.params["submitit_folder"]).parent
        say(f"{len(jobs)} jobs go into Slurm's queue, which squeue shows; their logs are in {logs}")
    before = set(logs.glob(_SUBMITTED)) if kind == "SlurmLauncher" else set()
    try:
        return [launched.return_value for launched in launcher.launch(jobs, first)]
    except KeyboardInterrupt:
        if kind == "SlurmLauncher":
            say("the jobs stay in Slurm's queue, and go on; scancel ends them")
        raise
    except Exception as error:
        # A process that dies takes with it what the launcher would have returned of the others.
        if kind == "JoblibLauncher" and _died(error):
            return _one_by_one(launcher, jobs, first)
        if kind == "SlurmLauncher" and (submitted := set(logs.glob(_SUBMITTED)) - before):
            return _from_slurm(logs, {pickle.parent.name for pickle in submitted}, len(jobs))
        lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise LaunchError(
            f"no job could be launched: {lines[-1]}; correct the keys of hydra.launcher"
        ) from error


def _died(error: Exception) -> bool:
    from joblib.externals.loky import BrokenProcessPool

    return isinstance(error, BrokenProcessPool)


def _one_by_one(launcher: Launcher, jobs: list[list[str]], first: int) -> list[str | None]:
    """Each job launched alone, so that one whose process dies takes no other with it."""
    errors: list[str | None] = []
    for index, job in enumerate(jobs, first):
        try:
            errors += [launched.return_value for launched in launcher.launch([job], index)]
        except Exception as error:
            if not _died(error):
                raise
            errors.append(_DIED)
    return errors


def _from_slurm(logs: Path, submitted: Iterable[str], count: int) -> list[str | None]:
    """The outcome of each job of an array, once all have ended."""
    from submitit import SlurmJob
    from submitit.core.utils import UncompletedJobError

    errors: list[str | None] = [_DIED] * count
    for job_id in submitted:
        job = SlurmJob(logs / "%j", job_id, tasks=[0])
        index = int(job_id.partition("_")[2] or 0)
        try:
            errors[index] = job.results()[0].return_value
        except UncompletedJobError:
            errors[index] = f"{_DIED}; see {job.paths.stderr}"
    return errors
