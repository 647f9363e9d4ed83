"""B-splines: partition of unity, first moment, gradient sum, affine inertia (physics.md, section 3)."""

import numpy as np
import pytest
import warp as wp

from nsf.mpm import precision_of
from nsf.mpm.grid.shape import shape_functions

ROUND_OFF = {"fp64": 1e-13, "fp32": 2e-5}
DX = 0.01


def make_evaluate(precision, name):
    """Kernel: nodes of the stencil [b + 1] an axis, weights and slopes [3, b + 1] of each x."""
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, name)
    base_node, local, weights, gradients = shape.base_node, shape.local, shape.weights, shape.gradients

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        x: wp.array(dtype=vec3),
        inv_dx: real,
        base: wp.array(dtype=wp.vec3i),
        w: wp.array3d(dtype=real),
        d: wp.array3d(dtype=real),
    ):
        p = wp.tid()
        b = base_node(x[p], inv_dx)
        f = local(x[p], inv_dx, b)
        weight = weights(f)
        slope = gradients(f)
        base[p] = b
        for axis in range(3):
            for k in range(wp.static(shape.degree + 1)):
                w[p, axis, k] = weight[axis, k]
                d[p, axis, k] = slope[axis, k]

    return evaluate


def evaluate(x, precision, name):
    """Weights w [n, b+1, b+1, b+1], gradients [n, ..., 3] [1/m], nodes [n, ..., 3] [m]."""
    types = precision_of(precision)
    n, width = len(x), shape_functions(types, name).degree + 1
    base = wp.zeros(n, dtype=wp.vec3i, device="cpu")
    w, d = (wp.zeros((n, 3, width), dtype=types.real, device="cpu") for _ in range(2))
    points = wp.array(x, dtype=types.vec3, device="cpu")
    wp.launch(
        make_evaluate(types, name), dim=n, inputs=[points, types.real(1.0 / DX), base, w, d], device="cpu"
    )
    base, w, d = base.numpy(), w.numpy().astype(float), d.numpy().astype(float) / DX
    weight = np.einsum("na,nb,nc->nabc", w[:, 0], w[:, 1], w[:, 2])
    slope = np.stack(
        [
            np.einsum("na,nb,nc->nabc", *(d[:, k] if k == axis else w[:, k] for k in range(3)))
            for axis in range(3)
        ],
        -1,
    )
    steps = np.stack(np.meshgrid(*[np.arange(width)] * 3, indexing="ij"), -1)
    return weight, slope, DX * (base[:, None, None, None] + steps)


@pytest.fixture(params=["quadratic", "cubic"])
def name(request):
    return request.param


@pytest.fixture
def x(rng):
    """Anywhere, and on nodes, faces and half-cells."""
    special = DX * np.array([[10.0, 11.0, 12.0], [10.5, 11.5, 12.5], [10.0, 11.5, 12.25]])
    return np.concatenate([DX * rng.uniform(5.0, 15.0, (500, 3)), special])


def test_sums(x, name, precision):
    """Σw = 1, Σw (x_i − x_p) = 0, Σ∇w = 0."""
    w, slope, nodes = evaluate(x, precision, name)
    eps = ROUND_OFF[precision]
    reach = nodes - x[:, None, None, None]
    assert np.abs(w.sum((1, 2, 3)) - 1.0).max() < eps
    assert np.abs((w[..., None] * reach).sum((1, 2, 3))).max() < eps * DX
    assert np.abs(slope.sum((1, 2, 3))).max() < eps / DX
    assert w.min() >= -eps


def test_gradient_of_a_linear_field_is_exact(x, name, precision):
    """Σ x_i ∇wᵀ = I: what makes the deformation increment exact for a linear velocity."""
    _, slope, nodes = evaluate(x, precision, name)
    reach = nodes - x[:, None, None, None]
    total = np.einsum("nabci,nabcj->nij", reach, slope)
    assert np.abs(total - np.eye(3)).max() < ROUND_OFF[precision]


@pytest.mark.parametrize(("name", "inertia"), [("quadratic", 1.0 / 4.0), ("cubic", 1.0 / 3.0)])
def test_affine_inertia(x, name, inertia, precision):
    """Σ w (x_i − x_p)(x_i − x_p)ᵀ = Δx² D I with D = (b + 1)/12."""
    w, _, nodes = evaluate(x, precision, name)
    reach = nodes - x[:, None, None, None]
    second = np.einsum("nabc,nabci,nabcj->nij", w, reach, reach) / DX**2
    assert np.abs(second - inertia * np.eye(3)).max() < ROUND_OFF[precision]
    assert shape_functions(precision_of(precision), name).affine_inertia == pytest.approx(inertia)


def test_gradients_are_derivatives_of_the_weights(rng, name):
    """Against a central difference, inside a cell of the stencil."""
    offset = 0.5 if name == "quadratic" else 0.0
    x = DX * (np.floor(rng.uniform(5.0, 15.0, (200, 3))) + offset + rng.uniform(0.05, 0.95, (200, 3)))
    h = 1e-5 * DX
    _, slope, _ = evaluate(x, "fp64", name)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        up, down = (evaluate(x + s, "fp64", name)[0] for s in (step, -step))
        assert np.abs((up - down) / (2.0 * h) - slope[..., axis]).max() < 1e-8 / DX


def by_node(nodes, values):
    """Values of one particle's stencil by node."""
    keys = map(tuple, np.round(nodes.reshape(-1, 3) / DX).astype(int))
    return dict(zip(keys, values.reshape(-1, *values.shape[4:]), strict=True))


def test_weights_are_continuous_across_cells(name):
    """Where the stencil shifts by a node no weight jumps, nor its slope."""
    edge = DX * np.array([[10.5, 10.5, 10.5] if name == "quadratic" else [10.0, 10.0, 10.0]])
    (before, after) = (evaluate(edge + s * 1e-12, "fp64", name) for s in (-1.0, 1.0))
    for k, scale in ((0, 1.0), (1, 1.0 / DX)):
        left, right = (by_node(nodes=e[2], values=e[k]) for e in (before, after))
        for node in left.keys() | right.keys():
            assert np.allclose(left.get(node, 0.0), right.get(node, 0.0), rtol=0, atol=1e-7 * scale)
