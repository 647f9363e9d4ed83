"""Keys in which listed runs differ, and their units."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from nsf.paths import files
from nsf.runs.listing import ABSENT, FIELDS, Entry, text, value_of

CASE = "case"
#: Keys that are shown first, and what they are called.
TITLES = {
    CASE: CASE,
    "latent_dim": "r",
    "sampler.size": "|S|",
    "model": "model",
    "stress": "stress",
    "affine": "affine",
    "field": "field",
    "sampler": "sampler",
    "seed": "seed",
    "scale": "scale",
    "precision": "precision",
    "device": "device",
}
_MOST = 6  # further keys that differ and have a column
_WIDEST = 28  # characters of a cell
#: Keys that say the same as another, or that no reader looks for.
_SAID = re.compile(r"_target_$|^(parameters|cases|validation|teaching_cases|files|model\.name|paper)\b")
#: Units of metrics by the end of their name; δ and other errors are shown in per cent.
_METRICS = {"seconds": "s", "ms": "ms", "mib": "MiB", "bytes": "B"}
_PERCENT = re.compile(r"(^|_)(delta|error)$")
#: Keys that a case replaces, which the column of cases shows.
_PARAMETER_KEY = re.compile(r"parameters\.\w+\.key")
_UNIT = re.compile(r"^\s*(\w+):[^#\n]*#\s*\[([^\]\d][^\]]*)\]", re.M)


@dataclass(frozen=True)
class Differing:
    """Keys by which runs differ.

    Attributes:
        keys: that have a column.
        more: that differ as well.
    """

    keys: tuple[str, ...]
    more: tuple[str, ...] = ()


def differing(found: Sequence[Entry], asked: Iterable[str] = ()) -> Differing:
    """The keys in which runs of one stage and scene differ, and those that are asked for.

    Args:
        found: the runs.
        asked: keys that were filtered or sorted by.
    """
    groups: dict[tuple[str, str], list[Entry]] = {}
    for entry in found:
        groups.setdefault((entry.run.stage, entry.run.scene), []).append(entry)
    differ: dict[str, None] = {}
    replaced = {
        value for entry in found for key, value in entry.settings.items() if _PARAMETER_KEY.fullmatch(key)
    }
    for entries in groups.values():
        known = dict.fromkeys(key for entry in entries for key in (*TITLES, *entry.settings))
        for key in known:
            # Some have no such key at all, as those of a recurrence.
            values = {cell(entry, key) for entry in entries} - {ABSENT}
            if not _SAID.search(key) and key not in replaced and len(values) > 1:
                differ[key] = None
    own = [key for key in dict.fromkeys(asked) if key not in FIELDS]
    first = [key for key in TITLES if key in differ and key not in own]
    rest = [key for key in differ if key not in TITLES and key not in own]
    return Differing((*first, *own, *rest[:_MOST]), tuple(rest[_MOST:]))


def cell(entry: Entry, key: str) -> str:
    """A setting of a run as shown."""
    shown = case_of(entry) if key == CASE else text(value_of(entry, key))
    return shown if len(shown) <= _WIDEST else f"{shown[: _WIDEST - 1]}…"


def case_of(entry: Entry) -> str:
    """The parameter values of a simulation, or those that a run was deployed at."""
    cases = entry.settings.get("cases")
    if entry.run.stage == "simulate":
        values = {
            found[1]: value
            for key, value in entry.settings.items()
            if (found := re.fullmatch(r"parameters\.(\w+)\.value", key))
        }
        cases = [values] if values else None
    if not (isinstance(cases, list) and all(isinstance(case, dict) for case in cases)):
        return ABSENT
    return "; ".join(", ".join(text(value) for value in case.values()) for case in cases)


def title_of(key: str) -> str:
    """The heading of a key, with its unit."""
    title, unit = TITLES.get(key, key), unit_of(key)
    return f"{title} [{unit}]" if unit else title


def unit_of(key: str) -> str:
    """Unit of a key or metric; empty where it has none."""
    part, *_, leaf = ("", *key.split(".")) if "." not in key else key.split(".")
    if _PERCENT.search(leaf):
        return "%"
    known = _units().get(part, {})
    return known.get(leaf) or _METRICS.get(leaf.rpartition("_")[2] or leaf, "")


def scaled(key: str, value: Any) -> Any:
    """A value in the unit that it is shown in: fractions become per cent."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return 100 * value if number and unit_of(key) == "%" else value


@cache
def _units() -> dict[str, dict[str, str]]:
    """Units by the first and the last part of a key, from the comments of `conf/`: `dx: 0.01  # [m]`."""
    found: dict[str, dict[str, str]] = {}
    for path in reversed(files()):
        group = path.parent.name
        for name, unit in _UNIT.findall(path.read_text(encoding="utf-8")):
            # A scene's file has the keys of its material, too.
            for part in ("scene", "material") if group == "scene" else (group,):
                if unit != "-":
                    found.setdefault(part, {}).setdefault(name, unit)
    return found
