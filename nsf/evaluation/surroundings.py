"""Gravity and colliders about the bodies of a run, for its pictures."""

import numpy as np

from nsf.mpm import Collider
from nsf.scenes import Scene
from nsf.vectors import rotation


def surroundings(scene: Scene, t: np.ndarray) -> dict[str, np.ndarray]:
    """Gravity and colliders of a scene at times t [F] [s].

    Returns:
        gravity: [F, 3] [m/s²].
        solid_shape: [c] `half-space`, `sphere` or `cuboid`.
        solid_extents: [c, 3] normal of a half-space, radius, or half edges [m], in the solid's own axes.
        solid_position: [F, c, 3] [m]; solid_orientation: [F, c, 3, 3].
        solid_active: [F, c] whether the collider acts.
    """
    frames, solids = len(t), scene.solids
    poses = [_poses(solid, t) for solid in solids]
    acts = [(solid.since <= t) & (t < solid.until) for solid in solids]
    return {
        "gravity": scene.acting_gravity.at(t).astype(np.float32),
        "solid_shape": np.array([solid.name for solid in solids], dtype=str),
        "solid_extents": np.array([solid.extents for solid in solids], np.float32).reshape(-1, 3),
        "solid_position": _stacked([position for position, _ in poses], (frames, 0, 3)),
        "solid_orientation": _stacked([turn for _, turn in poses], (frames, 0, 3, 3)),
        "solid_active": np.stack(acts, 1) if acts else np.zeros((frames, 0), bool),
    }


def _poses(solid: Collider, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [F, 3] [m] and orientation [F, 3, 3] of a collider at times t [F] [s]."""
    if solid.motion is None:
        return np.tile(solid.position, (len(t), 1)), np.tile(solid.orientation, (len(t), 1, 1))
    pose, (axis, pivot) = solid.motion.pose(t), solid.motion.hinge()
    turned = np.stack([rotation(axis, np.degrees(angle)) for angle in pose[:, 3]])
    return pivot + pose[:, :3] + turned @ (solid.position - pivot), turned @ solid.orientation


def _stacked(of_solids: list[np.ndarray], none: tuple[int, ...]) -> np.ndarray:
    """Arrays [F, …] of each solid as one [F, c, …]."""
    return (np.stack(of_solids, axis=1) if of_solids else np.zeros(none)).astype(np.float32)
