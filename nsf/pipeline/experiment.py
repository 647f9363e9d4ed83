"""Experiments: a question, and the jobs that answer it (one file each in `experiments/`)."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from omegaconf import DictConfig

from nsf import config as configuration
from nsf.config.documents import text_of
from nsf.errors import ConfigError, MissingRunError
from nsf.paths import EXPERIMENTS
from nsf.pipeline.names import Names
from nsf.reporting.keeping import unchanged
from nsf.runs import Run
from nsf.vectors import is_finite

_KEYS = {"title", "question", "paper", "jobs"}
_OPTIONAL = {"stages", "each", "printed"}
_MORE_STAGES = ("superresolve",)  # that a job may do after those of `nsf run`
#: Keys that a column of results.csv tells of.
_COLUMNS = ("scene", "method", "field", "latent_dim", "engine", "sampler.size", "precision", "device")
_MEASURING = "evaluation."  # keys of how runs are measured, which tell no two models apart


@dataclass(frozen=True)
class Job:
    """One configuration of an experiment.

    Attributes:
        overrides: `key=value` in Hydra's grammar.
        setting: those of them that tell the job from others alike in all columns of results.csv, but for how
            runs are measured.
    """

    overrides: tuple[str, ...]
    setting: str

    @property
    def keys(self) -> dict[str, str]:
        """Value by key, of what a run is; `evaluation` says how it is measured."""
        return dict(one.split("=", 1) for one in self.overrides if not one.startswith(_MEASURING))


@dataclass(frozen=True)
class Experiment:
    """A question and its jobs.

    Attributes:
        name: of the file, and of the report's folder.
        title: of the report.
        question: what it is to find out.
        paper: what the paper reports on it, with the place.
        grids: each a mapping from a key to its override with all values; every combination is a job.
        stages: what each job does after `evaluate`.
        printed: δ that the paper prints of single jobs, as `Study` has them; None where it prints one a scene
            and method, which the scene's file has.
        small: whether the file itself asks for scale=small, so that its report's name need not say so.
    """

    name: str
    title: str
    question: str
    paper: str
    grids: tuple[dict[str, str], ...]
    stages: tuple[str, ...] = ()
    printed: tuple[dict, ...] | None = None
    small: bool = False

    @classmethod
    def load(cls, name: str, overrides: Sequence[str] = (), folder: Path = EXPERIMENTS) -> "Experiment":
        """The experiment of `folder/name.yaml`; `overrides` take the place of its own.

        Args:
            name: of the file, without its ending.
            overrides: `key=value`; a key that no grid has is added to each.
            folder: of the files.

        Raises:
            ConfigError: there is no such file (the nearest is named), or a key of it is missing or unknown.
        """
        path, known = folder / f"{name}.yaml", sorted(p.stem for p in folder.glob("*.yaml"))
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise ConfigError(f"unknown experiment={name}; choose one of {', '.join(known)}{hint}")
        content = _read(path)
        stages = content.get("stages", [])
        if not isinstance(stages, list) or any(stage not in _MORE_STAGES for stage in stages):
            raise ConfigError(f"{path}: stages={stages} must be a list of {', '.join(_MORE_STAGES)}")
        each = _grid(content.get("each", {}), f"{path}: each")
        own = {override.split("=", 1)[0]: override for override in overrides}
        stated = [each | _grid(grid, f"{path}: jobs[{at}]") for at, grid in enumerate(content["jobs"])]
        grids = tuple(grid | own for grid in stated)
        small = all(grid.get("scale") == "scale=small" for grid in stated)
        texts = {
            key: " ".join(configuration.text(f"{path}: {key}", content[key]).split())
            for key in ("title", "question", "paper")
        }
        printed = _printed(content.get("printed"), path)
        return cls(name=name, grids=grids, stages=tuple(stages), printed=printed, small=small, **texts)

    @property
    def sweeps(self) -> list[list[str]]:
        """The overrides of each grid, as one multirun takes them."""
        return [list(grid.values()) for grid in self.grids]

    @property
    def jobs(self) -> list[Job]:
        """Every job, each once."""
        found = configuration.jobs(self.sweeps)

        def told(job: tuple[str, ...]) -> set[str]:
            return {override for override in job if override.split("=")[0] in _COLUMNS}

        def setting(job: tuple[str, ...]) -> str:
            alike = [set(other) for other in found if told(other) == told(job)]
            apart = (override for override in job if override not in set.intersection(*alike))
            return ", ".join(override for override in apart if not override.startswith(_MEASURING))

        return [Job(job, setting(job)) for job in found]

    def report(self, say: Callable[[str], None] = print, root: Path | None = None) -> tuple[Path, list[str]]:
        """Write `reports/<name>` from what the jobs left, whichever device they ran on.

        Returns:
            The page, and what is missing on it.

        Raises:
            MissingRunError: no job was evaluated.
        """
        from nsf.reporting.sources import Study

        runs: dict[str, Run] = {}
        fine: dict[str, Run] = {}
        settings, keys, missing, scales = {}, {}, [], set()
        for job in self.jobs:
            config = configuration.load(job.overrides)
            plan = Names(config, root)
            try:
                run = plan.evaluated()
            except MissingRunError:
                missing.append(f"{' '.join(job.overrides)}: {_why(plan)}")
                continue
            runs[run.id], settings[run.id], keys[run.id] = run, job.setting, job.keys
            scales.add(config.scale)
            if "superresolve" in self.stages:
                try:
                    fine[run.id] = plan.superresolved()
                except MissingRunError:
                    missing.append(
                        f"{' '.join(job.overrides)}: {_ended(plan.superresolution) or 'superresolve not run'}"
                    )
        if not runs:
            raise MissingRunError(
                f"no job of {self.name} was evaluated; run `nsf run +experiment={self.name}`"
            )
        folder = self._folder(config, scales)
        study = Study(self.question, self.paper, settings, keys, missing, self.printed, fine)
        if page := unchanged(folder, runs.values(), self.title, study=study):
            say(f"report: {len(runs)} jobs, {len(missing)} missing, unchanged, reused → {page}")
            return page, missing
        from nsf.reporting.build import build_report

        page = build_report(list(runs.values()), folder, self.title, study=study)
        say(f"report: {len(runs)} jobs, {len(missing)} missing → {page}")
        return page, missing

    def check_report_folder(self) -> None:
        """Refuse a place where no report could be written, before the jobs.

        Raises:
            ConfigError: something else stands there.
            StorageError: the folder above it cannot be written.
        """
        from nsf.results.folder import check_place

        config = configuration.load(self.jobs[0].overrides)
        check_place(self._folder(config, {config.scale}))

    def _folder(self, config: DictConfig, scales: set[str]) -> Path:
        shrunk = scales == {"small"} and not self.small
        return Path(config.report.folder) / (f"{self.name}_small" if shrunk else self.name)


def _read(path: Path) -> dict:
    """The content of an experiment's file, with the keys that it needs."""
    try:
        content = yaml.safe_load(text_of(path))
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path}: {str(error).splitlines()[0]}; correct the yaml") from error
    found = set(content) if isinstance(content, dict) else set()
    jobs = content["jobs"] if "jobs" in found else None
    if found - _OPTIONAL != _KEYS or not isinstance(jobs, list) or not jobs:
        raise ConfigError(f"{path} must have the keys {', '.join(sorted(_KEYS))}; jobs is a list")
    return content


