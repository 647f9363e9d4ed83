"""The layout of a trajectory file: the only home of names and units on disk.

attributes   schema_version units tau_order x_sha256 dt dx complete
/particles   X [P,3]  mass [P]  volume0 [P]                           float64
/frames      t [F] float64;  x v [F,P,3]  C [F,P,9]  tau [F,P,6], each in one piece
/parameters  one float64 scalar a problem parameter
/forcing     gravity [F,3]  solids [F,c,4] shift and angle of c      float64; of simulations of a scene
/cost        one float64 scalar a measured cost
"""

import hashlib

import numpy as np
from numpy.typing import ArrayLike

from nsf.errors import ShapeError

SCHEMA_VERSION = 1
#: Name of the file in the folder of a simulate run.
TRAJECTORY = "trajectory.h5"

# Kirchhoff stress is symmetric: its upper triangle, by rows.
TAU_ORDER = ("xx", "xy", "xz", "yy", "yz", "zz")
TAU_ROWS, TAU_COLUMNS = (tuple("xyz".index(pair[i]) for pair in TAU_ORDER) for i in (0, 1))
# tau6[..., TAU_MATRIX] is the 3x3 matrix, in NumPy and in torch.
TAU_MATRIX = [[TAU_ORDER.index("".join(sorted(row + column))) for column in "xyz"] for row in "xyz"]

# Particle fields of a frame and their number of components; C is a 3x3 matrix by rows.
COMPONENTS = {"x": 3, "v": 3, "C": 9, "tau": 6}

# The forcing of a simulation at each frame, and its shape after the frames.
FORCING = {"gravity": (3,), "solids": (None, 4)}

UNITS = {
    "X": "m",
    "mass": "kg",
    "volume0": "m^3",
    "t": "s",
    "x": "m",
    "v": "m/s",
    "C": "1/s",
    "tau": "Pa",
    "dt": "s",
    "dx": "m",
}


def hash_of_positions(X: ArrayLike) -> str:
    """The identity of a set of particles: sha256 over X as little-endian float64.

    Args:
        X: [P,3] positions in the undeformed state [m].

    Raises:
        ShapeError: X is not [P,3], or not finite.
    """
    positions = np.ascontiguousarray(X, dtype="<f8")
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise ShapeError(
            f"X has shape {list(positions.shape)} or non-finite values; give finite positions [P,3]"
        )
    return hashlib.sha256(positions.tobytes()).hexdigest()


def packed(field: str, values: np.ndarray) -> np.ndarray:
    """A frame's values as they lie on disk.

    Args:
        field: "x", "v", "C" or "tau".
        values: [P,c]; for C and tau also [P,3,3], of which tau must be symmetric.

    Returns:
        [P,c] with c = `COMPONENTS[field]`.
    """
    values = np.asarray(values)
    if values.ndim == 3 and values.shape[1:] == (3, 3):
        if field == "tau":
            return values[:, TAU_ROWS, TAU_COLUMNS]
        if field == "C":
            return values.reshape(-1, 9)
    return values
