"""Bodies from a user's triangle mesh."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import length
from nsf.scenes.shapes.formats import MeshFileError, read_polygons
from nsf.scenes.shapes.geometry import AXES, Ball, Box, Shape
from nsf.scenes.shapes.polygons import MAX_CORNERS, CrossingError, triangulated
from nsf.scenes.shapes.winding import WindingNumber
from nsf.vectors import vector

EXTENSIONS = (".obj", ".ply", ".stl")
# A triangle takes some 50 bytes of a file and 500 of memory while a mesh is read.
_MAX_BYTES = 256 * 2**20
_UNITE = (
    "pip install trimesh manifold3d, and unite its bodies: "
    "trimesh.boolean.union(trimesh.load_mesh(FILE).split()).export(FILE)"
)
_REMESH = "mend it where it was made, for instance by Blender's Boolean modifier with Self Intersection"
#: [m] of one unit of a file, by its name.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# Points at which a mesh is tested for overlaps of its own parts.
_PROBES = 2**15
# How far off a face's middle its two sides are probed, in units of the mesh's extent.
_OFF = 1e-9


@dataclass(frozen=True)
class Mesh(Shape):
    """The solid inside a closed triangle mesh, read from a file.

    Vertices that are equal to the bit are one vertex, as STL repeats them. Faces of more than three
    corners are cut into triangles, also where they are concave. Faces that all point inwards are
    turned. A closed surface inside another and turned inwards is a cavity. Only geometry is read: no
    materials, no textures, no file that the mesh refers to.

    Attributes:
        path: an .obj, .ply or .stl file; where relative, of the current directory.
        height: vertical extent to which the mesh is scaled [m]; by default `unit` says how large it is.
        base: middle of the bottom of its bounding box [m]; where the file has it, by default.
        up: axis of the file that points up, `x`, `y` or `z`.
        unit: of the file's lengths, `m`, `cm` or `mm`.

    Raises:
        ConfigError: the file is missing, too large, of another kind or not whole, or the mesh is not
            the boundary of a solid: it has open edges, neighbouring faces of opposite orientation,
            a body that is inside out, faces that are there twice, vertices that are not finite, no
            volume, or parts that overlap. Overlap is found where a face's middle lies beyond another
            part, or at one of 32 768 points of the bounding box, hence above about 1e-4 of its
            volume; a smaller one is counted twice in `volume`.
    """

    path: str
    height: float | None = None
    base: Sequence[float] | None = None
    up: str = "z"
    unit: str = "m"

    def __post_init__(self):
        if self.unit not in _UNITS:
            raise ConfigError(f"mesh unit={self.unit!r} is unknown; choose {', '.join(_UNITS)}")
        if self.height is not None:
            length("mesh height", self.height)
            if self.unit != "m":
                raise ConfigError(
                    f"mesh height={self.height} m and unit={self.unit} both scale the mesh; leave one out"
                )
        if self.base is not None:
            vector("mesh base", self.base, "m")
        if self.up not in AXES:
            raise ConfigError(f"mesh up={self.up!r} is unknown; choose x, y or z")
        _ = self._placed

    @cached_property
    def files(self) -> dict[str, str]:
        """Path and sha256 of the file, so that a run knows what it was made from."""
        return {str(self.path): hashlib.sha256(_read(str(self.path))).hexdigest()}

    @cached_property
    def _placed(self) -> tuple[float, np.ndarray, WindingNumber]:
        """Scale and shift from the file, and the surface in the file's units, turned upright."""
        surface = _surface(str(self.path), self.files[str(self.path)], self.up)
        lower, upper = surface.corners
        scale = _UNITS[self.unit] if self.height is None else self.height / (upper[2] - lower[2])
        foot = np.array([*(0.5 * (lower + upper))[:2], lower[2]])
        shift = np.zeros(3) if self.base is None else np.asarray(self.base, float) - scale * foot
        return scale, shift, surface

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        scale, _, surface = self._placed
        return scale**3 * signed_volume(surface.triangles)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [m]."""
        scale, shift, surface = self._placed
        lower, upper = surface.corners
        return scale * lower + shift, scale * upper + shift

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside; exact but within rounding of the surface."""
        scale, shift, surface = self._placed
        return surface.of((x - shift) / scale) > 0


def mesh_or_ball(
    mesh: str | None, height: float | None = None, base: Sequence[float] | None = None, up: str = "z"
) -> Shape:
    """The mesh of a file, or without one a ball that stands as high in the same place.

    Args:
        mesh: path of an .obj, .ply or .stl file, or None.
        height, base, up: as for `Mesh`; the ball needs the first two.

    Raises:
        ConfigError: see `Mesh`.
    """
    if mesh is not None:
        return Mesh(mesh, height, base, up)
    radius = 0.5 * length("height", height)
    x, y, z = vector("base", base, "m")
    return Ball((x, y, z + radius), radius)


