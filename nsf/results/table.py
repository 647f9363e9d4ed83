"""The table of results: read, asked and named.

A row is a (run, case, seed, model), with the columns of `nsf.results.columns`. The functions take and give
pandas data frames; those that `labelled` gives also have `body`, `variant` and a column a setting.
"""

import contextlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from nsf import schemas
from nsf.data.case import PROGRAM, Case
from nsf.errors import ConfigError, MissingRunError, SchemaError, first_line
from nsf.results.columns import (
    COLUMNS,
    SEEDS,
    TEXT,
    brief,
    column,
    is_empty,
    model_name,
)
from nsf.results.formats import spreadsheet
from nsf.storage import writing

_TRAIN = "scene.design.train"  # a list, whose length is shown
_SETTING = re.compile(r"; (?=[\w.@]+=)")
_ORDER = ("test", "validation", "extrapolation")
_COMPUTED = (
    *("body", "variant", "model_name", "delta_static", "delta_interpolated", "integration_share", "gamma"),
    *("decoded_ms", "line", "rank", "beyond"),
)
_COMPONENTS = 3  # values of a key that have a column each
BEYOND = " (beyond)"
"""Ends the variant of rows whose program led beyond what was taught; no mean of the others counts them."""
TAKEN = " (taken by the fallback)"
"""Ends the variant of rows whose runs another model took, likewise."""


def read(path: Path | str) -> pd.DataFrame:
    """The table of a file, such as `reports/results.csv`; columns that it lacks are empty.

    Raises:
        MissingRunError: there is no such file.
        SchemaError: it is no table of results.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingRunError(f"{path} is not there; `nsf report` and `nsf reports` write tables of results")
    return complete(parsed(path, TEXT), path)


def parsed(path: Path, texts: Iterable[str]) -> pd.DataFrame:
    """The table of a CSV file, as it stands there.

    Args:
        path: of the file; texts: columns that hold text, whatever it looks like.

    Raises:
        SchemaError: it is none.
    """
    try:
        frame = pd.read_csv(path, dtype=dict.fromkeys(texts, str))
        if not isinstance(frame.index, pd.RangeIndex):
            raise ValueError("rows have more cells than there are columns")
        return frame
    except (ValueError, OverflowError) as error:
        raise SchemaError(f"{path} is no table: {first_line(error)}; write it again") from error


def numbers(frame: pd.DataFrame, source: Path | str, texts: Iterable[str]) -> pd.DataFrame:
    """A frame whose columns hold numbers, but those of texts, in which an empty cell is empty text.

    Raises:
        SchemaError: a number is text.
    """
    texts = [name for name in texts if name in frame]
    frame[texts] = frame[texts].astype(object).where(frame[texts].notna(), "").astype(str)
    for name in frame.columns.difference(texts):
        try:
            frame[name] = pd.to_numeric(frame[name])
        except (ValueError, TypeError, OverflowError) as error:
            raise SchemaError(f"{source}: {name} holds text: {error}; run `nsf evaluate` again") from error
    return frame


def complete(frame: pd.DataFrame, source: Path | str) -> pd.DataFrame:
    """A frame with all columns of the table, in order; those that it lacks are empty.

    Raises:
        SchemaError: it lacks what every row has, or a number is text.
    """
    absent = [name for name in ("scene", "model", "case", "split", "delta") if name not in frame]
    if absent:
        raise SchemaError(f"{source} lacks the columns {', '.join(absent)}; run `nsf evaluate` again")
    return numbers(frame.reindex(columns=list(COLUMNS)), source, TEXT)


def write(frame: pd.DataFrame, path: Path) -> None:
    """Write a table, without columns that are empty.

    Raises:
        StorageError: the disk refused the file.
    """
    shown = [name for name in frame if not (frame[name].isna() | frame[name].eq("")).all()]
    with writing(path) as partial:
        frame[shown].map(spreadsheet).to_csv(partial, index=False)


def query(frame: pd.DataFrame, **wanted) -> pd.DataFrame:
    """The rows whose columns have some values; a list is any of them, `held_out=True` no training case.

    Raises:
        ConfigError: there is no such column, or no such row; names the values that there are.
    """
    held_out = wanted.pop("held_out", False)
    if unknown := [name for name in wanted if name not in frame]:
        raise ConfigError(f"no column {unknown[0]}; there are {', '.join(frame)}")
    rows = frame
    for name, values in wanted.items():
        values = [values] if isinstance(values, str | int | float) else list(values)
        chosen = rows[rows[name].isin(values)]
        if chosen.empty:
            present = ", ".join(sorted(map(str, rows[name].unique()))[:20])
            raise ConfigError(f"no row has {name}={', '.join(map(str, values))}; there are {present}")
        rows = chosen
    if held_out and (rows["split"] != "train").any():
        rows = rows[rows["split"] != "train"]
    return rows


def settings(text: str) -> dict[str, str]:
    """The keys and values of a row's `setting`."""
    parts = _SETTING.split(text) if text else []
    return dict(part.split("=", 1) for part in parts)


