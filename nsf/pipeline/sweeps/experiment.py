"""Experiments: a question, and the jobs that answer it (one file each in `experiments/`)."""

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.canonical import content_hash
from nsf.config.documents import text_of
from nsf.errors import ConfigError, MissingRunError
from nsf.paths import experiments, groups, option, reports_folder
from nsf.pipeline.chain import Pipeline
from nsf.pipeline.sweeps.chains import chain_of
from nsf.results.question import Question, unchanged
from nsf.runs import Run
from nsf.scalars import is_finite

_KEYS = {"title", "question", "paper", "jobs"}
_OPTIONAL = {"stages", "each", "printed", "plots"}
_KEYS_OF_PARTS = {"title", "question", "parts"}
_MORE_STAGES = ("superresolve",)  # that a job may do after those of `nsf run`
_MEASURING = "evaluation."  # keys of how runs are measured, which tell no two models apart
_WORKING = ("device", "tracking", "data.keep", "data.resident", "report.folder")  # keys that change no result
_LONGEST = 80  # characters of overrides in the name of a folder


@dataclass(frozen=True)
class Job:
    """One configuration of an experiment.

    Attributes:
        overrides: `key=value` in Hydra's grammar.
    """

    overrides: tuple[str, ...]

    @property
    def keys(self) -> dict[str, str]:
        """Value by key, of what a run is; `evaluation` says how it is measured."""
        return dict(one.split("=", 1) for one in self.overrides if not one.startswith(_MEASURING))


