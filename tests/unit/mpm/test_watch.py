"""What is watched in a full-order run: it stops where law or step no longer hold, and warns before."""

import numpy as np
import pytest

from nsf import config, load_scene
from nsf.errors import InstabilityError
from nsf.mpm import HalfSpace, Motion
from nsf.mpm.stability import multiplied_step_warning
from nsf.pipeline import Pipeline

#: The scene `drop` with a thousand particles.
SMALL = ("scale=small", "scene.dx=0.05", "scene.dt=0.004", "scene.steps=100")


def dropped(E, *overrides):
    """The solver of a ball after its fall."""
    solver = load_scene("drop", [*SMALL, *overrides]).full_order({"E": E}, device="cpu")
    solver.step(100)
    return solver


class TestDrop:
    @pytest.mark.parametrize("E", [300.0, 500.0])
    def test_a_body_that_collapses_is_no_result(self, E):
        with pytest.raises(
            InstabilityError, match=r"collapsed at step 50, .*1/20 of their volume, particle"
        ) as error:
            dropped(E)
        assert "give a stiffer material or a smaller load" in str(error.value)

    def test_a_body_inside_out_is_no_result(self):
        """Gravity in cm/s²."""
        with pytest.raises(
            InstabilityError, match=r"particle 0 is inside out at step 50, .*J = -.*check its unit"
        ):
            dropped(3000.0, "scene.gravity=[0,0,-981]")

    def test_the_scene_itself_is_quiet(self):
        assert dropped(2000.0).warnings == []

    def test_a_run_that_stops_is_no_run(self, tmp_path):
        keys = [*SMALL, "scene=drop", "device=cpu", "scene.design.train=[300,500]", "scene.design.test=[]"]
        chain = Pipeline(config.load(keys), say=lambda line: None, root=tmp_path)
        with pytest.raises(InstabilityError, match="collapsed"):
            chain.run("simulate")


@pytest.fixture
def deformed(block, solver_of):
    """Sets F_e of some particles, in a solver at t = 0."""

    def make(J, particles, **options):
        solver = solver_of(block, **options)
        F = solver.state.F_e.numpy()
        F[particles] = np.diag([1.0, 1.0, J])
        solver.state.F_e.assign(F)
        return solver

    return make


class TestVolume:
    def test_one_particle_inside_out(self, deformed):
        with pytest.raises(
            InstabilityError, match=r"particle 7 is inside out at step 0, t = 0 s: J = -0\.1;"
        ):
            deformed(-0.1, [7, 9]).check()

    @pytest.mark.parametrize("precision", ["fp32", "fp64"])
    def test_flat_within_round_off_is_not_inside_out(self, deformed, precision):
        solver = deformed(-1e-7 if precision == "fp32" else -1e-16, [7], precision=precision)
        solver.check()
        assert solver.warnings == []

    def test_some_collapsed(self, deformed, block):
        solver = deformed(0.02, range(len(block) // 10))
        solver.check()
        (line,) = solver.warnings
        assert line.startswith("10 % of the particles have less than 1/20 of their volume at step 0, t = 0 s")
        solver.restart()
        assert solver.warnings == []

    def test_most_collapsed(self, deformed, block):
        with pytest.raises(InstabilityError, match=r"particle 3 has J = 0\.02"):
            deformed(0.02, range(3, len(block))).check()


class TestSpeed:
    @pytest.mark.parametrize(
        ("cells", "line"), [(0.7, None), (0.9, "a particle moves 90 % of a cell in a step")]
    )
    def test_some_of_a_cell(self, block, solver_of, cells, line):
        v = np.zeros_like(block)
        v[7, 1] = cells / 16.0 / 0.002
        solver = solver_of(block, v=v)
        assert [text.split(" at step")[0] for text in solver.warnings] == ([line] if line else [])

    def test_more_than_a_cell(self, block, solver_of):
        solver = solver_of(block)
        v = np.zeros_like(block)
        v[7, 1] = -1.5 / 16.0 / 0.002
        solver.state.v.assign(v)
        with pytest.raises(
            InstabilityError, match=r"particle 7 moves more than a cell .*\|v\| dt/dx is 1\.5; reduce"
        ):
            solver.check()


class TestContact:
    @pytest.mark.parametrize("motion", [None, Motion((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)))])
    def test_inside_a_solid(self, block, solver_of, motion):
        solver = solver_of(block, colliders=[HalfSpace((0.0, 0.0, 0.1), (0.0, 0.0, 1.0), motion=motion)])
        x = solver.state.x.numpy()
        deep, shallow = np.arange(20), np.arange(20, 60)
        x[deep, 2], x[shallow, 2] = 0.1 - 1.01 / 16.0, 0.1 - 0.99 / 16.0
        solver.state.x.assign(x)
        solver.check()
        assert [line.split(" at step")[0] for line in solver.warnings] == [
            f"{100 * 20 / len(block):.3g} % of the particles are inside a collider by more than dx"
        ]

    def test_where_it_begins_is_no_fault(self, block, solver_of):
        """A grip holds material from the start."""
        assert solver_of(block, colliders=[HalfSpace((0.0, 0.0, 0.5), (0.0, 0.0, 1.0))]).warnings == []


class TestEnergy:
    @staticmethod
    def pushed(solver, speed):
        v = np.zeros((len(solver.state), 3))
        v[:, 0] = speed
        solver.state.v.assign(v)
        solver.check()

    def test_a_little(self, block, solver_of):
        v = np.full_like(block, 0.0)
        v[:, 0] = 1.0
        solver = solver_of(block, v=v)
        self.pushed(solver, 1.1)
        (line,) = solver.warnings
        assert "rose by 17.4 % of the largest kinetic energy at step 0, t = 0 s, and nothing did work" in line

    def test_of_gravity(self, block, solver_of):
        """A free fall: the body moves, and no energy is made."""
        solver = solver_of(block, gravity=(0.0, 0.0, -9.81), check_every=1)
        solver.step(30)
        assert solver.warnings == []

    def test_where_a_solid_does_work(self, block, solver_of):
        lift = Motion((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)))
        solver = solver_of(block, colliders=[HalfSpace((0.0, 0.0, 0.05), (0.0, 0.0, 1.0), motion=lift)])
        self.pushed(solver, 2.0)
        assert solver.warnings == []

    def test_after_a_hand_took_hold(self, block, solver_of):
        solver = solver_of(block)
        solver.forcing.gravity = (0.0, 0.0, 1.0)
        self.pushed(solver, 2.0)
        assert solver.warnings == []


@pytest.mark.parametrize(("multiplier", "warned"), [(1.0, False), (1.5, False), (8.0, True)])
def test_a_reduced_step_that_is_far_too_long(multiplier, warned):
    """c dt/dx = 0.8 at full order, the most of the stock scenes; the paper multiplies it by up to 1.5."""
    line = multiplied_step_warning(multiplier, 0.8, 1.0)
    assert bool(line) is warned
    if warned:
        assert "deploy.dt_multiplier=8: in a reduced step c dt/dx is 6.4" in line
        assert multiplied_step_warning(float(line.split()[-1]), 0.8, 1.0) is None
