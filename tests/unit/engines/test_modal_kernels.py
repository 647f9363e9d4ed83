"""Sums over modes are what NumPy makes of them, also at the last particles of the last block."""

from itertools import pairwise

import numpy as np
import pytest
import torch
import warp as wp
from torch.profiler import ProfilerActivity, profile

from nsf.engines.modal.arena import Arena
from nsf.engines.modal.closure import packed_weights, projection_block
from nsf.engines.modal.gathering import THREADS, tiling
from nsf.engines.modal.networks import make_layer, make_product, product_blocks
from nsf.engines.modal.projection import (
    EVALUATE,
    PREPARE,
    SOLVE,
    make_projection,
    prepared_size,
    shared_bytes,
)
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device
from nsf.mpm.native.access import SHARED, TAKEN

#: Fewer threads in the last block than coefficients, and modes that fill no whole vector of four; of one
#: simulation, of one tile, and of tiles that are not all full.
SIZES = [(129, 48, 1), (127, 47, 5), (300, 5, 19)]


@pytest.fixture
def arena(device):
    return Arena(precision_of("fp64"), warp_device(device))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def values_of(arena, rng, *shape):
    return arena.hold(rng.standard_normal(shape), torch.float64)


def as_bits(flags, tiles, tile):
    """[simulations, n] of 0 and 1 → [tiles, n], a bit a simulation of a tile."""
    padded = np.zeros((tiles * tile, flags.shape[1]), int)
    padded[: len(flags)] = flags
    return np.einsum("tsn,s->tn", padded.reshape(tiles, tile, -1), 2 ** np.arange(tile))


def test_tiles_hold_all():
    for simulations in range(1, 300):
        tiles, size = tiling(simulations)
        assert size <= 8
        assert 0 <= tiles * size - simulations < tiles
    assert tiling(64, 8000) == (13, 5)  # 45 056 bytes hold five
    assert tiling(64, 10**6) == (64, 1)


def test_half_precision_takes_lengths_out(arena, rng):
    modes = values_of(arena, rng, 7, 9, 6).float() * torch.logspace(-8, 6, 6, device=arena.zeros(1).device)
    stored, lengths = arena.halved(modes, torch.arange(7, device=modes.device))
    assert stored.dtype is torch.float16
    stored = stored.view(9, 2, 7, 4).permute(2, 0, 1, 3) if arena.device.is_cuda else stored.view(7, 9, 2, 4)
    found = stored.flatten(2)[..., :6].float() * lengths
    assert ((found - modes).abs().amax((0, 1)) < 1e-3 * modes.abs().amax((0, 1))).all()


def test_a_cpu_reads_the_table_itself(rng):
    arena = Arena(precision_of("fp64"), warp_device("cpu"))
    table, rows = values_of(arena, rng, 11, 3, 6).float(), torch.tensor([4, 0, 9])
    before = arena.nbytes
    placed = arena.placed(table, rows)
    assert placed["modes"].data_ptr() == table.data_ptr()
    assert placed["rows"].tolist() == [4, 0, 9]
    assert (arena.nbytes - before, arena.mode_bytes) == (3 * 4 + 8, 3 * 18 * 4)


def test_modes_are_those_of_the_rows_however_many_are_taken_at_once(arena, rng, monkeypatch):
    table = values_of(arena, rng, 11, 3, 6).float()
    rows = torch.tensor([4, 0, 9, 9, 2], device=table.device)
    each = torch.arange(5, device=table.device)
    whole = [arena.modes(table[rows], each), *arena.halved(table[rows], each)]
    for entries in (1, 50):  # a particle, and two of them, at once
        monkeypatch.setattr("nsf.engines.modal.arena._ENTRIES", entries)
        for found, expected in zip(
            [arena.modes(table, rows), *arena.halved(table, rows)], whole, strict=True
        ):
            torch.testing.assert_close(found, expected, rtol=0, atol=0)
        halves = arena.modes(table, rows, torch.float16, table.new_full((6,), 3.0))
        torch.testing.assert_close(halves, (whole[0] / 3.0).half(), rtol=0, atol=0)
    first = whole[0].view(3, 2, 5, 4)[:, :, 0] if arena.device.is_cuda else whole[0].view(5, 3, 2, 4)[0]
    torch.testing.assert_close(first.flatten(1)[:, :6], table[4], rtol=0, atol=0)


