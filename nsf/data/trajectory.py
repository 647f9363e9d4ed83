"""One full-order simulation on disk: written once and whole, read in pieces."""

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from nsf.data import hdf5, schema
from nsf.data.schema import COMPONENTS, FORCING, SCHEMA_VERSION, TAU_ORDER, UNITS, hash_of_positions, packed
from nsf.data.sink import Sink
from nsf.errors import ConfigError, InstabilityError, SchemaError, ShapeError
from nsf.storage import require_space, writing

_EXACT, _STORED = ("<f8",), ("<f4", "<f8")  # types of constants and of frames
_MOST_SCALARS = 1000
_WIDEST = 100.0  # Δx in units of how far particles lie from the origin: a grid ends beyond them


class TrajectoryWriter:
    """Writes a trajectory frame by frame; the file appears at `path` when it is whole.

    Leaving the `with` block by an exception leaves no file, and an earlier
    one of that name as it was.

    Args:
        path: the file to come.
        X: [P,3] undeformed positions [m]; kept in float64 whatever `dtype`.
        mass: [P] [kg].
        volume0: [P] undeformed volumes [m^3].
        parameters: value of every problem parameter.
        dt: time step of the solver [s].
        dx: grid spacing [m].
        frames: number of frames to be appended, the initial one included.
        dtype: "float32" or "float64", of x, v, C and tau.
        forcing: gravity [F,3] [m/s²] and solids [F,c,4], the shift [m] and angle [rad] of c solids.

    Raises:
        ShapeError: arrays disagree in the number of particles.
        StorageError: the disk cannot hold the file (checked before the first
            frame), or it cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        X: np.ndarray,
        mass: np.ndarray,
        volume0: np.ndarray,
        parameters: Mapping[str, float],
        dt: float,
        dx: float,
        frames: int,
        dtype: str = "float32",
        forcing: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.path = Path(path)
        self.frames = frames
        self.cost: dict[str, float] = {}
        self._t: list[float] = []
        self._dtype = np.dtype(dtype).newbyteorder("<")
        self._particles = {
            name: np.asarray(values, dtype="<f8")
            for name, values in {"X": X, "mass": mass, "volume0": volume0}.items()
        }
        x_sha256 = hash_of_positions(self._particles["X"])
        for name in ("mass", "volume0"):
            if (shape := self._particles[name].shape) != (len(X),):
                raise ShapeError(f"{name} has shape {list(shape)} for {len(X)} particles; give [{len(X)}]")
        self._parameters = {name: float(value) for name, value in parameters.items()}
        self._forcing = {name: np.asarray(values, "<f8") for name, values in (forcing or {}).items()}
        for name, values in self._forcing.items():
            if len(values) != frames:
                raise ShapeError(f"forcing {name} has {len(values)} frames; give frames={frames}")
        self._attributes = {
            "schema_version": SCHEMA_VERSION,
            "units": json.dumps(UNITS),
            "tau_order": ",".join(TAU_ORDER),
            "x_sha256": x_sha256,
            "dt": float(dt),
            "dx": float(dx),
            "complete": False,
        }

    def __enter__(self) -> "TrajectoryWriter":
        with ExitStack() as stack:
            partial = stack.enter_context(writing(self.path))
            particles = len(self._particles["X"])
            require_space(partial, particles * self.frames * sum(COMPONENTS.values()) * self._dtype.itemsize)
            self._sink = stack.enter_context(Sink(partial, "w+"))
            stack.push(self._sink.settle)
            self._file = stack.enter_context(h5py.File(self._sink, "w"))
            self._file.attrs.update(self._attributes)
            for name, values in self._particles.items():
                self._file[f"particles/{name}"] = values
            frames = self._file.create_group("frames")
            self._frames = {
                name: _reserved(frames, name, (self.frames, particles, c), self._dtype)
                for name, c in COMPONENTS.items()
            }
            _write_scalars(self._file.create_group("parameters"), self._parameters)
            for name, values in self._forcing.items():
                self._file[f"forcing/{name}"] = values
            self._stack = stack.pop_all()
        return self

    def append(self, t: float, x: np.ndarray, v: np.ndarray, C: np.ndarray, tau: np.ndarray) -> None:
        """Write the next frame.

        Args:
            t: time [s].
            x: [P,3] positions [m].
            v: [P,3] velocities [m/s].
            C: [P,3,3] or [P,9] affine velocity matrices, by rows [1/s].
            tau: [P,3,3] or [P,6] Kirchhoff stress [Pa].

        Raises:
            InstabilityError: a value is not finite.
            ShapeError: an array is not of all particles, or every frame is written.
        """
        frame = len(self._t)
        if frame == self.frames:
            raise ShapeError(f"{self.path} holds frames={frame} already; open the writer with more")
        for name, values in {"x": x, "v": v, "C": C, "tau": tau}.items():
            dataset = self._frames[name]
            row = packed(name, values)
            if row.shape != dataset.shape[1:]:
                raise ShapeError(f"{name} has shape {list(row.shape)}; give {list(dataset.shape[1:])}")
            if bad := int(np.count_nonzero(~np.isfinite(row))):
                raise InstabilityError(
                    f"frame {frame} has {bad} non-finite values of {name}; take a smaller dt"
                )
            row = np.ascontiguousarray(row, dataset.dtype)
            self._sink.place(row, dataset.offset + frame * row.nbytes)
        self._sink.settle()
        self._t.append(t)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            if error is not None:
                raise error
            if len(self._t) < self.frames:
                raise ShapeError(
                    f"{self.path} got {len(self._t)} of frames={self.frames}; append the rest, "
                    "or open it for fewer"
                )
            self._file["frames/t"] = np.asarray(self._t, "<f8")
            _write_scalars(self._file.create_group("cost"), self.cost)
            self._file.attrs["complete"] = True


class Trajectory:
    """A whole trajectory, opened for reading; frames are mapped, and read when asked for.

    Attributes:
        path: the file.
        X: [P,3] undeformed positions [m], float64.
        mass: [P] [kg], float64.
        volume0: [P] undeformed volumes [m^3], float64.
        t: [F] time of every frame [s].
        dt: time step of the solver [s].
        dx: grid spacing [m].
        parameters: value of every problem parameter, by name in sorted order.
        forcing: what forces the simulation at each frame, as the writer takes it; empty if not known.
        cost: measured costs of the simulation.
        x_sha256: identity of the particles (`hash_of_positions`).
        particles: P.
        frames: F, the initial frame included.
        every: steps of the solver from a frame to the next.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        _check_version(file)
        if not hdf5.attribute(file, "complete", bool):
            raise SchemaError("was not finished by its simulation")
        if (order := hdf5.attribute(file, "tau_order", str)) != ",".join(TAU_ORDER):
            raise SchemaError(f"has tau_order={order}, not {','.join(TAU_ORDER)}")
        if hdf5.attribute(file, "units", str) != json.dumps(UNITS):
            raise SchemaError("has units that are not those of this schema")
        self.x_sha256 = hdf5.attribute(file, "x_sha256", str)
        self.dt, self.dx = (hdf5.attribute(file, name, float) for name in ("dt", "dx"))
        hdf5.check("dt and dx", np.array([self.dt, self.dx]), positive=True)
        self.X = hdf5.values(file, "particles/X", _EXACT, (None, 3))
        self.particles = P = len(self.X)
        self.mass, self.volume0 = (
            hdf5.values(file, f"particles/{name}", _EXACT, (P,), positive=True)
            for name in ("mass", "volume0")
        )
        self.t = hdf5.values(file, "frames/t", _EXACT, (None,), increasing=True)
        self.frames = len(self.t)
        self._check_spacing()
        self.every = round((self.t[1] - self.t[0]) / self.dt) if self.frames > 1 else 1
        self._frames = {
            name: _mapped(path, hdf5.array(file, f"frames/{name}", _STORED, (self.frames, P, c)))
            for name, c in COMPONENTS.items()
        }
        self.parameters, self.cost = (_read_scalars(file, name) for name in ("parameters", "cost"))
        self.forcing = {}
        if "forcing" in file:
            self.forcing = {
                name: hdf5.values(file, f"forcing/{name}", _EXACT, (self.frames, *shape))
                for name, shape in FORCING.items()
            }
        if (x_sha256 := hash_of_positions(self.X)) != self.x_sha256:
            raise SchemaError(f"says x_sha256={self.x_sha256[:12]}, but its X has {x_sha256[:12]}")

    def _check_spacing(self) -> None:
        """Refuse a grid far wider than the particles' places, and steps longer than from frame to frame."""
        if _WIDEST * np.abs(self.X).max(initial=0.0) < self.dx:
            raise SchemaError(f"has dx={self.dx:g} m, far beyond its particles")
        if self.frames > 1 and np.diff(self.t).min() < (1 - 1e-6) * self.dt:
            raise SchemaError(f"has dt={self.dt:g} s, longer than from frame to frame")

    @classmethod
    def open(cls, path: str | Path) -> "Trajectory":
        """Open a trajectory and check it.

        Raises:
            MissingRunError: there is no such file.
            SchemaError: the file was changed after its run, is truncated, foreign,
                unfinished, of a newer schema, incomplete or damaged, has links or
                storage outside it, or values that no simulation leaves; names the file.
        """
        with (
            hdf5.opened(path, "trajectory", "simulate") as file,
            hdf5.reading(path, "trajectory", "simulate"),
        ):
            return cls(Path(path), file)

    @classmethod
    def of(cls, run: Any) -> "Trajectory":
        """Open that of a simulate run, as `open` does; the run has files by name, as `nsf.runs.Run`."""
        return cls.open(run.file(schema.TRAJECTORY))

    def read(
        self, field: str, frames: Any = slice(None), particles: Any = None, out: np.ndarray | None = None
    ) -> np.ndarray:
        """Read some frames of some particles; no more than one frame beyond them is held.

        Args:
            field: "x" [m], "v" [m/s], "C" [1/s] or "tau" [Pa] (Kirchhoff).
            frames: slice, index or indices.
            particles: slice or indices in any order; None for all.
            out: contiguous array [F,n,c] to read into; else a new one in the file's dtype.

        Returns:
            [F,n,c] with c = 3, 3, 9, 6.

        Raises:
            SchemaError: the data are damaged, or not finite.
            ShapeError: no such field, frame or particle, or `out` is of another shape.
        """
        if field not in COMPONENTS:
            raise ShapeError(f"field={field!r}; choose one of {', '.join(COMPONENTS)}")
        stored = self._frames[field]
        rows = _selection(frames, self.frames, "frame")
        columns = _selection(slice(None) if particles is None else particles, self.particles, "particle")
        numbers = np.arange(self.frames)[rows]
        count = len(range(self.particles)[columns]) if isinstance(columns, slice) else len(columns)
        shape = (len(numbers), count, COMPONENTS[field])
        if stored.base.size() < stored.offset + stored.nbytes:  # of the file, as it is now
            raise SchemaError(f"{self.path} was cut short while it was open; simulate again")
        if out is None:
            out = np.empty(shape, stored.dtype.newbyteorder("="))
        if out.shape != shape:
            raise ShapeError(f"out has shape {list(out.shape)}; give {list(shape)}")
        with np.errstate(over="ignore", invalid="ignore"):
            if isinstance(rows, slice) and isinstance(columns, slice):
                out[...] = stored[rows, columns]
            else:
                for i, row in enumerate(numbers):
                    out[i] = stored[row, columns]
        self._check_finite(field, numbers, out)
        return out

    def frames_at(self, steps: np.ndarray) -> np.ndarray:
        """Indices of the frames after some numbers of steps.

        Raises:
            ConfigError: one of them was not stored.
        """
        frames, beyond = np.divmod(steps, self.every)
        if beyond.any():
            raise ConfigError(
                f"{self.path} stores each {self.every}th step, and step {steps[beyond > 0][0]} is needed; "
                "simulate with data.every=1"
            )
        return frames

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        self._frames = {}

    def __enter__(self) -> "Trajectory":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, tuple[Path]]:
        return Trajectory.open, (self.path,)  # another process opens the file for itself

    def _check_finite(self, field: str, rows: np.ndarray, values: np.ndarray) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            total = values.sum()  # at the speed of memory, and not finite if one of the values is not
        if np.isfinite(total):
            return
        bad = np.flatnonzero(~np.isfinite(values).all((1, 2)))
        if bad.size:
            raise SchemaError(
                f"{self.path} has non-finite values of {field}, as in frame {rows[bad[0]]}; simulate again"
            )


