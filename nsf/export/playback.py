"""A reduced run, read from its files and decoded block by block at any number of points."""

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from nsf import config as configuration
from nsf.bodies import closed_radius
from nsf.bodies.colors import CLIP
from nsf.data import Case, Trajectory
from nsf.data.schema import TAU_COLUMNS, TAU_ROWS
from nsf.deployment import FULL_ORDER, Rollout, continuation_file, rollout_file
from nsf.dynamics import Decoder
from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.errors import ConfigError, SchemaError
from nsf.evaluation import metrics
from nsf.evaluation.superresolution import POINTS
from nsf.evaluation.surroundings import surroundings
from nsf.kinematics.interpolation import lying_together
from nsf.kinematics.manifold import Restriction
from nsf.live import page
from nsf.mpm import floor_height, precision_of
from nsf.mpm.device import warp_device
from nsf.pipeline import Pipeline
from nsf.progress import Progress
from nsf.runs import Run
from nsf.scalars import one_of
from nsf.scenes import Scene
from nsf.vectors import drawn

BLOCK = 1 << 21  # positions of all frames that are decoded at once: with τ some hundred MiB
SHOWN = 2000  # particles that set the colour scale and the camera


@dataclass(frozen=True)
class Quantity:
    """A quantity by which points can be coloured.

    Attributes:
        title, unit: for a legend.
        clip: [%] percentile at which the colour scale ends, because peaks of stress would darken all else.
    """

    title: str
    unit: str
    clip: float


QUANTITIES = {
    "von_mises": Quantity("von Mises equivalent of the Kirchhoff stress", "Pa", CLIP),
    "displacement": Quantity("displacement", "m", 99.5),
}


@dataclass(frozen=True)
class Block:
    """Some of the points in every frame, on the host.

    Attributes:
        rows: indices of these points among all points.
        X: [n, 3] at rest [m]; x: [F, n, 3] [m].
        tau: [F, n, 6] Kirchhoff stress [Pa], order xx xy xz yy yz zz.
    """

    rows: slice
    X: torch.Tensor
    x: torch.Tensor
    tau: torch.Tensor

    @property
    def displacement(self) -> torch.Tensor:
        """x − X [F, n, 3] [m]."""
        return self.x - self.X

    def magnitude(self, quantity: str) -> torch.Tensor:
        """One of `QUANTITIES` [F, n], in its unit."""
        return self.von_mises if quantity == "von_mises" else self.displacement.norm(dim=-1)

    @property
    def von_mises(self) -> torch.Tensor:
        """Equivalent of τ [F, n] [Pa]."""
        return metrics.von_mises(self.tau)

    @property
    def pressure(self) -> torch.Tensor:
        """−tr τ / 3 [F, n] [Pa]."""
        return metrics.pressure(self.tau)


