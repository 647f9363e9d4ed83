"""Bodies from mesh files: what is inside, where they stand, and what is refused."""

import builtins
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from meshes import FORMATS, cube, joined, sphere, torus, turned, write

from nsf import load_scene
from nsf.errors import ConfigError
from nsf.scenes import Ball, Box, Mesh, mesh_or_ball
from nsf.scenes.shapes import mesh
from nsf.scenes.shapes.winding import WindingNumber


def solid_angles(triangles, x):
    """Winding numbers by summed solid angles (van Oosterom and Strackee 1983): another method entirely."""
    found = np.empty(len(x))
    for i, p in enumerate(x):
        a, b, c = np.moveaxis(triangles - p, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        above = (a * np.cross(b, c)).sum(1)
        below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        found[i] = 2.0 * np.arctan2(above, below).sum() / (4.0 * np.pi)
    return found


@pytest.mark.parametrize("form", FORMATS)
class TestFormats:
    def test_cube(self, tmp_path, form):
        body = Mesh(write(tmp_path, cube((0.25, 0.25, 0.125), (0.75, 0.5, 1.0)), form))
        box = Box((0.25, 0.25, 0.125), (0.75, 0.5, 1.0))
        assert body.volume == pytest.approx(box.volume, rel=1e-12)
        np.testing.assert_array_equal(body.bounds, box.bounds)
        x = np.random.default_rng(0).random((5000, 3))
        np.testing.assert_array_equal(body.contains(x), box.contains(x))

    def test_sphere(self, tmp_path, form):
        body = Mesh(write(tmp_path, sphere(4), form))
        assert 0.99 * 4.0 / 3.0 * np.pi < body.volume < 4.0 / 3.0 * np.pi
        x = np.random.default_rng(0).uniform(-1.0, 1.0, (5000, 3))
        r = np.linalg.norm(x, axis=1)
        clear = (r < 0.99) | (r > 1.0)
        np.testing.assert_array_equal(body.contains(x)[clear], r[clear] < 1.0)

    def test_cut_short(self, tmp_path, form):
        path = Path(write(tmp_path, sphere(2), form))
        path.write_bytes(path.read_bytes()[: int(0.7 * path.stat().st_size)])
        with pytest.raises(ConfigError, match=re.escape(str(path))):
            Mesh(str(path))


@pytest.mark.parametrize("rotation", [np.eye(3), turned(2.1, (0.3, -1.0, 0.2))])
class TestInside:
    def test_torus(self, tmp_path, rotation):
        vertices, faces = torus()
        body = Mesh(write(tmp_path, (vertices @ rotation.T, faces)))
        lower, upper = body.bounds
        x = np.random.default_rng(1).uniform(lower, upper, (300, 3))
        expected = solid_angles(vertices[faces] @ rotation.T, x)
        assert np.abs(expected - expected.round()).max() < 1e-9
        np.testing.assert_array_equal(body.contains(x), expected.round() == 1)
        assert 0.1 < body.contains(x).mean() < 0.6

    def test_volume_against_counting(self, tmp_path, rotation):
        vertices, faces = torus()
        body = Mesh(write(tmp_path, (vertices @ rotation.T, faces)))
        lower, upper = body.bounds
        counted = [
            body.contains(np.random.default_rng(seed).uniform(lower, upper, (25_000, 3))).mean()
            for seed in range(4)
        ]
        error = 3.0 * (np.mean(counted) * (1 - np.mean(counted)) / 100_000) ** 0.5
        assert body.volume / np.prod(upper - lower) == pytest.approx(np.mean(counted), abs=error)
        # n m-gons swept round: below the smooth torus by (2π²/3)(1/n² + 1/m²).
        assert body.volume == pytest.approx(2 * np.pi**2 * 0.3 * 0.1**2, rel=0.02)


class TestLinesThroughEdgesAndCorners:
    def test_cube_of_aligned_faces(self):
        """Every line passes vertices, edges or diagonals of the 3-fold subdivided cube."""
        box = Box((0.25, 0.25, 0.25), (0.75, 0.75, 0.75))
        parts = [
            cube(np.array(k) / 8 + 0.25, np.array(k) / 8 + 0.375)
            for k in np.ndindex(4, 4, 4)
            if k != (1, 1, 1)
        ]
        vertices, faces = joined(*parts)
        merged, index = np.unique(vertices, axis=0, return_inverse=True)
        faces = index.ravel()[faces]
        # Faces between two small cubes are there twice, once each way: they cancel.
        x = np.stack(np.meshgrid(*[np.arange(33) / 32.0] * 3, indexing="ij"), -1).reshape(-1, 3)
        offset = np.array([0.0, 0.0, 1.0 / 64.0])
        number = WindingNumber(merged[faces]).of(x + offset)
        hole = Box((0.375, 0.375, 0.375), (0.5, 0.5, 0.5))
        inner = box.contains(x + offset) & ~hole.contains(x + offset)
        on_side = np.isin(x[:, :2], [0.25, 0.375, 0.5, 0.75]).any(1)
        assert set(np.unique(number)) == {0, 1}
        np.testing.assert_array_equal(number[~on_side], inner[~on_side])

    @pytest.mark.parametrize("seed", range(2))
    def test_walls_that_all_but_stand_upright(self, seed):
        """Their height above a point is rounding; still nothing is inside between two cubes."""
        vertices, faces = joined(cube(), cube((0.0, 0.0, 2.0), (1.0, 1.0, 3.0)))
        vertices[:, 0] += 1e-16 * vertices[:, 2]
        vertices = vertices @ turned(0.3 + seed, (0.0, 0.0, 1.0)).T
        t = np.random.default_rng(seed).random((300, 1))
        walls = np.concatenate(
            [vertices[a] + t * (vertices[b] - vertices[a]) for a, b in ((0, 2), (0, 4), (2, 6))]
        )
        surface = WindingNumber(vertices[faces])
        for z in np.linspace(1.01, 1.99, 9):
            assert not surface.of(np.column_stack([walls[:, :2], np.full(len(walls), z)])).any()

    @pytest.mark.parametrize("seed", range(2))
    def test_sphere(self, seed):
        """Points below and above every vertex, edge middle and face middle."""
        vertices, faces = sphere(3)
        vertices = vertices @ turned(seed).T
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        below = np.concatenate([vertices, 0.5 * (a + b), (a + b + c) / 3.0])
        below = below[np.linalg.norm(below[:, :2], axis=1) < 0.97]
        surface = WindingNumber(vertices[faces])
        for z, expected in ((-0.99, 0), (0.0, 1), (0.99, 0)):
            x = np.column_stack([below[:, :2], np.full(len(below), z)])
            x = x[np.abs(np.linalg.norm(x, axis=1) - 1.0) > 0.02]
            inside = (np.linalg.norm(x, axis=1) < 1.0).astype(int)
            np.testing.assert_array_equal(surface.of(x), inside)
            if z == 0.0:
                assert inside.min() == expected


def test_long_triangles_share_coarser_cells():
    """A thousand needles across the whole mesh: memory stays bounded, the answer stays."""
    n = 1000
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    vertices = np.concatenate([ring, [[0.0, 0.0, 1.0], [0.3, 0.1, -1.0]]])
    k = np.arange(n)
    top = np.column_stack([k, (k + 1) % n, np.full(n, n)])
    bottom = np.column_stack([(k + 1) % n, k, np.full(n, n + 1)])
    triangles = vertices[np.concatenate([top, bottom])] @ turned(1.2).T
    surface = WindingNumber(triangles)
    assert surface._order.size <= 64 * (len(triangles) + 1)
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))
    np.testing.assert_array_equal(surface.of(x), solid_angles(triangles, x).round())


