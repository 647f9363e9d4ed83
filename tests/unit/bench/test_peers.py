"""The step in Taichi is ours to round-off; skipped where Taichi is not installed."""

import sys

import numpy as np
import pytest

from nsf.bench.full_order import collapse
from nsf.bench.peers import TaichiMPM, run
from nsf.bench.rows import Measurements, Settings


@pytest.mark.parametrize(("precision", "tolerance"), [("fp64", 1e-8), ("fp32", 1e-3)])
def test_a_step_in_taichi_is_ours(precision, tolerance):
    taichi = pytest.importorskip("taichi")
    ours = collapse(2000, precision, "cpu")
    peer = TaichiMPM(taichi, ours)
    for solver in (ours, peer):
        solver.step(60)
    x = ours.state.x.rows.numpy()
    moved = np.abs(x - ours.constants.X[ours.state.order.numpy()]).max()
    assert moved > 1e-3
    assert np.abs(peer.x - x).max() < tolerance * moved


def test_without_taichi_nothing_is_measured(monkeypatch):
    monkeypatch.setitem(sys.modules, "taichi", None)
    said = []
    figures = Measurements(Settings((500,), ("fp64",), "cpu", 1), said.append)
    run(figures)
    assert not figures.rows
    assert "pip install 'nsf[peers]'" in said[0]
