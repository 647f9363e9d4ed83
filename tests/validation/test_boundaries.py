"""Boundary conditions of the grid: sticky, slip, separate, Coulomb friction, walls."""

import numpy as np
import pytest
import warp as wp

from nsf.mpm import (
    BoundaryArrays,
    DomainWalls,
    Forcing,
    Grid,
    GridGeometry,
    GridStep,
    HalfSpace,
    Transfer,
    precision_of,
)

DX = 1.0 / 8.0
NODES = 9
INNER = (4, 4, 4)
FACES = [(axis, side) for axis in range(3) for side in ("low", "high")]


def update(
    v, colliders=(), walls=DomainWalls("separate", 1), gravity=(0.0, 0.0, 0.0), mass=2.0, precision="fp64"
):
    """Velocity of every node [9, 9, 9, 3] after a grid update that starts from v at every node."""
    types = precision_of(precision)
    geometry = GridGeometry.of_domain((1.0, 1.0, 1.0), DX)
    # Every node is listed: of a box, only blocks that particles reach are updated.
    grid = Grid(geometry, types, "cpu", nodes=np.arange(geometry.count))
    boundaries = BoundaryArrays(colliders, walls, types, "cpu")
    forcing = Forcing([gravity], boundaries, types, "cpu")
    step = GridStep(grid, forcing, Transfer(), 0.1, types, wp.get_device("cpu"))
    grid.mass.fill_(mass)
    grid.momentum.assign(np.tile(np.asarray(v, types.numpy) * types.numpy(mass), (grid.count, 1)))
    step.update()
    return grid.momentum.numpy().reshape(NODES, NODES, NODES, 3).astype(float)


def solid(kind, friction=0.0, normal=(0.0, 0.0, 1.0), point=(0.5, 0.5, 0.55)):
    return HalfSpace(point, normal, kind, friction)


#: kind, friction, velocity, what is left of it; the normal is +z.
CONTACTS = [
    ("sticky", 0.0, (3.0, 1.0, -2.0), (0.0, 0.0, 0.0)),
    ("sticky", 0.0, (3.0, 1.0, 2.0), (0.0, 0.0, 0.0)),
    ("slip", 0.0, (3.0, 1.0, -2.0), (3.0, 1.0, 0.0)),
    ("slip", 0.0, (3.0, 1.0, 2.0), (3.0, 1.0, 0.0)),
    ("slip", 0.5, (3.0, 0.0, -2.0), (2.0, 0.0, 0.0)),
    ("slip", 0.5, (3.0, 0.0, 2.0), (3.0, 0.0, 0.0)),  # nothing presses, so nothing rubs
    ("separate", 0.0, (3.0, 1.0, -2.0), (3.0, 1.0, 0.0)),
    ("separate", 0.0, (3.0, 1.0, 2.0), (3.0, 1.0, 2.0)),
    ("separate", 0.5, (3.0, 4.0, -2.0), (2.4, 3.2, 0.0)),  # |v_t| = 5 falls by 0.5 · 2
    ("separate", 0.5, (3.0, 4.0, 2.0), (3.0, 4.0, 2.0)),
    ("separate", 2.6, (3.0, 4.0, -2.0), (0.0, 0.0, 0.0)),  # 5.2 > 5: it sticks
    ("separate", 0.5, (0.0, 0.0, -2.0), (0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
@pytest.mark.parametrize(("kind", "friction", "v", "left"), CONTACTS)
def test_half_space(kind, friction, v, left, precision):
    after = update(v, [solid(kind, friction)], precision=precision)
    eps = 1e-14 if precision == "fp64" else 1e-6
    np.testing.assert_allclose(after[INNER], left, atol=eps)  # z = 0.5, inside the solid
    np.testing.assert_allclose(after[4, 4, 5], v, atol=eps)  # z = 0.625, outside


@pytest.mark.parametrize(("kind", "friction", "v", "left"), CONTACTS)
def test_half_space_turns_with_its_normal(kind, friction, v, left, rng, rotation):
    """In any frame; the normal need not have length 1."""
    for Q in rotation(rng, 5):
        collider = solid(kind, friction, normal=3.0 * Q[:, 2], point=np.full(3, 0.5) + 0.05 * Q[:, 2])
        np.testing.assert_allclose(update(Q @ v, [collider])[INNER], Q @ left, atol=1e-13)


@pytest.mark.parametrize("round_off", [-1e-9, 0.0, 1e-9])
def test_a_node_on_the_surface_belongs_to_the_solid(round_off):
    after = update((0.0, 0.0, -1.0), [solid("sticky", point=(0.5, 0.5, 0.5 + round_off))])
    assert (after[INNER] == 0.0).all()
    assert (after[4, 4, 3] == 0.0).all()
    assert (after[4, 4, 5] == [0.0, 0.0, -1.0]).all()


def test_half_spaces_apply_in_order():
    """A corner of two slip planes stops both directions; the third stays."""
    corner = [solid("slip"), solid("slip", normal=(1.0, 0.0, 0.0), point=(0.55, 0.5, 0.5))]
    np.testing.assert_allclose(update((-1.0, 2.0, -3.0), corner)[INNER], [0.0, 2.0, 0.0], atol=1e-14)


def test_gravity_acts_before_the_contact():
    after = update((0.0, 0.0, 0.5), [solid("separate")], gravity=(0.0, 0.0, -10.0))
    np.testing.assert_allclose(after[INNER], 0.0, atol=1e-14)
    np.testing.assert_allclose(after[4, 4, 5], [0.0, 0.0, -0.5], atol=1e-14)


@pytest.mark.parametrize("padding", [1, 3])
@pytest.mark.parametrize(("axis", "side"), FACES)
@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
@pytest.mark.parametrize("outward", [True, False])
def test_walls(kind, axis, side, padding, outward):
    """Each face stops what its kind forbids, `padding` nodes deep and not a node deeper."""
    v = np.array([0.7, 0.8, 0.9])
    v[axis] = 2.0 if (side == "high") == outward else -2.0
    after = update(v, walls=DomainWalls(kind, padding))
    tangential = v.copy()
    tangential[axis] = 0.0
    expected = {"sticky": np.zeros(3), "slip": tangential, "separate": tangential if outward else v}[kind]
    for depth in range(padding + 1):
        node = list(INNER)
        node[axis] = depth if side == "low" else NODES - 1 - depth
        np.testing.assert_allclose(after[tuple(node)], expected if depth < padding else v, atol=1e-14)


def test_empty_nodes_are_left_alone():
    assert (update((1.0, 1.0, 1.0), [solid("sticky")], gravity=(0.0, 0.0, -1.0), mass=0.0) == 0.0).all()
