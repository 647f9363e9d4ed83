"""Search for good values of numeric keys, by Optuna: at the validation cases, never at the test cases."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from omegaconf import DictConfig, ListConfig

from nsf import config as configuration
from nsf.canonical import content_hash
from nsf.errors import ConfigError, MissingRunError, NSFError, SchemaError, first_line
from nsf.extras import optional
from nsf.pipeline.chain import Pipeline
from nsf.pipeline.sweeps.outcome import best_text
from nsf.results.columns import COLUMNS, Column
from nsf.results.formats import Rows, TerminalTable, spreadsheet
from nsf.results.style import MUTED, PALETTE, figure, save, styled
from nsf.results.table import read
from nsf.storage import locked, writing
from nsf.words import NUMBER

#: What a search can make small, by the name that a user gives it.
OBJECTIVES: dict[str, Column] = {"delta": COLUMNS["delta"], "step_ms": COLUMNS["step_ms"]}
_RANGE = re.compile(rf"(?P<key>[\w./]+)=(?P<low>{NUMBER})\.\.(?P<high>{NUMBER})(?P<log>:log)?")


@dataclass(frozen=True)
class Range:
    """Values of a key from `low` to `high`, both included, of equal weight on a logarithmic scale if `log`.

    Whole numbers where both ends are written as such.

    Raises:
        ConfigError: there is nothing between the ends, or a logarithmic scale reaches zero.
    """

    key: str
    low: float
    high: float
    log: bool

    def __post_init__(self):
        if not self.low < self.high:
            raise ConfigError(f"{self} has nothing between its ends; give the smaller one first")
        if self.log and self.low <= 0:
            raise ConfigError(f"{self} reaches zero; a logarithmic scale begins above it")

    def __str__(self):
        return f"{self.key}={self.low}..{self.high}{':log' * self.log}"

    @classmethod
    def parse(cls, word: str) -> "Range | None":
        """The range that `key=low..high` or `key=low..high:log` stands for; None for any other word."""
        match = _RANGE.fullmatch(word)
        if not match:
            return None
        ends = match["low"], match["high"]
        kind = int if all(re.fullmatch(r"[+-]?\d+", end) for end in ends) else float
        return cls(match["key"], *map(kind, ends), bool(match["log"]))

    def suggest(self, trial) -> str:
        """The override with a trial's value."""
        suggest = trial.suggest_int if isinstance(self.low, int) else trial.suggest_float
        return f"{self.key}={suggest(self.key, self.low, self.high, log=self.log)}"


def search(
    words: Sequence[str], say: Callable[[str], object] = print, root: Path | None = None
) -> tuple[Path, TerminalTable, str]:
    """Try values until `search.trials` have been tried, and write what came out.

    The trials lie in `search.db` in the folder of runs: the same keys go on with the same trials, also from
    several processes at once. Simulations and whatever else a trial shares with others is reused.

    Args:
        words: `key=low..high[:log]`, and `key=value` of everything else.
        say: called with a line for each trial.
        root: folder of all runs; NSF_RUNS, else ./runs.

    Returns:
        The chart, in whose folder `trials.csv` lies; the best trials; the command that deploys the best one.

    Raises:
        MissingExtraError: Optuna is not installed.
        ConfigError: no range; no validation cases; a value that a key refuses at an end of its range.
        MissingRunError: no trial has a result.
    """
    optional("optuna", "search")
    ranges, fixed = _parted(words)
    config = configuration.load(fixed)
    with configuration.naming_the_missing():
        objectives, trials = _objectives_and_trials(config)
    _check(ranges, fixed, root)
    study = _study(config, ranges, fixed, objectives, Path(Pipeline(config, root=root).check().training.root))

    def objective(trial):
        tried = [r.suggest(trial) for r in ranges]
        try:
            run, values = _tried([*fixed, *tried], objectives, root)
        except NSFError as error:
            trial.set_user_attr("error", str(error))
            say(f"trial {trial.number}: {' '.join(tried)}: {error}")
            raise
        trial.set_user_attr("run", run)
        columns = [OBJECTIVES[name] for name in objectives]
        scores = [f"{c.title} {c.cell(value)} {c.unit}" for c, value in zip(columns, values, strict=True)]
        say(f"trial {trial.number}: {' '.join(tried)}: {', '.join(scores)}")
        return values

    _optimize(study, objective, trials, say)
    table = _table(study, ranges, objectives)
    if not table["pareto"].any():
        raise MissingRunError("no trial of this search has a result; the lines above say why")
    folder = Path(config.report.folder) / f"search_{study.study_name}"
    with writing(folder / "trials.csv") as partial:
        table.map(spreadsheet).to_csv(partial, index=False)
    save(_chart(table, objectives), folder, "search")
    best = _best(table, objectives[0], ranges, fixed)
    return folder / "search.png", _best_trials(table), best


