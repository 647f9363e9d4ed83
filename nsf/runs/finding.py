"""Runs for Python: a data frame of them, and the one that some keys name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsf.errors import ConfigError
from nsf.runs.listing import FIELDS, entries, text, value_of
from nsf.runs.run import Run

if TYPE_CHECKING:
    import pandas as pd

_STAGES = {
    "train": "training", "teach": "taught", "deploy": "deployment", "evaluate": "evaluation",
    "superresolve": "superresolution",
}  # fmt: skip


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
        The fields, the keys in which the runs differ or that were filtered, and every metric, unrounded; the
        column `path` has the folder of each run.

    Raises:
        ConfigError: a word is not key=value, or no run has such a key; names the nearest.
    """
    import pandas as pd

    from nsf.runs.columns import CASE, case_of, differing

    asked = _filters(words) | {key: _wanted(value) for key, value in filters.items()}
    found = entries(asked, sort, None if root is None else Path(root))
    keys = differing(found, asked)
    rows = []
    for entry in found:
        own = {key: case_of(entry) if key == CASE else value_of(entry, key) for key in keys.keys + keys.more}
        fields = {field: entry.values[field] for field in FIELDS if field != "metric"}
        rows.append(fields | own | entry.metrics | {"path": str(entry.run.path)})
    frame = pd.DataFrame(rows, columns=None if rows else [*FIELDS[:-1], "path"])
    frame["created"] = pd.to_datetime(frame["created"], utc=True, format="ISO8601")
    return frame


def find(*words: str, stage: str = "train", root: str | Path | None = None, **keys: Any) -> Run:
    """The complete run of a stage that `nsf run` makes with exactly these keys, all others at their defaults.

    Args:
        words: keys with a dot, in Hydra's grammar, as `"sampler.size=50"`.
        stage: `train`, `teach`, `deploy`, `evaluate` or `superresolve`.
        root: folder of all runs; NSF_RUNS, else ./runs.
        **keys: keys of the configuration, as `scene="sand", latent_dim=6`.

    Raises:
        ConfigError: a key or value is refused, or the stage is none of those.
        MissingRunError: there is no such run, or it is not complete; says how far it came.
    """
    if stage not in _STAGES:
        raise ConfigError(f"stage={stage} is none of {', '.join(_STAGES)}")
    from nsf import config
    from nsf.pipeline.names import Names

    overrides = [*words, *(f"{key}={_hydra(value)}" for key, value in keys.items())]
    if not any(map(config.names_scene, overrides)):
        raise ConfigError('name a scene, as scene="sand"')
    names = Names(config.load(overrides), None if root is None else Path(root))
    if stage == "evaluate":
        return names.evaluated()
    if stage == "superresolve":
        return names.superresolved()
    return getattr(names, _STAGES[stage]).require()


def _filters(words: tuple[str, ...]) -> dict[str, str]:
    if wrong := [word for word in words if "=" not in word]:
        raise ConfigError(f"{wrong[0]!r} is not key=value")
    return dict(word.split("=", 1) for word in words)


def _wanted(value: Any) -> str:
    return ",".join(map(text, value)) if isinstance(value, list | tuple) else text(value)


def _hydra(value: Any) -> str:
    """A value in Hydra's grammar."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_hydra, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_hydra(one)}" for key, one in value.items()) + "}"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
