"""What was measured of one run: points of the body over time, and scalars of its shape."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
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
    def read(cls, path: Path | str, model: Model) -> "Observations":
        """Those of a CSV or HDF5 file (docs/howto/inverse.md).

        Raises:
            ConfigError: a column is missing or unknown, or a value refused; names the row.
        """
        table = _table(Path(path))
        if unknown := [name for name in table if name not in _KNOWN]:
            raise ConfigError(f"{path} has the column {unknown[0]!r}; it may have {', '.join(_KNOWN)}")
        if "deviation" not in table:
            raise ConfigError(f"{path} has no column deviation; give the standard deviation [m] of each row")
        rows = len(next(iter(table.values())))
        column = {name: _numbers(path, name, table, rows) for name in _KNOWN if name != "quantity"}
        names = [str(name) if isinstance(name, str) else "" for name in table.get("quantity", [""] * rows)]
        found: list[tuple[float, str, np.ndarray, float, float, str]] = []
        for row in range(rows):
            at, where = {name: values[row] for name, values in column.items()}, f"{path}, row {row + 1}"
            found += [(*seen, where) for seen in _row(where, at, names[row], model)]
        if not found:
            raise ConfigError(f"{path} observes nothing; give x, y, z of points, or value of a quantity")
        t, what, points, values, deviations, places = zip(*found, strict=True)
        return cls(np.array(t), what, np.array(points), np.array(values), np.array(deviations), places)

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
        for wrong, told in (
            (
                (self.t < -slack) | (self.t > end + slack),
                lambda k: (
                    f"t={self.t[k]:g} s is outside of the run, 0 … {end:g} s; leave the observation "
                    "out, or train with more scene.steps"
                ),
            ),
            (
                ~(np.isfinite(self.deviations) & (self.deviations > 0.0)),
                lambda k: (
                    f"deviation={self.deviations[k]:g} m must be positive and finite; give the standard "
                    "deviation of the measurement"
                ),
            ),
            (
                ~np.isfinite(self.values),
                lambda k: f"an observed value is {self.values[k]:g} m; give finite positions",
            ),
        ):
            if wrong.any():
                raise ConfigError(self._at(k := int(wrong.argmax())) + told(k))
        of_points = np.flatnonzero(~np.isnan(self.points[:, 0]))
        if len(of_points):
            model.check_points(self.points[of_points], lambda k: self._at(int(of_points[k])))
        return self


class View:
    """How observations are seen in runs.

    Args:
        observations: checked.
        model: of the runs.
    """

    def __init__(self, observations: Observations, model: Model):
        self.observations, self._model = observations.check(model), model
        own = observations
        self._of_points = np.flatnonzero([what in AXES for what in own.what])
        self._steps, shares = _between(own.t[self._of_points], model)
        self._shares = torch.as_tensor(shares, device=model.device)
        rows = own.points[self._of_points]
        self._points, self._row = np.unique(rows, axis=0, return_inverse=True)
        self._axis = np.array([AXES.index(own.what[i]) for i in self._of_points], int)
        self._quantities = [i for i, what in enumerate(own.what) if what in QUANTITIES]
        X = model.manifold.X
        if self._quantities:
            kept = np.sort(np.random.default_rng(0).permutation(len(X))[:BODY])
            self._body, self._X = kept, X[torch.as_tensor(kept)].to(model.device)

    def of_runs(self, xhat: Tensor) -> Tensor:
        """[B, m] of runs [B, N + 1, r], differentiable."""
        found = torch.zeros(len(xhat), len(self.observations), dtype=xhat.dtype, device=xhat.device)
        parts = [self._positions(xhat)] if len(self._of_points) else []
        parts += [self._quantity(i, xhat)[:, None] for i in self._quantities]
        order = np.argsort([*self._of_points, *self._quantities])
        return torch.cat(parts, 1)[:, torch.as_tensor(order, device=found.device)]

    def of_truth(self, trajectory: Trajectory) -> np.ndarray:
        """[m] of a full-order run."""
        found = np.zeros(len(self.observations))
        if len(self._of_points):
            frames, at = np.unique([self._steps, self._steps + 1], return_inverse=True)
            last = trajectory.frames - 1
            x = trajectory.read("x", frames=np.minimum(frames, last)).astype(float)
            seen = self._interpolation.value(torch.as_tensor(x.swapaxes(0, 1))).numpy()
            one, two = (seen[self._row, rows.reshape(-1), self._axis] for rows in at.reshape(2, -1))
            shares = self._shares.cpu().numpy()
            found[self._of_points] = (1.0 - shares) * one + shares * two
        for i in self._quantities:
            quantity = QUANTITIES[self.observations.what[i]]
            frame = round(self.observations.t[i] / self._model.dt)
            frames = slice(0, frame + 1) if quantity.whole else [frame]
            x = torch.as_tensor(trajectory.read("x", frames=frames, particles=self._body).astype(float))
            found[i] = float(quantity.of(x if quantity.whole else x[0], self._X.cpu()))
        return found

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

    def _quantity(self, i: int, xhat: Tensor) -> Tensor:
        """[B] of a scalar of the shape."""
        quantity = QUANTITIES[self.observations.what[i]]
        frame = round(self.observations.t[i] / self._model.dt)
        rows = xhat[:, : frame + 1] if quantity.whole else xhat[:, frame]
        return quantity.of(self._model.positions(rows, self._at_body), self._X)

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


def _table(path: Path) -> Mapping[str, Sequence]:
    """Columns of a file by name."""
    if not path.is_file():
        raise ConfigError(f"{path} is no file; name a CSV or HDF5 file of observations")
    if path.suffix in (".h5", ".hdf5"):
        import h5py

        try:
            with h5py.File(path, "r") as file:
                own = {name: file[name] for name in file if isinstance(file[name], h5py.Dataset)}
                if any(values.ndim != 1 or len(values) > _MOST for values in own.values()):
                    raise ConfigError(f"{path} must hold arrays of one axis, a column each")
                found = {
                    name: values.asstr()[()] if h5py.check_string_dtype(values.dtype) else values[()]
                    for name, values in own.items()
                }
        except OSError as error:
            raise ConfigError(f"{path} is no HDF5 file ({first_line(error)})") from error
    else:
        import pandas as pd

        try:
            frame = pd.read_csv(path, nrows=_MOST, skipinitialspace=True)
        except (ValueError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path} is no CSV file ({first_line(error)})") from error
        found = {name: frame[name].tolist() for name in frame}
    if (
        not found
        or len({len(values) for values in found.values()}) > 1
        or not len(next(iter(found.values())))
    ):
        raise ConfigError(f"{path} has no rows, or columns of different length; give a row an observation")
    return found


def _numbers(path, name: str, table: Mapping[str, Sequence], rows: int) -> np.ndarray:
    try:
        return np.asarray(table.get(name, np.full(rows, np.nan)), float)
    except (TypeError, ValueError):
        raise ConfigError(f"{path}: the column {name} must hold numbers") from None


def _row(where: str, at: Mapping[str, float], quantity: str, model: Model) -> list[tuple]:
    """The observations of one row of a file."""
    end, none = float(model.t[-1]), np.full(3, np.nan)
    if quantity:
        if quantity not in QUANTITIES:
            raise ConfigError(
                f"{where}: unknown quantity {quantity!r}; choose one of {', '.join(QUANTITIES)}"
            )
        if not np.isfinite(at["value"]):
            raise ConfigError(f"{where}: {quantity} has no value; give it [m]")
        t = end if np.isnan(at["t"]) else at["t"]
        return [(t, quantity, none, at["value"], at["deviation"])]
    if not np.isfinite(at["t"]):
        raise ConfigError(f"{where} has no t; give the time [s] of a point's position")
    point = np.array([at[name] for name in _POINT])
    if np.isfinite(at["particle"]):
        X = model.manifold.X.cpu().numpy()
        if not (at["particle"] % 1 == 0 and 0 <= at["particle"] < len(X)):
            raise ConfigError(f"{where}: particle={at['particle']:g} must be a whole number below {len(X)}")
        point = X[int(at["particle"])]
    if not np.isfinite(point).all():
        raise ConfigError(f"{where} names no point; give X, Y, Z at rest [m], or particle")
    seen = [axis for axis in AXES if not np.isnan(at[axis])]
    return [(at["t"], axis, point, at[axis], at["deviation"]) for axis in seen]
