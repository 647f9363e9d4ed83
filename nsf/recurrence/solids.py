"""States of colliders at each step, as a few numbers of the moment, never the time itself."""

from collections.abc import Sequence

import numpy as np

from nsf.mpm import Collider

#: Shift [m], angle [rad], both over the coming step too, and whether it acts.
FEATURES = 9
_SAME_TIME = 1e-6  # of a step, as `nsf.mpm.boundaries.motion` has it
#: A combination of features that moves less than this share of the first one counts for nothing.
_HARDLY = 0.03
#: Share of its largest value by which a feature may differ from itself without being another.
_ROUND_OFF = 1e-9


def collider_states(colliders: Sequence[Collider], dt: float, steps: int) -> np.ndarray:
    """State of every collider at the start of each step.

    Args:
        colliders: c of them.
        dt: step [s].
        steps: N.

    Returns:
        [N, 9 c]: of each collider its shift from rest d [m] and angle θ [rad], how both change in the coming
        step, and 1 where it acts, else 0.
    """
    t = dt * np.arange(steps + 1)
    states = [np.zeros((steps, 0))]
    for collider in colliders:
        pose = np.zeros((steps + 1, 4))
        if collider.motion is not None:
            pose = collider.motion.pose(t)
        later = t[:-1] + _SAME_TIME * dt
        active = (later >= collider.since) & (later < collider.until)
        states += [pose[:-1], np.diff(pose, axis=0), active[:, None].astype(float)]
    return np.concatenate(states, 1)


def principal(states: Sequence[np.ndarray], programs: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The combinations of collider states that vary in a run.

    Plates that mirror each other vary as one. What stays as it is in each run follows from the problem
    parameters and is no state, unless programs differ from run to run.

    Args:
        states: [N, f] of each training run, as `collider_states` gives them.
        programs: whether the runs follow programs.

    Returns:
        Mean [f] and matrix [f, C]: c = (state − mean) matrix, whose first entry has unit variance.
    """
    rows = np.concatenate(states)
    # A solid at constant speed comes on by as much in each step, but for round-off.
    spread = [np.ptp(run, axis=0) for run in ([rows] if programs else states)]
    varies = np.max(spread, axis=0) > _ROUND_OFF * np.abs(rows).max(0)
    mean = rows.mean(0)
    deviation = np.where(varies, rows.std(0), np.inf)
    _, sizes, axes = np.linalg.svd((rows - mean) / deviation, full_matrices=False)
    varying = sizes > _HARDLY * max(sizes.max(initial=0.0), np.finfo(float).tiny)
    scale = sizes[0] / np.sqrt(len(rows)) if varying.any() else 1.0
    return mean, (axes[varying] / scale / deviation).T
