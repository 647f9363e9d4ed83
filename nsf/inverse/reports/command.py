"""`nsf calibrate`, `nsf sample` and `nsf design`: their words, and the work."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nsf.data import PROGRAM
from nsf.errors import ConfigError, MissingRunError
from nsf.evaluation.quantities import QUANTITIES
from nsf.inverse.model import Model
from nsf.inverse.observations import Observations, View, is_scalar
from nsf.inverse.space import Space, check_taught
from nsf.paths import reports_folder
from nsf.results.folder import check_place
from nsf.runs import Run

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})")
_MOST_TRIALS = 10_000


def _whole(least: int = 1, most: int = 10_000_000) -> Callable[[str, str], int]:
    def read(key: str, text: str) -> int:
        if not (re.fullmatch(r"\d{1,9}", text) and least <= int(text) <= most):
            raise ConfigError(f"{key}={text} must be a whole number from {least} to {most}")
        return int(text)

    return read


def _base(key: str, text: str) -> int:
    """A power of two, or 0."""
    base = _whole(0)(key, text)
    if base == 1 or base & (base - 1):
        raise ConfigError(f"{key}={base} must be a power of two of at least 2, as 32 or 1024")
    return base


def _flag(key: str, text: str) -> bool:
    if text not in ("true", "false"):
        raise ConfigError(f"{key}={text} must be true or false")
    return text == "true"


def _number(key: str, text: str) -> float:
    if not re.fullmatch(_NUMBER, text):
        raise ConfigError(f"{key}={text} is no number")
    return float(text)


def _text(key: str, text: str) -> str:
    return text


_KEYS: dict[str, dict[str, Callable]] = {
    "calibrate": {
        "observations": _text, "trials": _whole(most=_MOST_TRIALS), "starts": _whole(), "full_order": _flag,
        "program": _whole(0),
    },
    "sample": {
        "of": _text, "runs": _whole(), "observations": _text, "sensitivities": _base, "full_order": _base,
        "program": _whole(0),
    },
    "design": {
        "target": _text, "tilt": _number, "move": _text, "knots": _whole(most=1000), "full_order": _flag,
    },
}  # fmt: skip
_EVERY = dict.fromkeys(("run", "+experiment", "device", "folder"), _text) | {"seed": _whole(0)}


def calibrate(words: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """Parameters from observations, or synthetic trials; gives the page.

    Args:
        words: `key=value`, as `nsf calibrate --help` has them.
        say: told what is done.

    Raises:
        NSFError: a word is refused, a run is missing, or the observations do not tell.
    """
    call = Words.of("calibrate", words)
    values, named = call.values, call.named
    if ("trials" in values) == ("observations" in values):
        raise ConfigError(
            "nsf calibrate takes observations=FILE, or trials=N to calibrate N full-order runs at known "
            "parameters; give one of them"
        )
    if "trials" in values:
        if named:
            raise ConfigError(f"trials={values['trials']} takes no {next(iter(named))}=; leave it out")
        from nsf.inverse.reports.trials import Trials, trying

        trials = Trials(values["trials"], seed=values.get("seed", 0))
        of = values.get("+experiment", "_".join(model.scene.name for model in call.models))
        folder = call.folder(f"calibration_{of.replace('/', '_')}_{trials.count}_seed{trials.seed}")
        return _written(trying(call.models, trials, say), folder, "calibrate", say)
    from nsf.inverse.reports.calibration import calibration
    from nsf.inverse.reports.page import Problem

    problem, folder = Problem(call.model, call.program), call.folder(f"calibrate_{call.scene}")
    view = View(Observations.read(values["observations"], call.model), call.model)
    space = Space.of(call.model, ranges_of(named))
    options = {key: values[key] for key in ("full_order", "starts") if key in values}
    return _written(calibration(problem, view, space, **options, say=say), folder, "calibrate", say)


def sample(words: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """Runs at drawn parameters; gives the page.

    Args:
        words: `key=value`, as `nsf sample --help` has them.
        say: told what is done.

    Raises:
        NSFError: a word is refused, or a run or an extra is missing.
    """
    call = Words.of("sample", words)
    from nsf.extras import optional
    from nsf.inverse.reports.page import Problem
    from nsf.inverse.reports.sample import sampling
    from nsf.inverse.sampling import Prior, Scalars

    values, model = call.values, call.model
    if values.get("full_order") and not values.get("sensitivities"):
        raise ConfigError("full_order= are runs beside sensitivities; give sensitivities= too")
    for needed in ("SALib",) * bool(values.get("sensitivities")) + ("emcee",) * ("observations" in values):
        optional(needed, "inverse")  # before any work
    problem, folder = Problem(model, call.program), call.folder(f"sample_{call.scene}")
    observed = "observations" in values
    results = sampling(
        problem,
        Prior.of(model, call.named),
        Scalars(values.get("of", "height").split(","), model),
        count=values.get("runs", 10_000),
        indices=values.get("sensitivities", 0),
        full_order=values.get("full_order", 0),
        view=View(Observations.read(values["observations"], model), model) if observed else None,
        seed=values.get("seed", 0),
        say=say,
    )
    return _written(results, folder, "sample", say)


def design(words: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """A program of forcing that brings a target about; gives the page.

    Args:
        words: `key=value`, as `nsf design --help` has them.
        say: told what is done.

    Raises:
        NSFError: a word is refused, or a run is missing.
    """
    scalars = [key for word in words if is_scalar(key := word.split("=")[0])]
    call = Words.of("design", words, dict.fromkeys(scalars, _number))
    from nsf.inverse.design import Moves, Tilt
    from nsf.inverse.reports.design import designing

    model, values = call.model, call.values
    if ("target" in values) == bool(scalars):
        raise ConfigError(
            f"nsf design takes target=FILE, or scalars at the end, as {next(iter(QUANTITIES))}=0.1"
        )
    if ("tilt" in values) == ("move" in values):
        raise ConfigError("nsf design takes tilt=ANGLE [°] or move=SOLID, what may change; give one of them")
    knots, moves = values.get("knots", 6), values.get("move", "").split(",")
    program = Tilt(model, values["tilt"], knots) if "tilt" in values else Moves(model, tuple(moves), knots)
    if "target" in values:
        seen = Observations.read(values["target"], model)
    else:
        seen = Observations.of_scalars({key: values[key] for key in scalars}, float(model.t[-1]))
    ranges = ranges_of(call.named)
    if wide := [name for name, value in ranges.items() if isinstance(value, list)]:
        raise ConfigError(f"{wide[0]}={call.named[wide[0]]} must be one value: the run's own")
    for name, value in ranges.items():
        check_taught(model, name, value, value)
    parameters = dict(zip(model.names, model.ranges.mean(1).tolist(), strict=True)) | ranges
    folder = call.folder(f"design_{call.scene}_{'tilt' if 'tilt' in values else '_'.join(moves)}")
    run_full_order, seed = values.get("full_order", True), values.get("seed", 0)
    results = designing(program, View(seen, model), parameters, run_full_order, seed, say)
    return _written(results, folder, "design", say)


def ranges_of(named: dict[str, str]) -> dict[str, list[float] | float]:
    """Ranges `LOW..HIGH`, or single values, by name.

    Raises:
        ConfigError: a text is neither.
    """
    ranges: dict[str, list[float] | float] = {}
    for name, text in named.items():
        if ends := _RANGE.fullmatch(text):
            ranges[name] = [float(ends[1]), float(ends[2])]
        elif re.fullmatch(_NUMBER, text):
            ranges[name] = float(text)
        else:
            raise ConfigError(f"{name}={text} is neither a value nor a range; give it as 30 or 25..35")
    return ranges


def _written(results, folder: Path, command: str, say: Callable[[str], object]) -> Path:
    """The page of results, once their warnings are said."""
    from nsf.inverse.reports.page import write

    for warning in results.warnings:
        say(f"{command}: warning: {warning}")
    return write(results, folder)


@dataclass(frozen=True)
class Words:
    """The words of a command.

    Attributes:
        models: of the runs that are meant.
        values: of the command's keys, read; named: texts by names of parameters.
    """

    models: list[Model]
    values: dict
    named: dict[str, str]

    @classmethod
    def of(cls, command: str, words: Sequence[str], more: dict[str, Callable] | None = None) -> "Words":
        """From `key=value`, with how to read keys that this command has today.

        Raises:
            ConfigError: a word is no such pair, or given twice, or its key unknown, or its value refused.
        """
        if wrong := [word for word in words if "=" not in word]:
            raise ConfigError(f"{wrong[0]!r} is not key=value; see `nsf {command} --help`")
        keys = [word.split("=", 1)[0] for word in words]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise ConfigError(f"{twice[0]}= is given twice; give it once")
        read = _EVERY | _KEYS[command] | (more or {})
        texts = dict(word.split("=", 1) for word in words)
        values = {key: read[key](key, text) for key, text in texts.items() if key in read}
        runs = _runs(values.get("run"), values.get("+experiment"))
        models = [Model(run, values.get("device", "auto")) for run in runs]
        named = {key: text for key, text in texts.items() if key not in read}
        names = sorted({name for model in models for name in model.names})
        if unknown := [key for key in named if key not in names]:
            raise ConfigError(
                f"nsf {command} has no key {unknown[0]!r}; it takes {', '.join(sorted(read))}, and the "
                f"parameters {', '.join(names)}"
            )
        return cls(models, values, named)

    @property
    def model(self) -> Model:
        """The one that is meant."""
        if len(self.models) > 1:
            first = self.models[0].run
            raise ConfigError(
                f"{len(self.models)} runs are named; name one, as run={first.scene}/{first.hash}"
            )
        return self.models[0]

    @property
    def scene(self) -> str:
        """The scene's name."""
        return self.model.scene.name

    @property
    def program(self) -> int | None:
        """The program that runs follow; None where the scene has no programs."""
        program = self.values.get("program")
        if PROGRAM not in self.model.scene.varied:
            if program is not None:
                raise ConfigError(f"program={program}: {self.scene} has no programs; leave it out")
        elif program is None:
            raise ConfigError(
                f"the runs of {self.scene} follow programs; give the number of one, as program=3, that of "
                "the observed run where there are observations"
            )
        return program

    def folder(self, name: str) -> Path:
        """Where the page goes, refused at once where none could be written."""
        folder = Path(self.values.get("folder") or reports_folder(name))
        check_place(folder)
        return folder


def _runs(named: str | None, experiment: str | None) -> list[Run]:
    """The deploy runs of some names, of an experiment's jobs, or the newest one."""
    if experiment is None:
        if named is None:
            return [Run.newest("deploy")]
        return [Run.named(name, "deploy").require() for name in named.split(",")]
    from nsf import config
    from nsf.pipeline import Pipeline
    from nsf.pipeline.experiment import Experiment

    runs = [Pipeline(config.load(job.overrides)).deployment for job in Experiment.load(experiment).jobs]
    if missing := [run for run in runs if not run.complete]:
        raise MissingRunError(
            f"no complete deploy run is there of {len(missing)} jobs of {experiment}, as {missing[0].id}; "
            f"make them by `nsf run +experiment={experiment}`"
        )
    return runs
