"""`nsf.Model`: a taught run as a function of its problem parameters and forcing, for thousands at once."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from numpy.polynomial import chebyshev
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from nsf.data import PROGRAM
from nsf.deployment import TRUST, Trust
from nsf.errors import ConfigError, ShapeError
from nsf.inverse.recurrence import differentiable_run, member_runs
from nsf.kinematics.manifold import Restriction
from nsf.models import Recurrence
from nsf.pipeline import Pipeline
from nsf.recurrence import RecurrenceEngine, collider_states, first_change
from nsf.recurrence.engine import between
from nsf.runs import Run


@dataclass(frozen=True)
class Forcing:
    """Gravity and solids that act on runs from outside at each step.

    Attributes:
        gravity: [N, 3], or [B, N, 3] of each run [m/s²].
        solids: [N, f], or [B, N, f]: state of the colliders, as `nsf.recurrence.collider_states` has it.
    """

    gravity: Tensor
    solids: Tensor


class Model:
    """Runs by recurrence as a function of their problem parameters: batched, and differentiable by torch.

    Args:
        run: complete deploy run with model=recurrence.
        device: `cpu`, `cuda`, `cuda:N` or `auto`.

    Attributes:
        run, pipeline, manifold: what it is made of.
        names: of the problem parameters, in the order of every tensor of them; units: theirs.
        ranges: [n, 2] what was taught of each.
        t: [N + 1] times of the frames [s]; dt: step [s].
        spacing: edge of the cube that a particle fills [m].

    Raises:
        MissingRunError: the run, or its teaching, is not whole.
        ConfigError: the run has another model, or its recurrence does not fit it.
        DeviceError: the device does not exist.
    """

    def __init__(self, run: Run, device: str = "auto"):
        self.run = run.require()
        self.pipeline = Pipeline.of_run(run, device, say=lambda line: None)
        if not isinstance(self.pipeline.model, Recurrence):
            raise ConfigError(
                f"{run.id} has model={self.pipeline.model.name}, whose steps know no gradient; deploy it "
                "with model=recurrence, which is taught first"
            )
        self.manifold = self.pipeline.manifold()
        self.recurrence: RecurrenceEngine = self.pipeline.recurrence()
        self.scene = self.pipeline.deployed
        one = self.pipeline.batch_at(
            self.manifold, self.pipeline.split.train[:1], engine=self.recurrence, scene=self.pipeline.scene
        ).batch.shared
        self.device = one.torch_device
        self.names = self.recurrence.taught.parameters
        self.units = tuple(self.scene.parameters[name].unit for name in self.names)
        self.ranges = np.array(self.recurrence.taught.ranges)
        self.dt, self.t = one.dt, one.dt * np.arange(one.total_steps + 1)
        self.spacing = float(one.constants.volume0.mean() ** (1 / 3))
        self._form = self.recurrence.form.to(self.device)
        self._xhat = one.xhat.to(self.device, torch.float64)
        self._given: dict[str, Polynomial] = {}
        self._built: dict[tuple, dict[str, np.ndarray]] = {}

    @classmethod
    def load(cls, run: Run | Path | str | None = None, device: str = "auto") -> "Model":
        """The model of a deploy run.

        Args:
            run: the run, its folder, or the beginning of its id or hash; None for the newest.
            device: as for `Model`.
        """
        if run is None:
            return cls(Run.newest("deploy"), device)
        return cls(run if isinstance(run, Run) else Run.named(str(run), "deploy"), device)

    def tensor(self, parameters: Tensor | Mapping[str, float] | Sequence) -> Tensor:
        """Parameters [..., n] of a tensor or array, or of a mapping of numbers or arrays by name.

        Raises:
            ConfigError: a name is unknown or missing. ShapeError: the last axis is not of the parameters.
        """
        if isinstance(parameters, Mapping):
            if wrong := set(self.names) ^ set(parameters):
                raise ConfigError(f"{sorted(wrong)[0]!r}: give a value for each of {', '.join(self.names)}")
            columns = [torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names]
            parameters = torch.stack(torch.broadcast_tensors(*columns), -1)
        tensor = torch.as_tensor(parameters, dtype=torch.float64, device=self.device)
        if tensor.ndim == 0 or tensor.shape[-1] != len(self.names):
            raise ShapeError(
                f"parameters have shape {list(tensor.shape)}; give [..., {len(self.names)}], as "
                f"{', '.join(self.names)}"
            )
        return tensor

    def __call__(self, parameters, forcing: Forcing | None = None) -> Tensor:
        """Latent vectors [..., N + 1, r] of runs, differentiable in parameters and forcing.

        Args:
            parameters: [..., n], or a mapping of numbers or arrays by name.
            forcing: of all runs, or of each; the scene's own by default.
        """
        mu = self.tensor(parameters)
        rows = mu.reshape(-1, mu.shape[-1])
        run = differentiable_run(self._form, *self._start_and_forcing(rows, forcing))
        return run.movedim(0, -2).unflatten(0, mu.shape[:-1]) if mu.ndim > 1 else run[:, 0]

    def _start_and_forcing(self, rows: Tensor, forcing: Forcing | None) -> tuple[Tensor, ...]:
        """x̂_0, d_0, parameters, gravity and solids of runs at parameters [B, n], as a run takes them."""
        first = self._of("start", rows).expand(len(rows), -1).clone()
        acting = forcing or Forcing(self._of("gravity", rows), self._of("solids", rows))
        gravity, solids = (
            values.to(self.device).flatten(0, -3).movedim(-2, 0) if values.ndim > 2 else values[:, None]
            for values in (acting.gravity, acting.solids)
        )
        return self._xhat.repeat(len(rows), 1), first, rows, gravity, solids

    def at(self, points) -> Restriction:
        """The fields at particles [n] or rest positions [n, 3] [m], for many calls of `positions`."""
        if isinstance(points, Restriction):
            return points
        points = torch.as_tensor(points)
        where = {"X": points.double()} if points.is_floating_point() else {"particles": points}
        return self.manifold.restrict(**where, dtype=torch.float64, device=self.device)

    def positions(self, xhat: Tensor, points) -> Tensor:
        """Positions [..., n, 3] [m] of points of the body at latent vectors [..., r], differentiable.

        Args:
            xhat: latent vectors.
            points: particles or rest positions, as for `at`, or what it gave.
        """
        x = self.at(points).position(xhat.flatten(0, -2) if xhat.ndim > 1 else xhat)
        return x.unflatten(0, xhat.shape[:-1]) if xhat.ndim > 1 else x

    def check_points(self, points: np.ndarray, where: Callable[[int], str] = lambda k: "") -> None:
        """Refuse rest positions [n, 3] [m] that are not of the body; `where` begins the message of one.

        Raises:
            ConfigError: one is further from the nearest particle than a particle is wide.
        """
        from scipy.spatial import cKDTree

        off, _ = cKDTree(self.manifold.X.cpu().numpy()).query(points)
        if off.max() > self.spacing:
            X = ", ".join(f"{value:.4g}" for value in points[off.argmax()])
            raise ConfigError(
                f"{where(int(off.argmax()))}the point ({X}) m lies {off.max():.3g} m from the nearest "
                "particle, outside of the body; X, Y, Z is where a point is at rest, before the run"
            )

    def forcing(self, parameters=None, program: int | None = None) -> Forcing:
        """The scene's own forcing.

        Args:
            parameters: [n] or a mapping by name; the middle of the ranges by default.
            program: number of the run's program, where the scene has programs; as configured by default.
        """
        mu = self.ranges.mean(1) if parameters is None else self.tensor(parameters).cpu().numpy()
        parts = (torch.as_tensor(self._inputs(mu, program)[name]) for name in ("gravity", "solids"))
        return Forcing(*(values.to(self.device) for values in parts))

    def error_bound(self, parameters, forcing: Forcing | None = None) -> np.ndarray:
        """[...] bound of the displacement error of runs, a share of the displacement.

        ∞ of a run that is lost or left what was taught; NaN where no validation run tells (docs/method.md).

        Args:
            parameters, forcing: as for a call.
        """
        mu = self.tensor(parameters).detach()
        rows = mu.reshape(-1, mu.shape[-1])
        with torch.no_grad():
            inputs, k = self._start_and_forcing(rows, forcing), self._form.stride
            path = member_runs(self._form, *inputs).permute(2, 1, 0, 3)  # [B, M, n, r] at strides
            runs = between(path.mean(1), inputs[1], k).cpu().numpy()
        acting = forcing or Forcing(self._of("gravity", rows), self._of("solids", rows))
        gravity, solids = (
            values.detach().cpu().expand(len(rows), *values.shape[-2:]).numpy()
            for values in (acting.gravity, acting.solids)
        )
        members, bounds = path.cpu().numpy(), []
        for values, xhat, paths, *forced in zip(rows.tolist(), runs, members, gravity, solids, strict=True):
            case, several = dict(zip(self.names, values, strict=True)), len(paths) > 1
            signal = self.trust.signal(xhat[::k], paths if several else None)
            outside = self.trust.reach.of_inputs(case, *forced, self.dt)
            verdict = self.trust.judge(case, self.t, xhat, np.interp(self.t, self.t[::k], signal), outside)
            bounds.append(np.inf if verdict.beyond else verdict.bound_share)
        return np.reshape(bounds, mu.shape[:-1])

    @cached_property
    def trust(self) -> Trust:
        """The bounds of its errors, as its deployment calibrated them."""
        return Trust.open(self.run.file(TRUST), self.manifold)

    def _of(self, name: str, mu: Tensor) -> Tensor:
        """The start of runs, or their forcing, at parameters."""
        if name not in self._given:
            of = partial(self._input, name)
            self._given[name] = Polynomial(of, self.ranges, (self.names, name)).to(self.device)
        return self._given[name](mu)

    def _input(self, name: str, mu: np.ndarray) -> np.ndarray:
        return self._inputs(mu)[name]

    def _inputs(self, mu: Sequence[float], program: int | None = None) -> dict[str, np.ndarray]:
        """Values of the scene at parameters: start d_0 [r], gravity [N, 3], solids [N, f]; built once."""
        case = dict(zip(self.names, map(float, mu), strict=True))
        if program is not None:
            case[PROGRAM] = program
        if (key := tuple(case.items())) not in self._built:
            self._built[key] = self._inputs_of(case)
        return self._built[key]

    def _inputs_of(self, case: Mapping[str, float]) -> dict[str, np.ndarray]:
        scene, steps = self.scene.at(self.scene.case(case)), len(self.t) - 1
        stride = self.dt * self.recurrence.form.stride
        start = first_change(self.manifold, scene.particles().X, scene.initial_velocity(), stride)
        return {
            "start": start.numpy(),
            "gravity": scene.acting_gravity.at(self.t[:-1]),
            "solids": collider_states(scene.solids, self.dt, steps),
        }


#: Degrees that are tried in turn: a velocity is linear in its speed, a direction takes more of its angle.
_DEGREES = (1, 2, 4, 8, 12)
_SAME = 1e-9  # of the largest value, by how much a polynomial may be off
_COMPARED = (0.137, 0.529, 0.871)  # where it is compared, in units of the ranges


class Polynomial:
    """An array as a polynomial of the problem parameters.

    Each parameter that changes the array has the degree that it takes by itself. Parameters whose changes
    add up have terms apart, so that the scenes that are built grow with their number and no faster; only
    those that act together, as a speed and its direction, have products of terms.

    Args:
        of: parameters [n] → array.
        ranges: [n, 2] of the parameters.
        names: of the parameters and of the array, for messages.

    Attributes:
        varies: whether any parameter changes the array.

    Raises:
        ConfigError: no polynomial comes near it.
    """

    def __init__(
        self, of: Callable[[np.ndarray], np.ndarray], ranges: np.ndarray, names: tuple[Sequence[str], str]
    ):
        self._ranges, self._of, self._names = np.asarray(ranges, float), of, names
        base = np.asarray(of(self._ranges.mean(1)), float)
        self._shape, self._base = base.shape, torch.as_tensor(base.ravel())
        one = {p: self._change({p: _COMPARED[0]}) for p in range(len(ranges))}
        along = [p for p, change in one.items() if change.any()]
        self.varies, self._terms = bool(along), []
        if not along:
            return
        compared = [dict.fromkeys(along, u) for u in _COMPARED]
        truth = torch.stack([self._change(place) for place in compared])
        largest = max(float((truth + self._base).abs().max()), float(self._base.abs().max()))
        self._slack = _SAME * largest
        degrees = {p: self._degree(p) for p in along}
        self._terms = [self._term(group, degrees) for group in self._groups(along, one)]
        if (self._sum(self._units(compared)) - truth).abs().max() > self._slack:
            self._refuse(along)

    def to(self, device: torch.device) -> "Polynomial":
        """Itself, with all it holds on a device."""
        self._base = self._base.to(device)
        self._terms = [(degrees, coefficients.to(device)) for degrees, coefficients in self._terms]
        return self

    def __call__(self, parameters: Tensor) -> Tensor:
        """The array [..., *shape] at parameters [..., n]; [*shape] where none changes it."""
        if not self.varies:
            return self._base.view(self._shape)
        low, high = torch.as_tensor(self._ranges.T).to(parameters)
        return (self._base + self._sum((parameters - low) / (high - low))).unflatten(-1, self._shape)

    def _sum(self, u: Tensor) -> Tensor:
        """Change [..., size] from the middle at parameters u [..., n] in units of their ranges."""
        return sum(_products(u, degrees) @ coefficients for degrees, coefficients in self._terms)

    def _units(self, places: Sequence[dict[int, float]]) -> Tensor:
        """u [places, n]: the middle of the ranges, but for some parameters."""
        rows = [[place.get(p, 0.5) for p in range(len(self._ranges))] for place in places]
        return torch.tensor(rows, dtype=torch.float64)

    def _change(self, place: dict[int, float]) -> Tensor:
        """[size] of the array itself at a place, less that in the middle."""
        low, high = self._ranges.T
        mu = low + self._units([place])[0].numpy() * (high - low)
        return torch.as_tensor(np.ravel(np.asarray(self._of(mu), float))) - self._base

    def _degree(self, p: int) -> int:
        """The least degree that follows a parameter by itself."""
        compared = [{p: u} for u in _COMPARED]
        truth = torch.stack([self._change(place) for place in compared])
        for degree in _DEGREES:
            degrees, coefficients = self._term([p], {p: degree})
            off = _products(self._units(compared), degrees) @ coefficients - truth
            if float(off.abs().max()) <= self._slack:
                return degree
        self._refuse([p])

    def _term(self, group: Sequence[int], degrees: dict[int, int]) -> tuple[dict[int, int], Tensor]:
        """Degrees of some parameters, and coefficients [products, size] of what they change together."""
        chosen = {p: degrees[p] for p in group}
        nodes = [0.5 + 0.5 * chebyshev.chebpts1(degree + 1) for degree in chosen.values()]
        places = [dict(zip(chosen, us, strict=True)) for us in itertools.product(*nodes)]
        change = torch.stack([self._change(place) for place in places])
        return chosen, torch.linalg.solve(_products(self._units(places), chosen), change)

    def _groups(self, along: Sequence[int], one: dict[int, Tensor]) -> list[list[int]]:
        """Parameters that act together: what two change at once is not what each changes by itself."""
        together = np.eye(len(along), dtype=bool)
        for (i, p), (j, other) in itertools.combinations(enumerate(along), 2):
            both = self._change({p: _COMPARED[0], other: _COMPARED[0]})
            together[i, j] = float((both - one[p] - one[other]).abs().max()) > self._slack
        count, label = connected_components(together, directed=False)
        return [[p for p, part in zip(along, label, strict=True) if part == k] for k in range(count)]

    def _refuse(self, along: Sequence[int]) -> NoReturn:
        which = " and ".join(self._names[0][p] for p in along)
        raise ConfigError(
            f"{which} changes the {self._names[1]} in a way that no polynomial follows; vary another key, or "
            "calibrate within a smaller range"
        )


def _products(u: Tensor, degrees: dict[int, int]) -> Tensor:
    """Products [..., K] of powers of some parameters of u [..., n] in [0, 1], from the middle."""
    products = torch.ones_like(u[..., :1])
    for p, degree in degrees.items():
        powers = (2.0 * u[..., p, None] - 1.0) ** torch.arange(degree + 1, device=u.device)
        products = (products[..., :, None] * powers[..., None, :]).flatten(-2)
    return products