def test_portions_make_no_difference(monkeypatch):
    vertices, faces = torus()
    surface = WindingNumber(vertices[faces])
    x = np.random.default_rng(0).uniform(-0.4, 0.4, (2000, 3))
    whole = surface.of(x)
    monkeypatch.setattr("nsf.scenes.shapes.winding._PAIRS", 50)
    np.testing.assert_array_equal(surface.of(x), whole)


class TestPlacement:
    def test_height_and_base(self, tmp_path):
        body = Mesh(write(tmp_path, cube((1.0, 2.0, 3.0), (2.0, 4.0, 6.0))), height=0.3, base=(0.5, 0.4, 0.1))
        np.testing.assert_allclose(body.bounds, [(0.45, 0.3, 0.1), (0.55, 0.5, 0.4)])
        assert body.volume == pytest.approx(0.1 * 0.2 * 0.3)
        x = [[0.46, 0.31, 0.11], [0.44, 0.31, 0.11], [0.46, 0.31, 0.09]]
        assert body.contains(np.array(x)).tolist() == [True, False, False]

    def test_height_alone_keeps_the_origin(self, tmp_path):
        body = Mesh(write(tmp_path, cube((1.0, 2.0, 3.0), (2.0, 4.0, 6.0))), height=1.5)
        np.testing.assert_allclose(body.bounds, [(0.5, 1.0, 1.5), (1.0, 2.0, 3.0)])

    @pytest.mark.parametrize(("up", "order"), [("x", [1, 2, 0]), ("y", [2, 0, 1]), ("z", [0, 1, 2])])
    def test_up(self, tmp_path, up, order):
        """The axes are exchanged in a cycle: nothing is mirrored."""
        vertices, faces = torus()
        vertices = vertices @ turned().T * [1.0, 2.0, 3.0]
        body = Mesh(write(tmp_path, (vertices, faces)), up=up)
        np.testing.assert_allclose(body.bounds[1], vertices.max(0)[order])
        x = np.random.default_rng(0).uniform(vertices.min(0), vertices.max(0), (2000, 3))
        upright = Mesh(write(tmp_path, (vertices, faces)))
        np.testing.assert_array_equal(body.contains(x[:, order]), upright.contains(x))
        assert body.volume == pytest.approx(upright.volume)

    def test_needle(self, tmp_path):
        """Read at once, whatever its share of the cube about it; its points would take days to find."""
        body = Mesh(write(tmp_path, cube((0.5, 0.5, 0.0), (0.50001, 0.50001, 1.0))))
        assert body.volume == pytest.approx(1e-10)
        with pytest.raises(ConfigError, match="cannot be placed in a shape that fills 1e-10 of the cube"):
            body.sample(100)

    def test_relative_path(self, tmp_path, monkeypatch):
        write(tmp_path, cube())
        monkeypatch.chdir(tmp_path)
        assert Mesh("body.obj").volume == pytest.approx(1.0)