@dataclass(frozen=True)
class Experiment:
    """A question and its jobs; or, of a file with parts, the questions and jobs of its parts.

    Attributes:
        name: of the file, with `/part` of a part; the report's folder has it too.
        title: of the report.
        question: what it is to find out.
        paper: what the paper reports on it, with the place.
        grids: each a mapping from a key to its override with all values; every combination is a job.
        stages: what each job does after `evaluate`.
        plots: names of the charts of its report; None for all.
        printed: δ that the paper prints of single jobs, as `Question` has them; None where it prints one a
            scene and method, which the scene's file has.
        placed: whether the command line says where the report goes.
        changes: overrides of the command line that not every grid states so, in order, also one that restates
            a default; the name and the title of the report have them, so that it never replaces one of the
            file's jobs.
        parts: experiments with questions, jobs and reports of their own; none where the file has jobs itself.
    """

    name: str
    title: str
    question: str
    paper: str
    grids: tuple[dict[str, str], ...]
    stages: tuple[str, ...] = ()
    printed: tuple[dict, ...] | None = None
    plots: tuple[str, ...] | None = None
    changes: tuple[str, ...] = ()
    placed: bool = False
    parts: "tuple[Experiment, ...]" = ()

    @classmethod
    def load(cls, name: str, overrides: Sequence[str] = (), folder: Path | None = None) -> "Experiment":
        """The experiment of a file, or a part of it; `overrides` take the place of its own.

        Args:
            name: of the file, without its ending; or of a part, as `table1/seeds`.
            overrides: `key=value`; a key that no grid has is added to each.
            folder: of the files; by default the user's, and ours.

        Raises:
            ConfigError: there is no such file or part (the nearest is named), or a key of it is missing or
                unknown.
        """
        stem, _, part = name.partition("/")
        files = _files(folder)
        if stem not in files:
            raise _unknown(name, list(files), _with_parts(files))
        path = files[stem]
        content = _read(path)
        if "parts" not in content:
            if part:
                raise ConfigError(f"unknown experiment={name}; {stem} has no parts, leave /{part} out")
            return cls._of(stem, content, overrides, f"{path}")
        names = [f"{stem}/{one}" for one in content["parts"]]
        if part and name not in names:
            raise _unknown(name, names, names)
        parts = {
            f"{stem}/{one}": cls._of(f"{stem}/{one}", of_part, overrides, f"{path}: {one}")
            for one, of_part in content["parts"].items()
            if part in ("", one)
        }
        if part:
            return parts[name]
        grids = tuple(grid for one in parts.values() for grid in one.grids)
        texts = _texts(content, ("title", "question"), f"{path}")
        return cls(name=stem, paper="", grids=grids, parts=tuple(parts.values()), **texts)

    @classmethod
    def _of(cls, name: str, content: dict, overrides: Sequence[str], where: str) -> "Experiment":
        """The experiment of a file without parts, or of one part; `where` says which in messages."""
        stages = content.get("stages", [])
        if not isinstance(stages, list) or any(stage not in _MORE_STAGES for stage in stages):
            raise ConfigError(f"{where}: stages={stages} must be a list of {', '.join(_MORE_STAGES)}")
        each = _grid(content.get("each", {}), f"{where}: each")
        replaced = {override.split("=", 1)[0]: override for override in overrides}
        stated = [each | _grid(grid, f"{where}: jobs[{at}]") for at, grid in enumerate(content["jobs"])]
        for grid in stated:
            _check_options(grid, replaced, where)
        grids = tuple(grid | replaced for grid in stated)
        changes = [
            override
            for key, override in replaced.items()
            if key not in _WORKING and any(grid.get(key) != override for grid in stated)
        ]
        changes.sort(key=lambda override: (override.startswith(_MEASURING), override))
        texts = _texts(content, ("title", "question", "paper"), where)
        printed, plots = _printed(content.get("printed"), where), content.get("plots")
        if plots is not None and not (isinstance(plots, list) and all(isinstance(p, str) for p in plots)):
            raise ConfigError(f"{where}: plots={plots} must be a list of names of charts")
        return cls(
            name=name, grids=grids, stages=tuple(stages), printed=printed, changes=tuple(changes),
            placed="report.folder" in replaced, plots=None if plots is None else tuple(plots), **texts,
        )  # fmt: skip

    @property
    def sweeps(self) -> list[list[str]]:
        """The overrides of each grid, as one multirun takes them."""
        return [list(grid.values()) for grid in self.grids]

    @property
    def jobs(self) -> list[Job]:
        """Every job, each once."""
        return [Job(job) for job in configuration.jobs(self.sweeps)]

    def report(self, say: Callable[[str], None] = print, root: Path | None = None) -> tuple[Path, list[str]]:
        """Write `reports/<name>` from what the jobs left, whichever device they ran on; one for each part.

        Returns:
            The page, of parts that of the first one, and what is missing on it or on those of all parts.

        Raises:
            MissingRunError: no job was evaluated.
        """
        if self.parts:
            return self._reports_of_parts(say, root)
        runs: dict[str, Run] = {}
        fine: dict[str, Run] = {}
        keys, configs, missing = {}, {}, []
        for job in self.jobs:
            config = configuration.load(job.overrides)
            pipeline = chain_of(config, root)
            try:
                run = pipeline.evaluated()
            except MissingRunError:
                missing.append(f"{' '.join(job.overrides)}: {_why(pipeline)}")
                continue
            runs[run.id], keys[run.id], configs[run.id] = run, job.keys, config
            if "superresolve" in self.stages:
                try:
                    fine[run.id] = pipeline.evaluated("superresolve")
                except MissingRunError:
                    why = _ended(pipeline.superresolution) or "superresolve not run"
                    missing.append(f"{' '.join(job.overrides)}: {why}")
        if not runs:
            raise MissingRunError(
                f"no job of {self.name} was evaluated; run `nsf run +experiment={self.name}`"
            )
        folder = self._folder(config)
        changed = f", with {' '.join(self.changes)}" if self.changes else ""
        question = Question(
            folder.relative_to(config.report.folder).as_posix(), f"{self.title}{changed}", self.question,
            self.paper, keys, self.printed, missing, fine, self.plots, _defaults(keys, configs),
        )  # fmt: skip
        said = f"report: {len(runs)} jobs, {len(missing)} missing{changed}"
        if page := unchanged(folder, runs.values(), question):
            say(f"{said}, unchanged, reused → {page}")
            return page, missing
        from nsf.results.report import build_report

        films = not question.settings or not any(map(len, question.settings.values()))
        page = build_report(runs.values(), folder, question, films=films)
        say(f"{said} → {page}")
        return page, missing

    def _reports_of_parts(self, say: Callable[[str], None], root: Path | None) -> tuple[Path, list[str]]:
        pages, missing = [], []
        for part in self.parts:
            try:
                page, absent = part.report(say, root)
            except MissingRunError as error:
                missing.append(f"{part.name}: {error}")
                continue
            pages.append(page)
            missing += [f"{part.name}: {one}" for one in absent]
        if not pages:
            raise MissingRunError(
                f"no job of {self.name} was evaluated; run `nsf run +experiment={self.name}`"
            )
        return pages[0], missing

    def check_report_folder(self) -> None:
        """Refuse a place where no report could be written, before the jobs.

        Raises:
            ConfigError: something else stands there.
            StorageError: the folder above it cannot be written.
        """
        from nsf.results.folder import check_place

        for one in self.parts or (self,):
            check_place(one._folder(configuration.load(one.jobs[0].overrides)))

    def _folder(self, config: DictConfig) -> Path:
        from nsf.results.folder import check_inside

        if not self.placed:
            check_inside(config.report.folder, reports_folder())
        return Path(config.report.folder) / "_".join((self.name, *_short(self.changes)))


