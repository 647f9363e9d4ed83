"""The table of README.md, from the table of the reports; `make readme` calls this module as a program."""

import sys
from pathlib import Path

import pandas as pd

from nsf.errors import ConfigError
from nsf.results import table
from nsf.results.averages import means
from nsf.results.columns import number

BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
TABLE = Path("reports/results.csv")
#: Reports of projected runs, and of those by recurrence.
_SEEDS, _RECURRENCE = "table1/seeds", "table1/recurrence"
_HEADINGS = ("scene", "paper", "projected", "recurrence", "interpolate", "speed")


def figures(frame: pd.DataFrame) -> str:
    """δ of each model beside the paper's, as Markdown.

    Args:
        frame: the table of all reports.

    Raises:
        ConfigError: a report that is shown is not in it.
    """
    projected, learned = _means(frame, _SEEDS, "projected"), _means(frame, _RECURRENCE, "recurrence")
    errors = (
        projected["paper_delta"], projected["delta"], learned["delta"], projected["delta_interpolated"]
    )  # fmt: skip
    body = [
        [
            scene,
            *(number(error.get(scene), 100) for error in errors),
            number(learned["speedup_decoded"].get(scene)),
        ]
        for scene in projected.index
    ]
    lines = [list(_HEADINGS), ["---", *["--:"] * (len(_HEADINGS) - 1)], *body]
    seeds = table.query(frame, report=_SEEDS)["seed"].nunique()
    return (
        f"δ [%], means over held-out cases and, of projected runs, {seeds} seeds; speed: recurrence, every "
        "frame decoded, over full order [×].\n\n" + "\n".join(f"|{'|'.join(line)}|" for line in lines)
    )


def _means(frame: pd.DataFrame, report: str, model: str) -> pd.DataFrame:
    """Means of a model by scene; of recurrences those that most drawn runs taught."""
    rows = table.labelled(table.query(frame, report=report, model=model))
    if "model.runs" in rows:
        rows = rows[rows["model.runs"] == rows["model.runs"].max()]
    return means(rows, ("body",)).set_index("body")


def updated(text: str, frame: pd.DataFrame) -> str:
    """README.md's text with the figures between its markers.

    Raises:
        ConfigError: the markers are not there once each, in order.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ConfigError(f"README must hold {BEGIN} and, after it, {END}, once each")
    head, rest = text.split(BEGIN)
    return f"{head}{BEGIN}\n{figures(frame)}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    readme = Path(sys.argv[1])
    readme.write_text(updated(readme.read_text(encoding="utf-8"), table.read(TABLE)), encoding="utf-8")