class TestMending:
    def test_faces_that_all_point_inwards_are_turned(self, tmp_path):
        vertices, faces = torus()
        body = Mesh(write(tmp_path, (vertices, faces[:, ::-1])))
        right = Mesh(write(tmp_path, (vertices, faces), name="right"))
        assert body.volume == pytest.approx(right.volume, rel=1e-12)
        assert body.volume > 0.0
        x = np.random.default_rng(0).uniform(*body.bounds, (2000, 3))
        np.testing.assert_array_equal(body.contains(x), right.contains(x))

    def test_cavity(self, tmp_path):
        inner, faces = cube((0.25, 0.25, 0.25), (0.75, 0.75, 0.75))
        body = Mesh(write(tmp_path, joined(cube(), (inner, faces[:, ::-1]))))
        assert body.volume == pytest.approx(0.875)
        assert body.contains(np.array([[0.5, 0.5, 0.5], [0.1, 0.5, 0.5]])).tolist() == [False, True]

    def test_parts_apart(self, tmp_path):
        body = Mesh(write(tmp_path, joined(cube(), cube((2.0, 0.0, 0.0), (3.0, 1.0, 1.0)))))
        assert body.volume == pytest.approx(2.0)

    def test_empty_faces_and_double_vertices(self, tmp_path):
        vertices, faces = cube()
        vertices = vertices[faces].reshape(-1, 3)
        faces = np.concatenate([np.arange(36).reshape(12, 3), [[0, 0, 1]]])
        assert Mesh(write(tmp_path, (vertices, faces))).volume == pytest.approx(1.0)


class TestSampling:
    @pytest.fixture
    def body(self, tmp_path):
        vertices, faces = torus()
        return Mesh(write(tmp_path, (vertices @ turned().T, faces)), height=0.4, base=(0.5, 0.5, 0.2))

    def test_inside_and_continued(self, body):
        x = body.sample(3000)
        assert body.contains(x).all()
        np.testing.assert_array_equal(body.sample(1000, 2000), x[2000:])
        np.testing.assert_array_equal(replace(body).sample(3000), x)

    def test_even(self, body):
        """Each octant of the torus gets its share."""
        x = body.sample(8000) - 0.5 * np.sum(body.bounds, axis=0)
        share = np.bincount((x @ turned() > 0.0) @ [4, 2, 1], minlength=8) / 8000
        np.testing.assert_allclose(share, 0.125, atol=0.004)


