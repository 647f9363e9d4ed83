"""`nsf calibrate`, `nsf sample` and `nsf design`: their words, and the work."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from nsf.data import PROGRAM
from nsf.errors import ConfigError, MissingRunError
from nsf.evaluation.quantities import QUANTITIES
from nsf.inverse.model import Model
from nsf.inverse.observations import Observations, View, is_scalar
from nsf.inverse.space import Space
from nsf.results.folder import check_place
from nsf.runs import Run

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})")
_MOST_TRIALS = 10_000


def calibrate(words: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """Parameters from observations, or synthetic trials; gives the page.

    Args:
        words: `key=value`, as `nsf calibrate --help` has them.
        say: told what is done.

    Raises:
        NSFError: a word is refused, a run is missing, or the observations do not tell.
    """
    known = ("observations", "trials", "starts", "full_order", "program", "seed")
    models, asked, named = _begun("calibrate", words, known)
    if ("trials" in asked) == ("observations" in asked):
        raise ConfigError(
            "nsf calibrate takes observations=FILE, or trials=N to calibrate N full-order runs at known "
            "parameters; give one of them"
        )
    if "trials" in asked:
        if named:
            raise ConfigError(f"trials={asked['trials']} takes no {next(iter(named))}=; leave it out")
        from nsf.inverse.reports.trials import report as trials_report
        from nsf.inverse.trials import Trials

        trials = Trials(
            _whole(asked, "trials", 20, most=_MOST_TRIALS), seed=_whole(asked, "seed", 0, least=0)
        )
        return trials_report(models, trials, _folder(asked, "calibration"), say)
    from nsf.inverse.reports.calibration import report

    model = _one(models)
    program = _program(asked, model)
    view = View(Observations.read(asked["observations"], model), model)
    page, _ = report(
        view,
        model,
        Space.of(model, ranges_of(named)),
        _folder(asked, f"calibrate_{model.scene.name}"),
        program=program,
        full_order=_flag(asked, "full_order", True),
        starts=_whole(asked, "starts", 64),
        say=say,
    )
    return page


def sample(words: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """What drawn parameters bring about; gives the page.

    Args:
        words: `key=value`, as `nsf sample --help` has them.
        say: told what is done.

    Raises:
        NSFError: a word is refused, or a run or an extra is missing.
    """
    known = ("of", "runs", "sensitivities", "full_order", "observations", "program", "seed")
    models, asked, named = _begun("sample", words, known)
    from nsf.extras import optional
    from nsf.inverse.reports.sample import report
    from nsf.inverse.sampling import Asked, Prior

    indices, full_order = (_whole(asked, key, 0, least=0) for key in ("sensitivities", "full_order"))
    for key, base in (("sensitivities", indices), ("full_order", full_order)):
        if base == 1 or base & (base - 1):
            raise ConfigError(f"{key}={base} must be a power of two of at least 2, as 32 or 1024")
    if full_order and not indices:
        raise ConfigError("full_order= are runs beside sensitivities; give sensitivities= too")
    for needed in ("SALib",) * bool(indices) + ("emcee",) * ("observations" in asked):
        optional(needed, "inverse")  # before any work
    model, view = _one(models), None
    program = _program(asked, model)
    if "observations" in asked:
        view = View(Observations.read(asked["observations"], model), model)
    return report(
        model,
        Prior.of(model, named),
        Asked(asked.get("of", "height").split(","), model),
        _folder(asked, f"sample_{model.scene.name}"),
        count=_whole(asked, "runs", 10_000),
        indices=indices,
        full_order=full_order,
        view=view,
        program=program,
        seed=_whole(asked, "seed", 0, least=0),
        say=say,
    )


def design(words: Sequence[str], say: Callable[[str], object] = print) -> Path:
    """A program of forcing that brings a target about; gives the page.

    Args:
        words: `key=value`, as `nsf design --help` has them.
        say: told what is done.

    Raises:
        NSFError: a word is refused, or a run is missing.
    """
    scalars = [key for word in words if is_scalar(key := word.split("=")[0])]
    known = ("target", "tilt", "move", "knots", "full_order", "seed", *scalars)
    models, asked, named = _begun("design", words, known)
    from nsf.inverse.design import Moves, Program, Tilt
    from nsf.inverse.reports.design import report
    from nsf.inverse.space import check_taught

    model = _one(models)
    if ("target" in asked) == bool(scalars):
        raise ConfigError(
            f"nsf design takes target=FILE, or scalars at the end, as {next(iter(QUANTITIES))}=0.1"
        )
    if ("tilt" in asked) == ("move" in asked):
        raise ConfigError("nsf design takes tilt=ANGLE [°] or move=SOLID, what may change; give one of them")
    knots = _whole(asked, "knots", 6, most=1000)
    program: Program = (
        Tilt(model, _number(asked, "tilt"), knots)
        if "tilt" in asked
        else Moves(model, tuple(asked["move"].split(",")), knots)
    )
    seen = (
        Observations.read(asked["target"], model)
        if "target" in asked
        else Observations.of_scalars({key: _number(asked, key) for key in scalars}, float(model.t[-1]))
    )
    values = ranges_of(named)
    if wide := [name for name, value in values.items() if isinstance(value, list)]:
        raise ConfigError(f"{wide[0]}={named[wide[0]]} must be one value: the run's own")
    for name, value in values.items():
        check_taught(model, name, value, value)
    middle = dict(zip(model.names, model.ranges.mean(1).tolist(), strict=True))
    page, _ = report(
        program,
        View(seen, model),
        middle | values,
        _folder(asked, f"design_{model.scene.name}"),
        run_full_order=_flag(asked, "full_order", True),
        seed=_whole(asked, "seed", 0, least=0),
        say=say,
    )
    return page


def _number(asked: Mapping[str, str], key: str) -> float:
    if not re.fullmatch(_NUMBER, asked[key]):
        raise ConfigError(f"{key}={asked[key]} is no number")
    return float(asked[key])


def ranges_of(named: Mapping[str, str]) -> dict[str, list[float] | float]:
    """Ranges `LOW..HIGH`, or single values, by name.

    Raises:
        ConfigError: a text is neither.
    """
    found: dict[str, list[float] | float] = {}
    for name, text in named.items():
        if ends := _RANGE.fullmatch(text):
            found[name] = [float(ends[1]), float(ends[2])]
        elif re.fullmatch(_NUMBER, text):
            found[name] = float(text)
        else:
            raise ConfigError(f"{name}={text} is neither a value nor a range; give it as 30 or 25..35")
    return found


def _begun(
    command: str, words: Sequence[str], known: Sequence[str]
) -> tuple[list[Model], dict[str, str], dict[str, str]]:
    """The models that are meant, what is asked by the command's keys, and by names of parameters."""
    if wrong := [word for word in words if "=" not in word]:
        raise ConfigError(f"{wrong[0]!r} is not key=value; see `nsf {command} --help`")
    given = [word.split("=", 1)[0] for word in words]
    if twice := [key for key in given if given.count(key) > 1]:
        raise ConfigError(f"{twice[0]}= is given twice; give it once")
    asked = dict(word.split("=", 1) for word in words)
    runs = _runs(asked.pop("run", None), asked.pop("+experiment", None))
    device = asked.pop("device", "auto")
    models = [Model(run, device) for run in runs]
    names = {name for model in models for name in model.names}
    keys = {*known, "folder"}
    if unknown := [key for key in asked if key not in keys | names]:
        told = ", ".join(sorted(keys | {"run", "device"}))
        raise ConfigError(
            f"nsf {command} has no key {unknown[0]!r}; it takes {told}, and the parameters "
            f"{', '.join(sorted(names))}"
        )
    own = {key: value for key, value in asked.items() if key in keys}
    return models, own, {key: value for key, value in asked.items() if key not in keys}


