"""Timers and probes; no assertion is about how long something takes."""

import subprocess
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from nsf import timing
from nsf.errors import DeviceError
from nsf.timing import MemoryProbe, StageTimer, synchronizer, untimed

MIB = 2**20


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until told."""
    clock = SimpleNamespace(now=0.0, waits=0)
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock.now)
    return clock


def advance(clock, seconds):
    clock.now += seconds


def test_stages_add_up(clock):
    timer = StageTimer()
    for _ in range(2):
        with timer("p2g"):
            advance(clock, 0.002)
        with timer("grid"):
            advance(clock, 0.001)
        advance(clock, 5.0)  # between stages
    with timer("grid"):
        advance(clock, 0.004)
    assert timer.milliseconds == pytest.approx({"p2g": 4, "grid": 6})
    assert timer.per_step(2) == pytest.approx({"p2g": 2, "grid": 3})


def test_a_stage_waits_for_its_own_work_and_not_for_earlier_work(clock):
    pending = [0.0]

    def wait():
        advance(clock, pending[0])
        pending[0] = 0.0

    timer = StageTimer(synchronize=wait)
    pending[0] = 7.0
    with timer("g2p"):
        pending[0] = 0.003
    assert timer.milliseconds == pytest.approx({"g2p": 3})


def test_a_stage_that_raises_is_not_counted(clock):
    timer = StageTimer()
    with pytest.raises(ValueError, match="x"), timer("p2g"):
        raise ValueError("x")
    assert timer.milliseconds == {}


def test_untimed_stands_in_for_a_timer():
    with untimed("p2g"):
        pass


def test_the_cpu_counts_what_the_caller_says():
    held = [0]
    with MemoryProbe("cpu", nbytes=lambda: held[0]) as probe:
        held[0] = 3 * MIB
    assert (probe.peak_mib, probe.grown_mib) == (3, 3)
    with MemoryProbe(nbytes=MIB) as probe:
        pass
    assert probe.peak_mib == 1


class FakeGpu:
    """The calls of torch and Warp that the probe makes, in MiB."""

    def __init__(self, monkeypatch, torch=True, warp=True):
        self.torch, self.torch_peak, self.warp, self.warp_mark, self.waits = 10, 50, 20, 40, []
        self.begun = False
        cuda = SimpleNamespace(
            is_available=lambda: True,
            init=lambda: setattr(self, "begun", True),
            synchronize=lambda device: self.waits.append(device),
            reset_peak_memory_stats=self.reset,
            memory_allocated=lambda device: self.torch * MIB,
            max_memory_allocated=lambda device: self.torch_peak * MIB,
        )
        fake_warp = SimpleNamespace(
            is_cuda_available=lambda: True,
            is_mempool_enabled=lambda device: True,
            synchronize_device=lambda device: self.waits.append(device),
            get_mempool_used_mem_high=lambda device: self.warp_mark * MIB,
            get_mempool_used_mem_current=lambda device: self.warp * MIB,
        )
        modules = {
            "torch": SimpleNamespace(cuda=cuda) if torch else None,
            "warp": fake_warp if warp else None,
        }
        monkeypatch.setattr(timing, "sys", SimpleNamespace(modules=modules))

    def reset(self, device):
        if not self.begun:  # as torch does
            raise RuntimeError("Invalid device argument")
        self.torch_peak = self.torch


def test_a_gpu_adds_both_allocators_over_the_region_alone(monkeypatch):
    gpu = FakeGpu(monkeypatch)
    with MemoryProbe("cuda:0") as probe:
        gpu.torch_peak, gpu.warp_mark = max(gpu.torch_peak, 15), 60
    assert (probe.peak_mib, probe.grown_mib) == (75, 45)


def test_an_earlier_mark_of_warp_is_not_counted(monkeypatch):
    gpu = FakeGpu(monkeypatch, torch=False)
    with MemoryProbe("cuda:0") as probe:
        gpu.warp = 25
    assert (probe.peak_mib, probe.grown_mib) == (25, 5)


@pytest.mark.parametrize("torch", [True, False])
def test_a_gpu_is_waited_for_through_the_loaded_library(monkeypatch, torch):
    gpu = FakeGpu(monkeypatch, torch=torch)
    with StageTimer("cuda:1")("p2g"):
        assert gpu.waits == ["cuda:1"]
    assert gpu.waits == ["cuda:1"] * 2


def test_a_launch_adds_the_times_between_the_marks_of_its_graph(monkeypatch):
    now = iter([1.0, 10.0, 12.0, 15.0, 20.0, 21.0, 25.0])

    class Event:
        def __init__(self, enable_timing, external):
            assert (enable_timing, external) == (True, True)

        def record(self, stream):
            assert stream == "torch's view of Warp's stream"
            self.at = next(now)

        def elapsed_time(self, end):
            return end.at - self.at

    def view(held, device):
        assert (held, device) == ("Warp's stream", "cuda:0")
        return "torch's view of Warp's stream"

    gpu = FakeGpu(monkeypatch)
    torch, warp = (timing.sys.modules[name] for name in ("torch", "warp"))
    torch.cuda.Event, torch.cuda.ExternalStream, torch.cuda.stream = Event, view, nullcontext
    warp.get_device = lambda device: SimpleNamespace(stream=SimpleNamespace(cuda_stream="Warp's stream"))
    timer = StageTimer("cuda:0")
    with pytest.raises(ValueError, match="fails"), timer.captured("p2g"):
        raise ValueError("a stage fails")
    for launch in (1, 2):
        for stage in ("p2g", "grid"):
            with timer.captured(stage):
                pass
        assert not gpu.waits or launch == 2  # nothing may be waited for while a graph is captured
        timer.add_launch()
        assert len(gpu.waits) == launch
    assert timer.milliseconds == {"p2g": 2.0 + 1.0, "grid": 3.0 + 4.0}


def test_a_captured_stage_needs_both_libraries(monkeypatch):
    FakeGpu(monkeypatch, torch=False)
    with pytest.raises(DeviceError, match="import both"), StageTimer("cuda:0").captured("p2g"):
        pass


def test_a_gpu_that_is_not_there(monkeypatch):
    FakeGpu(monkeypatch, torch=False, warp=False)
    for make in (synchronizer, StageTimer, MemoryProbe):
        with pytest.raises(DeviceError, match=r"device=cuda:0.*device=cpu"):
            make("cuda:0")


def test_timing_imports_no_array_library():
    code = "import sys, nsf.timing; assert not {'torch', 'warp', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.gpu
@pytest.mark.parametrize("device", ["cuda", "cuda:0"])
def test_a_real_gpu(device):
    import torch
    import warp as wp

    timer = StageTimer(device)
    with MemoryProbe(device) as probe, timer("work"):
        held = torch.zeros(64 * MIB, dtype=torch.uint8, device=device)
        array = wp.zeros(32 * MIB, dtype=wp.uint8, device=device)
    assert timer.milliseconds["work"] > 0
    assert probe.grown_mib == pytest.approx(len(held) / MIB + len(array) / MIB, abs=4)
    assert probe.peak_mib >= probe.grown_mib


@pytest.mark.gpu
def test_stages_of_a_real_graph():
    import warp as wp

    timer, array = StageTimer("cuda:0"), wp.zeros(256 * MIB, dtype=wp.uint8, device="cuda:0")
    with wp.ScopedCapture(device="cuda:0") as capture:
        for stage, times in {"once": 1, "ten times": 10}.items():
            with timer.captured(stage):
                for _ in range(times):
                    array.fill_(1)
    wp.capture_launch(capture.graph)
    timer.add_launch()
    assert list(timer.milliseconds) == ["once", "ten times"]
    assert 0 < timer.milliseconds["once"] < timer.milliseconds["ten times"]
