"""Folders of configurations, ours and the user's, and of reports."""

import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from nsf.errors import ConfigError


def _bundled(name: str) -> Path:
    inside = Path(__file__).parent / name
    return inside if inside.is_dir() else Path(__file__).parent.parent / name


CONF = _bundled("conf")
EXPERIMENTS = _bundled("experiments")
#: Folders of configurations of the user, separated as in PATH; `nsf --config-dir` adds one.
VARIABLE = "NSF_CONFIG"
REMEDY = f"name folders of configurations by --config-dir DIR, or by {VARIABLE}=DIR"


def add_folder(folder: str) -> None:
    """Put a folder before those of `NSF_CONFIG`, for this process and those that it starts."""
    os.environ[VARIABLE] = os.pathsep.join(filter(None, (os.path.abspath(folder), os.environ.get(VARIABLE))))


def user_folders() -> tuple[Path, ...]:
    """The folders of `NSF_CONFIG`.

    Raises:
        ConfigError: one is no folder, has no groups or a part of Hydra's, or two have the same file; or the
            folder that one works in was deleted.
    """
    try:
        cwd = os.getcwd()
    except FileNotFoundError as error:
        raise ConfigError("the folder that you are in was deleted; change to another one") from error
    return _checked(os.environ.get(VARIABLE, ""), cwd)


@cache
def _checked(text: str, cwd: str) -> tuple[Path, ...]:
    folders = tuple(dict.fromkeys(Path(cwd, part) for part in text.split(os.pathsep) if part))
    owners: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder} is no folder; correct --config-dir or {VARIABLE}")
        for name in ("hydra", "config.yaml", "point.yaml"):
            if (folder / name).exists():
                raise ConfigError(f"{folder / name} is refused, as it would replace nsf's; take it out")
        names = [path.relative_to(folder).as_posix() for path in _files(folder)]
        if not names:
            inner = [path for path in sorted(folder.iterdir()) if path.is_dir() and any(_files(path))]
            remedy = f"did you mean {inner[0]}?" if inner else f"its groups may be {', '.join(_own_groups())}"
            raise ConfigError(f"{folder} has no groups of configurations, as scene/NAME.yaml; {remedy}")
        if twice := [name for name in names if name in owners]:
            raise ConfigError(f"{folder} and {owners[twice[0]]} both have {twice[0]}; rename one")
        owners |= dict.fromkeys(names, folder)
    return folders


@cache
def _own_groups() -> list[str]:
    """Names of folders that a folder of configurations may have."""
    folders = (path.name for path in CONF.iterdir() if path.is_dir())
    return [*sorted(name for name in folders if name != "hydra"), "experiments"]


def _files(folder: Path) -> Iterator[Path]:
    for group in [*_own_groups(), "hydra"] if folder == CONF else _own_groups():
        yield from sorted((folder / group).rglob("*.yaml"))


def files() -> list[Path]:
    """Every file of every folder of configurations, the user's first."""
    return [path for folder in (*user_folders(), CONF) for path in _files(folder)]


def option(group: str, name: str) -> Path:
    """The file of an option of a group: the user's, where there is one."""
    return next(f for f in (d / group / f"{name}.yaml" for d in (*user_folders(), CONF)) if f.is_file())


def experiments() -> dict[str, Path]:
    """The files of experiments by name, in alphabetical order."""
    folders = (EXPERIMENTS, *(folder / "experiments" for folder in user_folders()))
    return dict(sorted((path.stem, path) for folder in folders for path in folder.glob("*.yaml")))


def reports_folder(*parts: str) -> Path:
    """The folder of reports (`NSF_REPORTS`), or one in it."""
    return Path(os.environ.get("NSF_REPORTS", "reports"), *parts)


def groups() -> dict[str, list[str]]:
    """Names of the options of every configuration group, such as `scene` or `hydra/launcher`."""
    options: dict[str, set[str]] = {}
    for folder in (*user_folders(), CONF):
        for file in _files(folder):
            group = file.parent.relative_to(folder).as_posix()
            if not group.startswith("experiments"):
                options.setdefault(group, set()).add(file.stem)
    return {group: sorted(names) for group, names in sorted(options.items())}
