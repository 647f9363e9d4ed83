"""Where configuration files lie, beside the package in a checkout, inside it in a wheel, and reports."""

import os
from pathlib import Path


def _bundled(name: str) -> Path:
    inside = Path(__file__).parent / name
    return inside if inside.is_dir() else Path(__file__).parent.parent / name


CONF = _bundled("conf")
EXPERIMENTS = _bundled("experiments")


def reports_folder(*parts: str) -> Path:
    """The folder of reports (`NSF_REPORTS`), or one in it."""
    return Path(os.environ.get("NSF_REPORTS", "reports"), *parts)


def groups() -> dict[str, list[str]]:
    """Names of the options of every configuration group, such as `scene` or `hydra/launcher`."""
    found: dict[str, list[str]] = {}
    for file in sorted(CONF.glob("*/**/*.yaml")):
        found.setdefault(file.parent.relative_to(CONF).as_posix(), []).append(file.stem)
    return found
