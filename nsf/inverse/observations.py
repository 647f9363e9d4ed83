"""What was measured of one run: points of the body over time, and scalars of its shape."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from nsf.data import Trajectory
from nsf.errors import ConfigError, first_line
from nsf.evaluation.quantities import QUANTITIES
from nsf.inverse.model import Model
from nsf.kinematics.interpolation import interpolation

AXES = ("x", "y", "z")
_POINT = ("X", "Y", "Z")
_KNOWN = ("t", "particle", *_POINT, *AXES, "quantity", "value", "deviation")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_COMPONENT = re.compile(rf"([xyz])@({_NUMBER}):({_NUMBER}):({_NUMBER})")
_MOST = 1_000_000  # rows of a file
#: Particles that a scalar of a shape is taken from.
BODY = 1000
#: Of Δt: how far a time may be outside of a run.
_SAME_TIME = 1e-6


def component(text: str) -> tuple[str, np.ndarray] | None:
    """Axis and rest position [3] [m] of a component of a point, as `z@0.5:0.5:0.2`; None of another text."""
    found = _COMPONENT.fullmatch(text)
    return (found[1], np.array(found.groups()[1:], float)) if found else None


def is_scalar(text: str) -> bool:
    """Whether a text names a quantity, or a component of a point."""
    return text in QUANTITIES or component(text) is not None


@dataclass(frozen=True)
class Observations:
    """Numbers that were measured, each with its standard deviation.

    Attributes:
        t: [m] [s].
        what: [m] `x`, `y` or `z` of a point, or the name of a quantity.
        points: [m, 3] rest position of each point [m]; NaN of quantities.
        values, deviations: [m] [m].
        where: [m] the row of a file that each is from, for messages; empty of those from no file.
    """

    t: np.ndarray
    what: tuple[str, ...]
    points: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    where: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    @classmethod
    def of_points(
        cls, t: Sequence[float], points: np.ndarray, x: np.ndarray, deviation: float
    ) -> "Observations":
        """Positions x [k, n, 3] [m] of points at rest [n, 3] at times t [k], all of one deviation [m]."""
        k, n = x.shape[:2]
        return cls(
            np.repeat(np.asarray(t, float), 3 * n),
            AXES * (k * n),
            np.tile(np.repeat(np.asarray(points, float), 3, axis=0), (k, 1)),
            np.asarray(x, float).ravel(),
            np.full(3 * k * n, float(deviation)),
        )

    @classmethod
    def of_scalars(cls, values: Mapping[str, float], t: float, deviation: float = 1e-3) -> "Observations":
        """Quantities and components of points, as `z@X:Y:Z`, by name [m] at a time [s]; one deviation [m]."""
        count = len(values)
        points = np.full((count, 3), np.nan)
        what = list(values)
        for k, name in enumerate(values):
            if found := component(name):
                what[k], points[k] = found
        own = np.array(list(values.values()), float)
        return cls(np.full(count, t), tuple(what), points, own, np.full(count, deviation))

    @classmethod
    def joined(cls, parts: Sequence["Observations"]) -> "Observations":
        """Several after one another."""
        arrays = {
            name: [getattr(own, name) for own in parts] for name in ("t", "points", "values", "deviations")
        }
        what = tuple(name for own in parts for name in own.what)
        return cls(what=what, **{name: np.concatenate(values) for name, values in arrays.items()})

    @classmethod
    def read(cls, path: Path | str, model: Model) -> "Observations":
        """Those of a CSV or HDF5 file (docs/howto/inverse.md).

        Raises:
            ConfigError: a column is missing or unknown, or a value refused; names the row.
        """
        rows = _table(Path(path))
        if unknown := [name for name in rows if name not in _KNOWN]:
            raise ConfigError(f"{path} has the column {unknown[0]!r}; it may have {', '.join(_KNOWN)}")
        if "deviation" not in rows:
            raise ConfigError(f"{path} has no column deviation; give the standard deviation [m] of each row")
        rows = rows.reindex(columns=list(_KNOWN))
        for name in _KNOWN:
            if name == "quantity":
                rows[name] = rows[name].astype(object).where(rows[name].notna(), "").astype(str)
                continue
            try:
                rows[name] = rows[name].astype(float)
            except (TypeError, ValueError):
                raise ConfigError(f"{path}: the column {name} must hold numbers") from None
        records = enumerate(rows.to_dict("records"), 1)
        found = [one for k, row in records for one in _row(f"{path}, row {k}", row, model)]
        if not found:
            raise ConfigError(f"{path} observes nothing; give x, y, z of points, or value of a quantity")
        t, what, points, values, deviations, places = zip(*found, strict=True)
        return cls(np.array(t), what, np.array(points), np.array(values), np.array(deviations), places)

    @property
    def frame(self) -> pd.DataFrame:
        """A row an observation: when, what, where at rest, the value and its deviation."""
        X = dict(zip(_POINT, self.points.T, strict=True))
        return pd.DataFrame(
            {"t": self.t, "what": self.what, **X, "value": self.values, "deviation": self.deviations}
        )

    def _at(self, k: int) -> str:
        """Where an observation is from, before what is wrong with it."""
        return f"{self.where[k]}: " if self.where else ""

    def place(self, k: int) -> str:
        """An observation in words: where it is from, what, and when."""
        return f"{self._at(k)}{self.what[k]} at t = {self.t[k]:g} s"

    def check(self, model: Model) -> "Observations":
        """Itself.

        Raises:
            ConfigError: a time is outside of the run, a point outside of the body, a deviation not positive,
                or a value not finite.
        """
        end, slack = float(model.t[-1]), _SAME_TIME * model.dt
        t, deviation, value = self.t, self.deviations, self.values
        outside, positive = (t < -slack) | (t > end + slack), np.isfinite(deviation) & (deviation > 0.0)
        self._refuse(
            outside,
            t,
            f"t={{:g}} s is outside of the run, 0 … {end:g} s; leave the observation out, or "
            "train with more scene.steps",
        )
        self._refuse(
            ~positive,
            deviation,
            "deviation={:g} m must be positive and finite; give the standard deviation of the measurement",
        )
        self._refuse(~np.isfinite(value), value, "an observed value is {:g} m; give finite positions")
        of_points = np.flatnonzero(~np.isnan(self.points[:, 0]))
        if len(of_points):
            model.check_points(self.points[of_points], lambda k: self._at(int(of_points[k])))
        return self

    def _refuse(self, wrong: np.ndarray, values: np.ndarray, message: str) -> None:
        if wrong.any():
            k = int(wrong.argmax())
            raise ConfigError(self._at(k) + message.format(values[k]))


class View:
    """How observations are seen in runs.

    Args:
        observations: checked.
        model: of the runs.
        looks: frames at which quantities of a whole run are taken; every frame by default.
    """

    def __init__(self, observations: Observations, model: Model, looks: np.ndarray | None = None):
        self.observations, self._model = observations.check(model), model
        own = observations
        self._of_points = np.flatnonzero([what in AXES for what in own.what])
        self._steps, shares = _between(own.t[self._of_points], model)
        self._shares = torch.as_tensor(shares, device=model.device)
        rows = own.points[self._of_points]
        self._points, self._row = np.unique(rows, axis=0, return_inverse=True)
        self._axis = np.array([AXES.index(own.what[i]) for i in self._of_points], int)
        self._of_shape = np.flatnonzero([what in QUANTITIES for what in own.what])
        self._frames = np.round(own.t[self._of_shape] / model.dt).astype(int)
        self._looks = np.arange(len(model.t)) if looks is None else looks
        self._order = np.argsort([*self._of_points, *self._of_shape])
        X = model.manifold.X
        self._body = np.sort(np.random.default_rng(0).permutation(len(X))[:BODY])
        self._X = X[torch.as_tensor(self._body)].to(model.device)

    def of_runs(self, xhat: Tensor) -> Tensor:
        """[B, m] of runs [B, N + 1, r], differentiable."""

        def body(frames: np.ndarray) -> Tensor:
            return self._model.positions(xhat[:, frames], self._at_body)

        parts = [self._positions(xhat)] if len(self._of_points) else []
        parts += [values[:, None] for values in self._quantities(body)]
        return torch.cat(parts, 1)[:, torch.as_tensor(self._order, device=xhat.device)]

    def of_truth(self, trajectory: Trajectory) -> np.ndarray:
        """[m] of a full-order run."""

        def body(frames: np.ndarray) -> Tensor:
            x = trajectory.read("x", frames=frames.tolist(), particles=self._body)
            return torch.as_tensor(x.astype(float))[None].to(self._X)

        seen = np.zeros(0)
        if len(self._of_points):
            frames, at = np.unique([self._steps, self._steps + 1], return_inverse=True)
            x = trajectory.read("x", frames=np.minimum(frames, trajectory.frames - 1)).astype(float)
            every = self._interpolation.value(torch.as_tensor(x.swapaxes(0, 1))).numpy()
            one, two = (every[self._row, rows.reshape(-1), self._axis] for rows in at.reshape(2, -1))
            shares = self._shares.cpu().numpy()
            seen = (1.0 - shares) * one + shares * two
        scalars = [float(value) for value in self._quantities(body)]
        return np.concatenate([seen, scalars])[self._order]

    def _quantities(self, body: Callable[[np.ndarray], Tensor]) -> list[Tensor]:
        """[B] of each scalar of the shape; `body` gives positions [B, frame, particle, 3] at some frames."""
        seen: dict[int, Tensor] = {}
        names = [self.observations.what[i] for i in self._of_shape]
        for frame in np.unique(self._frames):  # one at a time, as bodies are large
            x = body(np.array([frame]))[:, 0]
            for k in np.flatnonzero(self._frames == frame):
                if not (quantity := QUANTITIES[names[k]]).whole:
                    seen[k] = quantity.of(x, self._X)
        if len(seen) < len(names):
            x = body(self._looks)
            for k in set(range(len(names))) - set(seen):
                seen[k] = QUANTITIES[names[k]].of(x[:, self._looks <= self._frames[k]], self._X)
        return [seen[k] for k in range(len(names))]

    def _positions(self, xhat: Tensor) -> Tensor:
        """[B, …] of the observations of points."""
        kinds, at = np.unique(
            np.stack([self._steps, self._shares.cpu().numpy()], 1), axis=0, return_inverse=True
        )
        steps = torch.as_tensor(kinds[:, 0].astype(int), device=xhat.device)
        shares = torch.as_tensor(kinds[:, 1:], device=xhat.device)
        after = steps.add(1).clamp_max(xhat.shape[1] - 1)
        between = xhat[:, steps] * (1.0 - shares) + xhat[:, after] * shares
        x = self._model.positions(between, self._at)
        return x[:, at.reshape(-1), self._row, self._axis]

    @cached_property
    def _at(self):
        return self._model.at(self._points)

    @cached_property
    def _at_body(self):
        return self._model.at(self._body)

    @cached_property
    def _interpolation(self):
        X = self._model.manifold.X.cpu()
        return interpolation(torch.as_tensor(self._points), X)


def _between(t: np.ndarray, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """The frame before each time, and the share of the step that has passed since."""
    at = np.clip(t / model.dt, 0.0, len(model.t) - 1.0)
    whole = np.abs(at - np.round(at)) < _SAME_TIME
    at = np.where(whole, np.round(at), at)
    steps = np.floor(at).astype(int)
    return steps, at - steps


def _table(path: Path) -> pd.DataFrame:
    """The rows of a file."""
    if not path.is_file():
        raise ConfigError(f"{path} is no file; name a CSV or HDF5 file of observations")
    try:
        if path.suffix in (".h5", ".hdf5"):
            rows = _hdf5(path)
        else:
            rows = pd.read_csv(path, nrows=_MOST, skipinitialspace=True)
    except (OSError, ValueError) as error:
        kind = "HDF5" if path.suffix in (".h5", ".hdf5") else "CSV"
        raise ConfigError(f"{path} is no {kind} file of columns ({first_line(error)})") from error
    if not len(rows):
        raise ConfigError(f"{path} has no rows; give a row an observation")
    return rows


def _hdf5(path: Path) -> pd.DataFrame:
    """Data sets of one axis, a column each."""
    import h5py

    with h5py.File(path, "r") as file:
        own = {name: file[name] for name in file if isinstance(file[name], h5py.Dataset)}
        if any(values.ndim != 1 or len(values) > _MOST for values in own.values()):
            raise ConfigError(f"{path} must hold arrays of one axis, a column each")
        text = {name: h5py.check_string_dtype(values.dtype) for name, values in own.items()}
        return pd.DataFrame(
            {name: values.asstr()[()] if text[name] else values[()] for name, values in own.items()}
        )


def _row(where: str, row: Mapping, model: Model) -> list[tuple]:
    """The observations of one row of a file."""
    if quantity := row["quantity"]:
        if quantity not in QUANTITIES:
            raise ConfigError(
                f"{where}: unknown quantity {quantity!r}; choose one of {', '.join(QUANTITIES)}"
            )
        if not np.isfinite(row["value"]):
            raise ConfigError(f"{where}: {quantity} has no value; give it [m]")
        t = float(model.t[-1]) if np.isnan(row["t"]) else row["t"]
        return [(t, quantity, np.full(3, np.nan), row["value"], row["deviation"], where)]
    if not np.isfinite(row["t"]):
        raise ConfigError(f"{where} has no t; give the time [s] of a point's position")
    point, particle = np.array([row[name] for name in _POINT]), row["particle"]
    if np.isfinite(particle):
        X = model.manifold.X.cpu().numpy()
        if not (particle % 1 == 0 and 0 <= particle < len(X)):
            raise ConfigError(f"{where}: particle={particle:g} must be a whole number below {len(X)}")
        point = X[int(particle)]
    if not np.isfinite(point).all():
        raise ConfigError(f"{where} names no point; give X, Y, Z at rest [m], or particle")
    seen = [axis for axis in AXES if not np.isnan(row[axis])]
    return [(row["t"], axis, point, row[axis], row["deviation"], where) for axis in seen]
