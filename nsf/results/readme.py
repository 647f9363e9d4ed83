"""The table of README.md, from the table of the reports; `make readme` calls this module as a program."""

import sys
from pathlib import Path

import pandas as pd

from nsf.errors import ConfigError
from nsf.results import table
from nsf.results.columns import number

BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
TABLE = Path("reports/results.csv")
_ERRORS, _TIMES = "table1/seeds", "table1/operators"  # reports of the errors, and of times
_HEADINGS = ("scene", "paper", "projected", "recurrence", "interpolate", "speed")


def figures(frame: pd.DataFrame) -> str:
    """δ of each model beside the paper's, as Markdown.

    Args:
        frame: the table of all reports.

    Raises:
        ConfigError: a report that is shown is not in it.
    """
    rows = [(_means(frame, report, "projected"), _means(frame, report, "recurrence")) for report in _SHOWN]
    (projected, learned), (_, timed) = rows
    errors = (
        projected["paper_delta"], projected["delta"], learned["delta"], projected["delta_interpolated"]
    )  # fmt: skip
    body = [
        [
            scene,
            *(number(error.get(scene), 100) for error in errors),
            number(timed["speedup_decoded"].get(scene)),
        ]
        for scene in projected.index
    ]
    lines = [list(_HEADINGS), ["---", *["--:"] * (len(_HEADINGS) - 1)], *body]
    seeds = table.query(frame, report=_ERRORS)["seed"].nunique()
    return (
        f"δ [%], means over held-out cases and {seeds} seeds; speed: recurrence, every frame decoded, over "
        "full order [×].\n\n" + "\n".join(f"|{'|'.join(line)}|" for line in lines)
    )


_SHOWN = (_ERRORS, _TIMES)


def _means(frame: pd.DataFrame, report: str, model: str) -> pd.DataFrame:
    """Means of a model by scene; of recurrences those that runs taught."""
    teacher = {"teacher": "runs"} if model == "recurrence" else {}
    rows = table.query(frame, report=report, model=model, **teacher)
    return table.means(table.labelled(rows)).set_index("body")


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
