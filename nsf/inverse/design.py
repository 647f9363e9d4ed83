"""Forcing programs that bring a target about, by gradients through the recurrence."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from nsf.errors import ConfigError, InstabilityError
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import View
from nsf.mpm import Motion
from nsf.recurrence.solids import FEATURES
from nsf.scenes import Keyframes, Scene
from nsf.scenes.programs import Programs, across

_STARTS, _LOOKS = 8, 40  # that descend together, and for how many steps, before the best goes on alone
_RATE = 0.15  # of these steps, in units of the bounds
_MOST = 60  # steps of the best one
_HARDLY = 1e-6  # [m] of a solid that does not move


class Program(ABC):
    """Knots that are even in time, linear between, within bounds.

    Attributes:
        names: of the ways a knot can go; unit: theirs; knots: how many are free.
    """

    model: Model
    names: tuple[str, ...]
    unit: str
    knots: int

    @property
    @abstractmethod
    def bounds(self) -> np.ndarray:
        """[ways, 2] smallest and largest value."""

    @property
    @abstractmethod
    def first(self) -> np.ndarray:
        """[ways] value at t = 0, which is no knot."""

    @abstractmethod
    def forcing(self, values: Tensor) -> Forcing:
        """Of runs whose ways have values [B, N + 1, ways] at the steps, differentiable."""

    @abstractmethod
    def scene(self, scene: Scene, values: np.ndarray) -> Scene:
        """A scene with the program in place of its own, at values [N + 1, ways]."""

    @property
    def strides(self) -> np.ndarray:
        """[ways, 2] smallest and largest change from a knot to the next."""
        return np.array([[-np.inf, np.inf]] * len(self.names))

    def values(self, knots: Tensor) -> Tensor:
        """[B, N + 1, ways] of knots [B, knots, ways], each from 0 to 1 of what is in reach of the last."""
        low, high = torch.as_tensor(self.bounds).to(knots).unbind(1)
        back, on = torch.as_tensor(self.strides).to(knots).unbind(1)
        states = [torch.as_tensor(self.first).to(knots).expand(len(knots), -1)]
        for share in knots.unbind(1):
            least, most = torch.maximum(low, states[-1] + back), torch.minimum(high, states[-1] + on)
            states.append(least + share * (most - least))
        every = torch.stack(states, 1)
        at = torch.linspace(0.0, self.knots, len(self.model.t), dtype=knots.dtype, device=knots.device)
        before = at.floor().clamp_max(self.knots - 1)
        share, n = (at - before)[:, None], before.long()
        return every[:, n] * (1.0 - share) + every[:, n + 1] * share


@dataclass(frozen=True)
class Tilt(Program):
    """Gravity of the scene's size whose direction leaves the scene's.

    Attributes:
        model: of the runs; angle: the largest tilt [°]; knots: see `Program`.

    Raises:
        ConfigError: no gravity so far off in every direction was taught; or the scene has none.
    """

    model: Model
    angle: float
    knots: int = 6
    names = ("tilt along the first axis", "tilt along the second axis")
    unit = "°"

    def __post_init__(self):
        if not np.any(self.model.scene.base_gravity):
            raise ConfigError(f"{self.model.scene.name} has no gravity to tilt; move a solid, as move=NAME")
        taught = self.model.recurrence.taught
        most = _largest_tilt(np.array(self.model.scene.base_gravity), np.array(taught.gravity), taught.reach)
        if not 0.0 < self.angle <= most + 1e-9:
            raise ConfigError(
                f"tilt={self.angle:g}° must lie above 0° and within the {most:.3g}° that was taught; or "
                "train with programs of scene.forcing.gravity"
            )

    @property
    def bounds(self) -> np.ndarray:
        """See `Program.bounds`; a square within the disc."""
        return np.array([[-1.0, 1.0]] * 2) * self.angle / np.sqrt(2.0)

    @property
    def first(self) -> np.ndarray:
        """See `Program.first`."""
        return np.zeros(2)

    def forcing(self, values: Tensor) -> Forcing:
        """See `Program.forcing`."""
        gravity = torch.tensor(self.model.scene.base_gravity, dtype=values.dtype, device=values.device)
        size, tilt = gravity.norm(), torch.deg2rad(values[:, :-1])
        # At rest the angle has no gradient, but its square has.
        square = (tilt**2).sum(-1, keepdim=True)
        angle = torch.where(square > 0.0, square, torch.ones_like(square)).sqrt()
        sinc = torch.where(square > 1e-12, torch.sin(angle) / angle, 1.0 - square / 6.0)
        cosine = torch.where(square > 1e-12, torch.cos(angle), 1.0 - square / 2.0)
        aside = torch.as_tensor(across(np.array(self.model.scene.base_gravity))).to(values)
        turned = cosine * gravity + size * sinc * (tilt @ aside)
        return Forcing(turned, self._solids.expand(len(values), -1, -1))

    def scene(self, scene: Scene, values: np.ndarray) -> Scene:
        """See `Program.scene`."""
        with torch.no_grad():
            gravity = self.forcing(torch.as_tensor(values)[None]).gravity[0].cpu().numpy()
        keyframes = Keyframes(self.model.t[:-1].tolist(), gravity.tolist())
        return replace(scene, forcing=Programs({"designed": keyframes}, scene.forcing.colliders))

    @cached_property
    def _solids(self) -> Tensor:
        return self.model.forcing().solids


def _largest_tilt(gravity: np.ndarray, middle: np.ndarray, reach: float) -> float:
    """Largest angle [°] by which gravity [3] may tilt either way and stay within a ball [3] [m/s²].

    Tilted by θ away from the middle m it is off by |g|² + |m|² − 2 |g| |m| cos(θ + φ), squared, with φ the
    angle between both.
    """
    size, around = np.linalg.norm(gravity), max(float(np.linalg.norm(middle)), 1e-30)
    between = np.arccos(np.clip(gravity @ middle / (size * around), -1.0, 1.0))
    cosine = (size**2 + around**2 - reach**2) / (2.0 * size * around)
    return max(0.0, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)) - between)))


@dataclass(frozen=True)
class Moves(Program):
    """Solids that move as programs of training moved them: along the same axes, as far and as fast at most.

    Attributes:
        model: of the runs; solids: names of colliders; knots: see `Program`.

    Raises:
        ConfigError: there is no such solid, no program of training moves it, or it turns.
    """

    model: Model
    solids: Sequence[str]
    knots: int = 6
    unit = "m"

    def __post_init__(self):
        there = tuple(self.model.scene.colliders)
        if unknown := [name for name in self.solids if name not in there]:
            raise ConfigError(f"move={unknown[0]} is no solid of the scene; there are {', '.join(there)}")
        programs = self.model.pipeline.scene.forcing.colliders
        if still := [name for name in self.solids if name not in programs or not len(self._axes[name])]:
            raise ConfigError(
                f"move={still[0]} follows no program in training runs, so no other way of it was taught; "
                f"train with scene.forcing.colliders.{still[0]}"
            )
        colliders = dict(zip(there, self.model.scene.solids, strict=True))
        if turning := [n for n in self.solids if (m := colliders[n].motion) is not None and m.turns]:
            raise ConfigError(f"move={turning[0]} turns as well; only solids that shift alone are designed")

    @property
    def names(self) -> tuple[str, ...]:
        """See `Program`."""
        return tuple(
            f"{name} along ({', '.join(f'{a:.2g}' for a in axis)})"
            for name in self.solids
            for axis in self._axes[name]
        )

    @property
    def bounds(self) -> np.ndarray:
        """See `Program.bounds`."""
        return np.concatenate([self._bounds_of(name) for name in self.solids])

    @property
    def strides(self) -> np.ndarray:
        """See `Program.strides`; at rest, or at a velocity between the ends of those in training."""
        steps = (len(self.model.t) - 1) / self.knots
        along = [self._changes(name) @ self._axes[name].T for name in self.solids]
        return steps * np.concatenate(
            [np.stack([reached.min(0, initial=0.0), reached.max(0, initial=0.0)], 1) for reached in along]
        )

    @property
    def first(self) -> np.ndarray:
        """See `Program.first`; the middle of where training runs began."""
        return np.concatenate([self._begun(name) @ self._axes[name].T for name in self.solids])

    def forcing(self, values: Tensor) -> Forcing:
        """See `Program.forcing`."""
        scene = self.model.forcing()
        solids = scene.solids.expand(len(values), -1, -1).clone()
        for c, shift in self._by_collider(values):
            k = FEATURES * c
            solids = solids.clone()
            solids[..., k : k + 3] = shift[:, :-1]
            solids[..., k + 4 : k + 7] = torch.diff(shift, dim=1)
        return Forcing(scene.gravity.expand(len(values), -1, -1), solids)

    def scene(self, scene: Scene, values: np.ndarray) -> Scene:
        """See `Program.scene`."""
        colliders, programs = dict(scene.colliders), dict(scene.forcing.colliders)
        for c, shift in self._by_collider(torch.as_tensor(values)[None]):
            motion = Motion(self.model.t.tolist(), shift[0].cpu().numpy().tolist())
            name = tuple(colliders)[c]
            colliders[name] = replace(colliders[name], motion=motion)
            programs.pop(name, None)
        return replace(scene, colliders=colliders, forcing=Programs(scene.forcing.gravity, programs))

    def _by_collider(self, values: Tensor) -> list[tuple[int, Tensor]]:
        """Number and shift [B, N + 1, 3] of each solid."""
        shifts, k = [], 0
        for name in self.solids:
            ways, begun = self._axes[name], self._begun(name)
            axes, aside = (torch.as_tensor(v).to(values) for v in (ways, begun - begun @ ways.T @ ways))
            shift = aside + values[..., k : k + len(axes)] @ axes
            shifts.append((tuple(self.model.scene.colliders).index(name), shift))
            k += len(axes)
        return shifts

    @cached_property
    def _shifts(self) -> dict[str, np.ndarray]:
        """[R, N + 1, 3] of each solid in the training runs [m]."""
        model, names = self.model, tuple(self.model.scene.colliders)
        scenes = [model.pipeline.scene.at(case) for case in model.pipeline.split.train]
        solids = np.stack([scene.forcing_at(model.t)["solids"] for scene in scenes])
        return {name: solids[:, :, names.index(name), :3] for name in self.solids}

    @cached_property
    def _axes(self) -> dict[str, np.ndarray]:
        """[ways, 3] of each solid: the axes along which training runs moved it."""
        axes = {}
        for name in self.solids:
            _, sizes, directions = np.linalg.svd(self._changes(name), full_matrices=False)
            axes[name] = directions[sizes > _HARDLY]
        return axes

    def _begun(self, name: str) -> np.ndarray:
        """[3] where a solid is at t = 0, on average over training runs [m]."""
        return self._shifts[name][:, 0].mean(0)

    def _changes(self, name: str) -> np.ndarray:
        """[n, 3] of a solid's shift in each step of all training runs [m]."""
        return np.diff(self._shifts[name], axis=1).reshape(-1, 3)

    def _bounds_of(self, name: str) -> np.ndarray:
        along = self._shifts[name].reshape(-1, 3) @ self._axes[name].T
        return np.stack([along.min(0), along.max(0)], 1)


