"""`--vtk`: one VTKHDF file with every time step, for ParaView 5.12 or newer and VTK's readers.

VTK's own writer needs a whole step in memory. h5py fills the same layout block by block.
"""

from pathlib import Path

import h5py
import numpy as np

from nsf.data.schema import TAU_ORDER
from nsf.export.playback import Playback
from nsf.storage import require_space, writing

NEEDS = ()
VERSION = (2, 0)  # the first that holds time steps
VERTEX = 1  # VTK's number of a cell that is one point
# VTK takes six components for a symmetric tensor in this order.
TENSOR = [TAU_ORDER.index(pair) for pair in ("xx", "yy", "zz", "xy", "yz", "xz")]
ARRAYS = {"displacement": 3, "von_mises": 1, "pressure": 1, "kirchhoff_stress": 6}
_CHUNK = 1 << 14  # points of one step that lie together on disk


def write(playback: Playback, folder: Path) -> Path:
    """Write positions and the arrays of `ARRAYS` of every point and frame, in single precision.

    Arrays: displacement [m], von_mises and pressure [Pa], kirchhoff_stress [Pa] as XX YY ZZ XY YZ XZ. The
    time of a step is in seconds. The order of the points is the same in every step.

    Raises:
        StorageError: the disk cannot hold the file.
    """
    path = folder / f"{playback.name}.vtkhdf"
    N, F = len(playback.X), len(playback.t)
    with writing(path) as partial:
        require_space(partial, F * N * 4 * (3 + sum(ARRAYS.values())) + 17 * N)
        with h5py.File(partial, "w") as file:
            root = file.create_group("VTKHDF", track_order=True)
            root.attrs["Version"] = VERSION
            root.attrs["Type"] = np.bytes_("UnstructuredGrid")
            _cells(root, N)
            points = _dataset(root, "Points", F * N, 3)
            data = root.create_group("PointData")
            arrays = {name: _dataset(data, name, F * N, c) for name, c in ARRAYS.items()}
            _steps(root, playback.t, N)
            for block in playback.blocks("vtk"):
                values = {
                    "displacement": block.displacement,
                    "von_mises": block.von_mises,
                    "pressure": block.pressure,
                    "kirchhoff_stress": block.tau[..., TENSOR],
                }
                for step in range(F):
                    rows = slice(step * N + block.rows.start, step * N + block.rows.stop)
                    points[rows] = block.x[step].float().numpy()
                    for name, dataset in arrays.items():
                        dataset[rows] = values[name][step].float().numpy()
    return path


def _dataset(group: h5py.Group, name: str, rows: int, components: int) -> h5py.Dataset:
    shape = (rows,) if components == 1 else (rows, components)
    return group.create_dataset(name, shape, "f4", chunks=(min(rows, _CHUNK), *shape[1:]))


def _cells(root: h5py.Group, points: int) -> None:
    """Write a vertex cell at each point, the same in every step, because ParaView's filters work on cells."""
    root["NumberOfPoints"] = root["NumberOfCells"] = root["NumberOfConnectivityIds"] = np.array([points])
    root["Connectivity"] = np.arange(points)
    root["Offsets"] = np.arange(points + 1)
    root["Types"] = np.full(points, VERTEX, np.uint8)


def _steps(root: h5py.Group, t: np.ndarray, points: int) -> None:
    """Write the row at which the points of each step begin. All steps read the same cells, from row 0."""
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = len(t)
    steps["Values"] = t
    begins, zeros = np.arange(len(t)) * points, np.zeros(len(t), int)
    steps["PartOffsets"] = zeros
    steps["NumberOfParts"] = zeros + 1
    steps["PointOffsets"] = begins
    steps["CellOffsets"] = steps["ConnectivityIdOffsets"] = zeros[:, None]
    offsets = steps.create_group("PointDataOffsets")
    for name in ARRAYS:
        offsets[name] = begins
