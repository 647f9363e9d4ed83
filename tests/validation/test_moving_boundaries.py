"""Solids that move: grips, plates, belts, spheres, blades; their time level and their frames."""

import itertools
import math

import numpy as np
import pytest
import warp as wp

from nsf.mpm import (
    BoundaryArrays,
    Cuboid,
    DomainWalls,
    Forcing,
    Grid,
    GridGeometry,
    GridStep,
    HalfSpace,
    Motion,
    Sphere,
    Transfer,
    precision_of,
)
from nsf.mpm.materials import FixedCorotated
from nsf.vectors import rotation

DX = 1.0 / 16.0
# Nodes that no wall touches.
NODES = DX * np.stack(np.meshgrid(*[np.arange(1, 16)] * 3, indexing="ij"), -1)
STILL = np.zeros(3)
MIDDLE = (0.5, 0.5, 0.5)
Z = (0.0, 0.0, 1.0)


def updated(v, colliders, step=0, dt=0.01, precision="fp64"):
    """Velocity of the nodes [15, 15, 15, 3] after grid update number `step`, from v at every node."""
    types = precision_of(precision)
    geometry = GridGeometry.of_domain((1.0, 1.0, 1.0), DX)
    # Every node is listed: of a box, only blocks that particles reach are updated.
    grid = Grid(geometry, types, "cpu", nodes=np.arange(geometry.count))
    boundaries = BoundaryArrays(colliders, DomainWalls("separate", 1), types, "cpu")
    forcing = Forcing([(0.0, 0.0, 0.0)], boundaries, types, "cpu")
    work = GridStep(grid, forcing, Transfer(), dt, types, wp.get_device("cpu"))
    boundaries.steps.fill_(step)
    grid.mass.fill_(1.0)
    grid.momentum.assign(np.tile(v, (grid.count, 1)).astype(types.numpy))
    work.update()
    return grid.momentum.numpy().reshape(17, 17, 17, 3)[1:-1, 1:-1, 1:-1].astype(float)


def turned_at(motion, t):
    """d(t) and R(t) of a motion, by NumPy's interpolation."""
    times, translations, angles = motion.keyframes()
    d = np.array([np.interp(t, times, translations[:, a]) for a in range(3)])
    return d, rotation(motion.hinge()[0], math.degrees(np.interp(t, times, angles)))


# -- prescribed velocity --------------------------------------------------------------------------------

PULL = Motion((0.1, 0.4, 0.55), ((0.0, 0.0, 0.0), (0.03, -0.06, 0.0), (0.03, -0.06, 0.045)))


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (0, (0.0, 0.0, 0.0)),
        (1, (0.075, -0.15, 0.0)),  # from 0.08 to 0.16 s, of which 0.06 s move
        (3, (0.1, -0.2, 0.0)),
        (6, (0.0, 0.0, 0.3)),
        (7, (0.0, 0.0, 0.1)),  # stops at 0.55 s
        (8, (0.0, 0.0, 0.0)),
    ],
)
def test_nodes_of_a_grip_take_the_mean_velocity_of_the_step(step, expected, precision):
    grip = Cuboid(MIDDLE, (0.25, 0.25, 0.25), motion=PULL)
    dt = 0.08 if step < 3 else 0.075
    after = updated((5.0, 6.0, 7.0), [grip], step, dt, precision)
    held = (np.abs(NODES - 0.5 - turned_at(PULL, step * dt)[0]) <= 0.125 + 1e-6).all(-1)
    assert 27 <= held.sum() <= 125
    np.testing.assert_allclose(
        after[held], np.tile(expected, (held.sum(), 1)), atol=1e-13 if precision == "fp64" else 1e-6
    )
    assert (after[~held] == (5.0, 6.0, 7.0)).all()


SWING = Motion(
    (0.05, 0.2, 0.4),
    ((0.0, 0.0, 0.0), (0.05, 0.0, 0.02), (0.02, -0.04, 0.0)),
    (0.0, 25.0, -10.0),
    (1.0, 2.0, 3.0),
    (0.4, 0.55, 0.5),
)


