"""Every frame of several trajectories as one set of training snapshots."""

import collections
import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nsf.data.schema import COMPONENTS
from nsf.data.trajectory import Trajectory
from nsf.errors import ConfigError, DeviceError, SchemaError, ShapeError
from nsf.memory import host_memory

# Fields that training reads again and again; v is rarely read, and streams.
RESIDENT_FIELDS = ("x", "tau", "C")
# Of the free memory: the rest is for networks, their gradients and what else runs.
_RESIDENT_SHARE = 0.6
# Threads that read side by side, and what each holds between the file and the device.
_READERS = min(4, os.cpu_count() or 1)
_STAGING_BYTES = 64 * 2**20
SLAB_ENTRIES = 2**26  # values of a slab: 0.5 GiB in float64

Indices = slice | Sequence[int] | np.ndarray | Tensor


def resident_bytes(frames: int, particles: int) -> int:
    """[byte] of x, tau and C of some frames in float32."""
    return 4 * frames * particles * sum(COMPONENTS[field] for field in RESIDENT_FIELDS)


class Snapshots:
    """Rows of (frame, case), by trajectory and then by frame.

    The same calls give the same values whether the data lie on the device
    (`resident`) or stream from the files.

    Args:
        trajectories: of the same particles and parameter names.
        device: where tensors are returned.
        resident: keep x, tau and C on the device; "auto" if they take at most
            60 % of what is free there.

    Attributes:
        M: number of rows.
        P: number of particles.
        X: [P,3] undeformed positions [m], float64 (their hash is `x_sha256`).
        x_sha256: identity of the particles.
        parameter_names: sorted.
        parameters: [M,n_parameters] float64, the values of the cases.
        trajectory: [M] int64, index into `trajectories`.
        frame: [M] int64, index into the trajectory's frames.
        t: [M] float64 [s].
        resident: whether the data lie on the device.

    Raises:
        ConfigError: there is no trajectory, or `resident` is of another value.
        DeviceError: this machine has no such device.
        SchemaError: trajectories are of different particles or parameters.
    """

    def __init__(
        self,
        trajectories: Sequence[Trajectory | str | Path],
        device: str | torch.device = "cpu",
        resident: bool | str = "auto",
    ) -> None:
        self.trajectories = [t if isinstance(t, Trajectory) else Trajectory.open(t) for t in trajectories]
        if not self.trajectories:
            raise ConfigError("trajectories=[]; give at least one")
        if resident not in (True, False, "auto"):
            raise ConfigError(f"resident={resident!r}; choose auto, true or false")
        first = self.trajectories[0]
        for other in self.trajectories[1:]:
            _require_same(first, other)
        self.device = _device(device)
        self.P = first.particles
        self.x_sha256 = first.x_sha256
        self.parameter_names = tuple(first.parameters)
        frames = [trajectory.frames for trajectory in self.trajectories]
        self.M = sum(frames)
        values = [list(trajectory.parameters.values()) for trajectory in self.trajectories]
        index = np.repeat(np.arange(len(frames)), frames)
        self._first = np.cumsum([0, *frames])
        self.X = torch.tensor(first.X, device=self.device)
        self.trajectory = torch.tensor(index, device=self.device)
        self.frame = torch.tensor(np.concatenate([np.arange(n) for n in frames]), device=self.device)
        self.parameters = torch.tensor(
            np.array(values, dtype="f8").reshape(len(frames), -1)[index], device=self.device
        )
        times = np.concatenate([trajectory.t for trajectory in self.trajectories])
        self.t = torch.tensor(times, device=self.device)
        self.resident = (
            self.nbytes <= _RESIDENT_SHARE * _free(self.device) if resident == "auto" else bool(resident)
        )
        self._data = {field: self._load(field) for field in RESIDENT_FIELDS} if self.resident else {}

    @property
    def nbytes(self) -> int:
        """[byte] of x, tau and C of all rows."""
        return resident_bytes(self.M, self.P)

    def slab(self, field: str, particles: Indices) -> Float[Tensor, "row particle component"]:
        """All frames of some particles.

        Args:
            field: "x" [m], "v" [m/s], "C" [1/s] or "tau" [Pa] (Kirchhoff).
            particles: slice or indices.

        Returns:
            [M,n,c] float32; on resident data a slice is a view, not to be written to.
        """
        return self.gather(field, slice(None), particles)

    def slabs(self, field: str) -> Iterator[tuple[slice, Float[Tensor, "row particle component"]]]:
        """All frames of all particles, some particles at a time; arguments and result as of `slab`."""
        width = max(1, SLAB_ENTRIES // (self.M * COMPONENTS[field]))
        for start in range(0, self.P, width):
            particles = slice(start, min(start + width, self.P))
            yield particles, self.slab(field, particles)

    def gather(
        self, field: str, rows: Indices, particles: Indices
    ) -> Float[Tensor, "row particle component"]:
        """Some frames of some particles, in the order asked for.

        Args:
            field: "x" [m], "v" [m/s], "C" [1/s] or "tau" [Pa] (Kirchhoff).
            rows: slice or indices into 0..M-1.
            particles: slice or indices into 0..P-1, the same for every row.

        Returns:
            [len(rows),len(particles),c] float32.
        """
        if field in self._data:
            data = self._data[field]
            rows, particles = self._on_device(rows), self._on_device(particles)
            if isinstance(rows, slice) or isinstance(particles, slice):
                return data[rows, particles]
            return data[rows[:, None], particles]
        if field not in COMPONENTS:
            raise ShapeError(f"field={field!r}; choose one of {', '.join(COMPONENTS)}")
        columns, numbers = _on_host(particles), np.arange(self.M)[_on_host(rows)]
        out = torch.empty(len(numbers), len(np.arange(self.P)[columns]), COMPONENTS[field])
        self._read(field, numbers, columns, out)
        return out.to(self.device)

    def close(self) -> None:
        """Close the files; resident data stay readable."""
        for trajectory in self.trajectories:
            trajectory.close()

    def _load(self, field: str) -> Tensor:
        """A field [M,P,c] on the device, block by block."""
        data = torch.empty((self.M, self.P, COMPONENTS[field]), device=self.device)
        together = max(1, _STAGING_BYTES // (4 * self.P * COMPONENTS[field]))

        def read(first: int) -> None:
            block = data[first : first + together]
            # Pinned memory is what a GPU copies from at full speed.
            host = torch.empty(block.shape, pin_memory=True) if data.is_cuda else block
            self._read(field, np.arange(first, first + len(block)), slice(None), host)
            if data.is_cuda:
                block.copy_(host)

        with ThreadPoolExecutor(_READERS) as pool:
            collections.deque(pool.map(read, range(0, self.M, together)), maxlen=0)  # raises what one raised
        return data

    def _read(self, field: str, rows: np.ndarray, columns: slice | np.ndarray, out: Tensor) -> None:
        """Rows of a field from the files into a tensor on the host, neighbouring frames together."""
        index = np.searchsorted(self._first, rows, side="right") - 1
        frames, values = rows - self._first[index], out.numpy()
        parts = np.flatnonzero((np.diff(rows) != 1) | (np.diff(index) != 0)) + 1
        for first, end in itertools.pairwise([0, *parts.tolist(), len(rows)]):
            if first < end:
                together = slice(frames[first], frames[first] + end - first)
                self.trajectories[index[first]].read(field, together, columns, out=values[first:end])

    def _on_device(self, indices: Indices) -> slice | Tensor:
        if isinstance(indices, slice):
            return indices
        return torch.as_tensor(indices, dtype=torch.int64, device=self.device)


def _on_host(indices: Indices) -> slice | np.ndarray:
    if isinstance(indices, slice):
        return indices
    return indices.cpu().numpy() if isinstance(indices, Tensor) else np.asarray(indices, dtype=np.int64)


def _require_same(first: Trajectory, other: Trajectory) -> None:
    if first.x_sha256 != other.x_sha256:
        raise SchemaError(
            f"{first.path} and {other.path} are of different particles "
            f"({first.x_sha256[:12]}, {other.x_sha256[:12]}); simulate both from the same X"
        )
    if first.parameters.keys() != other.parameters.keys():
        raise SchemaError(
            f"{first.path} has parameters {list(first.parameters)} and {other.path} has "
            f"{list(other.parameters)}; use trajectories of one scene"
        )


def _device(device: str | torch.device) -> torch.device:
    device = torch.device(device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise DeviceError(f"device={device}: no GPU here, or a torch without CUDA; use device=cpu")
    return device


def _free(device: torch.device) -> int:
    """[byte] that could still be allocated on the device."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return host_memory()
