"""`nsf calibrate`, `nsf sample` and `nsf design`: their words, and the work."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nsf import words
from nsf.data import PROGRAM
from nsf.errors import ConfigError, MissingRunError
from nsf.evaluation.quantities import QUANTITIES
from nsf.inverse.model import Model
from nsf.inverse.observations import Observations, View, is_scalar
from nsf.inverse.space import Space, check_taught
from nsf.paths import reports_folder
from nsf.results.folder import check_place
from nsf.runs import Run

_RANGE = re.compile(rf"({words.NUMBER})\.\.({words.NUMBER})")
_MOST_TRIALS = 10_000


def _base(key: str, text: str) -> int:
    """A power of two, or 0."""
    base = words.whole(0)(key, text)
    if base == 1 or base & (base - 1):
        raise ConfigError(f"{key}={base} must be a power of two of at least 2, as 32 or 1024")
    return base


_SHARED = dict.fromkeys(("run", "+experiment", "device", "folder"), words.text) | {"seed": words.whole(0)}
_KEYS: dict[str, dict[str, words.Reader]] = {
    "calibrate": {
        "observations": words.text, "trials": words.whole(most=_MOST_TRIALS), "starts": words.whole(),
        "full_order": words.flag, "program": words.whole(0),
    },
    "sample": {
        "of": words.text, "runs": words.whole(), "observations": words.text, "sensitivities": _base,
        "full_order": _base, "program": words.whole(0),
    },
    "design": {
        "target": words.text, "tilt": words.number, "move": words.text, "knots": words.whole(most=1000),
        "full_order": words.flag,
    },
}  # fmt: skip


def calibrate(arguments: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """Parameters from observations, or synthetic trials; gives the page.

    Args:
        arguments: `key=value`, as `nsf calibrate --help` has them.
        say: shows a line of progress.

    Raises:
        NSFError: a word is refused, a run is missing, or the observations do not tell.
    """
    call = Call.of("calibrate", arguments)
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


def sample(arguments: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """Runs at drawn parameters; gives the page.

    Args:
        arguments: `key=value`, as `nsf sample --help` has them.
        say: shows a line of progress.

    Raises:
        NSFError: a word is refused, or a run or an extra is missing.
    """
    call = Call.of("sample", arguments)
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


def design(arguments: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """A program of forcing that brings a target about; gives the page.

    Args:
        arguments: `key=value`, as `nsf design --help` has them.
        say: shows a line of progress.

    Raises:
        NSFError: a word is refused, or a run is missing.
    """
    scalars = [key for word in arguments if is_scalar(key := word.split("=")[0])]
    call = Call.of("design", arguments, dict.fromkeys(scalars, words.number))
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
        elif re.fullmatch(words.NUMBER, text):
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
class Call:
    """A command with its words.

    Attributes:
        models: of the runs that are meant.
        values: of the command's keys; named: texts by names of parameters.
    """

    models: list[Model]
    values: dict
    named: dict[str, str]

    @classmethod
    def of(
        cls, command: str, arguments: Sequence[str], more: dict[str, words.Reader] | None = None
    ) -> "Call":
        """From `key=value`, with readers of further keys.

        Raises:
            ConfigError: a word is no such pair, or given twice, or its key unknown, or its value refused.
        """
        readers = _SHARED | _KEYS[command] | (more or {})
        texts = words.pairs(command, arguments)
        values = {key: readers[key](key, text) for key, text in texts.items() if key in readers}
        runs = _runs(values.get("run"), values.get("+experiment"))
        models = [Model(run, values.get("device", "auto")) for run in runs]
        named = {key: text for key, text in texts.items() if key not in readers}
        names = sorted({name for model in models for name in model.names})
        if unknown := [key for key in named if key not in names]:
            raise ConfigError(
                f"nsf {command} has no key {unknown[0]!r}; it takes {', '.join(sorted(readers))}, and the "
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
    from nsf.pipeline.sweeps.experiment import Experiment

    runs = [Pipeline(config.load(job.overrides)).deployment for job in Experiment.load(experiment).jobs]
    if missing := [run for run in runs if not run.complete]:
        raise MissingRunError(
            f"no complete deploy run is there of {len(missing)} jobs of {experiment}, as {missing[0].id}; "
            f"make them by `nsf run +experiment={experiment}`"
        )
    return runs