def _best(table: pd.DataFrame, objective: str, ranges: Sequence[Range], fixed: Sequence[str]) -> str:
    """The trial of the smallest objective at the validation values, and the command that deploys it."""
    row, column = table.loc[table[objective].idxmin()], OBJECTIVES[objective]
    tried = [f"{r.key}={row[r.key]}" for r in ranges]
    score = f"{column.title} {column.cell(row[objective])} {column.unit}"
    return best_text(score, tried, [*(word for word in fixed if not word.startswith("search.")), *tried])


def _parted(words: Sequence[str]) -> tuple[list[Range], list[str]]:
    ranged = {word: Range.parse(word) for word in words}
    ranges = [r for r in ranged.values() if r]
    if not ranges:
        raise ConfigError("nsf search needs a range, as latent_dim=4..8 or field.noise=1e-3..0.1:log")
    if any(word.startswith("+experiment=") for word in words):
        raise ConfigError("a search has no experiment; give the keys of one of its jobs instead")
    return ranges, [word for word, r in ranged.items() if not r]


def _objectives_and_trials(config: DictConfig) -> tuple[list[str], int]:
    keys = configuration.section(config, "search")
    objectives = keys.objectives
    listed = (
        isinstance(objectives, ListConfig)
        and objectives
        and all(name in list(OBJECTIVES) for name in objectives)
    )
    if not listed or len(set(objectives)) < len(objectives):
        raise ConfigError(f"search.objectives={objectives} must list one or more of {', '.join(OBJECTIVES)}")
    if "step_ms" in objectives and not configuration.section(config, "evaluation").trials:
        raise ConfigError(
            "search.objectives has step_ms, but evaluation.trials=0 measures none; give 1 or more"
        )
    return list(objectives), configuration.number("search.trials", keys.trials, least=1, whole=True)


def _check(ranges: Sequence[Range], fixed: Sequence[str], root: Path | None) -> None:
    """Build both ends of each range, with the test cases still there, so that no case is in two splits."""
    for end in ("low", "high"):
        overrides = [*fixed, *(f"{r.key}={getattr(r, end)}" for r in ranges), "deploy.split=validation"]
        pipeline = Pipeline(configuration.load(overrides), root=root).check()
        if not pipeline.split.validation:
            raise ConfigError(
                f"scene={pipeline.scene.name} has no validation cases, and a search never looks at test "
                "cases; give some, apart from those of training and test, as scene.design.validation=[27,31]"
            )


def _study(config: DictConfig, ranges, fixed: Sequence[str], objectives: Sequence[str], root: Path):
    import optuna
    from sqlalchemy.exc import DatabaseError

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    content = {
        "ranges": sorted(map(str, ranges)),
        "objectives": objectives,
        "fixed": sorted(word for word in fixed if not word.startswith(("search.", "report."))),
    }
    root.mkdir(parents=True, exist_ok=True)
    storage = f"sqlite:///{root.resolve() / 'search.db'}"
    # Two processes that make the same tables at once would fail.
    try:
        with locked(root / "search.lock", waiting=lambda: None):
            study = optuna.create_study(
                storage=storage,
                study_name=f"{config.scene.name}_{content_hash(content)[:6]}",
                directions=["minimize"] * len(objectives),
                load_if_exists=True,
            )
        # A generator that began again with the same seed would suggest again what was tried.
        study.sampler = optuna.samplers.TPESampler(seed=config.seed + len(study.trials))
    except (DatabaseError, optuna.exceptions.StorageInternalError, RuntimeError) as error:
        raise SchemaError(
            f"{root / 'search.db'} is damaged, or of another Optuna ({first_line(error)}); delete it: runs "
            "of its trials are reused"
        ) from error
    return study


