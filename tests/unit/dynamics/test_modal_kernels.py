"""Sums over modes are what NumPy makes of them, also at the last particles of the last block."""

import numpy as np
import pytest
import torch
import warp as wp

from nsf.data import TAU_MATRIX
from nsf.dynamics.arena import Arena
from nsf.dynamics.interop import as_vectors
from nsf.dynamics.modal_kernels import make_contraction, make_position
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device

#: Fewer threads in the last block than coefficients, and modes that fill no whole vector of four.
SIZES = [(129, 48), (127, 47), (300, 5)]


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


@pytest.mark.parametrize(("n", "K"), SIZES)
@pytest.mark.parametrize(("components", "coefficients"), [(6, torch.float64), (9, torch.float32)])
def test_contraction(arena, rng, n, K, components, coefficients):
    mean, modes = (values_of(arena, rng, n, components, *more).float() for more in ((), (K,)))
    a = arena.hold(rng.standard_normal(K), coefficients)
    needed = arena.hold(rng.integers(0, 2, n), torch.int32)
    found = arena.zeros(n, 3, 3)
    kernel = make_contraction(arena.precision, -(-K // 4), components == 6, wp.dtype_from_torch(coefficients))
    inputs = [needed, arena.hold(mean, torch.float64), arena.modes(modes), a, found]
    arena.pack(kernel, arena.whole_blocks(components // 3 * n), inputs).launch()
    wp.synchronize_device(arena.device)
    expected = (mean.double() + modes.double() @ a.double()).cpu().numpy()
    expected = expected[:, TAU_MATRIX] if components == 6 else expected.reshape(n, 3, 3)
    expected = expected * needed.cpu().numpy()[:, None, None]
    np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize(("n", "K"), SIZES)
def test_position(arena, rng, n, K, first):
    modes = values_of(arena, rng, n, 3, K).float()
    mean, start = (values_of(arena, rng, n, 3) for _ in range(2))
    a, rate = (values_of(arena, rng, K) for _ in range(2))
    x, v = (arena.zeros(n, 3) for _ in range(2))
    shown = [as_vectors(values, arena.precision) for values in (mean, start, x, v)]
    inputs = [shown[0], arena.modes(modes), a, rate, shown[1], arena.hold([first], torch.int32), *shown[2:]]
    arena.pack(make_position(arena.precision, -(-K // 4)), arena.whole_blocks(n), inputs).launch()
    wp.synchronize_device(arena.device)
    np.testing.assert_allclose(x.cpu(), (mean + modes.double() @ a).cpu(), rtol=1e-12, atol=1e-12)
    expected = start if first else modes.double() @ rate
    np.testing.assert_allclose(v.cpu(), expected.cpu(), rtol=1e-12, atol=1e-12)
