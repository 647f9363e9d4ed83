"""Thin parts and few particles are found and warned of; the scenes that are shipped are not."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from meshes import cube, torus, turned, write

from nsf import load_scene
from nsf.scenes import Ball, Box, Cylinder, Frame, Mesh, Ribbon, TentacleBall
from nsf.scenes.resolution import resolution_warnings, thinnest_part

ZIGZAG = [(0.2, 0.5, 0.5), (0.5, 0.5, 0.5), (0.5, 0.8, 0.5), (0.5, 0.7, 0.9)]


@dataclass(frozen=True)
class Chair(Box):
    """Four legs, a seat and a back."""

    parts: tuple = ()

    def contains(self, x):
        return np.any([part.contains(x) for part in self.parts], axis=0)


LEG = 0.027
CHAIR = Chair(
    (0.3, 0.3, 0.2),
    (0.6, 0.6, 0.7),
    (
        *(Box((x, y, 0.2), (x + LEG, y + LEG, 0.4)) for x in (0.3, 0.573) for y in (0.3, 0.573)),
        Box((0.3, 0.3, 0.4), (0.6, 0.6, 0.46)),
        Box((0.3, 0.3, 0.46), (0.6, 0.36, 0.7)),
    ),
)

KNOWN = {
    "box": (Box((0.1, 0.2, 0.3), (0.5, 0.4, 0.9)), 0.2),
    "slab": (Box((0.2, 0.2, 0.4), (0.8, 0.8, 0.45)), 0.05),
    "rod": (Box((0.2, 0.2, 0.4), (0.8, 0.23, 0.44)), 0.03),
    "cylinder": (Cylinder((0.5, 0.5, 0.13), 0.1, 0.3), 0.2),
    "thin cylinder": (Cylinder((0.5, 0.5, 0.13), 0.02, 0.4), 0.04),
    "ball": (Ball((0.5, 0.4, 0.3), 0.2), 0.4),
    "frame": (Frame((0.2, 0.4, 0.3), (0.8, 0.6, 0.7), 0.1), 0.1),
    "flat frame": (Frame((0.2, 0.4, 0.3), (0.8, 0.45, 0.7), 0.1), 0.05),
    "ribbon": (Ribbon(ZIGZAG, 0.06), 0.12),
    "tentacles": (TentacleBall((0.5, 0.5, 0.5), 0.15, 40, 0.1, 0.02), 0.04),
    "chair": (CHAIR, LEG),
}
MESHES = {
    "rod": (cube((0.0, 0.0, 0.0), (0.05, 0.05, 0.5)), 0.05),
    "torus": (torus(0.3, 0.05), 0.1),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_thickness(name):
    shape, thickness = KNOWN[name]
    for cells in (0.3, 1.8):
        assert thinnest_part(shape, thickness / cells, None) == pytest.approx(thickness, rel=0.08)
    assert thinnest_part(shape, thickness / 2.5, None) > 1.9 * thickness / 2.5


@pytest.mark.parametrize("name", MESHES)
def test_known_thickness_of_a_mesh(tmp_path, name):
    (vertices, faces), thickness = MESHES[name]
    shape = Mesh(write(tmp_path, (vertices @ turned().T, faces)))
    assert thinnest_part(shape, thickness, None) == pytest.approx(thickness, rel=0.08)
    assert thinnest_part(shape, thickness / 2.5, None) > 1.9 * thickness / 2.5


def test_blunt_edges_and_tips_are_not_thin(tmp_path):
    vertices = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 1.0
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    for rotation in (np.eye(3), turned()):
        tetrahedron = Mesh(write(tmp_path, (vertices @ rotation.T, faces), name=f"t{rotation[0, 0]:.3f}"))
        assert thinnest_part(tetrahedron, 0.1, None) == np.inf


def test_a_part_that_no_point_of_the_lattice_hits():
    """A slanting wire in a large box."""
    ends = np.array([(0.1, 0.1, 0.1), (0.9, 0.83, 0.77)])
    points = ends[0] + np.linspace(0.1, 0.9, 20)[:, None] * (ends[1] - ends[0])
    assert 8e-4 < thinnest_part(Ribbon(ends.tolist(), 2e-3), 0.2, points) < 4.8e-3


def test_thin_legs():
    """A chair of such legs fell into loose spheres on this grid; what the line names does."""
    leg = "{_target_: nsf.scenes.Box, lower: [0.4, 0.4, 0.2], upper: [0.427, 0.427, 0.6]}"

    def told(dx, particles):
        body = f"{{_target_: nsf.scenes.Body, shape: {leg}, density: 100, particles: {particles}}}"
        return resolution_warnings(
            load_scene("sand", ["~scene.bodies.column", f"scene.dx={dx}", f"+scene.bodies.leg={body}"])
        )

    (line,) = told(0.04, 50)
    assert line.startswith("scene.bodies.leg: its thinnest part is 0.027 m, 0.67 cells across")
    dx, particles = re.search(r"set scene\.dx=([\d.]+) or finer, .* at least (\d+) particles", line).groups()
    assert float(dx) == pytest.approx(0.013)
    assert told(dx, int(particles)) == []
    assert len(told(dx, int(0.9 * int(particles)))) == 1


def test_few_particles():
    (line,) = resolution_warnings(load_scene("sand", ["scene.bodies.column.particles=300"]))
    assert line.startswith("scene.bodies.column: 300 particles are 0.64 a cell")
    more = re.search(r"set (scene\.bodies\.column\.particles=\d+) or more", line)[1]
    assert resolution_warnings(load_scene("sand", [more])) == []


def test_a_body_that_reaches_into_the_walls():
    (line,) = resolution_warnings(load_scene("sand", ["scene.walls.padding=12"]))
    assert re.search(r"column: \d+ % of its particles lie in scene\.walls\.padding=12 nodes", line)
