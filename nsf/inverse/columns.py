"""Columns of a file of observations, CSV or HDF5: sizes are bounded before reading, nothing is lost.

Nothing here imports torch, so that a file is refused before it is loaded.
"""

import gzip
import io
import itertools
import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pandas as pd

from nsf.data import hdf5, heaps
from nsf.errors import ConfigError, SchemaError, first_line
from nsf.quantities import QUANTITIES
from nsf.words import NUMBER

AXES = ("x", "y", "z")
_COMPONENT = re.compile(rf"([xyz])@({NUMBER}):({NUMBER}):({NUMBER})")
COLUMNS = ("t", "particle", "X", "Y", "Z", "x", "y", "z", "quantity", "value", "deviation")
#: Of Δt: how far a time may be outside of a run.
SAME_TIME = 1e-6
_MOST_ROWS = 1_000_000
_MOST_BYTES = 2**28  # of a file, and of the text that is packed in it
_HEAD = 4096  # letters of the line of names
_TEXT_BYTES = 64  # of a quantity's name
_HDF5 = (".h5", ".hdf5")
_MISSING = ("", "nan", "na")


def component(text: str) -> tuple[str, np.ndarray] | None:
    """Axis and rest position [3] [m] of a component of a point, as `z@0.5:0.5:0.2`; None of another text."""
    match = _COMPONENT.fullmatch(text)
    return (match[1], np.array(match.groups()[1:], float)) if match else None


def is_scalar(text: str) -> bool:
    """Whether a text names a quantity, or a component of a point."""
    return text in QUANTITIES or component(text) is not None


def check_scalars(names: Sequence[str]) -> None:
    """Refuse what is no scalar.

    Raises:
        ConfigError: names the first such text.
    """
    if wrong := [name for name in names if not is_scalar(name)]:
        raise ConfigError(
            f"of={wrong[0]} is none of {', '.join(QUANTITIES)}, nor a component of a point at rest, as "
            "z@0.5:0.5:0.2"
        )


