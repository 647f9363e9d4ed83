"""Memory that is available, and what does not fit."""

import pytest

from nsf import memory
from nsf.errors import ConfigError

GIB = 2**30


def test_host_memory_is_read(monkeypatch):
    assert memory.host_memory() > 2**20

    def absent(*arguments, **keys):
        raise FileNotFoundError

    monkeypatch.setattr("builtins.open", absent)
    assert memory.host_memory() > 2**20


@pytest.mark.parametrize(
    ("line", "folder", "limit", "stat"),
    [
        ("0::/job/step", "job", ("memory.max", 5 * GIB), "anon 1073741824\nfile 9\n"),
        ("0::/job/step", ".", ("memory.max", 5 * GIB), "anon 1073741824\n"),
        ("4:memory:/job", "memory/job", ("memory.limit_in_bytes", 5 * GIB), "total_rss 1073741824\n"),
        ("4:memory:/job", "memory", ("memory.limit_in_bytes", 5 * GIB), "total_rss 1073741824\n"),
    ],
)
def test_limit_of_a_control_group(tmp_path, monkeypatch, line, folder, limit, stat):
    """Its own or one about it; what the group has allocated is gone, its file cache is not."""
    group = tmp_path / folder
    group.mkdir(parents=True, exist_ok=True)
    (group / limit[0]).write_text(f"{limit[1]}\n")
    (group / "memory.stat").write_text(stat)
    (tmp_path / "cgroup").write_text(f"3:cpu:/job\n{line}\n")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path)
    read = memory.Path
    monkeypatch.setattr(
        memory, "Path", lambda path: tmp_path / "cgroup" if path == "/proc/self/cgroup" else read(path)
    )
    assert memory._left_in_groups() == [4 * GIB]
    monkeypatch.setattr(memory, "_free_pages", lambda: 64 * GIB)
    assert memory.host_memory() == 4 * GIB


def test_no_limit(tmp_path, monkeypatch):
    (tmp_path / "memory.max").write_text("max\n")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path)
    assert memory._left_in_groups() == []


def test_what_does_not_fit():
    memory.require_memory("a grid", 3 * GIB, 3 * GIB, "coarsen it")
    with pytest.raises(ConfigError, match=r"a grid would take 4\.0 GiB .* 3\.0 GiB .*; coarsen it"):
        memory.require_memory("a grid", 4 * GIB, 3 * GIB, "coarsen it")
