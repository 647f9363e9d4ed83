"""Mesh files as programs write them, and as they arrive: read right, or refused as what they are."""

import itertools
import struct

import numpy as np
import pytest
from meshes import FORMATS, cube, joined, write

from nsf.errors import ConfigError
from nsf.scenes import Mesh
from nsf.scenes.shapes import polygons

#: A box of 3 × 2 × 1, its faces as quads, anticlockwise from outside.
BOX = [(0, 0, 0), (3, 0, 0), (3, 2, 0), (0, 2, 0), (0, 0, 1), (3, 0, 1), (3, 2, 1), (0, 2, 1)]
QUADS = [(3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


def obj(vertices=BOX, faces=QUADS, index=lambda i: str(i + 1)):
    """OBJ text, each corner written by `index`."""
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    return "\n".join([*lines, *("f " + " ".join(index(i) for i in face) for face in faces), ""])


def prism(outline):
    """Vertices and faces, two of them the polygon, over an anticlockwise outline [n, 2]."""
    n = len(outline)
    vertices = [(x, y, z) for z in (0, 1) for x, y in outline]
    sides = [(i, (i + 1) % n, n + (i + 1) % n, n + i) for i in range(n)]
    return vertices, [tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides]


def ply(order="<", vertices=BOX, faces=QUADS, counted=None, size="uchar", more=""):
    """Binary PLY: order `<` or `>`, `counted` faces by its header, property `more` after each list."""
    kind = {"<": "little", ">": "big"}[order]
    head = [
        "ply", f"format binary_{kind}_endian 1.0", "comment made by a test",
        f"element vertex {len(vertices)}",
        "property float x", "property float y", "property float z", f"element face {counted or len(faces)}",
        f"property list {size} int vertex_index", *([more] if more else []), "end_header", "",
    ]  # fmt: skip
    code = {"uchar": "B", "ushort": "H", "uint": "I"}[size]
    rows = [struct.pack(f"{order}3f", *v) for v in vertices]
    rows += [
        struct.pack(f"{order}{code}{len(f)}i{'B' if more else ''}", len(f), *f, *b"x"[: bool(more)])
        for f in faces
    ]
    return "\n".join(head).encode() + b"".join(rows)


def mesh(folder, content, name="body.obj"):
    """The mesh of a file with this content."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return Mesh(str(path))


def refused(folder, content, name, *words):
    with pytest.raises(ConfigError) as caught:
        mesh(folder, content, name)
    for word in words:
        assert word in str(caught.value)


class TestObj:
    def test_relative_indices_count_from_the_last_vertex_read(self, tmp_path):
        """The vertices of another part come after the faces; they are no business of these."""
        later = "".join(f"v {0.2 * x} {0.2 * y} {0.2 * z}\n" for x, y, z in BOX)
        body = mesh(tmp_path, obj(index=lambda i: str(i - 8)) + later)
        assert body.volume == pytest.approx(6.0)
        assert body.bounds[1].tolist() == [3.0, 2.0, 1.0]

    @pytest.mark.parametrize(
        "change",
        [
            lambda text: text.replace(" ", "\t"),
            lambda text: "\ufeff" + text,
            lambda text: text.replace("\n", "\r\n"),
            lambda text: text.replace("\n", "\r"),
            lambda text: text.replace("\n", "  # 1 2 3\n"),
            lambda text: text.replace("f 4 3", "f 4 \\\n 3"),
            lambda text: text.replace("f ", "fo "),
            lambda text: "\n# v 9 9 9\n\no part\ng side\ns off\nusemtl f\nl 1 2\np 1\n" + text,
            lambda text: text.replace("0 0 0\n", "0 0 0 1.0\n").replace("v 3 2 1\n", "v 3 2 1 0.5 0.5 0.5\n"),
            lambda text: "\n".join(sorted(text.splitlines(), key=lambda line: line[0])),
            lambda text: text.rstrip(),
        ],
        ids=[
            "tabs",
            "mark",
            "crlf",
            "cr",
            "comments",
            "continued",
            "fo",
            "statements",
            "colours",
            "faces first",
            "end",
        ],
    )
    def test_written_otherwise(self, tmp_path, change):
        changed = change(obj())
        assert changed != obj()
        assert mesh(tmp_path, changed).volume == pytest.approx(6.0)

    def test_corners_with_and_without_texture_and_normal(self, tmp_path):
        forms = itertools.cycle(["{}", "{}/2", "{}//3", "{}/2/3", "{}/", "{}/-1/-1"])
        text = "vt 0 0\nvt 1 1\nvn 0 0 1\nvn 0 1 0\nvn 1 0 0\n" + obj(
            index=lambda i: next(forms).format(i + 1)
        )
        assert mesh(tmp_path, text).volume == pytest.approx(6.0)

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ("f 1 2 6 5", "f 0 1 5 4", ["statement 11", "`f 0 1 5 4`", "vertex 0", "counts from 1"]),
            ("f 1 2 6 5", "f -9 2 6 5", ["statement 11", "vertex -9, of 8 read so far"]),
            ("f 1 2 6 5", "f 1 2 6 9", ["a face names vertex 8 of 8"]),
            ("f 1 2 6 5", "f 1 2", ["a face has 2 corners"]),
            ("f 1 2 6 5", "f 1 2 6 99999999999999999999", ["statement 11"]),
            ("v 3 0 0", "v 3,0 0,0 0,0", ["statement 2", "3,0"]),
            ("v 3 0 0", "v 3 nan 0", ["1 vertices are not finite"]),
            ("v 3 0 0", "call other.obj\nv 3 0 0", ["has `call`"]),
            ("v 3 0 0", "surf 0 1 0 1 1 2 3 4\nv 3 0 0", ["has `surf`"]),
        ],
    )
    def test_refused(self, tmp_path, old, new, words):
        text = obj()
        assert old in text
        refused(tmp_path, text.replace(old, new, 1), "body.obj", *words)

    @pytest.mark.parametrize("form", ["utf-16", "utf-16-be"])
    def test_wide_text(self, tmp_path, form):
        refused(tmp_path, ("\ufeff" * (form != "utf-16") + obj()).encode(form), "body.obj", "UTF-16")


ARROW = [(0, 0), (3, 3), (0, 1), (-3, 3)]
L = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]


class TestPolygons:
    @pytest.mark.parametrize(
        ("outline", "area"),
        [
            (ARROW, 3.0),
            (L, 5.0),
            ([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)], 4.0),
            (
                [
                    (0, 0),
                    (6, 0),
                    (6, 3),
                    (5, 3),
                    (5, 1),
                    (4, 1),
                    (4, 3),
                    (2, 3),
                    (2, 1),
                    (1, 1),
                    (1, 3),
                    (0, 3),
                ],
                14.0,
            ),
            # A square with a square hole, a bridge to it and back.
            ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], 12.0),
        ],
        ids=["arrow", "L", "corners on edges", "two slots", "bridge"],
    )
    def test_concave(self, outline, area):
        """From each first corner, from below, and turned in space."""
        for shift, turn in itertools.product(range(len(outline)), (0.0, 0.9)):
            vertices, faces = prism(outline[shift:] + outline[:shift])
            y, z = np.array(vertices, float).T[1:]
            turned = np.array(vertices, float)
            turned[:, 1], turned[:, 2] = (
                np.cos(turn) * y - np.sin(turn) * z,
                np.sin(turn) * y + np.cos(turn) * z,
            )
            triangles = polygons.triangulated(
                turned, np.concatenate(faces), np.array([len(face) for face in faces])
            )
            corner = turned[triangles]
            volume = (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum() / 6.0
            assert volume == pytest.approx(area, rel=1e-9)
            if turn == 0.0:
                areas = np.linalg.norm(
                    np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
                )
                flat = (corner[:, :, 2] == corner[:, :1, 2]).all(1)
                assert 0.5 * areas[flat].sum() == pytest.approx(2.0 * area)

    @pytest.mark.parametrize("outline", [ARROW, L])
    @pytest.mark.parametrize("name", ["body.obj", "body.ply"])
    def test_concave_in_files(self, tmp_path, outline, name):
        vertices, faces = prism(outline)
        content = obj(vertices, faces) if name == "body.obj" else ply("<", vertices, faces)
        assert mesh(tmp_path, content, name).volume == pytest.approx({4: 3.0, 6: 5.0}[len(outline)])

    def test_spiral_of_many_corners(self):
        t = np.linspace(0.0, 6.0 * np.pi, 300)
        arm = np.stack([(1 + t) * np.cos(t), (1 + t) * np.sin(t)], 1)
        outline = np.concatenate([arm, arm[::-1] * (1 - 0.5 / (1 + t[::-1, None]))])
        x, y = outline.T
        area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
        outline = outline if area > 0 else outline[::-1]
        vertices = np.column_stack([outline, np.zeros(len(outline))])
        triangles = polygons.triangulated(vertices, np.arange(len(x)), np.array([len(x)]))
        a, b, c = np.moveaxis(vertices[triangles], 1, 0)
        areas = np.cross(b - a, c - a)[:, 2]
        assert len(triangles) == len(x) - 2
        assert areas.min() >= 0.0
        assert 0.5 * areas.sum() == pytest.approx(abs(area))

    def test_edges_that_cross(self, tmp_path):
        bow = prism([(0, 0), (3, 2), (3, 0), (0, 1)])
        refused(tmp_path, obj(*bow), "body.obj", "4 corners crosses itself", "export it as triangles")

    def test_too_many_corners_to_clip(self, tmp_path, monkeypatch):
        monkeypatch.setattr(polygons, "MAX_CORNERS", 5)
        refused(tmp_path, obj(*prism(L)), "body.obj", "6 corners")


class TestPly:
    @pytest.mark.parametrize(
        ("order", "size", "more"),
        [("<", "uchar", ""), (">", "ushort", "property uchar flags"), (">", "uint", "")],
    )
    def test_quads_and_triangles(self, tmp_path, order, size, more):
        mixed = [(3, 2, 1), (3, 1, 0), *QUADS[1:]]
        for faces in (QUADS, mixed, mixed[::-1]):
            assert mesh(
                tmp_path, ply(order, BOX, faces, None, size, more), "body.ply"
            ).volume == pytest.approx(6.0)

    def test_text(self, tmp_path):
        rows = [" ".join(map(str, v)) for v in BOX] + [" ".join(map(str, (len(f), *f))) for f in QUADS[1:]]
        rows += ["3 3 2 1", "3 3 1 0"]
        head = ply(counted=7).split(b"end_header")[0].decode().replace("binary_little_endian", "ascii")
        for end in ("\n", "\r\n", "\r"):
            text = (head + "end_header\n" + "\n".join(rows) + "\n").replace("\n", end)
            assert mesh(tmp_path, text, "body.ply").volume == pytest.approx(6.0)
            assert mesh(tmp_path, "\ufeff" + text, "body.ply").volume == pytest.approx(6.0)

    def test_binary_after_a_head_with_carriage_returns(self, tmp_path):
        head, body = ply().split(b"end_header\n")
        content = head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body
        assert mesh(tmp_path, content, "body.ply").volume == pytest.approx(6.0)

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (ply(counted=7), ["is cut short", "counts 7 rows of face, 6 are there"]),
            (ply(faces=[(3, 2, 1), (3, 1, 0), *QUADS[1:]], counted=8), ["is cut short", "7 are there"]),
            (ply(counted=5), ["more rows than its header counts"]),
            (ply()[:-30], ["is cut short", "4 are there"]),
            (ply()[:60], ["its header has no end"]),
            (ply(faces=[*QUADS[1:], (3, 2)]), ["a face has 2 corners"]),
            (ply(faces=[*QUADS[1:], (3, 2, 1, -1)]), ["a face names vertex -1 of 8"]),
            (ply().replace(b"binary_little", b"binary_middle"), ["binary_middle_endian"]),
            (ply().replace(b"property float z\n", b""), ["without x, y and z"]),
            (ply().replace(b"vertex_index", b"corners_here"), ["without a list `vertex_indices`"]),
            (ply().replace(b"element face", b"element tristrips"), ["triangle strips"]),
            (ply().replace(b"float x", b"float y"), ["two properties of vertex"]),
        ],
    )  # fmt: skip
    def test_refused(self, tmp_path, content, words):
        refused(tmp_path, content, "body.ply", *words)

    @pytest.mark.parametrize("row", ["4 3 2 1 0.5", "4 3 2 1 x", "-4 3 2 1 0", "nan 3 2 1 0", "4 3 2 1 1e30"])
    def test_text_that_is_refused(self, tmp_path, row):
        rows = [" ".join(map(str, v)) for v in BOX] + [" ".join(map(str, (4, *f))) for f in QUADS[1:]] + [row]
        head = ply().split(b"end_header")[0].decode().replace("binary_little_endian", "ascii")
        refused(tmp_path, f"{head}end_header\n" + "\n".join(rows), "body.ply", "body.ply")


class TestStl:
    @staticmethod
    def content(form, tmp_path):
        with open(write(tmp_path, cube(), form), "rb") as file:
            return file.read()

    def test_binary_that_says_solid(self, tmp_path):
        content = b"solid exported by a program".ljust(80) + self.content("binary stl", tmp_path)[80:]
        assert mesh(tmp_path, content, "body.stl").volume == pytest.approx(1.0)

    @pytest.mark.parametrize(
        "change",
        [
            lambda text: text.upper(),
            lambda text: "\ufeff" + text,
            lambda text: text.replace("\n", "\r\n"),
            lambda text: "\n  " + text.replace("\n", "\n\t"),
            lambda text: text.replace("solid part", "solid vertex 1 2 3 endfacet"),
            lambda text: text.replace("endloop\n", "endloop "),
        ],
        ids=["upper", "mark", "crlf", "indented", "name", "joined"],
    )
    def test_text_written_otherwise(self, tmp_path, change):
        text = self.content("stl", tmp_path).decode()
        assert change(text) != text
        assert mesh(tmp_path, change(text), "body.stl").volume == pytest.approx(1.0)

    def test_two_solids(self, tmp_path):
        content = b"".join(
            FORMATS["stl"][1](*cube((3.0 * k, 0.0, 0.0), (3.0 * k + 1.0, 1.0, 1.0))) for k in range(2)
        )
        assert mesh(tmp_path, content, "body.stl").volume == pytest.approx(2.0)

    def test_binary_cut_short(self, tmp_path):
        content = self.content("binary stl", tmp_path)
        for length in (len(content) - 70, len(content) - 100):
            refused(
                tmp_path, content[:length], "body.stl", "is cut short", "counts 12 triangles, 10 are there"
            )
        refused(tmp_path, b"solid " + content[6:-70], "body.stl", "is cut short")
        refused(tmp_path, content + bytes(40), "body.stl", "has 40 bytes beyond the 12 triangles")
        refused(tmp_path, content[:40], "body.stl", "is no STL")

    def test_text_cut_short(self, tmp_path):
        content = self.content("stl", tmp_path)
        for end in (b"endsolid", b"vertex", b"endfacet\nendsolid"):
            refused(tmp_path, content[: content.rindex(end)], "body.stl", "is cut short after 1")
        doubled = content.replace(b"endloop", b"vertex 0 0 0\nendloop", 1)
        refused(tmp_path, doubled, "body.stl", "facet 1 is not one loop of three vertices")
        refused(tmp_path, content.replace(b"1.0", b"1,0"), "body.stl", "1,0")


class TestBodies:
    def test_cavity_whose_normals_point_out(self, tmp_path):
        """No advice that fills the cavity."""
        path = write(tmp_path, joined(cube(upper=(2, 2, 2)), cube((0.5,) * 3, (1.5,) * 3)), "binary stl")
        with pytest.raises(
            ConfigError, match=r"body 2 of 2 .*turn its faces over if it is a cavity"
        ) as caught:
            Mesh(path)
        assert "unite" not in str(caught.value)

    @pytest.mark.parametrize("order", [1, -1])
    def test_one_inside_out(self, tmp_path, order):
        near, far = cube(upper=(2, 2, 2)), cube((4, 0, 0), (5, 1, 1))
        parts = [near, (far[0], far[1][:, ::-1])][::order]
        path = write(tmp_path, joined(*parts), "binary stl")
        which = r"body \d of 2 \(12 faces from \[4\.0, 0\.0, 0\.0\] to \[5\.0, 1\.0, 1\.0\]\) is inside out"
        with pytest.raises(ConfigError, match=which):
            Mesh(path)

    def test_body_in_a_cavity(self, tmp_path):
        hollow = cube((1.0,) * 3, (3.0,) * 3)
        inner = cube((1.5,) * 3, (2.5,) * 3)
        whole = joined(cube(upper=(4, 4, 4)), (hollow[0], hollow[1][:, ::-1]), inner)
        assert Mesh(write(tmp_path, whole)).volume == pytest.approx(64.0 - 8.0 + 1.0)
        turned = joined(cube(upper=(4, 4, 4)), (hollow[0], hollow[1][:, ::-1]), (inner[0], inner[1][:, ::-1]))
        with pytest.raises(ConfigError, match=r"body 3 of 3 .* is inside out; turn its faces over"):
            Mesh(write(tmp_path, turned))

    def test_overlap_beside_a_cavity(self, tmp_path):
        """A union would fill the cavity, so it is not advised."""
        cavity = cube((0.25,) * 3, (0.75,) * 3)
        parts = [cube(), (cavity[0], cavity[1][:, ::-1]), cube((0.8,) * 3, (1.8,) * 3)]
        with pytest.raises(ConfigError, match="overlaps itself") as caught:
            Mesh(write(tmp_path, joined(*parts)))
        assert "union" not in str(caught.value)
        with pytest.raises(ConfigError, match=r"overlaps itself.*union"):
            Mesh(write(tmp_path, joined(parts[0], parts[2])))

    def test_one_face_twice(self, tmp_path):
        vertices, faces = cube()
        path = write(tmp_path, (vertices, np.concatenate([faces, np.roll(faces[3:4], 1, axis=1)])), "stl")
        with pytest.raises(ConfigError, match="1 of its 13 faces are there twice; delete one of each"):
            Mesh(path)