def setting(keys: Mapping[str, object]) -> str:
    """The text of keys and values, for the column `setting`."""
    return "; ".join(f"{key}={value}" for key, value in keys.items())


def _settings_of(frame: pd.DataFrame) -> pd.DataFrame:
    """A column of text for each key of `setting` that a frame lacks."""
    expanded = pd.DataFrame([settings(text) for text in frame["setting"]], index=frame.index)
    return expanded.drop(columns=[name for name in expanded if name in frame])


def with_settings(frame: pd.DataFrame) -> pd.DataFrame:
    """A frame with a column for each key of `setting`, and each number of a short list: `field.beta.0`."""
    expanded = _settings_of(frame)
    for name in list(expanded):
        lists = (
            expanded[name].str.extract(r"\A\[([^\[\]{}]+)\]\Z")[0].str.split(", *", expand=True, regex=True)
        )
        if 1 < lists.shape[1] <= _COMPONENTS:
            expanded = expanded.join(lists.add_prefix(f"{name}."))
    return pd.concat([frame, expanded], axis=1)


def labelled(frame: pd.DataFrame) -> pd.DataFrame:
    """The held-out rows of a report, sorted, with `body`, `variant`, and a column for each setting.

    `body` is the scene, with the material or the number of particles where a scene has several. `variant`
    says what tells rows of a body apart but for seeds and cases; `delta_static` and `delta_interpolated`
    are rivals' errors as δ.
    """
    frame = query(frame, held_out=True).reset_index(drop=True)
    expanded = _settings_of(frame)
    if _TRAIN in expanded:
        expanded["training_runs"] = expanded[_TRAIN].map(_length)
    frame = pd.concat([frame, expanded.apply(_numeric)], axis=1)
    frame["body"] = _bodies(frame)
    frame["model_name"] = [model_name(row) for row in frame.to_dict("records")]
    frame["variant"] = variants(frame)
    frame.loc[_beyond(frame), "variant"] += BEYOND
    taken = (frame["fallback_share"].fillna(0) > 0) & (frame["model"] != "full")
    frame.loc[taken, "variant"] += TAKEN
    # Both errors of a run divide one distance, so that their ratio is of the full-order run alone.
    ratio = (frame["delta"] / frame["displacement_error"]).groupby([frame["body"], frame["case"]])
    ratio = ratio.transform("median")
    frame["delta_static"], frame["delta_interpolated"] = ratio, frame["displacement_interpolated"] * ratio
    frame["integration_share"] = frame["integration"] / frame["particles"]
    frame["gamma"] = 3 * frame["particles"] / frame["r"]  # paper, section 6
    frame["decoded_ms"] = frame["total_ms"] + frame["decode_ms"]
    keys = [frame[name].map(natural) for name in ("body", "variant", "split", "seed", "case")]
    return frame.loc[pd.concat(keys, axis=1).apply(tuple, axis=1).sort_values(kind="stable").index]


def _beyond(frame: pd.DataFrame) -> pd.Series:
    """Whether most runs by recurrence say of a row's program that it led beyond what was taught."""
    said = frame.get("beyond", pd.Series(np.nan, frame.index)).where(frame["model"] == "recurrence")
    share = said.astype(float).groupby([frame["body"], frame["case"]]).transform("mean")
    return (share > 0.5) & frame["case"].str.contains(f"{PROGRAM}=")