def test_blocks_of_a_product_hold_all():
    for outputs, members, simulations in [(40, 2, 1), (32, 1, 16), (34, 2, 17), (7, 7, 300)]:
        first, blocks = product_blocks([(outputs, members), (5, 1)], simulations)
        tiles, rest = divmod(blocks, first + 1)  # one block of five outputs
        assert rest == 0
        assert 16 * tiles >= simulations > 16 * (tiles - 1)
        own, chunks = outputs // members, first // members
        assert 16 * chunks >= own > 16 * (chunks - 1)


@pytest.mark.parametrize("simulations", [1, 19, 37])
@pytest.mark.parametrize("outs", [(20, 10), (40, 10)])
@pytest.mark.parametrize("way", ["layer", "first_layers", "product"])
def test_layers_of_two_networks(arena, rng, simulations, outs, way):
    """Of two members, whose rows see their own entries alone; the first layer may come with the second."""
    if way == "product" and not arena.device.is_cuda:
        pytest.skip("products are of a GPU")
    r, hidden, fused = 5, 137, way == "first_layers"  # outputs are of a member

    def silu(z):
        return z * torch.sigmoid(z)

    def pair(*shape):
        return values_of(arena, rng, *shape), values_of(arena, rng, *shape)

    x = values_of(arena, rng, simulations, r)
    W_0, b_0 = pair(2 * hidden, r), pair(simulations, 2 * hidden)
    W = [values_of(arena, rng, 2 * out, hidden) for out in outs]
    b = [values_of(arena, rng, simulations, 2 * out) for out in outs]
    entries = [silu(x @ one.T + other) for one, other in zip(W_0, b_0, strict=True)]
    found = [arena.zeros(simulations, 2 * out) for out in outs]
    sides = [
        {"W": W[i], "b": b[i], "x": arena.hold(entries[i], torch.float64), "y": found[i]} for i in (0, 1)
    ]
    for i in range(2 if fused else 0):
        sides[i] |= {"W_0": W_0[i], "b_0": b_0[i], "x": x}
    one, two = sides
    (tiles, tile), lanes, count = tiling(simulations), arena.lanes(32), 2 * sum(outs)
    if way == "product":
        first, blocks = product_blocks([(2 * out, 2) for out in outs], simulations)
        kernel, threads, how = (
            make_product(arena.precision),
            blocks * THREADS,
            {"first": first, "blocks": blocks},
        )
    else:
        kernel = make_layer(arena.precision, tile, tiles > 1, r if fused else 0)
        threads, how = tiles * count * lanes, {"lanes": lanes, "outputs": count}
    arena.pack(kernel, threads, THREADS, one=one, two=two, active=True, **how).launch()
    wp.synchronize_device(arena.device)
    for i in (0, 1):
        of_members = entries[i].unflatten(1, (2, -1)), W[i].unflatten(0, (2, -1))
        expected = silu(torch.einsum("bme,moe->bmo", *of_members).flatten(1) + b[i])
        np.testing.assert_allclose(found[i].cpu(), expected.cpu(), rtol=1e-11, atol=1e-11)


def closure_of(layers, scale, x):
    """scale · Σ of the members at x [B, r]."""
    total = 0.0
    for *hidden, (W, b) in layers:
        y = x
        for W_h, b_h in hidden:
            y = torch.nn.functional.silu(y @ W_h.T + b_h)
        total = total + scale * (y @ W.T + b)
    return total