def _runs(named: str | None, experiment: str | None) -> list[Run]:
    """The deploy runs of some names, of an experiment's jobs, or the newest one."""
    if experiment is None:
        if named is None:
            return [Run.newest("deploy")]
        return [Run.named(name, "deploy").require() for name in named.split(",")]
    from nsf import config
    from nsf.pipeline.experiment import Experiment
    from nsf.pipeline.names import Names

    runs = [Names(config.load(job.overrides)).deployment for job in Experiment.load(experiment).jobs]
    if missing := [run for run in runs if not run.complete]:
        raise MissingRunError(
            f"no complete deploy run is there of {len(missing)} jobs of {experiment}, as {missing[0].id}; "
            f"make them by `nsf run +experiment={experiment}`"
        )
    return runs


def _program(asked: Mapping[str, str], model: Model) -> int | None:
    """The program that runs follow; None where the scene has no programs."""
    if PROGRAM not in model.scene.varied:
        if "program" in asked:
            raise ConfigError(f"program={asked['program']}: {model.scene.name} has no programs; leave it out")
        return None
    if "program" not in asked:
        raise ConfigError(
            f"the runs of {model.scene.name} follow programs; give the number of one, as program=3, that of "
            "the observed run where there are observations"
        )
    return _whole(asked, "program", 0, least=0)


def _one(models: Sequence[Model]) -> Model:
    if len(models) > 1:
        raise ConfigError(
            f"{len(models)} runs are named; name one, as run={models[0].run.scene}/{models[0].run.hash}"
        )
    return models[0]


def _whole(asked: Mapping[str, str], key: str, default: int, least: int = 1, most: int = 10_000_000) -> int:
    text = asked.get(key, str(default))
    if not (re.fullmatch(r"\d{1,9}", text) and least <= int(text) <= most):
        raise ConfigError(f"{key}={text} must be a whole number from {least} to {most}")
    return int(text)


def _flag(asked: Mapping[str, str], key: str, default: bool) -> bool:
    text = asked.get(key, str(default).lower())
    if text not in ("true", "false"):
        raise ConfigError(f"{key}={text} must be true or false")
    return text == "true"


def _folder(asked: Mapping[str, str], name: str) -> Path:
    """Where the page goes, refused at once where none could be written."""
    folder = Path(asked.get("folder") or Path(os.environ.get("NSF_REPORTS", "reports")) / name)
    check_place(folder)
    return folder
