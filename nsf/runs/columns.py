"""Keys in which listed runs differ, their units, and the rows of a list."""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from nsf.paths import files
from nsf.runs.listing import ABSENT, FIELDS, Entry, text, value_of

if TYPE_CHECKING:
    import pandas as pd

CASE = "case"
#: Keys that are shown first, and their titles.
TITLES = {CASE: CASE, "latent_dim": "r", "sampler.size": "|S|"} | {
    key: key
    for key in ("model", "stress", "affine", "field", "sampler", "seed", "scale", "precision", "device")
}
#: Keys that say the same as another, or that no reader looks for.
_HIDDEN = re.compile(r"_target_$|^(parameters|cases|validation|teaching_cases|files|model\.name|paper)\b")
#: Names of classes and hashes of code, which other columns say in words.
_INTERNAL = re.compile(r"_target_$|^(code|law|files|paper|columns)\b")
#: Units of metrics by a part of their name; δ and other errors are shown in per cent.
_METRICS = {"seconds": "s", "ms": "ms", "mib": "MiB", "bytes": "B"}
_METRIC = re.compile(rf"(?:^|_)({'|'.join(_METRICS)})(?:_|$)")
_PERCENT = re.compile(r"(^|_)(delta|error|error_bound)$")
#: Keys that a case replaces, which the column of cases shows.
_PARAMETER_KEY = re.compile(r"parameters\.\w+\.key")
_PARAMETER_VALUE = re.compile(r"parameters\.(\w+)\.value")
_COMPONENTS = 3  # values of a key that have a column each
_UNIT = re.compile(r"^\s*(\w+):[^#\n]*#\s*\[([^\]\d][^\]]*)\]", re.M)


def differing(listed: Sequence[Entry], named: Iterable[str] = ()) -> list[str]:
    """The keys in which runs of one stage and scene differ, the best known first, and those that are named.

    A key that parts the runs as an earlier one does, be it by other values, is left out unless it is named.
    """
    named = [key for key in dict.fromkeys(named) if key not in FIELDS]
    replaced = {
        value for entry in listed for key, value in entry.settings.items() if _PARAMETER_KEY.fullmatch(key)
    }
    keys = dict.fromkeys([*TITLES, *(key for entry in listed for key in entry.settings)])
    differ, partings = [], set()
    for key in keys:
        if key in named or key in replaced or _HIDDEN.search(key) or not _differs(listed, key):
            continue
        values = [text(setting(entry, key)) for entry in listed]
        parting = tuple(map(values.index, values))
        if key in TITLES or parting not in partings:
            differ.append(key)
        partings.add(parting)
    first = [key for key in differ if key in TITLES]
    return [*first, *named, *(key for key in differ if key not in TITLES)]


def _differs(listed: Sequence[Entry], key: str) -> bool:
    """Whether runs of one stage and scene have different values; some have no such key at all."""
    values: dict[tuple[str, str], set[str]] = {}
    for entry in listed:
        values.setdefault((entry.run.stage, entry.run.scene), set()).add(text(setting(entry, key)))
    return any(len(several - {ABSENT}) > 1 for several in values.values())


def setting(entry: Entry, key: str) -> Any:
    """A field, metric or setting of a run, or its case; None where it has none."""
    return case_of(entry) if key == CASE else value_of(entry, key)


def case_of(entry: Entry) -> str | None:
    """The parameter of a simulation, or those that a run was deployed at; several values by their names."""
    cases = entry.settings.get("cases")
    if entry.run.stage == "simulate":
        values = {
            match[1]: value
            for key, value in entry.settings.items()
            if (match := _PARAMETER_VALUE.fullmatch(key))
        }
        cases = [values] if values else None
    if not (isinstance(cases, list) and all(isinstance(case, dict) for case in cases)):
        return None
    return "; ".join(map(_case, cases))


def _case(values: Mapping[str, Any]) -> str:
    if len(values) == 1:
        return text(next(iter(values.values())))
    return ", ".join(f"{name}={text(value)}" for name, value in values.items())


def table(listed: Sequence[Entry], named: Iterable[str] = ()) -> "pd.DataFrame":
    """A row a run: its fields, the keys of `differing`, metrics, its `path`, and every other key, unrounded.

    Errors are fractions. `attrs["units"]` has the units of the columns that have one. A key with a value for
    each network or axis, as `field.beta`, also has a column for each of them, as `field.beta.0`.
    """
    import pandas as pd  # 0.5 s that a list need not pay

    fields = [field for field in FIELDS if field != "metric"]
    frame = pd.DataFrame([_record(entry, [*fields, *differing(listed, named)]) for entry in listed])
    frame = frame.reindex(columns=frame.columns if len(frame) else [*fields, "path"])
    frame.attrs["units"] = {name: unit for name in frame if (unit := unit_of(name, shown=False))}
    return frame


def _record(entry: Entry, first: Sequence[str]) -> dict[str, Any]:
    """A run's row of `table`, some columns first."""
    row = {key: setting(entry, key) for key in first}
    row |= {key: value for key, value in entry.metrics.items() if key not in row}
    row["path"] = str(entry.run.path)
    for key, value in entry.settings.items():
        if _INTERNAL.search(key):
            continue
        row.setdefault(key, value)
        if isinstance(value, list) and all(isinstance(one, int | float) for one in value):
            row |= {f"{key}.{k}": one for k, one in enumerate(value[:_COMPONENTS])}
    return row


def title_of(key: str) -> str:
    """The heading of a key, with its unit."""
    title, unit = TITLES.get(key, key), unit_of(key)
    return f"{title} [{unit}]" if unit else title


def unit_of(key: str, shown: bool = True) -> str:
    """Unit of a key or metric; empty where it has none, as of a fraction unless it is shown in per cent."""
    part, *_, leaf = ("", *key.split(".")) if "." not in key else key.split(".")
    if _PERCENT.search(leaf):
        return "%" if shown else ""
    metric = _METRIC.search(leaf)
    return _units().get(part, {}).get(leaf) or (_METRICS[metric[1]] if metric else "")


def scaled(key: str, value: Any) -> Any:
    """A value in the unit that it is shown in: fractions become per cent."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return 100 * value if number and unit_of(key) == "%" else value


@cache
def _units() -> dict[str, dict[str, str]]:
    """Units by the first and the last part of a key, from the comments of `conf/`: `dx: 0.01  # [m]`."""
    units: dict[str, dict[str, str]] = {}
    for path in reversed(files()):
        group = path.parent.name
        for name, unit in _UNIT.findall(path.read_text(encoding="utf-8")):
            # A scene's file has the keys of its material, too.
            for part in ("scene", "material") if group == "scene" else (group,):
                if unit != "-":
                    units.setdefault(part, {}).setdefault(name, unit)
    return units