@dataclass(frozen=True)
class Designed:
    """The designed program and its run.

    Attributes:
        values: [N + 1, ways] of the program at the steps.
        xhat: [N + 1, r] of the run by recurrence; seen: [m] the targets in it [m].
        cost: sum of squares of (seen − target)/tolerance; stopped: why the search ended.
        distrust: of the run.
    """

    values: np.ndarray
    xhat: np.ndarray
    seen: np.ndarray
    cost: float
    stopped: str
    distrust: float


def design(
    program: Program, view: View, parameters, seed: int = 0, say: Callable[[str], object] = print
) -> Designed:
    """The program whose run comes nearest to targets, by gradients.

    Several random programs descend together (Adam); the best goes on by L-BFGS-B within the bounds.

    Args:
        program: what may change, and how far.
        view: of the targets; their deviations are tolerances.
        parameters: [n] of the run, or a mapping by name.
        seed: of the random programs.
        say: told how far it is.

    Raises:
        InstabilityError: no program gives a run that stays finite.
    """
    model, targets = program.model, view.observations
    target, tolerance = (
        torch.as_tensor(v, device=model.device) for v in (targets.values, targets.deviations)
    )
    mu, shape = model.tensor(parameters), (program.knots, len(program.names))

    def run(knots: Tensor) -> tuple[Tensor, Forcing]:
        forcing = program.forcing(program.values(knots))
        return model(mu.expand(len(knots), -1), forcing), forcing

    def costs(knots: Tensor) -> Tensor:
        return (((view.of_runs(run(knots)[0]) - target) / tolerance) ** 2).sum(1)

    starts = torch.as_tensor(np.random.default_rng(seed).random((_STARTS, *shape)), device=model.device)
    starts[0] = 0.5
    best, least = _best_of(costs, starts)
    if not np.isfinite(least):
        raise InstabilityError("no program gives a run that stays finite; choose narrower bounds")
    say(f"design: the best of {_STARTS} programs is {np.sqrt(least / len(targets)):.3g} tolerances off (RMS)")
    end = _followed(costs, best)
    knots = torch.as_tensor(end.x.reshape(1, *shape), device=model.device)
    with torch.no_grad():
        xhat, forcing = run(knots)
        seen = view.of_runs(xhat)[0].cpu().numpy()
        values = program.values(knots)[0].cpu().numpy()
        distrust = float(model.distrust(xhat, mu.expand(1, -1), forcing)[0])
    return Designed(values, xhat[0].cpu().numpy(), seen, float(end.fun), str(end.message), distrust)


