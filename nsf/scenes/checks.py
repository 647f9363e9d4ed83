"""Scenes that cannot be computed, refused before any work."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsf.memory import host_memory, require_memory
from nsf.mpm import Precision, precision_of
from nsf.mpm.device import warp_device
from nsf.mpm.recording import block_bytes
from nsf.mpm.solver import bytes_on_device

if TYPE_CHECKING:
    from nsf.scenes.scene import Scene

# [byte] a particle that placing it and building a solver take on the host, measured.
_PLACED = 240
# Blocks of frames on the host while a slow disk takes them.
_WAITING = 10
_SMALLER = "take fewer particles, a coarser scene.dx or a smaller scene.size"


def check_particles(count: int) -> None:
    """Refuse particles that the host cannot hold, before they are placed.

    Raises:
        ConfigError: names the bytes needed and available.
    """
    require_memory(f"{count} particles", _PLACED * count, host_memory(), "take fewer")


def check_memory(scene: Scene, precision: str, device: str, stored: Precision | None = None) -> None:
    """Refuse a full-order simulation that fits neither the device nor the host.

    Args:
        scene: what is simulated.
        precision, device: as for `Scene.full_order`.
        stored: precision of the frames, where they are stored.

    Raises:
        ConfigError: names the bytes needed and available.
        DeviceError: the device does not exist.
    """
    on, particles, grid = warp_device(device), scene.particle_count, scene.grid
    solver = bytes_on_device(particles, grid, scene.material, precision_of(precision))
    block = block_bytes(particles, stored) if stored else 0
    what = f"{particles} particles on a grid of {' × '.join(map(str, grid.nodes))} nodes"
    if on.is_cuda:
        require_memory(f"{what}, on {on.alias},", solver + block, on.free_memory, _SMALLER)
        solver = 0
    require_memory(what, _PLACED * particles + solver + _WAITING * block, host_memory(), _SMALLER)