def variants(frame: pd.DataFrame, without: Iterable[str] = ()) -> list[str]:
    """Names that tell the rows of a body apart, but for seeds, cases and the columns of `without`."""
    names = [name for name in frame if name not in COLUMNS and name not in _COMPUTED]
    names = ["model_name", "field", *names, "r", "precision", "device", "material"]
    hidden = {*SEEDS, _TRAIN if "training_runs" in names else "", *without}
    keys = telling(frame, [name for name in names if name in frame and name not in hidden])
    shown = frame[keys].drop(columns="model_name", errors="ignore")
    if not len(shown.columns):
        return frame["model_name"].to_list()
    names = frame["model_name"] if "model_name" in keys else pd.Series("", frame.index)
    parts = [
        [name, *(_named(key, value) for key, value in row.items() if not is_empty(value))]
        for name, row in zip(names, shown.to_dict("records"), strict=True)
    ]
    return [" · ".join(filter(None, part)) or "default" for part in parts]


def telling(frame: pd.DataFrame, keys: Sequence[str]) -> list[str]:
    """Keys, each of which parts rows of a body that those before it leave together, seeds and cases alike."""
    chosen: list[str] = []
    fixed = ["body", *(seed for seed in SEEDS if seed in frame)]
    texts = frame[[*fixed, *keys]].astype(object).where(frame[[*fixed, *keys]].notna(), "").astype(str)
    kinds = len(texts[fixed].drop_duplicates())
    for key in keys:
        more = len(texts[[*fixed, *chosen, key]].drop_duplicates())
        if more > kinds:
            chosen.append(key)
            kinds = more
    return chosen


def parameter(case: str) -> tuple[str, str]:
    """Name and unit of what tells cases apart: of one parameter its own, of several `case`."""
    try:
        read_case = Case.read(case)
    except ConfigError:
        return "case", ""
    if len(read_case) > 1:
        return "case", ""
    return read_case.names[0].replace("_", " "), read_case.units[0]


def natural(value) -> tuple:
    """Sort key: numbers by size, then text with the numbers in it by size; held-out splits first."""
    if is_empty(value):
        return (0, 0.0, "")
    if isinstance(value, int | float):
        return (1, float(value), "")
    if value in (*_ORDER, "train"):
        return (2, float((*_ORDER, "train").index(value)), "")
    return (3, 0.0, re.sub(r"\d[\d,]*(\.\d+)?", _padded, str(value)))


def _padded(digits: re.Match) -> str:
    return f"{float(digits[0].replace(',', '')):024.9f}"


def _bodies(frame: pd.DataFrame) -> pd.Series:
    names = frame["scene"].copy()
    for name, form in (("material", " · {}"), ("particles", " · {:,.0f} particles")):
        several = frame.groupby("scene")[name].transform("nunique") > 1
        names = names.where(~several, names + frame[name].map(form.format))
    return names


def _length(text) -> float:
    with contextlib.suppress(SchemaError):
        return len(schemas.parse(text, _TRAIN, list)) if isinstance(text, str) else math.nan
    return math.nan


def _numeric(values: pd.Series) -> pd.Series:
    """Numbers where all values that are there are numbers."""
    numbers = pd.to_numeric(values, errors="coerce")
    return numbers if numbers.notna().eq(values.notna()).all() else values


def _named(key: str, value) -> str:
    """A setting away from its heading: numbers and bare words need their title."""
    text = f"{value:,.10g}" if isinstance(value, int | float) else brief(str(value))
    if text.startswith("{"):
        entries = (entry.partition(":") for entry in text.strip("{}").split(","))
        return ", ".join(f"{name.rpartition('.')[2]} {changed}" for name, _, changed in entries)
    bare = text in ("null", "paper") or text.startswith("[") or isinstance(value, int | float)
    title = {"field": "", "sampler": "", "device": "", "precision": ""}.get(key, column(key).title)
    return f"{title} {text}".strip() if bare or (key not in COLUMNS and key != "sampler") else text