def refused(path, *words):
    with pytest.raises(ConfigError) as caught:
        Mesh(str(path))
    for word in (str(path), *words):
        assert word in str(caught.value)


class TestRefused:
    def test_missing(self, tmp_path):
        refused(tmp_path / "bunny.obj", "is no file", str(Path.cwd()))

    def test_folder(self, tmp_path):
        (tmp_path / "body.obj").mkdir()
        refused(tmp_path / "body.obj", "is no file")

    @pytest.mark.parametrize("name", ["body.glb", "body.pkl", "body", "body.obj.gz"])
    def test_extension(self, tmp_path, name):
        (tmp_path / name).write_bytes(b"x")
        refused(tmp_path / name, "is not supported", ".obj, .ply, .stl")

    @pytest.mark.parametrize("extension", mesh.EXTENSIONS)
    @pytest.mark.parametrize("content", [b"", b"\x00\xff" * 200, b"hello\n", b"ply\nformat ascii 1.0\n"])
    def test_no_mesh(self, tmp_path, extension, content):
        path = tmp_path / f"body{extension}"
        path.write_bytes(content)
        refused(path)

    @pytest.mark.parametrize("form", FORMATS)
    def test_no_faces(self, tmp_path, form):
        refused(write(tmp_path, (cube()[0], np.empty((0, 3), int)), form))

    def test_not_finite_is_named(self, tmp_path):
        vertices, faces = cube()
        vertices[[3, 5], 1] = np.nan, np.inf
        refused(write(tmp_path, (vertices, faces), "binary ply"), "2 vertices are not finite")

    def test_open_edges_are_counted(self, tmp_path):
        vertices, faces = cube()
        refused(write(tmp_path, (vertices, faces[1:])), "3 of its 18 edges")

    def test_face_turned(self, tmp_path):
        vertices, faces = cube()
        faces[0] = faces[0, ::-1]
        refused(write(tmp_path, (vertices, faces)), "3 of its 18 edges have opposite orientations")

    def test_part_turned(self, tmp_path):
        far, faces = cube((2.0, 0.0, 0.0), (2.5, 1.0, 1.0))
        refused(
            write(tmp_path, joined(cube(), (far, faces[:, ::-1]))),
            "body 2 of 2 (12 faces from",
            "is inside out",
        )

    def test_parts_overlap(self, tmp_path):
        refused(write(tmp_path, joined(cube(), cube((0.5, 0.2, 0.2), (1.5, 0.6, 0.7)))), "overlaps itself")

    def test_corners_overlap(self, tmp_path):
        """No face's middle lies in the other cube."""
        parts = cube(), cube((0.8, 0.8, 0.8), (1.8, 1.8, 1.8))
        refused(write(tmp_path, joined(*parts)), "of its bounding box")

    def test_small_part_inside_another(self, tmp_path):
        """Too small for the points of the bounding box; its faces' middles show it."""
        parts = cube(), cube((0.5, 0.5, 0.5), (0.501, 0.501, 0.501))
        refused(write(tmp_path, joined(*parts)), "body 2 of 2", "lies inside another")

    def test_surface_through_itself(self, tmp_path):
        """One connected sphere, its top pushed down and out through its bottom."""
        vertices, faces = sphere(3)
        vertices[vertices[:, 2] > 0.8, 2] -= 2.5
        refused(write(tmp_path, (vertices, faces)), "overlaps itself")

    def test_doubled(self, tmp_path):
        refused(write(tmp_path, joined(cube(), cube()), "stl"), "12 of its 24 faces are there twice")

    @pytest.mark.parametrize("rotation", [np.eye(3), turned()])
    def test_flat(self, tmp_path, rotation):
        vertices, faces = cube((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))
        refused(write(tmp_path, (vertices @ rotation.T, faces)), "encloses no volume")

    def test_too_large(self, tmp_path, monkeypatch):
        path = write(tmp_path, cube())
        monkeypatch.setattr(mesh, "_MAX_BYTES", 100)
        refused(path, "decimate")

    @pytest.mark.parametrize(
        ("values", "quoted"),
        [
            ({"height": 0.0}, "mesh height=0.0"),
            ({"height": float("nan")}, "mesh height=nan"),
            ({"base": (0.5, 0.5)}, "mesh base=(0.5, 0.5)"),
            ({"up": "w"}, "mesh up='w'"),
        ],
    )
    def test_values(self, tmp_path, values, quoted):
        with pytest.raises(ConfigError, match=re.escape(quoted)):
            Mesh(write(tmp_path, cube()), **values)