def _defaults(
    keys: Mapping[str, Mapping[str, str]], configs: Mapping[str, DictConfig]
) -> dict[str, dict[str, str]]:
    """By run id, numbers of keys that its job leaves out and another job of its scene sets."""
    varied: dict[str, dict[str, None]] = {}
    for run, job in keys.items():
        varied.setdefault(configs[run].scene.name, {}).update(dict.fromkeys(job))
    values = {
        run: {key: OmegaConf.select(config, key) for key in varied[config.scene.name]}
        for run, config in configs.items()
    }
    return {
        run: {key: configuration.grammar(one) for key, one in of.items() if type(one) in (int, float)}
        for run, of in values.items()
    }


def _short(changes: Sequence[str]) -> list[str]:
    """Overrides as part of the name of a folder; what could be no name, or is long, ends in a hash."""
    text = ",".join(changes)
    plain = re.sub(r"[^\w.,=+-]", "-", text, flags=re.ASCII)[:_LONGEST]
    return [plain if plain == text else f"{plain}-{content_hash(list(changes))}"] if changes else []


def questions(folder: Path | None = None) -> dict[str, dict[str, str]]:
    """Title, question and what the paper says, of each experiment and part that has a report."""
    loaded = [Experiment.load(stem, folder=folder) for stem in _files(folder)]
    return {
        one.name: {"title": one.title, "question": one.question, "paper": one.paper}
        for experiment in loaded
        for one in experiment.parts or (experiment,)
    }


