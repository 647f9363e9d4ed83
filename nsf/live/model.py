"""A deployed reduced model that runs at any values of its problem parameters, and its full-order runs."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from nsf.bodies.colors import CLIP
from nsf.data import Case, Trajectory
from nsf.data.schema import packed
from nsf.deployment import TRUST, Trust, Verdict
from nsf.dynamics import Decoder, ReducedMPM
from nsf.errors import ConfigError, InstabilityError
from nsf.evaluation.metrics import pressure, von_mises
from nsf.live import page
from nsf.live.surface import at_surface
from nsf.mpm import floor_height
from nsf.mpm.stability import check_time_step
from nsf.pipeline import Pipeline
from nsf.runs import Run
from nsf.scenes.tilts import largest_tilt, tilted

#: Precision of live runs, whatever the deployment's: a CPU reads half as much a step. On the sand column this
#: moves no particle by more than a thousandth of the displacement.
PRECISION = "fp32"
#: Reach of a parameter beyond its training values on each side, over their span.
_BEYOND = 0.5
#: Number of steps in the range of a parameter.
_STEPS = 200
#: Share of the particles that are shown which lie at the surface, where there are so many.
_OUTER = 0.7
_CLIP = 99.5  # [%] percentile of the displacement at which its scale ends
_SNAPSHOTS = 64  # training snapshots that bounds and colour scales are taken from


@dataclass(frozen=True)
class Parameter:
    """A problem parameter and its range.

    Attributes:
        name, unit: of the scene's parameter.
        trained: smallest and largest training value.
        lower, upper: smallest and largest value that can be asked for.
    """

    name: str
    unit: str
    trained: tuple[float, float]
    lower: float
    upper: float

    @property
    def step(self) -> float:
        """Least difference of two values that is worth another run."""
        return (self.upper - self.lower) / _STEPS or 1.0


class Truth:
    """The full-order run of a case, at the particles that are shown.

    Args:
        trajectory: opened; each frame is read when it is asked for.
        particles: [n] indices of the particles that are shown.
    """

    def __init__(self, trajectory: Trajectory, particles: np.ndarray):
        self._trajectory, self._particles = trajectory, particles

    def positions(self, t: float) -> np.ndarray:
        """[n, 3] m at time t [s], linear between frames."""
        return self._at("x", t)

    def stress(self, t: float) -> np.ndarray:
        """[n, 6] Kirchhoff stress [Pa] at time t [s], linear between frames."""
        return self._at("tau", t)

    def _at(self, field: str, t: float) -> np.ndarray:
        at = float(np.interp(t, self._trajectory.t, np.arange(self._trajectory.frames)))
        # A step's time is a whole number of Δt but for round-off. One frame is then read in place of two.
        first = round(at) if abs(at - round(at)) < 1e-6 else int(at)
        here = self._read(field, first)
        part = at - first
        return here if part < 1e-6 else here + part * (self._read(field, first + 1) - here)

    def _read(self, field: str, frame: int) -> np.ndarray:
        return self._trajectory.read(field, frames=[frame], particles=self._particles)[0].astype(np.float32)


class LiveRun:
    """A reduced run in the making: one thread advances it while others read its steps up to `reached`.

    Args:
        case: its problem parameters.
        solver: reduced solver at t = 0.
        decoder: the solver's fields at the particles that are shown.
        trust: bounds the error of the run.

    Attributes:
        steps, dt: number of steps of the whole run, and their length [s].
        reached: last step that can be read.
        finished: whether the run has reached the scene's end or has diverged.
        by_hand: whether a hand has changed gravity in its course.
        diverged: whether the run ended early, with x̂ not finite or a sample particle off the grid.
        seconds: wall time of the steps [s].
    """

    def __init__(self, case: Case, solver: ReducedMPM, decoder: Decoder, trust: Trust):
        self.by_hand = False
        self.case, self.steps, self.dt = case, solver.total_steps, solver.dt
        self._solver: ReducedMPM | None = solver
        self._decoder, self._trust = decoder, trust
        self._xhat = np.zeros((self.steps + 1, solver.manifold.latent_dim), np.float32)
        self._shat: np.ndarray | None = None
        self._signal = np.zeros(self.steps + 1)
        self._outside = 0, trust.outside(solver)  # step from which on inputs are outside, and why
        self._xhat[0] = solver.state.xhat
        self.reached, self.seconds, self.diverged = 0, 0.0, False

    @property
    def finished(self) -> bool:
        """Whether the run has reached the scene's end or has diverged."""
        return self._solver is None

    def advance(self, steps: int) -> None:
        """Take `steps` steps, or as many as are left. The last step frees the solver."""
        solver, first = self._solver, self.reached + 1
        if solver is None:
            return
        started = time.perf_counter()
        solver.step(min(steps, self.steps - self.reached))
        latent = solver.trajectory()
        lost = solver.left_grid(since=first)
        last = solver.steps_taken if lost < 0 else lost - 1
        block = slice(first, last + 1)
        self._xhat[block] = latent.xhat[block]
        if latent.stress is not None:
            if self._shat is None:
                self._shat = np.zeros((self.steps + 1, latent.stress.shape[1]), np.float32)
            self._shat[block] = latent.stress[block]
        self._signal[block] = self._trust.signal_of(solver, first)[: last - first + 1]
        why = self._trust.outside(solver, first)
        if why and not self._outside[1]:
            self._outside = first, why
        self.seconds += time.perf_counter() - started
        self.diverged = lost >= 0
        self.reached = last  # only now, since other threads read all steps up to here
        if self.diverged or last == self.steps:
            self._solver = None

    def end(self) -> None:
        """Take no further step, as where one has failed."""
        self.diverged, self._solver = True, None

    def goes_on(self, run: "LiveRun", step: int, gravity: Sequence[float]) -> None:
        """Take over another run of the same case up to a step, and let gravity be another from there on.

        Args:
            run: that has come as far.
            step: the last that is taken over.
            gravity: [3] [m/s²].
        """
        solver, kept = self._solver, slice(0, step + 1)
        assert solver is not None, "the run has begun"
        self._xhat[kept], self._signal[kept] = run._xhat[kept], run._signal[kept]
        self._shat = None if run._shat is None else run._shat.copy()
        self.reached, self.by_hand = step, True
        record = solver.record
        record.xhat[kept] = torch.as_tensor(run._xhat[kept]).to(record.xhat)
        record.now.copy_(record.xhat[step])
        record.before.copy_(record.xhat[max(0, step - 1)])
        record.row.fill_(step)
        solver.together.resume(step)
        solver.forcing.gravity = gravity

    def xhat(self, step: int) -> np.ndarray:
        """[r] float32 latent vector."""
        return self._xhat[step]

    def verdict(self, step: int) -> Verdict:
        """The bound of the error up to the step; ∞ at the end of a run that diverged."""
        shown, (first, why) = slice(0, step + 1), self._outside
        diverged = step if self.diverged and step >= self.reached else -1
        t, whole = self.dt * np.arange(step + 1), step == self.steps
        run = t, self._xhat[shown].astype(float), self._signal[shown]
        return self._trust.judge(self.case, *run, why if step >= first else "", diverged, whole)

    def positions(self, step: int) -> np.ndarray:
        """[n, 3] m, float32."""
        return self._decoder.position(torch.as_tensor(self._xhat[step])).cpu().numpy()

    def stress(self, step: int) -> np.ndarray:
        """[n, 6] Kirchhoff stress [Pa] that the run's method uses, float32."""
        now = torch.as_tensor(self._xhat[step], device=self._decoder.at.device)
        shat = None if self._shat is None else torch.as_tensor(self._shat[step : step + 1])
        return packed("tau", self._decoder.stress(now[None], shat)[0].cpu().numpy())