def _optimize(study, objective, trials: int, say: Callable[[str], object]) -> None:
    from optuna.study import MaxTrialsCallback
    from optuna.trial import TrialState

    ended = (TrialState.COMPLETE, TrialState.FAIL)
    there = len(study.get_trials(deepcopy=False, states=ended))
    if there:
        say(f"search: {there} trials of {study.study_name} are there")
    if there < trials:
        study.optimize(objective, callbacks=[MaxTrialsCallback(trials, ended)], catch=(NSFError,))


def _tried(overrides: list[str], objectives: Sequence[str], root: Path | None) -> tuple[str, list[float]]:
    """The evaluate run of one trial, and its objectives: means over the validation cases."""
    config = configuration.load([*overrides, "deploy.split=validation"])
    pipeline = Pipeline(config, lambda line: None, root)
    pipeline.split = replace(pipeline.split, test=())  # which a search never looks at
    with pipeline.tracked:
        for stage in pipeline.stages[:-1]:
            run = pipeline.run(stage)
    results = read(run.file("results.csv"))
    if set(results["split"]) != {"validation"}:
        raise ConfigError(f"{run.id} is not of the validation cases alone; leave deploy.split out")
    values = [float(results[OBJECTIVES[name].name].mean()) for name in objectives]
    if not all(map(math.isfinite, values)):
        raise MissingRunError(f"{run.id}: the reduced run diverged")
    return run.id, values


def _table(study, ranges: Sequence[Range], objectives: Sequence[str]) -> pd.DataFrame:
    """One row a trial that has ended: number, values of the keys, objectives, and the run or the error."""
    from optuna.trial import TrialState

    best = {trial.number for trial in study.best_trials}
    rows = [
        {"trial": trial.number}
        | {r.key: trial.params.get(r.key) for r in ranges}
        | dict(zip(objectives, trial.values or [math.nan] * len(objectives), strict=True))
        | {"pareto": trial.number in best}
        | {key: trial.user_attrs.get(key, "") for key in ("run", "error")}
        for trial in study.get_trials(states=(TrialState.COMPLETE, TrialState.FAIL))
    ]
    return pd.DataFrame(rows)


def _chart(table: pd.DataFrame, objectives: Sequence[str]) -> Figure:
    """The trials that did not fail: two objectives and their front, or one over the trials."""
    with styled():
        fig = figure(4.2)
        ax = fig.add_subplot()
        (_front if len(objectives) == 2 else _progress)(ax, table.dropna(subset=list(objectives)), objectives)
        ax.grid(True)
        ax.legend()
    return fig


def _best_trials(trials: pd.DataFrame) -> TerminalTable:
    """The Pareto front, for the terminal."""
    best = trials[trials["pareto"]].drop(columns=["pareto", "error"])
    columns = [OBJECTIVES.get(name, Column(name, name)) for name in best]
    body = [
        [column.cell(row[name]) for name, column in zip(best, columns, strict=True)]
        for row in best.to_dict("records")
    ]
    return TerminalTable(Rows([column.heading for column in columns], body, [False] * len(columns)))


def _front(ax, done: pd.DataFrame, objectives: Sequence[str]) -> None:
    """Both objectives of every trial, and the front of those that no other trial beats in both."""
    x, y = objectives
    shown = done[[x, y]] * [OBJECTIVES[x].scale, OBJECTIVES[y].scale]
    front = shown[done["pareto"]].sort_values(x)
    ax.scatter(shown[x], shown[y], s=22, color=MUTED, label="trials")
    ax.step(front[x], front[y], where="post", color=PALETTE[0], marker="o", label="Pareto front")
    for at, row in front.iterrows():
        ax.annotate(f"{done['trial'][at]}", (row[x], row[y]), xytext=(4, 4), textcoords="offset points")
    ax.set(
        xlabel=OBJECTIVES[x].heading, ylabel=OBJECTIVES[y].heading, title="Trials at the validation values"
    )


def _progress(ax, done: pd.DataFrame, objectives: Sequence[str]) -> None:
    """The objective of every trial, and the best until then."""
    (name,) = objectives
    shown = done[name] * OBJECTIVES[name].scale
    ax.scatter(done["trial"], shown, s=22, color=MUTED, label="trials")
    ax.step(done["trial"], shown.cummin(), where="post", color=PALETTE[0], label="best until then")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set(xlabel="trial", ylabel=OBJECTIVES[name].heading, title="Trials at the validation values")
