"""Scenes that cannot be computed, refused before any work."""

import itertools
from collections.abc import Iterator

import numpy as np

from nsf.errors import ConfigError
from nsf.memory import host_memory, require_memory
from nsf.mpm.precision import Precision, precision_of
from nsf.mpm.stability import wave_speed

# [byte] a particle that placing it and building a solver take on the host, measured.
_PLACED = 240
# [byte] that any host has: to ask for more takes milliseconds, and scenes are placed often.
_ANY_HOST = 2**24
# Blocks of frames on the host while a slow disk takes them.
_WAITING = 10
# How deep two bodies, or a body and a solid, may overlap, in Δx: neighbours touch within rounding.
_TOUCHING = 0.25
# Cells that an elastic wave must cross in a run, lest nothing at all moves.
_LEAST_REACH = 1e-6
_SMALLER = "take fewer particles, a coarser scene.dx or a smaller scene.size"


def check_particles(count: int) -> None:
    """Refuse particles that the host cannot hold, before they are placed.

    Raises:
        ConfigError: names the bytes needed and available.
    """
    if _PLACED * count > _ANY_HOST:
        require_memory(f"{count} particles", _PLACED * count, host_memory(), "take fewer")


def check_memory(scene, precision: str, device: str, stored: Precision | None = None) -> None:
    """Refuse a full-order simulation that fits neither the device nor the host.

    Args:
        scene: a `nsf.scenes.Scene`.
        precision, device: as for `Scene.full_order`.
        stored: precision of the frames, where they are stored.

    Raises:
        ConfigError: names the bytes needed and available.
        DeviceError: the device does not exist.
    """
    from nsf.mpm.device import warp_device  # Warp takes 0.3 s to load
    from nsf.mpm.recording import block_bytes
    from nsf.mpm.solver import bytes_on_device

    on, particles, grid = warp_device(device), scene.particle_count, scene.grid
    solver = bytes_on_device(particles, grid, scene.material, precision_of(precision))
    block = block_bytes(particles, stored) if stored else 0
    what = f"{particles} particles on a grid of {' × '.join(map(str, grid.nodes))} nodes"
    if on.is_cuda:
        require_memory(f"{what}, on {on.alias},", solver + block, on.free_memory, _SMALLER)
        solver = 0
    require_memory(what, _PLACED * particles + solver + _WAITING * block, host_memory(), _SMALLER)


def host_bytes(scene, precision: str, stored: Precision | None = None) -> int:
    """[byte] that a full-order simulation takes on a CPU; arguments as of `check_memory`."""
    from nsf.mpm.recording import block_bytes
    from nsf.mpm.solver import bytes_on_device

    solver = bytes_on_device(scene.particle_count, scene.grid, scene.material, precision_of(precision))
    block = block_bytes(scene.particle_count, stored) if stored else 0
    return _PLACED * scene.particle_count + solver + _WAITING * block


def check_physics(scene) -> None:
    """Refuse a scene at t = 0 that cannot be meant.

    Raises:
        ConfigError: see `check_placement` and `check_motion`.
    """
    check_placement(scene)
    check_motion(scene)


def check_placement(scene) -> None:
    """Refuse walls, solids and bodies that cannot be meant to be where they are at t = 0.

    A `sticky` solid may hold a part of a body, as a grip or a root does.

    Raises:
        ConfigError: the walls leave no node free, a solid that never moves lies outside the domain, two
            bodies overlap, or a body lies inside a solid or the walls; names them.
    """
    nodes, padding = scene.grid.nodes, scene.walls.padding
    if min(nodes) <= 2 * padding:
        raise ConfigError(
            f"scene.walls.padding={padding} from both sides leaves none of {min(nodes)} nodes free; "
            f"set at most {(min(nodes) - 1) // 4}"
        )
    corners = np.array(list(itertools.product(*((0.0, edge) for edge in scene.size))))
    for name, solid in zip(scene.colliders, scene.solids, strict=True):
        outside = np.linalg.norm(solid.position - np.clip(solid.position, 0.0, scene.size)) > solid.bound
        if solid.motion is None and (
            outside or (solid.bound == np.inf and solid.distance(corners).min() > 0)
        ):
            raise ConfigError(
                f"scene.colliders.{name} lies outside the domain [0, {scene.size}] m and never moves; "
                "move it, or leave it out"
            )
    for name, body in scene.bodies.items():
        _check_solids(scene, name, body.points())
    for (name, body), (other, second) in itertools.permutations(scene.bodies.items(), 2):
        X = body.points()
        deep = second.shape.contains(X)
        for step in _TOUCHING * scene.dx * np.concatenate([np.eye(3), -np.eye(3)]):
            deep[deep] = second.shape.contains(X[deep] + step)
        if deep.any():
            raise ConfigError(
                f"scene.bodies.{name} overlaps scene.bodies.{other}: {deep.sum()} of its {len(X)} particles "
                "lie inside the other, where mass would count twice; move one, or make them one shape"
            )


def _check_solids(scene, name: str, X: np.ndarray) -> None:
    """Refuse a body whose particles X [P, 3] [m] are within what they should meet."""
    if (depth_in_walls(scene, X) > 0.0).all():
        raise ConfigError(
            f"scene.bodies.{name} lies wholly in scene.walls.padding={scene.walls.padding} nodes of the "
            "domain's edge, where the walls hold it; move it inwards"
        )
    for which, kind, distance in _solids(scene, X):
        deep = distance < -_TOUCHING * scene.dx
        if deep.all() or (deep.any() and kind != "sticky"):
            grip = "" if kind == "sticky" else ", or set kind=sticky where it is to hold them"
            raise ConfigError(
                f"scene.bodies.{name}: {deep.sum()} of its {len(X)} particles lie inside {which} "
                f"(kind={kind}) at t = 0, up to {-distance.min():.2g} m deep; move one of them{grip}"
            )


def depth_in_walls(scene, X: np.ndarray) -> np.ndarray:
    """[P] how deep particles X [P, 3] [m] lie behind the walls' innermost nodes [m], negative before them."""
    padding, upper = (scene.walls.padding - 1) * scene.dx, np.array(scene.grid.upper)
    return np.maximum(padding - X, X - (upper - padding)).max(1)


def _solids(scene, X: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    """Name and kind of each solid that acts at t = 0, and the distance [P] of X from it [m]."""
    for name, solid in zip(scene.colliders, scene.solids, strict=True):
        if solid.since == 0.0:
            yield f"scene.colliders.{name}", solid.kind, solid.distance(X)


def check_motion(scene) -> None:
    """Refuse steps so short, or a material so soft, that a run would show nothing of the material.

    Raises:
        ConfigError: an elastic wave crosses less than a millionth of a cell in all steps.
    """
    c = wave_speed(scene.particles())
    reach = c * scene.dt * scene.steps / scene.dx
    if scene.dt > 0 and reach < _LEAST_REACH:  # a dt that is not positive is the solver's to refuse
        raise ConfigError(
            f"in scene.steps={scene.steps} of scene.dt={scene.dt:g} s an elastic wave of {c:.3g} m/s crosses "
            f"{reach:.2g} of a cell: nothing would deform; raise dt or material.E={scene.material.E:g} Pa, "
            "or lower the density"
        )
