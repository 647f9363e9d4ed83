"""Runs for Python: a data frame of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsf import words as words_of
from nsf.runs.listing import entries, text

if TYPE_CHECKING:
    import pandas as pd


def table(
    *words: str, sort: str = "-created", root: str | Path | None = None, **filters: Any
) -> pd.DataFrame:
    """Every run that passes the filters, a row each, as `nsf runs` lists them.

    Args:
        words: filters whose key has a dot, as `"sampler.size=50,150"`.
        sort: field, metric or key; from the largest down with a leading `-`.
        root: folder of all runs; NSF_RUNS, else ./runs.
        **filters: by field, metric or key, the value that it must have; a list for one of several, and `*`
            in a text stands for anything.

    Returns:
        The fields; the keys in which the runs differ or that were filtered; every metric, unrounded, errors
        as fractions; `path`, the folder of each run; every other key. `attrs["units"]` has the units.

    Raises:
        ConfigError: a word is not key=value, or no run has such a key; names the nearest.
    """
    import pandas as pd

    from nsf.runs import columns

    wanted = words_of.pairs("runs", words) | {key: _texts(value) for key, value in filters.items()}
    frame = columns.table(entries(wanted, sort, None if root is None else Path(root)), wanted)
    frame["created"] = pd.to_datetime(frame["created"], utc=True, format="ISO8601")
    return frame


def _texts(value: Any) -> str:
    return ",".join(map(text, value)) if isinstance(value, list | tuple) else text(value)
