"""Planes in which a scene is its own mirror image, so that the image of a run is a run as well."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from nsf.errors import ConfigError
from nsf.vectors import direction, vector

if TYPE_CHECKING:
    from nsf.mpm import Collider
    from nsf.scenes.body import Body

_MOST = 48  # images of a cube; more come of planes at an odd angle
_POINTS = 1000  # of each body, and about each collider
_NEAR = 1e-6  # of the domain's longest edge
_EDGE = 0.003  # of the points, which round-off may put outside


class Solids(Protocol):
    """Parts of a `nsf.scenes.Scene` that have to be their own image: edges [m], bodies and solids."""

    size: Sequence[float]
    bodies: "Mapping[str, Body]"
    solids: "Sequence[Collider]"


@dataclass(frozen=True)
class Image:
    """How a run is seen in mirrors: a point x is at centre + R (x − centre).

    Attributes:
        R: [3, 3] orthogonal.
        partners: of each collider, the number of the one that its image is.
    """

    R: np.ndarray
    partners: tuple[int, ...]


@dataclass(frozen=True)
class Symmetry:
    """Mirror planes of a scene at rest, all through one point; its problem parameters may tell no direction.

    Attributes:
        centre: the point [m].
        mirrors: normals of the planes, any length.

    Raises:
        ConfigError: a zero normal, a value that is not finite, or planes that have more than 48 images.
    """

    centre: Sequence[float]
    mirrors: Sequence[Sequence[float]]

    def __post_init__(self):
        vector("symmetry.centre", self.centre, "m")
        self.group()

    def group(self) -> list[np.ndarray]:
        """Every [3, 3] that reflections at the planes make up, the identity first."""
        normals = [direction("symmetry.mirrors", normal) for normal in self.mirrors]
        planes = [np.eye(3) - 2.0 * np.outer(n, n) for n in normals]
        found = [np.eye(3)]
        for R in found:  # which grows
            for made in (plane @ R for plane in planes):
                if not any(np.allclose(made, known, atol=1e-9) for known in found):
                    found.append(made)
            if len(found) > _MOST:
                raise ConfigError(
                    f"symmetry.mirrors={self.mirrors} have more than {_MOST} images; leave out a plane"
                )
        return found

    def at(self, x: np.ndarray, R: np.ndarray) -> np.ndarray:
        """Where points x [..., 3] [m] are in an image."""
        return np.asarray(self.centre) + (x - np.asarray(self.centre)) @ R.T

    def images(self, scene: Solids) -> list[Image]:
        """The images of a scene, itself first.

        Raises:
            ConfigError: names what is not its own image: the domain, a body, its velocity or weakness, a
                collider without an equal one where its image is, or one that turns.
        """
        return [Image(R, self._partners(scene, R)) for R in self.group()]

    def _partners(self, scene: Solids, R: np.ndarray) -> tuple[int, ...]:
        size = np.asarray(scene.size, float)
        domain, near = np.stack([np.zeros(3), size]), _NEAR * float(size.max())
        if not np.allclose(np.sort(self.at(domain, R), axis=0), domain, atol=near):
            raise self._refused("the domain")
        for name, body in scene.bodies.items():
            if not body.shape.contains(self.at(body.shape.sample(_POINTS), R)).mean() > 1.0 - _EDGE:
                raise self._refused(f"body {name} ({type(body.shape).__name__})")
            if body.weakness is not None or not np.allclose(R @ np.asarray(body.velocity), body.velocity):
                raise self._refused(f"the velocity or the weakness of body {name}")
        x = size * np.random.default_rng(0).random((_POINTS, 3))
        return tuple(self._partner(own, scene.solids, x, R, near) for own in scene.solids)

    def _partner(self, own: "Collider", others, x: np.ndarray, R: np.ndarray, near: float) -> int:
        if own.motion is not None and np.any(own.motion.keyframes()[2]) and not np.array_equal(R, np.eye(3)):
            raise self._refused(f"the {own.name}, which turns,")
        far = replace(own, motion=None).distance(x)
        for number, other in enumerate(others):
            if (other.kind, other.friction) == (own.kind, own.friction) and np.allclose(
                replace(other, motion=None).distance(self.at(x, R)), far, atol=near
            ):
                return number
        raise self._refused(f"the {own.name} at {own.position}")

    def _refused(self, what: str) -> ConfigError:
        planes = [list(normal) for normal in self.mirrors]
        return ConfigError(
            f"symmetry.mirrors={planes} about {list(self.centre)}: {what} is not its own mirror image; "
            "leave out that plane, or set reduction.symmetry=null"
        )