def _files(folder: Path | None) -> dict[str, Path]:
    """The files of experiments by name: of a folder, or all that there are."""
    return experiments() if folder is None else {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _with_parts(files: Mapping[str, Path]) -> list[str]:
    """Names of experiments, and of their parts; a file that cannot be read has none."""
    names = list(files)
    for stem, path in files.items():
        with suppress(ConfigError):
            names += [f"{stem}/{part}" for part in _read(path).get("parts", ())]
    return names


def _unknown(name: str, choices: Sequence[str], names: Sequence[str]) -> ConfigError:
    near = difflib.get_close_matches(name, names, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return ConfigError(f"unknown experiment={name}; choose one of {', '.join(choices)}{hint}")


def _read(path: Path) -> dict:
    """The content of an experiment's file, with the keys that it needs, and each part with those it needs."""
    try:
        content = yaml.safe_load(text_of(path))
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path}: {str(error).splitlines()[0]}; correct the yaml") from error
    if not isinstance(content, dict) or "parts" not in content:
        _check_keys(content, str(path))
        return content
    parts = content["parts"]
    if set(content) != _KEYS_OF_PARTS or not isinstance(parts, dict) or not parts:
        raise ConfigError(
            f"{path} must have the keys {', '.join(sorted(_KEYS_OF_PARTS))} and no other; parts is a mapping"
        )
    for name, part in parts.items():
        _check_keys(part, f"{path}: {name}")
    return content


def _check_keys(content, where: str) -> None:
    """Refuse what is no experiment and no part of one."""
    names = set(content) if isinstance(content, dict) else set()
    jobs = content["jobs"] if "jobs" in names else None
    if names - _OPTIONAL != _KEYS or not isinstance(jobs, list) or not jobs:
        raise ConfigError(f"{where} must have the keys {', '.join(sorted(_KEYS))}; jobs is a list")


def _texts(content: dict, keys: Sequence[str], where: str) -> dict[str, str]:
    """The texts of a file or part, each on one line."""
    return {key: " ".join(configuration.text(f"{where}: {key}", content[key]).split()) for key in keys}


def _grid(values, where: str) -> dict[str, str]:
    """The override with all its values, by key."""
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise ConfigError(f"{where}={values} must be keys with their values, as {{scene: sand}}")
    if empty := [key for key, value in values.items() if value == []]:
        raise ConfigError(f"{where}: {empty[0]}=[] has no value; give one, or [[]] for an empty list")
    return {key: f"{key}={_values(value)}" for key, value in values.items()}


def _why(pipeline: Pipeline) -> str:
    """The reason why a job has no result: the first stage that did not end well."""
    needed = (
        pipeline.training_data,
        [pipeline.training],
        [pipeline.deployment],
        [pipeline.evaluation],
    )
    for runs in needed:
        for run in runs:
            if reason := _ended(run):
                return reason
    return "not run"


def _ended(run: Run) -> str | None:
    """How a run ended that did not end well; None if it did, or was never begun."""
    error = run.manifest.get("error")
    return f"{run.stage} {run.manifest.get('status')}: {error}" if error else None


def _check_options(grid: Mapping[str, str], replaced: Mapping[str, str], where: str) -> None:
    """Refuse an option of the command line, as model=interpolate, that lacks a key which a job sets."""
    for group in replaced.keys() & groups().keys():
        keys = [key for key in grid if key.startswith(f"{group}.") and key not in replaced]
        for name in replaced[group].partition("=")[2].split(",") if keys else ():
            lacking = [key for key in keys if not _has(group, name, key)]
            if lacking:
                raise ConfigError(
                    f"{where} sets {lacking[0]}, which {group}={name} does not have; leave {group}={name} out"
                )


def _has(group: str, name: str, key: str) -> bool:
    """Whether an option of a group has a key in its file; an option that is unknown is refused elsewhere."""
    if name not in groups()[group]:
        return True
    node = yaml.safe_load(text_of(option(group, name)))
    whole = isinstance(node, dict) and group in node  # a scene's file is of the package _global_
    for part in key.split(".")[0 if whole else 1 :]:
        if not isinstance(node, dict) or part not in node:
            return False
        node = node[part]
    return True


def _printed(entries, where: str) -> tuple[dict, ...] | None:
    """Figures of the paper: δ as a number, all else as the text that keys of jobs have."""
    if entries is None:
        return None
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict) and isinstance(entry.get("delta"), float) and is_finite(entry["delta"])
        for entry in entries
    ):
        raise ConfigError(f"{where}: printed must be a list of mappings, each with a number delta")
    return tuple(
        {str(key): value if key == "delta" else configuration.grammar(value) for key, value in entry.items()}
        for entry in entries
    )


def _values(value) -> str:
    """A value, or a list of values to be taken in turn, in Hydra's grammar."""
    return ",".join(map(configuration.grammar, value if isinstance(value, list) else [value]))
