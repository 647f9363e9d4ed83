"""`nsf bench key=value …`: which benchmarks, at which sizes, and where their report goes."""

import re
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

import pandas as pd

from nsf.bench.report import write_report
from nsf.bench.rows import KernelRow, Result, Row, Settings, StageRow, columns
from nsf.errors import ConfigError
from nsf.mpm.device import warp_device
from nsf.mpm.precision import precision_of
from nsf.storage import require_folder, writing

BENCHES = ("full_order", "scaling", "reduced", "batch", "operators", "training")
"""Modules of this package that have `run(settings, found, say)`, which adds what it finds to a `Result`."""

_MOST = 10**9  # particles: some hundred GB of them
_UNITS = {"": 1, "k": 1_000, "m": 1_000_000}


def bench(folder: str | Path, asked: Mapping[str, str], say: Callable[[str], object]) -> Path:
    """Run benchmarks, and write the report of these and of those that the folder has already.

    Args:
        folder: the csv files, index.md and charts; rows of other benchmarks or devices are kept.
        asked: `benches`, `particles`, `precision`, `device`, `trials`, `scenes`, as on the command line.
        say: told of every result.

    Returns:
        The report's page.

    Raises:
        ConfigError: a value is not one of those there are.
        DeviceError: the device does not exist.
        StorageError: the folder cannot be made or written.
    """
    folder = Path(folder)
    names = asked.get("benches", ",".join(BENCHES)).split(",")
    if unknown := [name for name in names if name not in BENCHES]:
        raise ConfigError(f"benches={unknown[0]} is unknown; choose from {', '.join(BENCHES)}")
    settings = _settings(asked)
    require_folder(folder)
    for name in names:
        found = Result()
        try:
            import_module(f"nsf.bench.{name}").run(settings, found, say)
        except BaseException:
            if found.rows:  # what was measured stays
                _report(folder, found)
            raise
        page = _report(folder, found)
    return page


def _report(folder: Path, found: Result) -> Path:
    _merge(folder / "results.csv", Row, found.rows)
    _merge(folder / "kernels.csv", KernelRow, found.kernels)
    _merge(folder / "stages.csv", StageRow, found.stages)
    return write_report(folder)


def _settings(asked: Mapping[str, str]) -> Settings:
    precisions = tuple(asked.get("precision", "fp32,fp64").split(","))
    trials = asked.get("trials", "10")
    if not (trials.isdigit() and int(trials)):
        raise ConfigError(f"trials={trials} must be a whole number of at least 1")
    sizes = asked.get("particles", "")
    return Settings(
        particles=tuple(_count(text) for text in sizes.split(",")) if sizes else (),
        precisions=tuple(precision_of(name).name for name in precisions),
        device=str(warp_device(asked.get("device", "auto"))),
        trials=int(trials),
        scenes=_scenes(asked.get("scenes", "")),
    )


def _scenes(text: str) -> tuple[str, ...]:
    """Scenes of benchmarks of reduced steps, by their names with commas in between."""
    from nsf.bench.reduced import SCENES  # brings the whole chain, which others do not need

    names = tuple(text.split(",")) if text else ()
    if unknown := [name for name in names if name not in SCENES]:
        raise ConfigError(f"scenes={unknown[0]} is not measured; choose from {', '.join(SCENES)}")
    return names


def _count(text: str) -> int:
    """`71363`, `200k` or `1.5m` particles."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([km]?)", text.strip().lower())
    count = float(found[1]) * _UNITS[found[2]] if found else 0.0
    if not 1.0 <= count <= _MOST:
        raise ConfigError(
            f"particles={text} is no number of particles up to a billion; give for example 71363, 200k or 1m"
        )
    return round(count)


def _merge(path: Path, kind: type, rows: list) -> None:
    """Put rows in place of those of the same benchmark, case, size, precision and device; keep the others."""
    if not rows and path.is_file():
        return
    fresh = pd.DataFrame(rows, columns=columns(kind))
    if path.is_file():
        kept = pd.read_csv(path)
        key = ["bench", "case", "particles", "precision", "device"]
        replaced = set(fresh[key].itertuples(index=False, name=None))
        known = kept[key].itertuples(index=False, name=None)
        kept = kept[[entry not in replaced for entry in known]]
        fresh = pd.concat([kept, fresh]) if len(kept) else fresh
    fresh = fresh.sort_values(["device", "bench", "precision", "particles"], kind="stable")
    with writing(path) as partial:
        fresh.to_csv(partial, index=False)
