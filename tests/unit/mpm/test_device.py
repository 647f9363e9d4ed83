"""GPUs of a host, shared out among processes."""

import os
import time
from functools import partial

import pytest
import warp as wp

from nsf.mpm.device import take_gpu, visible_gpus
from nsf.workers import ended, working


@pytest.mark.parametrize(
    ("named", "count", "expected"),
    [(None, 2, ("0", "1")), ("3, GPU-5a", 2, ("3", "GPU-5a")), ("0,-1,1", 1, ("0",)), ("", 0, ())],
)
def test_gpus_by_name(monkeypatch, named, count, expected):
    monkeypatch.setattr("nsf.mpm.device.wp.get_cuda_devices", lambda: [object()] * count)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if named is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
    assert visible_gpus() == expected


def uuid_taken(gpus, folder, tell):
    taken(gpus, folder, tell)
    return wp.get_device("cuda:0").uuid, len(wp.get_cuda_devices())


@pytest.mark.gpu
@pytest.mark.skipif(len(wp.get_cuda_devices()) < 2, reason="needs two GPUs")
def test_processes_use_the_gpus_that_they_took(tmp_path):
    told = []

    def count(amount):
        told.append(amount)
        if len(told) == 2:
            (tmp_path / "end").touch()

    with working([partial(uuid_taken, visible_gpus()[:2], tmp_path)] * 2, [{}] * 2) as workers:
        found = [outcome for _, outcome in ended(workers, count)]
    assert {uuid for uuid, _ in found} == {device.uuid for device in wp.get_cuda_devices()[:2]}
    assert [number for _, number in found] == [1, 1]


def taken(gpus, folder, tell):
    """The GPU of this process, which stays at work until all others have theirs."""
    take_gpu(gpus, folder)
    take_gpu(gpus, folder)  # the next job of the process keeps it
    tell(1)
    while not (folder / "end").exists():
        time.sleep(0.01)
    return os.environ["CUDA_VISIBLE_DEVICES"]


@pytest.mark.parametrize(("processes", "gpus"), [(2, ("0", "1", "2")), (3, ("4", "GPU-7"))])
def test_processes_take_gpus_in_turn(tmp_path, processes, gpus):
    told = []

    def count(amount):
        told.append(amount)
        if len(told) == processes:
            (tmp_path / "end").touch()

    calls = [partial(taken, gpus, tmp_path)] * processes
    with working(calls, [{}] * processes) as workers:
        found = [gpu for _, gpu in ended(workers, count)]
    assert sorted(found) == sorted(gpus[turn % len(gpus)] for turn in range(processes))
    (tmp_path / "end").touch()
    with working(calls[:1], [{}]) as workers:  # what those had is free again
        assert [gpu for _, gpu in ended(workers)] == [gpus[0]]
