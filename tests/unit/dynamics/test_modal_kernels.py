"""Sums over modes are what NumPy makes of them, also at the last particles of the last block."""

import numpy as np
import pytest
import torch
import warp as wp

from nsf.data import TAU_MATRIX
from nsf.dynamics.arena import Arena
from nsf.dynamics.interop import as_vectors
from nsf.dynamics.modal_kernels import THREADS, make_contraction, make_position, tiling
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device

#: Fewer threads in the last block than coefficients, and modes that fill no whole vector of four; of one
#: simulation, of one tile, and of tiles that are not all full.
SIZES = [(129, 48, 1), (127, 47, 5), (300, 5, 19)]


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def arena(request):
    if request.param == "cuda" and not (torch.cuda.is_available() and wp.is_cuda_available()):
        pytest.skip("needs a GPU")
    return Arena(precision_of("fp64"), warp_device(request.param))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def values_of(arena, rng, *shape):
    return arena.hold(rng.standard_normal(shape), torch.float64)


def test_tiles_hold_all():
    for simulations in range(1, 300):
        tiles, size = tiling(simulations)
        assert size <= 8
        assert 0 <= tiles * size - simulations < tiles
    assert tiling(64, 8000) == (13, 5)  # 45 056 bytes hold five
    assert tiling(64, 10**6) == (64, 1)


@pytest.mark.parametrize(("n", "K", "simulations"), SIZES)
@pytest.mark.parametrize(
    ("components", "coefficients", "half"),
    [(6, torch.float64, True), (9, torch.float32, True), (9, torch.float64, False)],
)
def test_contraction(arena, rng, n, K, simulations, components, coefficients, half):
    mean, modes = (values_of(arena, rng, n, components, *more).float() for more in ((), (K,)))
    a = arena.hold(rng.standard_normal((simulations, K)), coefficients)
    needed = arena.hold(rng.integers(0, 2, (simulations, n)), torch.int32)
    found = arena.zeros(simulations * n, 3, 3)
    (tiles, tile), of = tiling(simulations), wp.dtype_from_torch(coefficients)
    stored, lengths = arena.halved(modes) if half else (arena.modes(modes), 1.0)
    read = (modes / lengths).to(stored.dtype).double()
    kind = wp.dtype_from_torch(stored.dtype)
    kernel = make_contraction(arena.precision, -(-K // 4), components == 6, of, tile, tiles > 1, kind)
    lanes, threads = arena.lanes(THREADS), tiles * arena.whole_blocks(components // 3 * n, THREADS)
    inputs = [needed, arena.hold(mean, torch.float64), stored, a, tiles, lanes, found]
    arena.pack(kernel, threads, inputs, THREADS).launch()
    wp.synchronize_device(arena.device)
    expected = mean.double() + torch.einsum("nck,bk->bnc", read, a.double())
    expected = expected.cpu().numpy().reshape(simulations * n, components)
    expected = expected[:, TAU_MATRIX] if components == 6 else expected.reshape(-1, 3, 3)
    expected = expected * needed.cpu().numpy().reshape(-1, 1, 1)
    np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=1e-12, atol=1e-12)


def test_half_precision_is_of_a_gpu_and_takes_lengths_out(arena, rng):
    modes = values_of(arena, rng, 7, 9, 6).float() * torch.logspace(-8, 6, 6, device=arena.zeros(1).device)
    stored, lengths = arena.halved(modes)
    if not arena.device.is_cuda:
        assert stored.dtype is torch.float32
        assert (lengths == 1).all()
        return
    assert stored.dtype is torch.float16
    found = stored.view(9, 2, 7, 4).permute(2, 0, 1, 3).flatten(2)[..., :6].float() * lengths
    assert ((found - modes).abs().amax((0, 1)) < 1e-3 * modes.abs().amax((0, 1))).all()


def test_modes_are_those_of_the_rows_however_many_are_taken_at_once(arena, rng, monkeypatch):
    table = values_of(arena, rng, 11, 3, 6).float()
    rows = torch.tensor([4, 0, 9, 9, 2], device=table.device)
    whole = [arena.modes(table[rows]), *arena.halved(table[rows])]
    for entries in (1, 50):  # a particle, and two of them, at once
        monkeypatch.setattr("nsf.dynamics.arena._ENTRIES", entries)
        for found, expected in zip(
            [arena.modes(table, rows), *arena.halved(table, rows)], whole, strict=True
        ):
            torch.testing.assert_close(found, expected, rtol=0, atol=0)
        halves = arena.modes(table, rows, torch.float16, table.new_full((6,), 3.0))
        torch.testing.assert_close(halves, (whole[0] / 3.0).half(), rtol=0, atol=0)
    first = whole[0].view(3, 2, 5, 4)[:, :, 0] if arena.device.is_cuda else whole[0].view(5, 3, 2, 4)[0]
    torch.testing.assert_close(first.flatten(1)[:, :6], table[4], rtol=0, atol=0)


@pytest.mark.parametrize(("n", "K", "simulations"), SIZES)
def test_position(arena, rng, n, K, simulations):
    modes = values_of(arena, rng, n, 3, K).float()
    mean, start = values_of(arena, rng, n, 3), values_of(arena, rng, simulations * n, 3)
    a, rate = (values_of(arena, rng, simulations, K) for _ in range(2))
    x, v = (arena.zeros(simulations * n, 3) for _ in range(2))
    for first in (np.arange(simulations) % 2, np.arange(1, simulations + 1) % 2):
        shown = [as_vectors(values, arena.precision) for values in (mean, start, x, v)]
        (tiles, tile), lanes = tiling(simulations), arena.lanes(THREADS)
        inputs = [shown[0], arena.modes(modes), a, rate, shown[1], arena.hold(first, torch.int32)]
        kernel = make_position(arena.precision, -(-K // 4), tile, tiles > 1)
        threads = tiles * arena.whole_blocks(n, THREADS)
        arena.pack(kernel, threads, [*inputs, tiles, lanes, *shown[2:]], THREADS).launch()
        wp.synchronize_device(arena.device)
        places, moved = (torch.einsum("nck,bk->bnc", modes.double(), c).cpu() for c in (a, rate))
        np.testing.assert_allclose(x.cpu().view(-1, n, 3), mean.cpu() + places, rtol=1e-12, atol=1e-12)
        begun = torch.as_tensor(first == 1)[:, None, None]
        expected = torch.where(begun, start.cpu().view(-1, n, 3), moved)
        np.testing.assert_allclose(v.cpu().view(-1, n, 3), expected, rtol=1e-12, atol=1e-12)
