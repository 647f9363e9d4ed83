"""Forcing programs that bring a target about, by slopes of runs by recurrence."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nsf.errors import ConfigError, InstabilityError
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import View
from nsf.inverse.search import nearest
from nsf.mpm import Motion
from nsf.recurrence.solids import FEATURES
from nsf.scenes import Keyframes, Scene
from nsf.scenes.programs import Programs
from nsf.scenes.tilts import across, largest_tilt

_STARTS = 64  # programs that are tried in one batch
_HARDLY = 1e-6  # [m] of a solid that does not move


class Program(ABC):
    """A program that is linear between knots evenly spread in time, within bounds.

    Args:
        model: of the runs; knots: how many are free.
        names: [k] of the numbers that are set at each knot; unit: theirs.
        bounds: [k, 2] smallest and largest value.
        first: [k] value at t = 0, which is no knot.
        rates: [k, 2] smallest and largest change in a step.
    """

    def __init__(
        self,
        model: Model,
        knots: int,
        names: Sequence[str],
        unit: str,
        bounds: np.ndarray,
        first: np.ndarray,
        rates: np.ndarray,
    ):
        self.model, self.knots, self.names, self.unit = model, knots, tuple(names), unit
        self.bounds, self._first, self._rates = bounds, first, rates

    @abstractmethod
    def forcing(self, values: Tensor) -> Forcing:
        """Forcing of runs whose coordinates have values [B, N + 1, k] at the steps, differentiable."""

    @abstractmethod
    def scene(self, scene: Scene, values: np.ndarray) -> Scene:
        """A scene with this program in place of its own, at values [N + 1, k]."""

    def values(self, knots: Tensor) -> Tensor:
        """[B, N + 1, k] of knots [B, knots, k], each from 0 to 1 of the reach from the knot before it."""
        low, high = torch.as_tensor(self.bounds).to(knots).unbind(1)
        steps = (len(self.model.t) - 1) / self.knots
        back, on = torch.as_tensor(steps * self._rates).to(knots).unbind(1)
        states = [torch.as_tensor(self._first).to(knots).expand(len(knots), -1)]
        for share in knots.unbind(1):
            least, most = torch.maximum(low, states[-1] + back), torch.minimum(high, states[-1] + on)
            states.append(least + share * (most - least))
        every = torch.stack(states, 1)
        at = torch.linspace(0.0, self.knots, len(self.model.t), dtype=knots.dtype, device=knots.device)
        before = at.floor().clamp_max(self.knots - 1)
        share, n = (at - before)[:, None], before.long()
        return every[:, n] * (1.0 - share) + every[:, n + 1] * share


class Tilt(Program):
    """Gravity of the scene's size whose direction leaves the scene's.

    Args:
        model: of the runs.
        angle: largest tilt [°].
        knots: how many are free.

    Raises:
        ConfigError: the recurrence was taught no gravity so far off in every direction, or there is none.
    """

    def __init__(self, model: Model, angle: float, knots: int = 6):
        self._gravity = np.array(model.scene.base_gravity)
        if not np.any(self._gravity):
            raise ConfigError(f"{model.scene.name} has no gravity to tilt; move a solid, as move=NAME")
        taught = model.recurrence.taught
        most = np.degrees(largest_tilt(self._gravity, np.array(taught.gravity), taught.reach))
        if not 0.0 < angle <= most + 1e-9:
            wider = "wider programs" if model.scene.forcing.gravity else "programs"
            raise ConfigError(
                f"tilt={angle:g}° must lie above 0° and within the {most:.3g}° that was "
                f"taught; or train with {wider} of scene.forcing.gravity"
            )
        # A square within the disc.
        super().__init__(
            model,
            knots,
            names=("tilt along the first axis", "tilt along the second axis"),
            unit="°",
            bounds=np.array([[-1.0, 1.0]] * 2) * angle / np.sqrt(2.0),
            first=np.zeros(2),
            rates=np.array([[-np.inf, np.inf]] * 2),
        )
        self._solids = model.forcing().solids

    def forcing(self, values: Tensor) -> Forcing:
        """See `Program.forcing`."""
        gravity = torch.as_tensor(self._gravity).to(values)
        size, tilt = gravity.norm(), torch.deg2rad(values[:, :-1])
        # At rest the angle has no gradient, but its square has.
        square = (tilt**2).sum(-1, keepdim=True)
        angle = torch.where(square > 0.0, square, torch.ones_like(square)).sqrt()
        sinc = torch.where(square > 1e-12, torch.sin(angle) / angle, 1.0 - square / 6.0)
        cosine = torch.where(square > 1e-12, torch.cos(angle), 1.0 - square / 2.0)
        aside = torch.as_tensor(across(self._gravity)).to(values)
        turned = cosine * gravity + size * sinc * (tilt @ aside)
        return Forcing(turned, self._solids.expand(len(values), -1, -1))

    def scene(self, scene: Scene, values: np.ndarray) -> Scene:
        """See `Program.scene`."""
        with torch.no_grad():
            gravity = self.forcing(torch.as_tensor(values)[None]).gravity[0].cpu().numpy()
        keyframes = Keyframes(self.model.t[:-1].tolist(), gravity.tolist())
        return replace(scene, forcing=Programs({"designed": keyframes}, scene.forcing.colliders))


@dataclass(frozen=True)
class Track:
    """How programs of training moved a solid.

    Attributes:
        index: among the colliders.
        axes: [k, 3] directions along which it moved.
        shifts: [R, N + 1, 3] in each training run [m].
    """

    index: int
    axes: np.ndarray
    shifts: np.ndarray

    @classmethod
    def of(cls, index: int, shifts: np.ndarray) -> "Track":
        """From the shifts in training runs."""
        changes = np.diff(shifts, axis=1).reshape(-1, 3)
        _, sizes, directions = np.linalg.svd(changes, full_matrices=False)
        return cls(index, directions[sizes > _HARDLY], shifts)

    @property
    def begun(self) -> np.ndarray:
        """[3] where it is at t = 0, on average [m]."""
        return self.shifts[:, 0].mean(0)

    @property
    def bounds(self) -> np.ndarray:
        """[k, 2] smallest and largest shift along the axes [m]."""
        return _range(self.shifts @ self.axes.T)

    @property
    def rates(self) -> np.ndarray:
        """[k, 2] smallest and largest change in a step [m]; a solid may always rest."""
        changes = np.diff(self.shifts, axis=1) @ self.axes.T
        return _range(np.concatenate([changes.reshape(-1, len(self.axes)), np.zeros((1, len(self.axes)))]))

    def shift(self, values: Tensor) -> Tensor:
        """[..., 3] [m] at values [..., k] along the axes."""
        aside = self.begun - self.begun @ self.axes.T @ self.axes
        return torch.as_tensor(aside).to(values) + values @ torch.as_tensor(self.axes).to(values)


def _range(values: np.ndarray) -> np.ndarray:
    """[k, 2] smallest and largest of values [..., k]."""
    rows = values.reshape(-1, values.shape[-1])
    return np.stack([rows.min(0), rows.max(0)], 1)


class Moves(Program):
    """Solids that move along the axes of training's programs, as far and as fast as these at most.

    Args:
        model: of the runs.
        solids: names of colliders.
        knots: how many are free.

    Raises:
        ConfigError: there is no such solid, no program of training moves it, or it turns.
    """

    def __init__(self, model: Model, solids: Sequence[str], knots: int = 6):
        colliders = dict(zip(model.scene.colliders, model.scene.solids, strict=True))
        if unknown := [name for name in solids if name not in colliders]:
            raise ConfigError(f"move={unknown[0]} is no solid of the scene; there are {', '.join(colliders)}")
        self.tracks = _tracks(model, solids)
        programs = model.pipeline.scene.forcing.colliders
        if still := [name for name in solids if name not in programs or not len(self.tracks[name].axes)]:
            raise ConfigError(
                f"move={still[0]} follows no program in training runs, so no other way of it was taught; "
                f"train with scene.forcing.colliders.{still[0]}"
            )
        if turning := [n for n in solids if (m := colliders[n].motion) is not None and m.turns]:
            raise ConfigError(f"move={turning[0]} turns as well; only solids that shift alone are designed")
        tracks = self.tracks.values()
        super().__init__(
            model,
            knots,
            names=[
                f"{name} along ({', '.join(f'{a:.2g}' for a in axis)})"
                for name, track in self.tracks.items()
                for axis in track.axes
            ],
            unit="m",
            bounds=np.concatenate([track.bounds for track in tracks]),
            first=np.concatenate([track.begun @ track.axes.T for track in tracks]),
            rates=np.concatenate([track.rates for track in tracks]),
        )

    def forcing(self, values: Tensor) -> Forcing:
        """See `Program.forcing`."""
        scene = self.model.forcing()
        columns = list(scene.solids.expand(len(values), -1, -1).unbind(-1))
        for track, shift in self._shifts(values):
            k = FEATURES * track.index
            columns[k : k + 3] = shift[:, :-1].unbind(-1)
            columns[k + 4 : k + 7] = torch.diff(shift, dim=1).unbind(-1)
        return Forcing(scene.gravity.expand(len(values), -1, -1), torch.stack(columns, -1))

    def scene(self, scene: Scene, values: np.ndarray) -> Scene:
        """See `Program.scene`."""
        colliders, programs = dict(scene.colliders), dict(scene.forcing.colliders)
        for track, shift in self._shifts(torch.as_tensor(values)[None]):
            motion = Motion(self.model.t.tolist(), shift[0].cpu().numpy().tolist())
            name = tuple(colliders)[track.index]
            colliders[name] = replace(colliders[name], motion=motion)
            programs.pop(name, None)
        return replace(scene, colliders=colliders, forcing=Programs(scene.forcing.gravity, programs))

    def _shifts(self, values: Tensor) -> list[tuple[Track, Tensor]]:
        """Each solid and its shift [B, N + 1, 3] [m]."""
        tracks = list(self.tracks.values())
        parts = values.split([len(track.axes) for track in tracks], dim=-1)
        return [(track, track.shift(part)) for track, part in zip(tracks, parts, strict=True)]


def _tracks(model: Model, solids: Sequence[str]) -> dict[str, Track]:
    """How each solid moved in the training runs."""
    pipeline, order = model.pipeline, list(model.scene.colliders)
    scenes = [pipeline.scene.at(case) for case in pipeline.split.train]
    states = np.stack([scene.forcing_at(model.t)["solids"] for scene in scenes])
    return {name: Track.of(order.index(name), states[:, :, order.index(name), :3]) for name in solids}


@dataclass(frozen=True)
class Designed:
    """A designed program and its run.

    Attributes:
        values: [N + 1, k] of the program at the steps.
        xhat: [N + 1, r] of the run by recurrence; seen: [m] the targets in it [m].
        cost: sum of squares of (seen − target)/tolerance; stopped: why the search ended.
        error_bound: of the run, a share of its displacement.
    """

    values: np.ndarray
    xhat: np.ndarray
    seen: np.ndarray
    cost: float
    stopped: str
    error_bound: float


def design(program: Program, view: View, parameters, seed: int = 0) -> Designed:
    """The program whose run comes nearest to targets, by least squares.

    Args:
        program: what may change, and how far.
        view: of the targets; their deviations are tolerances.
        parameters: [n] of the run, or a mapping by name.
        seed: of the programs to begin at.

    Raises:
        InstabilityError: no program gives a run that stays finite.
    """
    model, targets = program.model, view.observations
    mu, shape = model.tensor(parameters), (program.knots, len(program.names))

    def run(u: Tensor) -> tuple[Tensor, Forcing]:
        forcing = program.forcing(program.values(u.unflatten(-1, shape)))
        return model(mu.expand(len(u), -1), forcing), forcing

    end = nearest(
        lambda u: view.of_runs(run(u)[0]), targets.values, targets.deviations, int(np.prod(shape)),
        _STARTS, model.device, seed,
    )  # fmt: skip
    if end is None:
        raise InstabilityError("no program gives a run that stays finite; choose narrower bounds")
    u = torch.as_tensor(end.x, device=model.device)[None]
    with torch.no_grad():
        xhat, forcing = run(u)
        seen = view.of_runs(xhat)[0].cpu().numpy()
        values = program.values(u.unflatten(-1, shape))[0].cpu().numpy()
        error_bound = float(model.error_bound(mu.expand(1, -1), forcing)[0])
    return Designed(values, xhat[0].cpu().numpy(), seen, 2.0 * end.cost, str(end.message), error_bound)


def full_order(program: Program, designed: Designed, parameters) -> np.ndarray:
    """Positions [N + 1, P, 3] [m] of the full-order run of a designed program."""
    model = program.model
    values = dict(zip(model.names, model.tensor(parameters).tolist(), strict=True))
    scene = program.scene(model.scene.at(model.scene.case(values)), designed.values)
    solver = scene.full_order(None, model.pipeline.config.precision, model.pipeline.device)
    frames = [solver.state.numpy()["x"].astype(np.float32)]
    for _ in range(scene.steps):
        solver.step()
        frames.append(solver.state.numpy()["x"].astype(np.float32))
    return np.array(frames)
