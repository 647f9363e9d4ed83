"""`nsf calibrate`, `nsf sample` and `nsf design`: what they do, once their words are checked."""

from collections.abc import Callable, Sequence
from pathlib import Path

from nsf import words
from nsf.errors import ConfigError
from nsf.inverse.call import Call
from nsf.inverse.columns import is_scalar
from nsf.quantities import QUANTITIES


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

        of = values.get("+experiment", "_".join(run.scene for run in call.runs))
        trials = Trials(values["trials"], seed=values.get("seed", 0))
        folder = call.folder(f"calibration_{of.replace('/', '_')}_{trials.count}_seed{trials.seed}")
        return _written(trying(call.models, trials, say), folder, "calibrate", say)
    program, ranges, path = call.program, call.ranges(), call.observed("observations")
    folder = call.folder(f"calibrate_{call.run.scene}")
    from nsf.inverse.observations import Observations, View
    from nsf.inverse.reports.calibration import calibration
    from nsf.inverse.reports.page import Problem
    from nsf.inverse.space import Space

    problem = Problem(call.model, program)
    view = View(Observations.read(path, call.model), call.model)
    space = Space.of(call.model, ranges)
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

    values = call.values
    if values.get("full_order") and not values.get("sensitivities"):
        raise ConfigError("full_order= are runs beside sensitivities; give sensitivities= too")
    for needed in ("SALib",) * bool(values.get("sensitivities")) + ("emcee",) * ("observations" in values):
        optional(needed, "inverse")  # before any work
    program, path = call.program, call.observed("observations")
    folder = call.folder(f"sample_{call.run.scene}")
    from nsf.inverse.observations import Observations, View
    from nsf.inverse.reports.page import Problem
    from nsf.inverse.reports.sample import sampling
    from nsf.inverse.sampling import Prior, Scalars

    model = call.model
    results = sampling(
        Problem(model, program),
        Prior.of(model, call.named),
        Scalars(values.get("of", ["height"]), model),
        count=values.get("runs", 10_000),
        indices=values.get("sensitivities", 0),
        full_order=values.get("full_order", 0),
        view=View(Observations.read(path, model), model) if path else None,
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
    values = call.values
    if ("target" in values) == bool(scalars):
        raise ConfigError(
            f"nsf design takes target=FILE, or scalars at the end, as {next(iter(QUANTITIES))}=0.1"
        )
    if ("tilt" in values) == ("move" in values):
        raise ConfigError("nsf design takes tilt=ANGLE [°] or move=SOLID, what may change; give one of them")
    ranges, path = call.ranges(), call.observed("target")
    if wide := [name for name, value in ranges.items() if isinstance(value, list)]:
        raise ConfigError(f"{wide[0]}={call.named[wide[0]]} must be one value: the run's own")
    knots, moves = values.get("knots", 6), values.get("move", "").split(",")
    folder = call.folder(f"design_{call.run.scene}_{'tilt' if 'tilt' in values else '_'.join(moves)}")
    from nsf.inverse.design import Moves, Tilt
    from nsf.inverse.observations import Observations, View
    from nsf.inverse.reports.design import designing

    model = call.model
    program = Tilt(model, values["tilt"], knots) if "tilt" in values else Moves(model, tuple(moves), knots)
    if path:
        seen = Observations.read(path, model)
    else:
        seen = Observations.of_scalars({key: values[key] for key in scalars}, float(model.t[-1]))
    parameters = dict(zip(model.names, model.ranges.mean(1).tolist(), strict=True)) | ranges
    run_full_order, seed = values.get("full_order", True), values.get("seed", 0)
    results = designing(program, View(seen, model), parameters, run_full_order, seed, say)
    return _written(results, folder, "design", say)


def _written(results, folder: Path, command: str, say: Callable[[str], object]) -> Path:
    """The page of results, once their warnings are said."""
    from nsf.inverse.reports.page import write

    for warning in results.warnings:
        say(f"{command}: warning: {warning}")
    return write(results, folder)
