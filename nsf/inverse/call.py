"""The words of `nsf calibrate`, `nsf sample` and `nsf design`, refused before a model is loaded.

Whatever a word or a file can be refused for by the run's manifest and configuration is refused here. Nothing
here imports torch, which with all that a model needs takes seconds.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from nsf import schemas, words
from nsf.data import PROGRAM, Trajectory
from nsf.errors import ConfigError, MissingRunError
from nsf.inverse.columns import SAME_TIME, check_scalars, read_columns
from nsf.paths import reports_folder
from nsf.results.folder import check_place
from nsf.runs import Run

if TYPE_CHECKING:
    from nsf.inverse.model import Model

_RANGE = re.compile(rf"({words.NUMBER})\.\.({words.NUMBER})")
_MOST_TRIALS = 10_000
_CASES = {"cases": [[{...: float}]]}  # of a teach run: training, drawn and validation cases
_SCENE = {"scene": {"dt": float, "steps": int}, "parameters": {...: dict}}  # of a deploy run


def _base(key: str, text: str) -> int:
    """A power of two, or 0."""
    base = words.whole(0)(key, text)
    if base == 1 or base & (base - 1):
        raise ConfigError(f"{key}={base} must be a power of two of at least 2, as 32 or 1024")
    return base


def _scalars(_: str, text: str) -> list[str]:
    """Names of scalars."""
    check_scalars(names := text.split(","))
    return names


_SHARED = dict.fromkeys(("run", "+experiment", "device", "folder"), words.text) | {"seed": words.whole(0)}
_KEYS: dict[str, dict[str, words.Reader]] = {
    "calibrate": {
        "observations": words.text, "trials": words.whole(most=_MOST_TRIALS), "starts": words.whole(),
        "full_order": words.flag, "program": words.whole(0),
    },
    "sample": {
        "of": _scalars, "runs": words.whole(), "observations": words.text, "sensitivities": _base,
        "full_order": _base, "program": words.whole(0),
    },
    "design": {
        "target": words.text, "tilt": words.positive, "move": words.text, "knots": words.whole(most=1000),
        "full_order": words.flag,
    },
}  # fmt: skip


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


def check_taught(name: str, low: float, high: float, least: float, most: float) -> None:
    """Refuse a range of a parameter, or a value as both its ends, beyond what was taught: least to most.

    Raises:
        ConfigError: its ends are the wrong way round, or one lies outside.
    """
    if low > high:
        raise ConfigError(f"{name}={low:g}..{high:g} is the wrong way round; give {name}={high:g}..{low:g}")
    slack = 1e-9 * max(abs(least), abs(most))
    if not least - slack <= low <= high <= most + slack:
        text = f"{low:g}" if low == high else f"{low:g}..{high:g}"
        raise ConfigError(
            f"{name}={text} goes beyond what was taught, {least:g}..{most:g}; stay within, or train with a "
            "wider range"
        )


@dataclass(frozen=True)
class Call:
    """A command with its words.

    Attributes:
        runs: complete deploy runs that are meant.
        values: of the command's keys; named: texts by names of parameters.
    """

    runs: list[Run]
    values: dict
    named: dict[str, str]

    @classmethod
    def of(
        cls, command: str, arguments: Sequence[str], more: dict[str, words.Reader] | None = None
    ) -> "Call":
        """From `key=value`, with readers of further keys.

        Raises:
            ConfigError: a word is no such pair, or given twice, or its key unknown, or its value refused.
            MissingRunError: a run is not there.
        """
        readers = _SHARED | _KEYS[command] | (more or {})
        texts = words.pairs(command, arguments)
        values = {key: readers[key](key, text) for key, text in texts.items() if key in readers}
        runs = _runs(values.get("run"), values.get("+experiment"))
        named = {key: text for key, text in texts.items() if key not in readers}
        names = sorted({name for run in runs for name in _taught(run)})
        if unknown := [key for key in named if key not in names]:
            raise ConfigError(
                f"nsf {command} has no key {unknown[0]!r}; it takes {', '.join(sorted(readers))}, and the "
                f"parameters {', '.join(names)}"
            )
        return cls(runs, values, named)

    @cached_property
    def models(self) -> "list[Model]":
        """Those of the runs, loaded."""
        from nsf.inverse.model import Model

        return [Model(run, self.values.get("device", "auto")) for run in self.runs]

    @property
    def run(self) -> Run:
        """The one that is meant."""
        if len(self.runs) > 1:
            first = self.runs[0]
            raise ConfigError(f"{len(self.runs)} runs are named; name one, as run={first.scene}/{first.hash}")
        return self.runs[0]

    @property
    def model(self) -> "Model":
        """That of the one run, loaded."""
        return self.models[0]

    @property
    def program(self) -> int | None:
        """The program that runs follow; None where the scene has no programs."""
        program = self.values.get("program")
        if PROGRAM not in self.run.config["parameters"]:
            if program is not None:
                raise ConfigError(f"program={program}: {self.run.scene} has no programs; leave it out")
        elif program is None:
            raise ConfigError(
                f"the runs of {self.run.scene} follow programs; give the number of one, as program=3, that "
                "of the observed run where there are observations"
            )
        return program

    def ranges(self) -> dict[str, list[float] | float]:
        """Ranges, or single values, of the parameters that were named, each within what was taught."""
        ranges, taught = ranges_of(self.named), _taught(self.run)
        for name, value in ranges.items():
            ends = value if isinstance(value, list) else [value, value]
            check_taught(name, *ends, *taught[name])
        return ranges

    def observed(self, key: str) -> str | None:
        """The file of observations or targets that a key names; None where there is none.

        Raises:
            ConfigError: it is no such file, or of another run: later than its end, or outside of its body.
        """
        if (path := self.values.get(key)) is None:
            return None
        columns, scene = read_columns(path), self.run.config["scene"]
        run = (0.0, scene["dt"] * scene["steps"], scene["dt"] * SAME_TIME)
        for name, (low, high, slack) in {"t": run, **_box(self.run)}.items():
            values = columns.get(name, np.zeros(0))
            outside = np.flatnonzero((values < low - slack) | (values > high + slack))
            if len(outside):
                of = "run" if name == "t" else "body at rest"
                raise ConfigError(
                    f"{path}, row {outside[0] + 1}: {name}={values[outside[0]]:g} is outside of the {of}, "
                    f"{low:.4g} … {high:.4g}; leave the observation out, or name its run, as run=RUN"
                )
        return path

    def folder(self, name: str) -> Path:
        """Where the page goes, refused at once where none could be written."""
        folder = Path(self.values.get("folder") or reports_folder(name))
        check_place(folder)
        return folder


def _taught(run: Run) -> dict[str, tuple[float, float]]:
    """Smallest and largest training value of each parameter of a deploy run.

    Raises:
        ConfigError: its model was taught nothing. MissingRunError: the teaching is gone.
    """
    teaching = next((parent for parent in run.parent_runs if parent.stage == "teach"), None)
    if teaching is None:
        raise ConfigError(
            f"{run.id} has model={run.metric('model', kind=str)}, whose steps know no gradient; deploy it "
            "with model=recurrence, which is taught first"
        )
    schemas.check(run.config, _SCENE, f"{run.id}: its configuration")
    schemas.check(teaching.require().config, _CASES, f"{teaching.id}: its configuration")
    training = pd.DataFrame(teaching.config["cases"][0]).drop(columns=PROGRAM, errors="ignore")
    return {name: (values.min(), values.max()) for name, values in training.items()}


def _box(run: Run) -> dict[str, tuple[float, float, float]]:
    """By axis, where a deploy run's body begins and ends at rest, and a particle's largest width [m].

    Empty where no training trajectory is left: the model, once loaded, refuses points outside of its body.
    """
    trained = (of for parent in run.parent_runs if parent.stage == "train" for of in parent.parent_runs)
    if (simulated := next((one for one in trained if one.complete), None)) is None:
        return {}
    with Trajectory.of(simulated) as trajectory:
        low, high = trajectory.X.min(0), trajectory.X.max(0)
        width = (high - low).max() / trajectory.particles ** (1 / 3)
    return {axis: (low[k], high[k], width) for k, axis in enumerate("XYZ")}


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