def test_nothing_the_file_names_is_opened(tmp_path, monkeypatch):
    path = Path(write(tmp_path, cube()))
    (tmp_path / "secret.mtl").write_text("newmtl m\nmap_Kd secret.png\n")
    lines = path.read_text().splitlines()
    path.write_text("\n".join(["mtllib secret.mtl", *lines[:8], "usemtl m", *lines[8:], ""]))
    opened, through = [], builtins.open

    def recorded(file, *args, **kwargs):
        opened.append(str(file))
        return through(file, *args, **kwargs)

    monkeypatch.setattr(builtins, "open", recorded)
    assert Mesh(str(path)).volume == pytest.approx(1.0)
    assert not [file for file in opened if "secret" in file]


def test_a_changed_file_is_read_again(tmp_path):
    before = Mesh(write(tmp_path, cube()))
    after = Mesh(write(tmp_path, cube(upper=(1.0, 1.0, 2.0))))
    assert (before.volume, after.volume) == (pytest.approx(1.0), pytest.approx(2.0))
    assert before.files.keys() == after.files.keys()
    assert before.files != after.files


class TestDrop:
    def test_ball_without_a_mesh(self):
        scene = load_scene("drop")
        assert next(iter(scene.bodies.values())).shape == Ball((0.5, 0.5, 0.3), 0.15)
        assert scene.files == {}
        np.testing.assert_array_equal(mesh_or_ball(None, 0.3, (0.5, 0.5, 0.15)).bounds[0], (0.35, 0.35, 0.15))

    def test_mesh(self, tmp_path):
        path = write(tmp_path, sphere(3))
        scene = load_scene("drop", [f"scene.geometry.mesh={path}", "scene.geometry.height=0.2"])
        body, particles = next(iter(scene.bodies.values())), scene.particles()
        assert body.shape == Mesh(path, 0.2, [0.5, 0.5, 0.15])
        assert body.particles == round(8 * body.shape.volume / scene.dx**3) == len(particles)
        assert list(scene.files) == [path]
        scene.full_order({"E": 2000.0}, device="cpu").step()

    def test_outside_the_domain(self, tmp_path):
        path = write(tmp_path, cube())
        with pytest.raises(ConfigError, match=r"reaches outside the domain .*; move it or make it smaller"):
            load_scene("drop", [f"scene.geometry.mesh={path}", "scene.geometry.height=0.9"])

    def test_missing_mesh(self):
        with pytest.raises(ConfigError, match=r"mesh path=bunny\.obj is no file"):
            load_scene("drop", ["scene.geometry.mesh=bunny.obj"])


def test_faces_without_an_area_are_refused(tmp_path):
    path = tmp_path / "odd.obj"
    path.write_text("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n")
    with pytest.raises(ConfigError, match="no face with an area"):
        Mesh(str(path))


def test_a_mesh_in_millimetres(tmp_path):
    path = tmp_path / "box.obj"
    corners = [f"v {x} {y} {z}\n" for x in (0, 300) for y in (0, 200) for z in (0, 100)]
    faces = ["f 1 2 4 3\n", "f 5 7 8 6\n", "f 1 5 6 2\n", "f 3 4 8 7\n", "f 1 3 7 5\n", "f 2 6 8 4\n"]
    path.write_text("".join(corners + faces))
    assert Mesh(str(path), unit="mm").volume == pytest.approx(0.006)
    with pytest.raises(ConfigError, match="both scale the mesh; leave one out"):
        Mesh(str(path), height=0.1, unit="mm")
    with pytest.raises(ConfigError, match="unit='inch' is unknown; choose m, cm, mm"):
        Mesh(str(path), unit="inch")
