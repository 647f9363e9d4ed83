"""The trials of a search: a table, the best of them, and a chart."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nsf.results.columns import COLUMNS, Column
from nsf.results.formats import Rows, TerminalTable, spreadsheet
from nsf.results.style import MUTED, PALETTE, figure, save, styled
from nsf.results.table import parsed
from nsf.storage import writing

#: What a search can make small, by the name that a user gives it.
OBJECTIVES: dict[str, Column] = {"delta": COLUMNS["delta"], "step_ms": COLUMNS["step_ms"]}


def write_search(table: pd.DataFrame, objectives: Sequence[str], folder: Path) -> Path:
    """Write `trials.csv` and the chart, `search.svg` and `search.png`; gives the chart.

    Args:
        table: one row a trial: `trial`, the keys, the objectives (NaN where it failed), `pareto`.
        objectives: columns of it, each a key of `OBJECTIVES`.
        folder: they go there.

    Raises:
        StorageError: the disk refused a file.
    """
    with writing(folder / "trials.csv") as partial:
        table.map(spreadsheet).to_csv(partial, index=False)
    save(search_chart(table, objectives), folder, "search")
    return folder / "search.png"


def search_chart(table: pd.DataFrame, objectives: Sequence[str]) -> Figure:
    """The trials that did not fail: two objectives and their front, or one over the trials."""
    with styled():
        fig = figure(4.2)
        ax = fig.add_subplot()
        (_front if len(objectives) == 2 else _progress)(ax, table.dropna(subset=list(objectives)), objectives)
        ax.grid(True)
        ax.legend()
    return fig


def best_table(path: Path) -> TerminalTable:
    """The best trials of a `trials.csv`, for the terminal: the Pareto front."""
    trials = parsed(path, ())
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
