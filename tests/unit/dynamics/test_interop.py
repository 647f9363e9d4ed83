"""Torch and Warp on one stream, and steps captured as a CUDA graph."""

import gc
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from gpu_references import SOURCES

import nsf
from nsf.dynamics.interop import captured, on_torch_stream


class FakeDevice:
    """Stands for a GPU whose current Warp stream is `stream`."""

    is_cuda = True

    def __init__(self, handle):
        self.stream = SimpleNamespace(cuda_stream=handle)

    def __str__(self):
        return "cuda:0"


@pytest.fixture
def entered(monkeypatch):
    """Handles of the streams that Warp was told to launch on."""
    told = []
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=7))
    monkeypatch.setattr(wp, "stream_from_torch", lambda stream: stream)
    monkeypatch.setattr(
        wp, "ScopedStream", lambda stream, **more: told.append(stream.cuda_stream) or nullcontext()
    )
    return told


def test_torchs_stream_is_entered_once(entered):
    """Leaving an inner context would take the stream away from the outer one."""
    with on_torch_stream(FakeDevice(0)):
        assert entered == [7]
    with on_torch_stream(FakeDevice(7)):
        assert entered == [7]


@pytest.mark.gpu
@pytest.mark.parametrize("sources", SOURCES, ids=str)
def test_captured_steps_are_the_steps_themselves(sources, tiny_scene, reference_manifold):
    """Every replay clears the grid and takes the stress anew."""
    found = []
    for capturable in (True, False):
        solver = nsf.reduced(
            tiny_scene, reference_manifold, {"friction_angle": 26.0}, 60, sources=sources, device="cuda"
        )
        solver.span.capturable = capturable
        solver.step(8)
        found.append(solver.trajectory().xhat)
    np.testing.assert_allclose(*found, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("collects", [True, False])
def test_no_garbage_is_collected_within_a_capture(collects, monkeypatch):
    begins_and_ends = []

    @contextmanager
    def graph(_):
        begins_and_ends.append(gc.isenabled())
        yield
        begins_and_ends.append(gc.isenabled())

    monkeypatch.setattr(torch.cuda, "CUDAGraph", object)
    monkeypatch.setattr(torch.cuda, "graph", graph)
    before = gc.isenabled()
    (gc.enable if collects else gc.disable)()
    try:
        with captured(SimpleNamespace(is_cuda=False)):
            assert not gc.isenabled()
        assert begins_and_ends == [False, False]
        assert gc.isenabled() == collects
    finally:
        (gc.enable if before else gc.disable)()
