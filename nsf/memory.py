"""How much memory there is, and a refusal of what cannot fit into it."""

import os
from pathlib import Path

from nsf.errors import ConfigError

_GROUPS = Path("/sys/fs/cgroup")
#: Of a control group: file of its limit, and the entry of memory.stat that no cache counts into.
_LIMITS = {"memory.max": "anon", "memory.limit_in_bytes": "total_rss"}


def host_memory() -> int:
    """[byte] that this process could still take: what is free, within the limits of its control groups."""
    return min([_free_pages(), *_left_in_groups()])


def require_memory(what: str, size: int, available: int, remedy: str) -> None:
    """Refuse what does not fit.

    Args:
        what: that takes the memory.
        size: [byte] that it takes.
        available: [byte] that there are.
        remedy: for the user.

    Raises:
        ConfigError: names both numbers.
    """
    if size > available:
        raise ConfigError(
            f"{what} would take {size / 2**30:,.1f} GiB of memory and {available / 2**30:,.1f} GiB are "
            f"available; {remedy}"
        )


def _free_pages() -> int:
    try:  # free pages and the file cache that the kernel would give up
        with open("/proc/meminfo", encoding="ascii") as file:
            return next(1024 * int(line.split()[1]) for line in file if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _left_in_groups() -> list[int]:
    """Memory that each control group of this process still allows; inside a container the root is one."""
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    found = []
    for controllers, path in (line.split(":", 2)[1:] for line in lines):
        if controllers in ("", "memory"):
            root = _GROUPS / controllers
            own = root / path.lstrip("/")
            found += [_left(group) for group in (own, *own.parents) if group.is_relative_to(root)]
    return [left for left in found if left is not None]


def _left(group: Path) -> int | None:
    """The memory that one group still allows; None where it has no limit."""
    for name, used in _LIMITS.items():
        try:
            limit = int((group / name).read_text())
            stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            return max(0, limit - int(stat[used]))
        except (OSError, ValueError, KeyError):
            continue
    return None