class LiveModel:
    """The reduced model of a deploy run.

    Args:
        run: complete deploy run.
        points: most particles that are shown; the sample particles are always among them.
        device: `cpu`, `cuda`, `cuda:N` or `auto`.
        surface: whether most of the particles that are shown lie at the surface of the bodies at rest, where
            there are too many for all.

    Attributes:
        run, manifold, pipeline.
        parameters: what can be set; simulated: cases with a full-order trajectory, ascending.
        title: of the scene.
        particles: P.
        sample: indices of the sample particles.
        shown: [n] indices of the particles that are shown.
        at: the fields at these particles.
        X: [n, 3] positions of these particles at rest [m].
        spacing: edge of the cube that each of these particles fills [m].

    Raises:
        MissingRunError: the deployment, or its training, is not whole.
        DeviceError: the device does not exist.
    """

    def __init__(self, run: Run, points: int = 6000, device: str = "auto", surface: bool = False):
        self.run = run
        self.pipeline = Pipeline.of_run(run, device)
        self.title = self.pipeline.config.scene.title
        self.manifold = self.pipeline.manifold()
        self._truths = _truths(self.pipeline)
        self.simulated = tuple(sorted(self._truths))
        self.parameters = _parameters(self.pipeline, self.simulated)
        # Live runs share the samples and sets, which are found in the deployment's own precision.
        solver = self.pipeline.solver_at(self.manifold, self.initial)
        sample = np.unique(np.concatenate([sets.sample for sets in solver.sets]))
        self._sets_at = solver.sets_at
        self.trust = Trust.open(run.file(TRUST), self.manifold)
        self.particles = len(self.manifold.X)
        self.sample = sample
        self.shown = _shown(self.manifold.X.numpy(), sample, points, surface)
        self.at = self.manifold.restrict(self.shown, dtype=torch.float32, device=self.pipeline.device)
        self.X = self.manifold.X[self.shown].numpy().astype(np.float32)
        self.spacing = float((solver.setup.constants.volume0.sum() / len(self.shown)) ** (1 / 3))

    @property
    def initial(self) -> Case:
        """The first case to show: the first that was deployed."""
        return self.pipeline.held_out[0]

    def checked(self, numbers: Sequence[float]) -> Case:
        """The case of some values, or the known one that lies within half a step of each of them.

        Raises:
            ConfigError: there is not a value for each parameter, or one is not finite or out of reach.
        """
        if len(numbers) != len(self.parameters):
            raise ConfigError(f"{len(numbers)} values must be {len(self.parameters)}, one for each parameter")
        for p, value in zip(self.parameters, numbers, strict=True):
            if not (math.isfinite(value) and p.lower <= value <= p.upper):
                raise ConfigError(f"{p.name}={value:g} must lie in [{p.lower:g}, {p.upper:g}]")
        steps = [p.step for p in self.parameters]

        def off(case: Case) -> float:
            return max(abs(np.subtract(list(case.parameters.values()), numbers)) / steps)

        nearest = min(self.simulated, key=off, default=None)
        if nearest is not None and off(nearest) <= 0.5:
            return nearest
        return self.pipeline.scene.case(numbers)

    def start(self, case: Case) -> LiveRun:
        """A run of a case, at t = 0."""
        solver = self.pipeline.solver_at(self.manifold, case, precision=PRECISION)
        return LiveRun(case, solver, solver.decoder(self.shown, self.at), self.trust)

    @property
    def tilt(self) -> float | None:
        """Largest tilt of gravity that programs of training may give [rad]; None where they give none."""
        gravity, reach = np.array(self.pipeline.deployed.gravity), self.trust.reach
        if not self.pipeline.scene.forcing.gravity or not np.any(gravity):
            return None
        return largest_tilt(gravity, np.array(reach.gravity), reach.radius)

    def tilted(self, run: LiveRun, step: int, tilt: Sequence[float]) -> LiveRun:
        """A run that goes on from a step of another under gravity that a hand has tilted.

        Args:
            run: that has come as far.
            step: from which on.
            tilt: [2] [rad] along x and y, where gravity points down.
        """
        gravity = tilted(np.array([self.pipeline.deployed.gravity]), np.array([tilt]))[0]
        other = self.start(run.case)
        other.goes_on(run, step, gravity.tolist())
        return other

    def truth_run(self, case: Case) -> Run | None:
        """The simulate run of a known case; None of other cases."""
        return self._truths.get(case)

    def truth(self, case: Case) -> Truth | None:
        """The full-order run of a known case; None of other cases."""
        run = self.truth_run(case)
        return Truth(Trajectory.of(run), self.shown) if run else None

    @property
    def floor(self) -> float | None:
        """Height of a horizontal floor at rest [m]."""
        return floor_height(list(self.pipeline.deployed.solids))

    def solids(self, case: Case) -> list[dict]:
        """The solids of a case, for a page."""
        scene = self.pipeline.deployed.at(case)
        return [page.solid(name, pose) for name, pose in zip(scene.colliders, scene.solids, strict=True)]

    def roles(self, step: int) -> np.ndarray:
        """[n] set of each shown particle in the step that starts at `step`: 2 S, 1 N only, 0 neither.

        N is the set that the step has, which may hold more particles than it needs (`integration=superset`).
        """
        sets = self._sets_at(step)
        role = np.zeros(self.particles, np.int8)
        role[sets.integration], role[sets.sample] = 1, 2
        return role[self.shown]

    @cached_property
    def tops(self) -> dict[str, float]:
        """Ends of the colour scales of `displacement` [m], `von_mises` and `pressure` [Pa]."""
        x, tau = self.training_frames
        tau = torch.as_tensor(tau)
        tops = {
            "displacement": np.percentile(np.linalg.norm(x - self.X, axis=2), _CLIP),
            "von_mises": np.percentile(von_mises(tau), CLIP),
            "pressure": np.percentile(pressure(tau).abs(), CLIP),
        }
        return {name: float(top) or 1.0 for name, top in tops.items()}

    @cached_property
    def training_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """x [F, n, 3] m and τ [F, n, 6] Pa of some training snapshots, evaluated by the fields."""
        latents = self.manifold.training_latents
        rows = torch.linspace(0, len(latents) - 1, min(len(latents), _SNAPSHOTS)).long()
        xhat = latents[rows].to(self.at.device)
        parameters = self.manifold.training_parameters[rows].to(self.at.device)
        return self.at.position(xhat).cpu().numpy(), self.at.stress(xhat, parameters).cpu().numpy()