@pytest.mark.parametrize("dt", [0.0023, 0.0031])  # neither meets the keyframes
@pytest.mark.parametrize("motion", [PULL, SWING], ids=["translation", "rotation"])
def test_what_a_grip_holds_moves_as_the_grip(motion, dt, solver_of, rng):
    """x = pivot + R(X − pivot) + d to round-off at every time, and no strain: F_e = R."""
    X = rng.uniform(0.45, 0.55, (60, 3))
    grip = Cuboid(MIDDLE, (0.6, 0.6, 0.6), motion=motion)
    solver = solver_of(X, DX / 2, DX, dt, colliders=[grip], v=np.tile([1.0, -2.0, 0.5], (60, 1)))
    pivot = motion.hinge()[1]
    for _ in range(6):
        solver.step(32)
        d, R = turned_at(motion, solver.time)
        state = solver.state.numpy()
        np.testing.assert_allclose(state["x"], pivot + (X - pivot) @ R.T + d, atol=1e-12)
        np.testing.assert_allclose(state["F_e"], np.broadcast_to(R, (60, 3, 3)), atol=1e-11)
    assert solver.time > 0.4


def test_a_rotating_blade_moves_its_nodes_at_omega_cross_r():
    """To first order in Δt, and of second order to ω × r at the middle of the step."""
    omega, pivot = 3.0, np.array([0.3, 0.5, 0.5])
    motion = Motion((0.0, 1.0), angles=(0.0, math.degrees(omega)), axis=Z, pivot=pivot)
    # Held at t = 0.1, where it has turned by 0.3 rad.
    blade = Cuboid(MIDDLE, (0.5, 0.01, 0.5), motion=motion)
    error, midpoint = [], []
    for dt in (0.02, 0.01):
        after = updated((50.0, 50.0, 50.0), [blade], round(0.1 / dt), dt)
        held = (after != 50.0).any(-1)
        R = rotation(np.array(Z), math.degrees(0.3))
        local = (NODES - pivot) @ R
        inside = (np.abs(local - [0.2, 0.0, 0.0]) <= [0.25, 0.75 * DX, 0.25 + 1e-6]).all(-1)
        assert (held == inside).all()
        assert inside.sum() > 30
        r = NODES[inside] - pivot
        spin = np.cross([0.0, 0.0, omega], r)
        later = rotation(np.array(Z), math.degrees(0.5 * omega * dt))
        error.append(np.abs(after[inside] - spin).max())
        midpoint.append(np.abs(after[inside] - spin @ later.T).max())
        assert error[-1] <= 0.5 * omega**2 * dt * np.linalg.norm(r, axis=1).max()
    assert error[0] / error[1] == pytest.approx(2.0, rel=0.01)
    assert midpoint[0] / midpoint[1] == pytest.approx(4.0, rel=0.01)


# -- plates and belts -----------------------------------------------------------------------------------


def block_of(lattice, lower, upper):
    return lattice(lower, upper, DX / 2)


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_a_pushed_block_takes_the_velocity_of_the_plate(kind, lattice, solver_of):
    """PIC damps the waves in it; a weak gravity holds it to the plate that may separate."""
    X = block_of(lattice, (0.25, 0.375, 0.375), (0.5, 0.625, 0.625))
    plate = Cuboid(
        (0.125, 0.5, 0.5), (0.25, 0.5, 0.5), kind, motion=Motion((0.0, 1.0), (STILL, (0.6, 0.0, 0.0)))
    )
    solver = solver_of(
        X, DX / 2, DX, 0.002, (2.0, 1.0, 1.0), material=FixedCorotated(100.0, 0.3), colliders=[plate],
        transfer=Transfer("pic"), gravity=(-8.0, 0.0, 0.0),
    )  # fmt: skip
    solver.step(400)
    v, moved = solver.state.v.numpy(), (solver.state.x.numpy() - X).mean(0)
    np.testing.assert_allclose(v.mean(0), [0.6, 0.0, 0.0], atol=0.02)
    assert np.abs(v - [0.6, 0.0, 0.0]).max() < 0.05
    assert moved[0] == pytest.approx(0.6 * solver.time, abs=0.5 * DX)


BELT, FRICTION, G = 0.5, 0.3, 10.0


