"""The paper's contact scenes at small scale: full-order runs show what section 6 says of them."""

import numpy as np
import pytest

import nsf

SMALL = "scale=small"


def run(name, value, *overrides, until=1.0, every=None):
    """The scene, x and v [f, P, 3] after each `every` steps or the last of `until` of them, mass [P, 1]."""
    scene = nsf.load_scene(name, [SMALL, *overrides])
    scene = scene.at(scene.case(value))
    solver = scene.full_order(device="cpu")
    steps = round(until * scene.steps)
    x, v = [], []
    for _ in range(max(1, steps // (every or steps))):
        solver.step(every or steps)
        state = solver.state.numpy()
        x.append(state["x"].copy())
        v.append(state["v"].copy())
    return scene, np.array(x), np.array(v), scene.particles().mass[:, None]


def mean(values, mass):
    return (mass * values).sum(-2) / mass.sum()


def angular_momentum(x, v, mass):
    """[..., 3] about the own centre [kg m²/s]."""
    x, v = x - mean(x, mass)[..., None, :], v - mean(v, mass)[..., None, :]
    return (mass * np.cross(x, v)).sum(-2)


def kinetic_energy(v, mass):
    return 0.5 * (mass * v**2).sum((-2, -1))


class TestJellyCube:
    @staticmethod
    def spin(*overrides):
        """Angular velocity [3] of the cube after the hit, in units of its first speed over its edge."""
        scene, x, v, mass = run("jelly_cube", 0.5, *overrides, until=0.6)
        n = next(iter(scene.bodies.values())).particles
        lower, upper = next(iter(scene.bodies.values())).shape.bounds
        edge = (upper - lower)[0]
        inertia = mass[:n].sum() * edge**2 / 6.0
        return angular_momentum(x[-1, :n], v[-1, :n], mass[:n]) / inertia * edge / 0.5

    def test_spins_after_the_hit(self):
        """About the horizontal axis across its flight: its top goes on, its bottom is held back."""
        spin = self.spin()
        assert spin[1] > 0.2
        assert np.abs(spin[[0, 2]]).max() < 0.1 * spin[1]

    def test_sense_of_the_spin_follows_the_side_of_the_hit(self):
        """On a free wall amid the domain: none at its middle, at its foot the reverse of that at its top."""
        free = ["~scene.colliders.floor", *self.box("wall", [0.52, 0.38], [0.64, 0.62], 0.5, 0.125)]

        def spin(height):
            return self.spin(*free, *self.box("cube", [0.29, 0.42], [0.45, 0.58], 0.5 + height, 0.08))[1]

        top, central, foot = spin(0.125), spin(0.0), spin(-0.125)
        assert foot == pytest.approx(-top, rel=0.15)
        assert abs(central) < 0.05 * top

    @staticmethod
    def box(body, lower, upper, middle, half):
        """Overrides that give a body these sides, and the height [m] middle ± half."""
        shape = f"scene.bodies.{body}.shape"
        return f"{shape}.lower={[*lower, middle - half]}", f"{shape}.upper={[*upper, middle + half]}"

    def test_momentum_is_conserved_where_no_boundary_acts(self):
        """Through the hit, the floor taken away; with it the wall is held, and momentum is lost."""
        drift = {}
        for name, overrides in {"free": ["~scene.colliders.floor"], "held": []}.items():
            scene, _, v, mass = run("jelly_cube", 0.5, *overrides, until=0.6)
            before = (mass * scene.initial_velocity()).sum(0)
            after = (mass * v[-1]).sum(0)
            drift[name] = np.linalg.norm(after - before) / np.linalg.norm(before)
        assert drift["free"] < 1e-12
        assert drift["held"] > 0.1


class TestSquishyBall:
    @pytest.fixture(scope="class")
    @classmethod
    def tilted(cls):
        return {angle: run("squishy_ball", angle, until=0.75, every=8) for angle in (15.0, 0.0, -15.0)}

    def test_rolls_down_the_plane(self, tilted):
        """To +x and about +y at a positive inclination, the reverse at a negative one, nowhere at none."""
        moved, spin = {}, {}
        for angle, (scene, x, v, mass) in tilted.items():
            moved[angle] = (mean(x[-1], mass) - mean(scene.particles().X, mass))[0]
            spin[angle] = angular_momentum(x[-1], v[-1], mass)
        for angle in (15.0, -15.0):
            assert moved[angle] * angle > 0
            assert spin[angle][1] * angle > 0
            assert abs(moved[angle]) > 0.04
            assert abs(moved[0.0]) < 0.2 * abs(moved[angle])
            assert abs(spin[0.0][1]) < 0.2 * abs(spin[angle][1])

    def test_tentacles_touch_each_other(self, tilted):
        """Particles of different tentacles share a cell, hence every node about it."""
        scene, x, _, _ = tilted[15.0]
        shape, X = next(iter(scene.bodies.values())).shape, scene.particles().X
        outer = np.linalg.norm(X - shape.centre, axis=1) > shape.radius + 0.5 * shape.length
        # Farther apart than this at rest, two of them are not of one tentacle.
        widest = np.hypot(0.5 * shape.length, 2.0 * shape.tentacle_radius)

        def touching(positions):
            """Pairs of such particles in a cell, counting neighbours in a list of the cell alone."""
            cells = np.floor(positions[outer] / scene.dx).astype(int)
            order = np.lexsort(cells.T)
            same = (np.diff(cells[order], axis=0) == 0).all(1)
            rest = X[outer][order]
            return int((same & (np.linalg.norm(np.diff(rest, axis=0), axis=1) > widest)).sum())

        contacts = [touching(frame) for frame in x]
        assert touching(X) == 0
        assert max(contacts) >= 10


class TestToothpaste:
    @staticmethod
    def lay(angle, *overrides):
        """The run, its plane, and the speed [m/s] of its middle down the brush in the last tenth."""
        scene, x, v, mass = run("toothpaste", angle, *overrides, every=10)
        plane = scene.solids[0]
        down = np.cross([0.0, 1.0, 0.0], plane.extents)
        creep = (mean(x[-1], mass) - mean(x[-2], mass)) @ down / (10 * scene.dt)
        return scene, plane, x, v, mass, creep

    @pytest.fixture(scope="class")
    @classmethod
    def laid(cls):
        return {angle: cls.lay(angle) for angle in (0.0, 10.0, 20.0)}

    def test_comes_to_lie_on_the_brush(self, laid):
        for angle, (scene, plane, x, v, mass, _) in laid.items():
            energy = kinetic_energy(v, mass)
            assert energy[-1] < 0.03 * energy.max(), angle
            height = (x[-1] - plane.position) @ plane.extents
            assert height.min() > -scene.dx
            # Thinner than the ribbon was, as it spreads.
            assert height.max() < 2.0 * next(iter(scene.bodies.values())).shape.radius

    def test_creeps_down_faster_on_a_steeper_brush(self, laid):
        creep = {angle: case[-1] for angle, case in laid.items()}
        assert abs(creep[0.0]) < 0.1 * creep[10.0]
        assert creep[20.0] > 1.3 * creep[10.0]

    def test_yield_stress_holds_it(self, laid):
        """Twenty times the yield stress, and it stays where it fell."""
        assert abs(self.lay(20.0, "material.yield_stress=1.0")[-1]) < 0.2 * laid[20.0][-1]