def _truths(pipeline: Pipeline) -> Mapping[Case, Run]:
    """Full-order runs of the scene that is deployed, by case."""
    pairs = ((case, scene) for case, scene in pipeline.needed() if scene is pipeline.deployed)
    runs = {case: pipeline.simulation(case, scene) for case, scene in pairs}
    return {case: run for case, run in runs.items() if run.complete}


def _parameters(pipeline: Pipeline, simulated: Sequence[Case]) -> tuple[Parameter, ...]:
    """The parameters and their ranges, which end where the scene cannot be built or is not stable."""
    parameters, middle = [], pipeline.scene.case(pipeline.split.box.mean(1))
    for (name, p), (low, high) in zip(
        pipeline.scene.parameters.items(), pipeline.split.box.tolist(), strict=True
    ):
        span = (high - low) or abs(low) or 1.0

        def reach(end: float, sign: float, name: str = name, span: float = span) -> float:
            for share in (1.0, 0.75, 0.5, 0.25, 0.1):
                value = end + sign * share * _BEYOND * span
                if _possible(pipeline, dict(middle) | {name: value}):
                    return value
            return end

        wanted = [case[name] for case in (*simulated, *pipeline.held_out)]
        lower, upper = min(reach(low, -1.0), *wanted), max(reach(high, 1.0), *wanted)
        parameters.append(Parameter(name, p.unit, (low, high), lower, upper))
    return tuple(parameters)


def _possible(pipeline: Pipeline, case: Mapping[str, float]) -> bool:
    try:
        scene = pipeline.deployed.at(case)
        check_time_step(scene.particles(), scene.initial_velocity(), scene.dx, scene.dt)
    except (ConfigError, InstabilityError):
        return False
    return True


def _shown(X: np.ndarray, sample: np.ndarray, points: int, surface: bool) -> np.ndarray:
    """Indices of the sample particles and of others at random, ascending."""
    order = np.random.default_rng(0).permutation(len(X))
    others = order[~np.isin(order, sample)]
    left = max(0, points - len(sample))
    if surface and len(others) > left:
        outer = at_surface(X)[others]
        # The rest of them lies inside, which shows where a body is cut or tears.
        first = others[outer][: int(_OUTER * left)]
        others = np.concatenate([first, others[~np.isin(others, first)]])
    return np.sort(np.concatenate([sample, others[:left]]))
