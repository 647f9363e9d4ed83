"""Triangle meshes made and written by the tests, in each format by hand."""

import struct

import numpy as np


def cube(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0)):
    """8 vertices and 12 faces, outwards."""
    corners = np.array([[(i >> 2) & 1, (i >> 1) & 1, i & 1] for i in range(8)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    return lower + corners * (upper - lower), np.array(faces)


def sphere(subdivisions=3):
    """An octahedron, subdivided onto the unit sphere."""
    vertices = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    vertices = [np.array(v, float) for v in vertices]
    for _ in range(subdivisions):
        middles, finer = {}, []
        for face in faces:
            m = []
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                key = (min(a, b), max(a, b))
                if key not in middles:
                    v = vertices[a] + vertices[b]
                    vertices.append(v / np.linalg.norm(v))
                    middles[key] = len(vertices) - 1
                m.append(middles[key])
            a, b, c = face
            finer += [(a, m[0], m[2]), (b, m[1], m[0]), (c, m[2], m[1]), tuple(m)]
        faces = finer
    return np.array(vertices), np.array(faces)


def torus(major=0.3, minor=0.1, n=48, m=24):
    """Round the z axis; with a hole, so not convex."""
    u, v = np.meshgrid(2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m, indexing="ij")
    ring = major + minor * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), minor * np.sin(v)], -1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    here, right = i * m + j, (i + 1) % n * m + j
    up, across = i * m + (j + 1) % m, (i + 1) % n * m + (j + 1) % m
    return vertices, np.concatenate([np.stack([here, right, across], 1), np.stack([here, across, up], 1)])


def joined(*parts):
    """Several meshes in one file."""
    offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
    vertices = np.concatenate([v for v, _ in parts])
    return vertices, np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=False)])


def turned(angle=0.7, axis=(1.0, 2.0, 3.0)):
    """A rotation matrix."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def _obj(vertices, faces):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]).encode() + b"\n"


def _ply_head(kind, vertices, faces):
    return (
        f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()


def _ply(vertices, faces):
    body = [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces]
    return _ply_head("ascii", vertices, faces) + "\n".join(body).encode() + b"\n"


def _binary_ply(vertices, faces):
    body = vertices.astype("<f8").tobytes() + b"".join(struct.pack("<B3i", 3, *f) for f in faces.tolist())
    return _ply_head("binary_little_endian", vertices, faces) + body


def _stl(vertices, faces):
    lines = ["solid part"]
    for face in vertices[faces]:
        corners = [f"vertex {x!r} {y!r} {z!r}" for x, y, z in face.tolist()]
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    return "\n".join([*lines, "endsolid part", ""]).encode()


def _binary_stl(vertices, faces):
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *f.ravel(), 0) for f in vertices[faces])
    return bytes(80) + struct.pack("<I", len(faces)) + body


#: name → (extension, bytes of vertices and faces)
FORMATS = {
    "obj": (".obj", _obj),
    "ply": (".ply", _ply),
    "binary ply": (".ply", _binary_ply),
    "stl": (".stl", _stl),
    "binary stl": (".stl", _binary_stl),
}


def write(folder, mesh, form="obj", name="body"):
    """The path, as text, of the mesh in this format."""
    extension, content = FORMATS[form]
    path = folder / f"{name}{extension}"
    path.write_bytes(content(np.asarray(mesh[0], float), np.asarray(mesh[1])))
    return str(path)