def read_columns(path: Path | str) -> dict[str, np.ndarray]:
    """Columns of a file by name, each [rows]: float64 with NaN in empty cells, but `quantity` of text.

    Args:
        path: HDF5 where it ends in .h5 or .hdf5, else CSV, packed by gzip where it ends in .gz.

    Raises:
        ConfigError: a column is unknown, or a row does not fit the columns; names it.
        SchemaError: the file is damaged, or would be read from elsewhere.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise ConfigError(f"{path} is no file; name a CSV or HDF5 file of observations")
    if path.stat().st_size > _MOST_BYTES:
        raise ConfigError(f"{path} is larger than {_MOST_BYTES >> 20} MiB; observe fewer points or times")
    columns = _of_hdf5(path) if path.suffix in _HDF5 else _of_csv(path)
    if not len(columns["deviation"]):
        raise ConfigError(f"{path} has no rows; give a row an observation")
    return columns


def _check_names(path: Path, names: Sequence[str]) -> None:
    if not names:
        raise ConfigError(f"{path} has no rows; give columns of {', '.join(COLUMNS)}")
    if unknown := [name for name in names if name not in COLUMNS]:
        remedy = "separate columns by commas" if {";", "\t"} & set(unknown[0]) else "leave it out"
        raise ConfigError(
            f"{path} has the column {unknown[0][:80]!r}; {remedy}: it may have {', '.join(COLUMNS)}"
        )
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{path} has the column {twice[0]} twice; leave one of them out")
    if "deviation" not in names:
        raise ConfigError(f"{path} has no column deviation; give the standard deviation [m] of each row")


def _check_rows(path: Path, count: int) -> None:
    if count > _MOST_ROWS:
        raise ConfigError(f"{path} has more than {_MOST_ROWS:,} rows; observe fewer points or times")


# -- text -----------------------------------------------------------------------------------------------


def _of_csv(path: Path) -> dict[str, np.ndarray]:
    try:
        text = _text(path).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path} is no UTF-8 text; save it as .csv in UTF-8, as .csv.gz packed by gzip, or as .h5 of HDF5"
        ) from error
    except (OSError, EOFError, zlib.error) as error:
        raise SchemaError(
            f"{path} is damaged or cannot be read; write it again ({first_line(error)})"
        ) from error
    head, _, body = text.partition("\n")
    names = [name.strip() for name in head[:_HEAD].split(",")] if head.strip() else []
    _check_names(path, names)
    _check_rows(path, body.count("\n"))
    try:
        # Read as a row, so that no row has more fields than there are names.
        cells = pd.read_csv(
            io.StringIO(text), header=None, dtype=str, keep_default_na=False, skipinitialspace=True
        )
    except (ValueError, pd.errors.ParserError) as error:
        raise ConfigError(f"{path} is no CSV file of these columns ({first_line(error)})") from error
    cells = cells.iloc[1:].set_axis(names, axis=1)  # a row of fewer fields ends in empty cells
    return {name: _numbers(path, name, cells[name].str.strip()) for name in names}


def _text(path: Path) -> bytes:
    """The bytes of a file of text, unpacked.

    Raises:
        ConfigError: it holds too many.
    """
    with (gzip.open if path.suffix == ".gz" else open)(path, "rb") as file:
        text = file.read(_MOST_BYTES + 1)
    if len(text) > _MOST_BYTES:
        raise ConfigError(
            f"{path} holds more than {_MOST_BYTES >> 20} MiB of text; observe fewer points or times"
        )
    return text


def _numbers(path: Path, name: str, cells: pd.Series) -> np.ndarray:
    """The values [rows] of a column: NaN in empty cells, or the texts of `quantity`.

    Raises:
        ConfigError: a cell is no number.
    """
    cells = cells.mask(cells.str.lower().isin(_MISSING), "")
    if name == "quantity":
        return cells.to_numpy(object)
    values = pd.to_numeric(cells.replace("", "nan"), errors="coerce").to_numpy(float)
    wrong = np.isnan(values) & cells.ne("").to_numpy()
    if wrong.any():
        row = int(wrong.argmax())
        raise ConfigError(f"{path}, row {row + 1}: {name}={cells.iloc[row][:80]} must be a number")
    return values


# -- HDF5 -----------------------------------------------------------------------------------------------


def _of_hdf5(path: Path) -> dict[str, np.ndarray]:
    heaps.checked(path)
    with hdf5.reading(path, "file of observations", "write it"), h5py.File(path, "r") as file:
        names = list(itertools.islice(file, len(COLUMNS) + 1))
        _check_names(path, names)
        rows = hdf5.array(file, "deviation", [_type(file, "deviation")], [None]).size
        _check_rows(path, rows)
        return {name: _column(file, name, rows) for name in names}


def _column(file: h5py.File, name: str, rows: int) -> np.ndarray:
    """The values [rows] of a column."""
    kind = _type(file, name)
    if name != "quantity":
        return hdf5.array(file, name, [kind], [rows])[()].astype(float)
    texts = (
        hdf5.texts(file, name, [rows])
        if kind == "text"
        else hdf5.array(file, name, [kind], [rows]).asstr("utf-8")
    )
    return np.array([text.strip() for text in texts[:]], object)


def _type(file: h5py.File, name: str) -> str:
    """The type of a column's values, as `nsf.data.hdf5.array` has it."""
    dtype = getattr(hdf5.group(file, name), "dtype", np.dtype("V"))
    text = h5py.check_string_dtype(dtype)
    if name != "quantity" and (text or dtype.kind not in "fiu"):
        raise SchemaError(f"has {name} of {dtype}, and not of numbers")
    if name == "quantity" and not (text and (text.length or 1) <= _TEXT_BYTES):
        raise SchemaError(f"has {name} of {dtype}, and not of text of at most {_TEXT_BYTES} bytes")
    return "text" if text and text.length is None else dtype.str