def _best_of(costs: Callable[[Tensor], Tensor], knots: Tensor) -> tuple[Tensor, float]:
    """The best [1, knots, ways] that programs [B, knots, ways] meet as they descend together (Adam)."""
    best, least = knots[:1].clone(), np.inf
    adam = torch.optim.Adam([knots.requires_grad_()], lr=_RATE, betas=(0.9, 0.99))
    slower = torch.optim.lr_scheduler.LinearLR(adam, 1.0, 1.0 / _LOOKS, _LOOKS)
    for _ in range(_LOOKS):
        now = costs(knots)
        finite = torch.where(torch.isfinite(now), now, torch.inf).detach()
        if float(finite.min()) < least:
            least, best = float(finite.min()), knots[finite.argmin()][None].detach().clone()
        (slope,) = torch.autograd.grad(torch.log1p(now).sum(), knots)
        knots.grad = torch.nan_to_num(slope)
        adam.step()
        slower.step()
        with torch.no_grad():
            knots.clamp_(0.0, 1.0)
    return best, least


def _followed(costs: Callable[[Tensor], Tensor], best: Tensor):
    """scipy's L-BFGS-B from a program [1, knots, ways], within the bounds."""

    def value(flat: np.ndarray) -> tuple[float, np.ndarray]:
        knots = torch.as_tensor(flat.reshape(best.shape), device=best.device).requires_grad_()
        total = costs(knots).sum()
        (slope,) = torch.autograd.grad(total, knots)
        total, slope = torch.nan_to_num(total.detach(), 1e30, 1e30), torch.nan_to_num(slope)
        return float(total), slope.cpu().numpy().ravel()

    box = [(0.0, 1.0)] * best.numel()
    flat = best.cpu().numpy().ravel()
    return minimize(value, flat, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": _MOST})


class Held:
    """Positions of a run in memory, read as those of a `Trajectory` are.

    Args:
        x: [N + 1, P, 3] m.
    """

    def __init__(self, x: np.ndarray):
        self._x, self.frames = x, len(x)

    def read(self, _: str, frames, particles: np.ndarray | None = None) -> np.ndarray:
        """[frames, particles, 3] m."""
        x = self._x[frames]
        return x if particles is None else x[:, particles]


def full_order(program: Program, designed: Designed, parameters) -> Held:
    """The full-order run of a designed program."""
    model = program.model
    values = dict(zip(model.names, model.tensor(parameters).tolist(), strict=True))
    scene = program.scene(model.scene.at(model.scene.case(values)), designed.values)
    solver = scene.full_order(None, model.pipeline.config.precision, model.pipeline.device)
    frames = [solver.state.numpy()["x"].astype(np.float32)]
    for _ in range(scene.steps):
        solver.step()
        frames.append(solver.state.numpy()["x"].astype(np.float32))
    return Held(np.array(frames))
