"""`nsf bench key=value …`: which benchmarks, at which sizes, and where their report goes."""

import re
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

from nsf.bench.report import write_report
from nsf.bench.rows import Measurements, Settings
from nsf.errors import ConfigError
from nsf.mpm.device import warp_device
from nsf.mpm.precision import precision_of
from nsf.scalars import one_of
from nsf.storage import require_folder

BENCHES = ("whole", "full_order", "scaling", "reduced", "batch", "recurrence", "training", "peers")
"""Modules of this package with `run(figures)`, which adds its figures to `Measurements`."""

SCENES = ("cake", "metal")  # of benchmarks of reduced steps
_KNOWN = ("bread", "cake", "jelly_cube", "metal", "sand", "squishy_ball", "toothpaste")
_MOST = 10**9  # particles: some hundred GB of them
_UNITS = {"": 1, "k": 1_000, "m": 1_000_000}


def bench(folder: str | Path, options: Mapping[str, str], say: Callable[[str], object]) -> Path:
    """Run benchmarks, and write the report of these and of those that the folder has already.

    Args:
        folder: of the table, index.md and charts; rows of other benchmarks or devices are kept.
        options: `benches`, `particles`, `precision`, `device`, `trials`, `scenes`, `limit` and keys of the
            configuration, as on the command line.
        say: called with a line on each result.

    Returns:
        The report's page.

    Raises:
        ConfigError: a value is not one of those there are.
        DeviceError: the device does not exist.
        StorageError: the folder cannot be made or written.
    """
    folder = Path(folder)
    names = _chosen("benches", options.get("benches", ",".join(BENCHES)), BENCHES)
    settings = _settings(options)
    require_folder(folder)
    for name in names:
        figures = Measurements(settings, say, folder=folder)
        try:
            import_module(f"nsf.bench.{name}").run(figures)
        except BaseException:
            if figures.rows:  # those that were measured stay
                figures.save()
                write_report(folder)
            raise
        figures.save()
        page = write_report(folder)
    return page


def _settings(options: Mapping[str, str]) -> Settings:
    trials, sizes, scenes, limit = (
        options.get(key, "") for key in ("trials", "particles", "scenes", "limit")
    )
    for key, text in (("trials", trials), ("limit", limit)):
        if text and not (text.isdigit() and int(text)):
            raise ConfigError(f"{key}={text} must be a whole number of at least 1")
    precisions = options.get("precision", "fp32,fp64").split(",")
    return Settings(
        particles=tuple(map(_count, sizes.split(","))) if sizes else (),
        precisions=tuple(precision_of(name).name for name in precisions),
        device=str(warp_device(options.get("device", "auto"))),
        trials=int(trials or 10),
        scenes=_chosen("scenes", scenes, _KNOWN) if scenes else (),
        limit=float(limit or Settings.limit),
        keys=tuple(f"{key}={value}" for key, value in options.items() if "." in key),
    )


def _chosen(key: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    """Names with commas in between."""
    return tuple(one_of(key, name, known) for name in text.split(","))


def _count(text: str) -> int:
    """`71363`, `200k` or `1.5m` particles."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([km]?)", text.strip().lower())
    count = float(match[1]) * _UNITS[match[2]] if match else 0.0
    if not 1.0 <= count <= _MOST:
        raise ConfigError(
            f"particles={text} is no number of particles up to a billion; give for example 71363, 200k or 1m"
        )
    return round(count)