class Playback:
    """One reduced run of a deploy run: its frames, and its points at rest.

    A playback reads the files of the deploy run and of its train run.

    Args:
        run: complete deploy run.
        parameter: held-out case, as the value of one parameter, a mapping from name to value, or text such as
            `E=1500,friction=0.3`, to which the nearest is taken; the first by default.
        points: number of points; the particles by default. More than the training particles are points of the
            same shapes between them (super-resolution). Fewer are a fixed random choice of the particles.
        color: one of `QUANTITIES`, by which points are coloured.
        every: take one step in `every`, and the last step.
        fps: frames shown a second.
        device: where the fields are decoded: `cpu`, `cuda`, `cuda:N` or `auto`.

    Attributes:
        case: that is played.
        points_given: whether a number of points was asked for.
        t: [F] time of the frames [s].
        X: [N, 3] points at rest [m], in the order of the blocks.
        stopped: time [s] at which the run diverged, after the last frame; None if it did not diverge.

    Raises:
        ConfigError: the case was not deployed; a number is not positive; or points between the particles are
            asked of a run by the full-order solver, which has no fields.
        MissingRunError: the train run is not whole.
        SchemaError: the reduced run has other parameters than its manifold.
        DeviceError: there is no such device.
    """

    def __init__(
        self,
        run: Run,
        parameter: Mapping[str, float] | float | str | None = None,
        points: int | None = None,
        color: str = "von_mises",
        every: int = 1,
        fps: float = 30.0,
        device: str = "auto",
    ):
        configuration.number("every", every, least=1, whole=True)
        if points is not None:
            configuration.number("points", points, least=1, whole=True)
        one_of("color", color, QUANTITIES)
        if not (fps > 0 and math.isfinite(fps)):
            raise ConfigError(f"fps={fps} must be positive and finite")
        self.run, self.color, self.every, self.fps = run, color, every, fps
        index = _chosen(run.config["cases"], parameter)
        self._pipeline = Pipeline.of_run(run, device, say=lambda line: None)
        self.device = torch_device(warp_device(self._pipeline.device))
        self._precision = precision_of(self._pipeline.config.precision)
        self._dtype = torch_dtype(self._precision)
        self.manifold = self._pipeline.manifold().to(self.device)
        self._rollout = Rollout.open(run.file(rollout_file(index)), self.manifold.latent_dim)
        self.case = self._rollout.case
        taken = self._rollout.by == FULL_ORDER  # from its beginning
        self._full_order = run.file(continuation_file(index)) if taken else None
        if set(self.case) != set(self.manifold.parameter_names):
            raise SchemaError(
                f"{run.path} is of {', '.join(self.case)}, and its manifold of "
                f"{', '.join(self.manifold.parameter_names)}; deploy again"
            )
        self.points_given = points is not None
        self._choose_frames()
        self._choose_points(points)

    def _choose_frames(self) -> None:
        rollout = self._rollout
        t = rollout.t if rollout.diverged < 0 else rollout.t[: rollout.diverged]
        if self._full_order:
            with Trajectory.open(self._full_order) as trajectory:
                t = trajectory.t
        self._frames = np.union1d(np.arange(0, len(t), self.every), len(t) - 1)
        self.t = t[self._frames]
        self.stopped = float(rollout.t[rollout.diverged]) if rollout.diverged >= 0 else None
        steps = self._frames[:1] if self._full_order else self._frames
        self._xhat = torch.as_tensor(rollout.xhat[steps], dtype=self._dtype, device=self.device)
        self._shat = None if rollout.stress is None else torch.as_tensor(rollout.stress[steps])
        self._rate = _rates(rollout)[steps]

    def _choose_points(self, points: int | None) -> None:
        X = self.manifold.X.cpu().numpy()
        rows, constants = np.arange(len(X)), None
        self._between = points is not None and points > len(X)
        if self._between:
            if self._full_order:
                raise ConfigError(
                    f"points={points}: the full-order solver took this run, and has its {len(X)} particles "
                    "alone; leave points out, or deploy with fallback=none"
                )
            constants = self._scene.resampled(points).particles()
            X = constants.X
            rows = torch.cat(lying_together(torch.as_tensor(X), POINTS)).numpy()
        elif points is not None:
            rows = drawn(len(X), points)
        self.X, self._rows = X[rows], rows
        self._moduli = None
        if not self._pipeline.sources.neural_stress:
            constants = constants or self._scene.particles()
            self._moduli = constants.mu[rows], constants.lam[rows]

    @property
    def name(self) -> str:
        """For files: the parameters and their values, such as `friction_angle_26`."""
        return self.case.label

    @property
    def title(self) -> str:
        """For readers: the scene and the case."""
        return f"{self.run.scene}, {self.case.named}".replace("_", " ")

    @property
    def xhat(self) -> np.ndarray:
        """[F, r] latent vectors of the reduced run; of one by the full-order solver the first alone."""
        return self._xhat.cpu().numpy()

    @property
    def rate(self) -> np.ndarray:
        """[F, r] dx̂/dt in the frames of `xhat` [1/s], as steps have it: from the step before."""
        return self._rate

    @property
    def parameters(self) -> list[float]:
        """[n] problem parameters in the order of the manifold's."""
        return [self.case[name] for name in self.manifold.parameter_names]

    @property
    def floor(self) -> float | None:
        """Height of a horizontal floor at rest [m]."""
        return floor_height(list(self._scene.solids))

    @property
    def solids(self) -> list[dict]:
        """The solids, for a page."""
        return [page.solid(*solid) for solid in zip(self._scene.colliders, self._scene.solids, strict=True)]

    @property
    def around(self) -> dict[str, np.ndarray]:
        """Gravity and colliders in the frames, as `nsf.evaluation.surroundings` gives them."""
        return surroundings(self._scene, self.t)

    @property
    def radius(self) -> float:
        """Radius [m] of spheres at which the points look closed at rest."""
        return closed_radius(self.X)

    def thinned(self, points: int) -> "Playback":
        """The same frames at `points` of the particles, or at all particles if there are fewer."""
        other = copy(self)
        other._choose_points(min(points, len(self.manifold.X)))
        return other

    @cached_property
    def tops(self) -> dict[str, float]:
        """The end of the colour scale of each of `QUANTITIES`, the same for any number of points."""
        tops: dict[str, float] = {}
        for name, quantity in QUANTITIES.items():
            values = torch.cat([block.magnitude(name).flatten() for block in self._some])
            tops[name] = float(np.percentile(values.double().numpy(), quantity.clip)) or 1.0
        return tops

    @cached_property
    def _some(self) -> list[Block]:
        return list(self.thinned(SHOWN)._decoded())

    def restricted(self, rows: slice = slice(None), dtype: torch.dtype | None = None) -> Restriction:
        """The fields at some of the points, in the run's precision by default."""
        where = {"dtype": dtype or self._dtype, "device": self.device}
        if self._between:
            return self.manifold.restrict(X=torch.as_tensor(self.X[rows], device=self.device), **where)
        return self.manifold.restrict(particles=self._rows[rows], **where)

    def blocks(self, what: str = "decode") -> Iterator[Block]:
        """Every point in every frame, a block of points at a time, with a progress bar.

        Only one block is held at a time, so memory does not grow with points × frames.

        Args:
            what: name of the work, for the bar.
        """
        with Progress(f"export: {what}", len(self.X), "points") as progress:
            for block in self._decoded():
                yield block
                progress.advance(len(block.X))

    def _decoded(self) -> Iterator[Block]:
        size = max(1, min(POINTS, BLOCK // len(self.t)))
        for start in range(0, len(self.X), size):
            rows = slice(start, min(start + size, len(self.X)))
            x, tau = self._read(rows) if self._full_order else self._evaluated(rows)
            yield Block(rows, torch.as_tensor(self.X[rows]).to(x), x, tau)

    def _decoder(self, rows: slice) -> Decoder:
        """The fields at some of the points, combined as in the run."""
        at = self.restricted(rows)

        def tensor(values: Sequence[float]) -> torch.Tensor:
            return torch.as_tensor(values, dtype=self._dtype, device=self.device)

        parameters = tensor(self.parameters)
        law = None, None, None
        if self._moduli is not None:
            law = self._scene.material, *(tensor(values[rows]) for values in self._moduli)
        sources, device = self._pipeline.sources, warp_device(self._pipeline.device)
        stress = sources.stress_of(at, parameters, *law, self._precision, device)
        return Decoder(at, stress, sources.affine_of(at, parameters))

    def _evaluated(self, rows: slice) -> tuple[torch.Tensor, torch.Tensor]:
        """x and τ of some of the points, by the fields."""
        with torch.no_grad():
            decoder = self._decoder(rows)
            x = decoder.position(self._xhat).cpu()
            return x, decoder.stress(self._xhat, self._shat)[..., TAU_ROWS, TAU_COLUMNS].cpu()

    def _read(self, rows: slice) -> tuple[torch.Tensor, torch.Tensor]:
        """x and τ of some of the points, of the full-order run."""
        with Trajectory.open(self._full_order) as trajectory:
            of = {"frames": self._frames, "particles": self._rows[rows]}
            return tuple(torch.as_tensor(trajectory.read(name, **of)) for name in ("x", "tau"))

    @cached_property
    def _scene(self) -> Scene:
        """The scene deployed on, in the run's case, for its shapes and law."""
        return self._pipeline.deployed.at(self.case)


def _rates(rollout: Rollout) -> np.ndarray:
    """[N + 1, r] dx̂/dt [1/s] of all steps; 0 of a run without steps."""
    if len(rollout.xhat) < 2:
        return np.zeros_like(rollout.xhat)
    changes = np.diff(rollout.xhat, axis=0)
    return np.concatenate([changes[:1], changes]) / (rollout.t[1] - rollout.t[0])


def _chosen(cases: Sequence[Mapping[str, float]], parameter: Mapping[str, float] | float | str | None) -> int:
    """Index of a held-out case: the first, the one of a value, or that nearest to values by name.

    Raises:
        ConfigError: no such case was deployed, or the text is none; names those that are there.
    """
    if parameter is None:
        return 0
    names = list(cases[0])
    values = np.array([[case[name] for name in names] for case in cases])
    wanted = _by_name(parameter, names)
    if wanted and wanted.keys() <= set(names):
        at = values[:, [names.index(name) for name in wanted]]
        off, spread = abs(at - list(wanted.values())), np.ptp(at, axis=0)
        if len(names) > 1:
            return int((off / np.where(spread > 0, spread, 1.0)).max(1).argmin())
        if (same := off[:, 0] == 0.0).any():
            return int(same.argmax())
    listed = [Case.of(case) for case in cases]
    held_out = "; ".join(map(str, listed)) if len(names) > 1 else ", ".join(map(str, listed))
    shown = dict(parameter) if isinstance(parameter, Mapping) else parameter
    raise ConfigError(
        f"parameter={shown} was not deployed; choose one of {held_out}, or deploy with scene.design.test"
    )


def _by_name(parameter: Mapping[str, float] | float | str, names: Sequence[str]) -> dict[str, float]:
    """Values by name of a parameter as a user writes it; empty where it is no text of numbers."""
    if isinstance(parameter, Mapping):
        return dict(parameter)
    try:
        if isinstance(parameter, str) and "=" in parameter:
            return {
                name.strip(): float(value) for name, value in (p.split("=") for p in parameter.split(","))
            }
        return {names[0]: float(parameter)} if len(names) == 1 else {}
    except ValueError:
        return {}