def _grid(values, where: str) -> dict[str, str]:
    """The override with all its values, by key."""
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise ConfigError(f"{where}={values} must be keys with their values, as {{scene: sand}}")
    if empty := [key for key, value in values.items() if value == []]:
        raise ConfigError(f"{where}: {empty[0]}=[] has no value; give one, or [[]] for an empty list")
    return {key: f"{key}={_values(value)}" for key, value in values.items()}


def _why(plan: Names) -> str:
    """What became of a job that has no result: the first stage that did not end well."""
    needed = (
        [plan.simulation(v) for v in plan.split.train],
        [plan.training],
        [plan.deployment],
        [plan.evaluation],
    )
    for runs in needed:
        for run in runs:
            if told := _ended(run):
                return told
    return "not run"


def _ended(run: Run) -> str | None:
    """How a run ended that did not end well; None if it did, or was never begun."""
    error = run.manifest.get("error")
    return f"{run.stage} {run.manifest.get('status')}: {error}" if error else None


def _printed(entries, path: Path) -> tuple[dict, ...] | None:
    """Figures of the paper: δ as a number, all else as the text that keys of jobs have."""
    if entries is None:
        return None
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict) and isinstance(entry.get("delta"), float) and is_finite(entry["delta"])
        for entry in entries
    ):
        raise ConfigError(f"{path}: printed must be a list of mappings, each with a number delta")
    return tuple(
        {str(key): value if key == "delta" else _text(value) for key, value in entry.items()}
        for entry in entries
    )


def _values(value) -> str:
    """A value, or a list of values to be taken in turn, in Hydra's grammar."""
    return ",".join(map(_text, value)) if isinstance(value, list) else _text(value)


def _text(value) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{','.join(map(_text, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_text(v)}" for key, v in value.items()) + "}"
    return str(value)
