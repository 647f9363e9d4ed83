"""Frames that are decoded block by block, and what fp32 costs them."""

import pytest
import torch

from nsf.kinematics import blocks
from nsf.kinematics.fields import modal


@pytest.mark.parametrize("frames", [1, 5, 26])
def test_blocks_are_the_positions_of_each_frame(manifold, frames, monkeypatch):
    monkeypatch.setattr(blocks, "_HOST_BYTES", 3 * 8 * 150 * 4)  # four frames
    monkeypatch.setattr(modal, "TILE", 9 * 100)
    xhat = manifold.training_latents[:frames]
    at = manifold.restrict()
    taken = [block.clone() for block in at.positions(xhat)]
    assert [len(block) for block in taken] == [len(part) for part in xhat.split(4)]
    torch.testing.assert_close(torch.cat(taken), at.position(xhat))
    assert not any(block.requires_grad for block in taken)


def test_fp32_is_off_by_less_than_a_tenth_of_the_model(manifold, snapshots):
    """Of the displacements; the model's error is that of the training frames, encoded and decoded."""
    x = snapshots.slab("x", slice(None)).double()
    xhat = manifold.encode(x)
    double, single = (
        torch.cat([block.double() for block in manifold.restrict(dtype=dtype).positions(xhat)])
        for dtype in (torch.float64, torch.float32)
    )
    assert (single - double).norm() < 0.1 * (double - x).norm()


def test_rounding_to_tf32_is_that_of_its_mantissa():
    """One in 2^11 at most of each factor; over many of them, a few in ten thousand."""
    torch.manual_seed(0)
    coefficients, modes = torch.randn(40, 48), torch.randn(3000, 48)
    assert 1e-4 < blocks.tf32_error(coefficients, modes) < 5e-4
    exact = torch.tensor([[1.0, -0.5, 3.0]])
    assert blocks.tf32_error(exact, exact) == 0.0


def test_a_block_has_a_frame_at_least():
    assert blocks.frames_at_once(10**12, torch.float64, "cpu") == 1


@pytest.mark.parametrize("n", [90, 128, 1001])
def test_a_product_in_slices_is_that_of_all(n):
    generator = torch.Generator().manual_seed(0)
    values, modes = (torch.randn(*shape, generator=generator).double() for shape in ((7, n), (n, 5)))
    torch.testing.assert_close(blocks.in_slices(values, modes), values @ modes)


@pytest.mark.gpu
@pytest.mark.parametrize("tolerance", [0.0, 1e-2])
def test_tensor_cores_are_near_enough_on_a_gpu(manifold, tolerance):
    xhat = manifold.training_latents
    exact = manifold.restrict().position(xhat)
    at = manifold.restrict(dtype=torch.float32, device="cuda")
    x = torch.cat([block.double().cpu() for block in at.positions(xhat.float().cuda(), tolerance)])
    assert (x - exact).norm() < (tolerance or 1e-5) * (exact - manifold.X).norm()