@pytest.mark.parametrize("shape", ["half-space", "cuboid"])
def test_a_belt_carries_a_block_up_to_its_speed(shape, lattice, solver_of):
    """v = μ g t until t = V/(μ g), then V; the block has then slipped back by half of its way."""
    h, floor = 1.0 / 32.0, np.array([0.25, 0.375, 0.5 + 1e-9])
    X = floor + lattice([0.0] * 3, [0.25, 0.25, 0.125], h)
    motion = Motion((0.0, 1.0), (STILL, (BELT, 0.0, 0.0)))
    contact = {"kind": "separate", "friction": FRICTION, "motion": motion}
    belt = (
        HalfSpace(floor, Z, **contact)
        if shape == "half-space"
        else Cuboid(floor - [-0.1, -0.1, 0.2], (1.6, 1.6, 0.4), **contact)
    )
    end, steps = 0.25, 2000
    solver = solver_of(
        X, h, DX, end / steps, material=FixedCorotated(3e4, 0.3), gravity=(0.0, 0.0, -G), colliders=[belt]
    )
    solver.step(steps // 2)
    assert solver.state.v.numpy()[:, 0].mean() == pytest.approx(FRICTION * G * end / 2, rel=0.02)
    solver.step(steps // 2)
    start = BELT / (FRICTION * G)
    assert start < end
    assert solver.state.v.numpy()[:, 0].mean() == pytest.approx(BELT, rel=0.02)
    moved = (solver.state.x.numpy() - X).mean(0)
    assert moved[0] == pytest.approx(BELT * (end - 0.5 * start), abs=1e-3)
    assert np.abs(moved[1:]).max() < 1e-3


# -- spheres --------------------------------------------------------------------------------------------

BALL, RADIUS = np.array([0.5, 0.53, 0.47]), 0.22


def sphere_normals():
    r = NODES - BALL
    held = np.linalg.norm(r, axis=-1) <= RADIUS
    return held, r[held] / np.linalg.norm(r[held], axis=-1, keepdims=True)


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_a_sphere_stops_what_its_kind_forbids(kind):
    v = np.array([0.4, -0.7, 0.2])
    after = updated(v, [Sphere(BALL, RADIUS, kind)])
    held, n = sphere_normals()
    along = (n @ v)[:, None]
    expected = {
        "sticky": 0.0 * n,
        "slip": v - along * n,
        "separate": np.where(along < 0, v - along * n, v),
    }[kind]
    np.testing.assert_allclose(after[held], expected, atol=1e-14)
    assert held.sum() > 100


def test_a_spinning_sphere_drags_along():
    """Enough friction gives the surface's own velocity; a little changes v by μ |v_n| towards it."""
    omega, dt = np.array([0.0, 0.0, 2.0]), 1e-8
    motion = Motion((0.0, 1.0), ((0.1, 0.0, 0.0), (0.1, 0.3, 0.0)), (0.0, math.degrees(2.0)), Z, BALL)
    centre = BALL - [-0.1, 0.0, 0.0]
    inside = np.linalg.norm(NODES - centre, axis=-1) <= RADIUS
    r = NODES[inside] - centre
    n = r / np.linalg.norm(r, axis=-1, keepdims=True)
    solid = np.cross(omega, r) + np.array([0.0, 0.3, 0.0])
    relative = np.array([-0.3, 0.1, -0.4]) - solid
    normal_speed = (relative * n).sum(1, keepdims=True)
    tangential = relative - normal_speed * n
    speed = np.linalg.norm(tangential, axis=1, keepdims=True)
    for friction in (0.1, 50.0):
        after = updated((-0.3, 0.1, -0.4), [Sphere(BALL, RADIUS, "separate", friction, motion=motion)], dt=dt)
        left = np.maximum(0.0, 1.0 - friction * -normal_speed / speed) * tangential
        expected = solid + np.where(normal_speed < 0, left, relative)
        np.testing.assert_allclose(after[inside], expected, atol=1e-5)


@pytest.mark.parametrize(("kind", "leaves"), [("separate", True), ("slip", False)])
def test_a_ball_falls_on_a_sphere(kind, leaves, lattice, solver_of):
    """It lifts off a separating sphere; a slip sphere lets no normal motion go and holds it."""
    X = block_of(lattice, (0.375, 0.375, 0.53), (0.625, 0.625, 0.78))
    X = X[np.linalg.norm(X - [0.5, 0.5, 0.655], axis=1) < 0.125]
    support = Sphere((0.5, 0.5, 0.3), 0.2, kind)
    solver = solver_of(
        X, DX / 2, DX, 0.002, material=FixedCorotated(50.0, 0.2), colliders=[support],
        v=np.tile([0.0, 0.0, -0.3], (len(X), 1)),
    )  # fmt: skip
    solver.step(300)
    v, x = solver.state.v.numpy(), solver.state.x.numpy()
    assert np.abs(v.mean(0)[:2]).max() < 1e-6  # head-on
    if leaves:
        assert 0.1 < v[:, 2].mean() < 0.3
        assert np.linalg.norm(x - [0.5, 0.5, 0.3], axis=1).min() > 0.2 + DX
    else:
        assert np.linalg.norm(x - [0.5, 0.5, 0.3], axis=1).min() < 0.2 + DX
        assert abs(v[:, 2].mean()) < 0.1


# -- blades ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [-0.5, -0.2, 0.0, 0.3, 0.49])
@pytest.mark.parametrize("kind", ["sticky", "slip"])
def test_a_blade_thinner_than_a_cell_parts_a_block(kind, offset, lattice, solver_of):
    """One half is pushed or pulled; none of it reaches the other, wherever the blade lies in a cell."""
    plane = 0.5 + offset * DX
    half = block_of(lattice, (0.0, 0.375, 0.375), (0.25, 0.625, 0.625))
    half[:, 0] += 0.77 * DX - half[:, 0].min()
    X = np.concatenate([half * [side, 1.0, 1.0] + [plane, 0.0, 0.0] for side in (-1.0, 1.0)])
    left = X[:, 0] < plane
    blade = Cuboid((plane, 0.5, 0.5), (0.01 * DX, 0.8, 0.8), kind)
    for speed in (-0.2, 0.02):
        v = np.where(left[:, None], [speed, 0.0, 0.0], 0.0)
        options = {"colliders": [blade], "v": v, "material": FixedCorotated(10.0, 0.3)}
        solver = solver_of(X, DX / 2, DX, 0.002, **options)
        solver.step(10)
        moved = solver.state.x.numpy() - X
        if kind == "sticky":
            assert (moved[~left] == 0.0).all()
        else:  # what slides along a slip blade still meets in its nodes
            assert np.abs(moved[~left][:, 0]).max() < 1e-3 * np.abs(moved[left][:, 0]).max()
        assert np.abs(moved[left][:, 0] / (speed * solver.time)).max() > 0.5
        whole = solver_of(X, DX / 2, DX, 0.002, **(options | {"colliders": []}))
        whole.step(10)
        without = np.abs(whole.state.x.numpy() - X)[~left][:, 0].max()
        assert without > 0.01 * np.abs(moved[left][:, 0]).max()  # otherwise the test shows nothing


@pytest.mark.parametrize("angle", [0.0, 17.0, 30.0, 45.0, 71.0])
@pytest.mark.parametrize("axis", [Z, (1.0, 1.0, 0.0), (1.0, -2.0, 0.7)])
def test_no_neighbouring_nodes_face_each_other_across_a_blade(axis, angle, rng):
    """At any angle and place: no gap, and the layer is 1.5 Δx thick."""
    R = rotation(np.array(axis) / np.linalg.norm(axis), angle)
    for _ in range(5):
        centre = 0.5 + rng.uniform(-DX, DX, 3)
        blade = Cuboid(centre, (1e-6, 3.0, 3.0), axis=axis, angle=angle)
        held = (updated((9.0, 9.0, 9.0), [blade]) == 0.0).all(-1)
        side = ((NODES - centre) @ R)[..., 0]
        assert (held == (np.abs(side) <= (0.75 + 1e-4) * DX)).all()
        free = np.where(held, 0.0, np.sign(side))
        for a in range(3):
            assert (np.take(free, range(14), a) * np.take(free, range(1, 15), a) >= 0.0).all()


def test_a_tilted_box_pushes_along_its_nearest_face():
    R = rotation(np.array(Z), 30.0)
    box = Cuboid(MIDDLE, (0.5, 0.3, 0.4), "slip", angle=30.0)
    v = np.array([1.0, 2.0, 3.0])
    after = updated(v, [box])
    local = (NODES - 0.5) @ R
    depth = np.abs(local) - [0.25, 0.15, 0.2]
    held = (depth <= 0).all(-1)
    # Nodes as near to one face as to another may go with either.
    clear = held & (np.diff(np.sort(depth, -1), axis=-1)[..., 1] > 1e-9)
    n = R[:, depth[clear].argmax(-1)].T
    np.testing.assert_allclose(after[clear], v - (n @ v)[:, None] * n, atol=1e-14)
    assert clear.sum() > 100


# -- release --------------------------------------------------------------------------------------------


def acts(step, dt, **when):
    return bool((updated((1.0, 1.0, 1.0), [Sphere(MIDDLE, 0.2, **when)], step, dt)[7, 7, 7] == 0.0).all())


@pytest.mark.parametrize("n", range(1, 31))
@pytest.mark.parametrize("dt", [0.1, 0.7])
def test_a_collider_acts_in_the_steps_that_start_in_its_span(dt, n):
    """In binary 3 · 0.1 is above 0.3, and 3 · 0.7 below 2.1; either counts as that time."""
    time = round(dt * n, 1)
    assert acts(n - 1, dt, until=time)
    assert not acts(n, dt, until=time)
    assert not acts(n - 1, dt, since=time)
    assert acts(n, dt, since=time)


def test_what_a_grip_lets_go_moves_freely(solver_of, rng):
    """Lifted at 0.4 m/s until 0.1 s, then thrown: x = x₀ + 0.04 + 0.4 s − ½ g s (s + Δt)."""
    X = rng.uniform(0.3, 0.35, (20, 3))
    lift = Motion((0.0, 1.0), (STILL, (0.0, 0.0, 0.4)))
    dt = 0.0025
    grip = Cuboid((0.3, 0.3, 0.3), (0.5, 0.5, 0.5), motion=lift, until=0.1)
    solver = solver_of(X, DX / 2, DX, dt, colliders=[grip], gravity=(0.0, 0.0, -9.0))
    solver.step(40)
    np.testing.assert_allclose(solver.state.x.numpy() - X, np.tile([0.0, 0.0, 0.04], (20, 1)), atol=1e-13)
    solver.step(40)
    s = 0.1
    rise = 0.04 + 0.4 * s - 0.5 * 9.0 * s * (s + dt)
    np.testing.assert_allclose(solver.state.x.numpy() - X, np.tile([0.0, 0.0, rise], (20, 1)), atol=1e-12)


# -- frames ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_frames_that_move_are_equal(kind, lattice, solver_of):
    """A plate that turns and pushes a falling block, seen from a frame that moves by a cell a step.

    Nodes lie alike in both frames, so the relative motion is the same to round-off, provided that the pose
    and the particles are of one time.
    """
    dt, steps = 0.002, 40
    frame = np.array([-DX / dt, 0.0, 0.0])
    X = block_of(lattice, (3.25, 0.375, 0.375), (3.5, 0.625, 0.625)) + 1e-3
    pushed = np.array([(0.0, 0.0, 0.0), (0.06, 0.01, 0.0), (0.15, 0.0, 0.0)])
    times = np.array([0.0, 0.033, 0.1])
    moved = []
    for velocity in (np.zeros(3), frame):
        motion = Motion(
            times, pushed + times[:, None] * velocity, (0.0, 4.0, -3.0), (0.2, 0.3, 1.0), (3.1, 0.5, 0.5)
        )
        plate = Cuboid(
            (3.12, 0.5, 0.5), (0.24, 0.4, 0.4), kind, 0.0 if kind == "sticky" else 0.4, motion=motion
        )
        solver = solver_of(
            X, DX / 2, DX, dt, (4.0, 1.0, 1.0), material=FixedCorotated(30.0, 0.3), colliders=[plate],
            v=np.tile(velocity, (len(X), 1)), gravity=(0.0, 0.0, -2.0),
        )  # fmt: skip
        solver.step(steps)
        moved.append(solver.state.x.numpy() - X - solver.time * velocity)
    assert np.abs(moved[0]).max() > 0.05
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-10)


# -- scenes at rest -------------------------------------------------------------------------------------


def test_a_mover_elsewhere_leaves_every_bit(lattice, solver_of):
    """Colliders at rest stay where they are, to the last bit, when another one moves."""
    X = block_of(lattice, (0.375, 0.375, 0.375), (0.625, 0.625, 0.625))
    rest = [
        HalfSpace((0.5, 0.5, 0.36), (0.1, 0.2, 1.0), "separate", 0.3),
        Cuboid((0.3, 0.5, 0.5), (0.2, 0.6, 0.7), "slip", angle=10.0),
        Sphere((0.5, 0.75, 0.5), 0.15, "slip", 0.1),
    ]
    far = Sphere((0.85, 0.15, 0.85), 0.1, motion=Motion((0.0, 0.5), (STILL, (0.05, 0.0, 0.0))))
    states = []
    for colliders in (rest, [*rest, far]):
        solver = solver_of(X, DX / 2, DX, 0.002, colliders=colliders, gravity=(0.0, 1.0, -9.0))
        solver.step(60)
        states.append(solver.state.numpy())
    assert all(np.array_equal(states[0][k], states[1][k]) for k in states[0])


def test_colliders_meet_in_order():
    """Where two grips overlap, the later one decides."""
    grips = [
        Cuboid(MIDDLE, (0.3, 0.3, 0.3), motion=Motion((0.0, 1.0), (STILL, d)))
        for d in ((0.1, 0.0, 0.0), (0.0, 0.2, 0.0))
    ]
    for order in itertools.permutations((0, 1)):
        after = updated(STILL, [grips[k] for k in order])[7, 7, 7]
        np.testing.assert_allclose(after, [[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]][order[1]], atol=1e-15)