@dataclass(frozen=True)
class _Reserved:
    """Where a field's frames are to lie: its shape, the type of its values, its place in the file [byte]."""

    shape: tuple[int, ...]
    dtype: np.dtype
    offset: int


def _reserved(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype) -> _Reserved:
    """Reserve one piece of the file for a field, which HDF5 leaves as it is."""
    how = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    how.set_layout(h5py.h5d.CONTIGUOUS)
    how.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    how.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    created = h5py.h5d.create(
        group.id, name.encode(), h5py.h5t.py_create(dtype), h5py.h5s.create_simple(shape), how
    )
    return _Reserved(shape, dtype, created.get_offset())


def _mapped(path: Path, dataset: h5py.Dataset) -> np.ndarray:
    """The values of an array that lies in one piece in its file.

    Past HDF5, under whose lock one thread at a time could read, and which picks scattered particles slowly.
    """
    return np.memmap(path, dataset.dtype, "r", dataset.id.get_offset(), dataset.shape)


def _check_version(file: h5py.File) -> None:
    try:
        version = hdf5.attribute(file, "schema_version", int)
    except (KeyError, SchemaError) as error:
        raise SchemaError("is HDF5, but not written by nsf; give a file of `nsf simulate`") from error
    if version != SCHEMA_VERSION:
        raise SchemaError(
            f"has schema_version={version}, this nsf reads {SCHEMA_VERSION}; "
            "simulate again with `nsf simulate`"
        )


def _selection(indices: Any, size: int, kind: str) -> slice | np.ndarray:
    """Indices [n] that are in range, or a slice."""
    if isinstance(indices, slice):
        return indices
    array = np.atleast_1d(np.asarray(indices))
    if array.ndim != 1 or not (array.size == 0 or np.issubdtype(array.dtype, np.integer)):
        raise ShapeError(f"{kind}s have shape {list(array.shape)} of {array.dtype}; give integer indices [n]")
    if array.size and not (-size <= array.min() and array.max() < size):
        raise ShapeError(f"{kind}s reach {array.min()}..{array.max()}; there are {size}")
    return array.astype(np.int64)


def _write_scalars(group: h5py.Group, values: Mapping[str, float]) -> None:
    for name, value in values.items():
        group[name] = np.float64(value)


def _read_scalars(file: h5py.File, name: str) -> dict[str, float]:
    group = hdf5.group(file, name)
    if len(group) > _MOST_SCALARS:
        raise SchemaError(f"has {len(group):,} {name}")
    return {key: float(hdf5.values(group, key, _EXACT, ())) for key in sorted(group)}