def signed_volume(triangles: np.ndarray) -> float:
    """Volume inside triangles [F, 3, 3], by the divergence theorem; negative where they point inwards."""
    a, b, c = np.moveaxis(triangles - 0.5 * (triangles.min((0, 1)) + triangles.max((0, 1))), 1, 0)
    return float((a * np.cross(b, c)).sum() / 6.0)


def _read(path: str) -> bytes:
    """The file's bytes, if it can be a mesh."""
    file = Path(path).expanduser()
    if file.suffix.lower() not in EXTENSIONS:
        raise ConfigError(
            f"mesh={path}: extension {file.suffix!r} is not supported; export it as {', '.join(EXTENSIONS)}"
        )
    if not file.is_file():
        raise ConfigError(
            f"mesh path={path} is no file; a relative path is read from the current folder, {Path.cwd()}"
        )
    try:
        size = file.stat().st_size
        if size > _MAX_BYTES:
            raise ConfigError(
                f"mesh={path} has {size / 2**20:.0f} MiB, more than {_MAX_BYTES // 2**20} MiB; decimate it"
            )
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"mesh={path} cannot be read: {error.strerror}; check its permissions") from error


@lru_cache(maxsize=4)
def _surface(path: str, digest: str, up: str) -> WindingNumber:
    """The checked surface of a file; kept, since a scene is built anew at each parameter value."""
    vertices, faces = _parse(path)
    used = vertices[faces]
    # A cyclic exchange of axes, so that a right-handed file stays right-handed. 0.0 turns −0.0 into 0.0.
    used = np.roll(used, 2 - AXES[up], axis=2) + 0.0
    vertices, faces = np.unique(used.reshape(-1, 3), axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    if not len(faces):
        raise ConfigError(f"mesh={path} has no face with an area; export a solid")
    _check_closed(path, faces)
    return _oriented(path, vertices, faces)


def _bodies(faces: np.ndarray) -> np.ndarray:
    """[F] number of the connected surface that each face belongs to, from 0, by their first faces."""
    from scipy.sparse import coo_matrix  # takes 0.2 s to load
    from scipy.sparse.csgraph import connected_components

    edges = np.stack([faces, np.roll(faces, -1, axis=1)], 2).reshape(-1, 2)
    links = coo_matrix((np.ones(len(edges)), edges.T), shape=(faces.max() + 1,) * 2)
    of_face = connected_components(links, directed=False)[1][faces[:, 0]]
    _, first, body = np.unique(of_face, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[body]


def _parse(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [F, 3] as the file has them."""
    try:
        polygons = read_polygons(_read(path), Path(path).suffix.lower())
    except MeshFileError as error:
        raise ConfigError(f"mesh={path} {error}; export it again") from error
    vertices, corners, sizes = polygons.vertices, polygons.corners, polygons.sizes
    if not len(sizes):
        raise ConfigError(f"mesh={path} has no faces; export triangles, not points or lines")
    if sizes.min() < 3:
        raise ConfigError(f"mesh={path}: a face has {sizes.min()} corners; export faces, not lines")
    if corners.min() < 0 or corners.max() >= len(vertices):
        worst = corners.min() if corners.min() < 0 else corners.max()
        raise ConfigError(f"mesh={path}: a face names vertex {worst} of {len(vertices)}; export it again")
    if not np.isfinite(vertices[corners]).all():
        count = len(np.unique(corners[~np.isfinite(vertices[corners]).all(1)]))
        raise ConfigError(f"mesh={path}: {count} vertices are not finite; repair the mesh")
    try:
        return vertices, triangulated(vertices, corners, sizes)
    except CrossingError as error:
        raise ConfigError(
            f"mesh={path}: a face of {error.corners} corners crosses itself, or is concave with more than "
            f"{MAX_CORNERS}; export it as triangles"
        ) from error


def _check_closed(path: str, faces: np.ndarray) -> None:
    """Each edge must be passed as often one way as the other, and no face be there twice."""
    # Turned so that the lowest vertex comes first: faces that are turned over stay different.
    places = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    doubled = len(faces) - len(np.unique(np.take_along_axis(faces, places, 1), axis=0))
    if doubled:
        raise ConfigError(
            f"mesh={path}: {doubled} of its {len(faces)} faces are there twice; delete one of each"
        )
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], 2).reshape(-1, 2)
    rising = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, which, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(which.ravel(), weights=rising, minlength=len(count))
    boundary = int((count % 2).astype(bool).sum())
    if boundary:
        raise ConfigError(
            f"mesh={path} is open: {boundary} of its {len(count)} edges are on a boundary; "
            "close its holes and merge double vertices"
        )
    clashing = int(np.count_nonzero(balance))
    if clashing:
        raise ConfigError(
            f"mesh={path}: faces on both sides of {clashing} of its {len(count)} edges have opposite "
            "orientations; make its normals consistent"
        )


def _oriented(path: str, vertices: np.ndarray, faces: np.ndarray) -> WindingNumber:
    """The surface with its faces pointing outwards, if it bounds a solid.

    Args:
        path: of the file, for messages.
        vertices: [V, 3] in the file's unit.
        faces: [F, 3] of closed surfaces.
    """
    triangles = vertices[faces]
    volume = signed_volume(triangles)
    lower, upper = triangles.min((0, 1)), triangles.max((0, 1))
    # Rounding of a flat mesh's volume stays below this.
    if not abs(volume) > 1e-12 * np.prod(np.maximum(upper - lower, 1e-6 * (upper - lower).max())):
        raise ConfigError(f"mesh={path} encloses no volume; give a solid")
    surface = WindingNumber(triangles if volume > 0.0 else triangles[:, ::-1])
    _, inner, outer = _sides(surface, surface)
    wrong = (inner != 1) | (outer != 0)
    if wrong.any():
        body = _bodies(faces)
        _check_bodies(path, surface.triangles, body)
        raise ConfigError(
            f"mesh={path} overlaps itself: {wrong.sum()} of its {len(triangles)} faces lie inside another "
            f"part or are doubled; {_advice(surface.triangles, body)}"
        )
    # Stretched to the box, as a needle's would hardly be hit otherwise.
    number = surface.of(lower + (upper - lower) * Box((0, 0, 0), (1, 1, 1)).sample(_PROBES))
    if ((number < 0) | (number > 1)).any():
        share = ((number < 0) | (number > 1)).mean()
        raise ConfigError(
            f"mesh={path} overlaps itself in {100 * share:.2g} % of its bounding box; "
            f"{_advice(surface.triangles, _bodies(faces))}"
        )
    return surface


def _sides(surface: WindingNumber, among: WindingNumber) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces of a surface whose sides can be told apart, and how often another winds round each side.

    Returns:
        [n] faces, [n] winding numbers just behind the middle of each, and [n] just before it.
    """
    a, b, c = np.moveaxis(surface.triangles, 1, 0)
    normal, middle = np.cross(b - a, c - a), (a + b + c) / 3.0
    area = np.linalg.norm(normal, axis=1)
    # A sliver's middle is within rounding of its neighbours.
    broad = np.flatnonzero(area > 1e-9 * np.abs(surface.upper - surface.lower).max(1) ** 2)
    extent = (surface.corners[1] - surface.corners[0]).max()
    off = _OFF * extent * normal[broad] / area[broad, None]
    return broad, among.of(middle[broad] - off), among.of(middle[broad] + off)


def _check_bodies(path: str, triangles: np.ndarray, body: np.ndarray) -> None:
    """Refuse a body that is inside out, with its name, where no two surfaces pass through one another.

    With all surfaces turned outwards, the winding number before a face is the number of surfaces about
    it: of an even one it must point outwards, of an odd one it bounds a cavity and must point inwards.
    """
    volumes = _volumes(triangles, body)
    outwards = WindingNumber(np.where((volumes > 0.0)[body][:, None, None], triangles, triangles[:, ::-1]))
    broad, _, depth = _sides(outwards, outwards)
    of = body[broad]
    least, most = (np.full(len(volumes), start) for start in (np.iinfo(int).max, -1))
    np.minimum.at(least, of, depth)
    np.maximum.at(most, of, depth)
    if (least != most).any():
        return
    for k in np.flatnonzero((least % 2 == 1) == (volumes > 0.0)):
        lower, upper = (np.round(v, 6).tolist() for v in _extent(triangles[body == k]))
        which = f"body {k + 1} of {len(volumes)} ({(body == k).sum()} faces from {lower} to {upper})"
        remedy = "turn its faces over"
        if least[k] % 2:
            remedy = "turn its faces over if it is a cavity, delete it if it is not"
        inside = "lies inside another and points outwards" if least[k] % 2 else "is inside out"
        raise ConfigError(f"mesh={path}: {which} {inside}; {remedy}")


def _volumes(triangles: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Signed volume of each body, closed as each is."""
    a, b, c = np.moveaxis(triangles - 0.5 * np.sum(_extent(triangles), axis=0), 1, 0)
    return np.bincount(body, weights=(a * np.cross(b, c)).sum(1) / 6.0)


def _extent(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return triangles.min((0, 1)), triangles.max((0, 1))


def _advice(triangles: np.ndarray, body: np.ndarray) -> str:
    """How to mend bodies that overlap; a union would fill cavities, and leaves one body as it is."""
    volumes = _volumes(triangles, body)
    return _UNITE if len(volumes) > 1 and (volumes > 0.0).all() else _REMESH
