"""Scalars of a shape, on shapes whose scalars are known."""

import pytest
import torch

from nsf.quantities import QUANTITIES, at_end, height, opening, run_out, springback


@pytest.fixture
def bar():
    """A bar of 20 × 4 × 10 points, 1 cm apart."""
    axes = (0.01 * torch.arange(n, dtype=torch.float64) for n in (20, 4, 10))
    return torch.cartesian_prod(*axes)


def test_height(bar):
    assert float(height(bar, bar)) == pytest.approx(0.09)
    assert float(height(2.0 * bar + 1.0, bar)) == pytest.approx(0.18)


def test_run_out_is_from_the_axis_at_rest(bar):
    corner = (0.095**2 + 0.015**2) ** 0.5
    assert float(run_out(bar, bar)) == pytest.approx(corner, rel=1e-6)
    moved = bar + torch.tensor([0.3, 0.0, 0.0])
    assert float(run_out(moved, bar)) == pytest.approx(0.3 + 0.095, rel=1e-2)


def test_opening_is_the_widest_gap(bar):
    assert float(opening(bar, bar)) == pytest.approx(0.01)
    torn = bar + torch.where(bar[:, :1] > 0.105, 0.07, 0.0) * torch.tensor([1.0, 0.0, 0.0])
    assert float(opening(torn, bar)) == pytest.approx(0.08)


def test_springback_is_what_comes_back(bar):
    frames = torch.stack([bar * torch.tensor([1.0, 1.0, s]) for s in (1.0, 0.5, 0.8)])
    assert float(springback(frames, bar)) == pytest.approx(0.3 * 0.09)
    found = at_end(height(frames, bar), frames[-1], bar)
    assert set(found) == set(QUANTITIES)
    assert found["springback"] == pytest.approx(0.3 * 0.09)
    assert found["height"] == pytest.approx(0.8 * 0.09)


def test_they_have_gradients(bar):
    x = bar.clone().requires_grad_()
    for name, quantity in QUANTITIES.items():
        own = quantity.of(x[None] if quantity.whole else x, bar).sum()
        if name != "springback":  # of one frame it is zero
            assert torch.autograd.grad(own, x)[0].abs().sum() > 0