@pytest.mark.parametrize(("precision", "accuracy"), [("fp64", 1e-9), ("fp32", 2e-5)])
@pytest.mark.parametrize(("K", "members", "kept"), [(20, 3, True), (72, 1, False)])
@pytest.mark.parametrize("stops", [True, False], ids=["early", "late"])
def test_the_inversion_finds_the_latents_that_moved_the_sample(
    device, rng, precision, accuracy, K, members, kept, stops
):
    """Of three runs, with G in shared memory or not; no latents give all of the displacement."""
    arena, runs, r, s, dt = Arena(precision_of(precision), warp_device(device)), 3, 5, 11, 0.25
    widths, scale, iterations, left = (r, 40, 33, K - r), 0.3, 8, 0.7
    assert (shared_bytes(arena.precision, widths, r, K) + 8 * K**2 <= SHARED - TAKEN) == kept
    layers = [
        [
            (torch.tensor(rng.normal(size=(out, into)) / into**0.5), torch.tensor(rng.normal(size=out)))
            for into, out in pairwise(widths)
        ]
        for _ in range(members)
    ]
    layers = [[(W.float().double(), b.float().double()) for W, b in member] for member in layers]
    sigma, B = torch.tensor(1.0 + rng.random(r)), torch.tensor(rng.normal(size=(3 * s, K)) / 6.0)
    B = torch.cat([B, torch.eye(K)])  # so that G is well conditioned
    x, before, target = (torch.tensor(rng.normal(size=(runs, r))) for _ in range(3))
    before, target = x + 0.02 * before, x + 0.05 * target

    def coefficients(at):
        return torch.cat([sigma * at, closure_of(layers, scale, at)], 1)

    moved = coefficients(target) - coefficients(x)
    b = moved @ (B.T @ B)
    squares = (moved * b).sum(1, keepdim=True) + left
    packed = torch.cat([packed_weights(member, arena.device.is_cuda) for member in layers])
    held = {
        name: arena.hold(values, torch.float64)
        for name, values in {
            "sigma": sigma, "G": (B.T @ B).flatten(), "b": torch.cat([b, squares], 1), "latent": x.clone(),
        }.items()
    }  # fmt: skip
    held |= {
        name: arena.zeros(runs, n) for name, n in {"a": K, "rate": K, "prepared": prepared_size(r, K)}.items()
    }
    held |= {"xhat": arena.hold(x.clone(), arena.real), "xhat_previous": arena.hold(before, arena.real)}
    sizes = {"xhats": 2 * r, "residuals": iterations + 1, "updates": iterations}
    held |= {name: arena.zeros(runs, n, dtype=arena.real) for name, n in sizes.items()}
    held["row"] = arena.zeros(runs, 1, dtype=torch.int64)
    held |= {name: arena.zeros(runs, 1, dtype=torch.int32) for name in ("first", "step")}
    given = held | {
        "weights": arena.hold(packed, torch.float32), "scale": scale, "sample": s, "iterations": iterations,
        "tolerance": 1e-11 if stops else 0.0, "linear": False, "dt": dt,
    }  # fmt: skip
    kernel, block = make_projection(arena.precision, widths, members, r, K, True), projection_block(widths)
    threads = arena.lanes(block)
    tasks = []
    for task in (EVALUATE, PREPARE, SOLVE):
        arena.pack(kernel, runs * threads, block, inversion=given, task=task, threads=threads).launch()
        wp.synchronize_device(arena.device)
        tasks.append({name: held[name].cpu().double().clone() for name in ("a", "rate", "latent")})
    evaluated, _, found = tasks
    options = {"rtol": 0, "atol": accuracy}
    torch.testing.assert_close(evaluated["a"], coefficients(x), **options)
    torch.testing.assert_close(found["latent"], target, **options)
    torch.testing.assert_close(found["a"], coefficients(target), **options)
    torch.testing.assert_close(
        found["rate"], (coefficients(target) - coefficients(x)) / dt, rtol=0, atol=accuracy / dt
    )
    torch.testing.assert_close(held["xhats"].cpu().double()[:, r:], found["latent"], rtol=1e-6, atol=0)
    torch.testing.assert_close(
        held["residuals"].cpu().double()[:, -1],
        torch.full((runs,), (left / s) ** 0.5).double(),
        rtol=1e-4,
        atol=0,
    )
    taken = (held["updates"].cpu() > 0).sum(1)
    assert held["row"].flatten().tolist() == [1] * runs
    assert (taken < iterations).all() if stops else (taken == iterations).all()


def test_modes_are_taken_in_small_parts():
    """A solver's peak is then what it holds, and not several copies of its modes beside."""
    arena, table = Arena(precision_of("fp64"), warp_device("cpu")), torch.ones(6000, 9, 64)
    rows = torch.arange(6000)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        held = arena.modes(table, rows, torch.float16, torch.ones(64).double()).nbytes
    events = recorded.profiler.kineto_results.events()
    changes = sorted((e.start_ns(), e.nbytes()) for e in events if e.name() == "[memory]")
    assert np.cumsum([size for _, size in changes]).max() < held + 2**24
