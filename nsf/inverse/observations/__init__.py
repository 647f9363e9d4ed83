"""Observations of one run: points of the body over time, and scalars of its shape."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from nsf.data import Trajectory
from nsf.errors import ConfigError
from nsf.inverse.columns import AXES, COLUMNS, SAME_TIME, component, read_columns
from nsf.inverse.model import Model
from nsf.kinematics.interpolation import interpolation
from nsf.kinematics.manifold import Restriction
from nsf.quantities import QUANTITIES
from nsf.vectors import drawn

_Positions = Callable[[np.ndarray], Tensor]
_POINT = ("X", "Y", "Z")
#: Particles that a scalar of a shape is taken from.
BODY = 1000


@dataclass(frozen=True)
class Observations:
    """Numbers that were measured, each with its standard deviation.

    Attributes:
        t: [m] [s].
        what: [m] `x`, `y` or `z` of a point, or the name of a quantity.
        points: [m, 3] rest position of each point [m]; NaN of quantities.
        values, deviations: [m] [m].
        rows: [m] the row of a file that each is from, and source: the file, for messages; none of others.
    """

    t: np.ndarray
    what: tuple[str, ...]
    points: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    rows: np.ndarray | None = None
    source: str = ""

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
    def of_scalars(cls, values: Mapping[str, float], times: float | np.ndarray) -> "Observations":
        """Quantities and components of points, as `z@X:Y:Z`, by name [m], at each of some times [s].

        Their deviation is 1 mm.
        """
        times = np.atleast_1d(times)
        what, points = zip(*(component(name) or (name, np.full(3, np.nan)) for name in values), strict=True)
        return cls(
            np.repeat(times, len(values)),
            what * len(times),
            np.tile(points, (len(times), 1)),
            np.tile(np.array(list(values.values()), float), len(times)),
            np.full(len(times) * len(values), 1e-3),
        )

    @classmethod
    def read(cls, path: Path | str, model: Model) -> "Observations":
        """The observations of a CSV or HDF5 file (docs/howto/inverse.md).

        Raises:
            ConfigError: a column is missing or unknown, or a value refused; names the row.
            SchemaError: the file is damaged, or reads others.
        """
        table = read_columns(path)
        count = len(table["deviation"])
        empty = dict.fromkeys(COLUMNS, np.full(count, np.nan)) | {"quantity": np.full(count, "", object)}
        table = empty | table
        scalar = table["quantity"] != ""
        X, x = (np.column_stack([table[name] for name in names]) for names in (_POINT, AXES))
        rest, particle = model.manifold.X.cpu().numpy(), table["particle"]
        _check_rows(path, table, len(rest))
        named = ~np.isnan(particle)
        X[named] = rest[particle[named].astype(int)]
        rows, which = np.nonzero(np.column_stack([~np.isnan(x), scalar]))
        whole = np.where(scalar & np.isnan(table["t"]), float(model.t[-1]), table["t"])
        return cls(
            whole[rows],
            tuple([*AXES, table["quantity"][row]][k] for row, k in zip(rows, which, strict=True)),
            X[rows],
            np.column_stack([x, table["value"]])[rows, which],
            table["deviation"][rows],
            rows + 1,
            str(path),
        )

    @property
    def frame(self) -> pd.DataFrame:
        """A row an observation: when, what, where at rest, the value and its deviation."""
        X = dict(zip(_POINT, self.points.T, strict=True))
        return pd.DataFrame(
            {"t": self.t, "what": self.what, **X, "value": self.values, "deviation": self.deviations}
        )

    def _at(self, k: int) -> str:
        """Where an observation is from, before what is wrong with it."""
        return "" if self.rows is None else f"{self.source}, row {self.rows[k]}: "

    def place(self, k: int) -> str:
        """An observation in words: where it is from, what, and when."""
        return f"{self._at(k)}{self.what[k]} at t = {self.t[k]:g} s"

    def check(self, model: Model) -> "Observations":
        """Itself.

        Raises:
            ConfigError: a time is outside of the run, a point outside of the body, a deviation not positive,
                or a value not finite.
        """
        end, slack = float(model.t[-1]), SAME_TIME * model.dt
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
    """How observations are seen in runs; between two frames linear in time.

    Args:
        observations: checked.
        model: of the runs.
        looks: frames at which quantities of a whole run are taken; every frame by default.
    """

    def __init__(self, observations: Observations, model: Model, looks: np.ndarray | None = None):
        self.observations, self._model = observations.check(model), model
        t, what, X = observations.t, observations.what, model.manifold.X
        self._of_points = np.flatnonzero([name in AXES for name in what])
        self._steps, self._shares = _between(t[self._of_points], model)
        self._points, self._row = np.unique(observations.points[self._of_points], axis=0, return_inverse=True)
        self._axis = np.array([AXES.index(what[i]) for i in self._of_points], int)
        self._of_shape = np.flatnonzero([name in QUANTITIES for name in what])
        self._frames = np.round(t[self._of_shape] / model.dt).astype(int)
        self._looks = np.arange(len(model.t)) if looks is None else looks
        self._order = np.argsort([*self._of_points, *self._of_shape])
        self._body = drawn(len(X), BODY)
        self._X = X[torch.as_tensor(self._body)].to(model.device)

    def of_runs(self, xhat: Tensor) -> Tensor:
        """[B, m] of runs [B, N + 1, r], differentiable."""
        return self._seen(
            lambda frames: self._model.positions(xhat[:, frames], self._at),
            lambda frames: self._model.positions(xhat[:, frames], self._at_body),
        )

    def of_truth(self, run: Trajectory | np.ndarray) -> np.ndarray:
        """[m] of a full-order run, or of its positions [N + 1, P, 3] [m]."""

        def read(steps: np.ndarray, particles: np.ndarray | slice = slice(None)) -> Tensor:
            if isinstance(run, np.ndarray):
                x = run[steps][:, particles]
            else:
                x = run.read("x", frames=run.frames_at(steps).tolist(), particles=particles)
            return torch.as_tensor(x.astype(float))

        seen = self._seen(
            lambda frames: self._interpolation.value(read(frames).transpose(0, 1)).transpose(0, 1)[None],
            lambda frames: read(frames, self._body)[None].to(self._X),
        )
        return seen[0].cpu().numpy()

    def _seen(self, points: _Positions, body: _Positions) -> Tensor:
        """[B, m] of positions [B, frame, n, 3] at some frames, of the observed points and of the body."""
        parts = [values[:, None] for values in self._quantities(body)]
        if len(self._of_points):
            after = self._steps + (self._shares > 0.0)
            frames, at = np.unique([self._steps, after], return_inverse=True)
            x = points(frames)
            begun, ended = (x[:, rows, self._row, self._axis] for rows in at.reshape(2, -1))
            parts.insert(0, begun + torch.as_tensor(self._shares).to(x) * (ended - begun))
        return torch.cat(parts, 1)[:, self._order]

    def _quantities(self, body: _Positions) -> list[Tensor]:
        """[B] of each scalar of the shape."""
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

    @cached_property
    def _at(self) -> Restriction:
        return self._model.at(self._points)

    @cached_property
    def _at_body(self) -> Restriction:
        return self._model.at(self._body)

    @cached_property
    def _interpolation(self):
        return interpolation(torch.as_tensor(self._points), self._model.manifold.X.cpu())


def _between(t: np.ndarray, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """The frame before each time, and the share of the step that has passed since."""
    at = np.clip(t / model.dt, 0.0, len(model.t) - 1.0)
    at = np.where(np.abs(at - np.round(at)) < SAME_TIME, np.round(at), at)
    steps = np.floor(at).astype(int)
    return steps, at - steps


def _check_rows(path: Path | str, table: Mapping[str, np.ndarray], particles: int) -> None:
    """Refuse rows of a file that name no point or quantity, or hold a number that nobody would read.

    Args:
        path: of the file.
        table: every column [rows], NaN or "" where it is empty.
        particles: of the body.

    Raises:
        ConfigError: names the first such row.
    """
    filled = {name: ~np.isnan(table[name]) for name in COLUMNS if name != "quantity"}
    placed, seen = (np.any([filled[name] for name in names], axis=0) for names in (_POINT, AXES))
    scalar, particle = table["quantity"] != "", table["particle"]
    whole = np.all([np.isfinite(table[name]) for name in _POINT], axis=0) | filled["particle"]
    valid = (np.floor(particle) == particle) & (particle >= 0) & (particle < particles)
    for wrong, message in (
        (
            scalar & ~np.isin(table["quantity"], list(QUANTITIES)),
            f": unknown quantity {{quantity!r}}; choose one of {', '.join(QUANTITIES)}",
        ),
        (scalar & ~np.isfinite(table["value"]), ": {quantity} has no value; give it [m]"),
        (
            scalar & (placed | seen | filled["particle"]),
            ": {quantity} stands beside a point (particle, X, Y, Z, x, y, z); give each its own row",
        ),
        (
            ~scalar & filled["value"],
            ": value={value:g} is of no quantity; name it, or give x, y, z of a point",
        ),
        (~scalar & ~np.isfinite(table["t"]), " has no t; give the time [s] of a point's position"),
        (placed & filled["particle"], ": particle={particle:g} stands beside X, Y, Z; give one of them"),
        (filled["particle"] & ~valid, f": particle={{particle:g}} must be a whole number below {particles}"),
        (~scalar & ~whole, " names no point; give X, Y, Z at rest [m], or particle"),
        (~scalar & ~seen, " observes nothing; give x, y, z of the point [m], or leave the row out"),
    ):
        if wrong.any():
            k = int(wrong.argmax())
            row = {name: values[k] for name, values in table.items()}
            raise ConfigError(f"{path}, row {k + 1}{message.format(**row)}")
