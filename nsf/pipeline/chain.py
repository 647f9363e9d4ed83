"""The stages in order; each reads the files of the one before it and nothing else.

scene → simulate → dataset → train → deploy → evaluate → report
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError

from nsf import config as configuration
from nsf.data import Snapshots, Split, Trajectory
from nsf.dynamics import ParticleSets, ReducedMPM, Rollout, SamplePhase, calibrate, deploy, go_on
from nsf.dynamics.interop import torch_device
from nsf.dynamics.sampling import check_well_posed
from nsf.dynamics.solver import reduced_steps
from nsf.errors import ConfigError, MissingRunError
from nsf.evaluation import Subject, compare, measure, superresolve
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training import TRACKING, train
from nsf.mpm import FP32, FP64, precision_of
from nsf.mpm.device import warp_device
from nsf.mpm.stability import check_colliders, check_time_step
from nsf.pipeline import results
from nsf.pipeline.simulation import Job, simulate
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.scene import NOT_PHYSICS

#: Keys of the configuration that each stage's content depends on, beyond its parents.
_SCENE_KEYS = ("scale", "material", "transfer")
STAGES = ("simulate", "train", "deploy", "evaluate", "report")


@dataclass
class Pipeline:
    """The chain for one configuration.

    Args:
        config: configuration, as `nsf.config.load` gives it; resolved here.
        say: called with a line for the user.
        root: folder of runs; `NSF_RUNS` or `runs` by default.
    """

    config: DictConfig
    say: Callable[[str], None] = print
    root: Path | None = None

    def __post_init__(self):
        try:
            self._build()
        except ConfigKeyError as error:
            raise ConfigError(
                f"{error.full_key} is missing from the configuration; give it a value"
            ) from error

    def _build(self) -> None:
        """Build and check everything, so that a bad value is refused before any work."""
        self.scene = Scene.from_config(self.config)
        c = self.config = self.scene.config
        p = self.scene.parameters
        self.split = Split(train=tuple(p.train), validation=tuple(p.validation), test=tuple(p.test))
        for name in ("field", "trainer", "method", "sampler", "projector", "integration"):
            setattr(self, name, configuration.build(c[name], name))
        for key, least in (("latent_dim", 1), ("seed", 0)):
            configuration.number(key, c[key], least=least, whole=True)
        for key in ("trials", "picture_particles", "picture_frames"):
            configuration.number(f"evaluation.{key}", c.evaluation[key], least=1, whole=True)
        configuration.number("super_resolution.factor", c.super_resolution.factor, least=2, whole=True)
        for key in ("substeps", "frames"):
            configuration.number(f"super_resolution.{key}", c.super_resolution[key], least=1, whole=True)
        multiplier = c.deploy.dt_multiplier
        if not configuration.number("deploy.dt_multiplier", multiplier) > 0:
            raise ConfigError(f"deploy.dt_multiplier={multiplier} must be positive")
        _one_of("deploy.split", c.deploy.split, ("test", "validation", "train"))
        _one_of("deploy.on_distrust", c.deploy.on_distrust, ("report", "full_order"))
        _one_of("tracking", c.tracking, TRACKING)
        _one_of("data.resident", c.data.resident, (True, False, "auto"))
        _one_of("data.dtype", c.data.dtype, tuple(_STORED))
        if str(c.report.name) in ("", "..") or Path(str(c.report.name)).name != str(c.report.name):
            raise ConfigError(f"report.name={c.report.name} must be one folder's name; set report.folder")
        precision_of(c.precision)
        self.deployed = self._changed(c.deploy.changes)
        X = self.scene.particles().X
        for region in self.sampler.regions:
            check_well_posed(region.size, c.latent_dim)
            region.candidates(X)
        self._phases: Sequence[SamplePhase] | None = None
        self._sets: Sequence[ParticleSets] | None = None
        # The device is found once, so that a missing GPU is reported before any work.
        self.device = str(torch_device(warp_device(c.device)))
        self.check_values()

    def _changed(self, changes: DictConfig | None) -> Scene:
        """The scene of the held-out simulations and of deployment."""
        if not changes:
            return self.scene
        if not isinstance(changes, DictConfig):
            raise ConfigError(f"deploy.changes={changes} must map keys to values, as {{material.nu:0.25}}")
        try:
            return self.scene.with_changes(OmegaConf.to_container(changes))
        except ConfigError as error:
            raise ConfigError(f"deploy.changes: {error}") from error

    def check_values(self) -> None:
        """Build the scene at every parameter value: one out of range fails before any work.

        Raises:
            ConfigError: names the value.
            InstabilityError: Δt is unstable at a value.
        """
        for value, scene in self._needed():
            scene = scene.with_parameters({self.scene.parameters.name: value})
            grid = scene.grid
            check_time_step(scene.particles(), scene.initial_velocity(), grid.dx, scene.dt)
            for multiplier in (1.0, self.config.deploy.dt_multiplier):
                check_colliders(scene.colliders, grid, multiplier * scene.dt)

    @property
    def held_out(self) -> tuple[float, ...]:
        """Values that are deployed and evaluated."""
        self.check_held_out()
        return tuple(getattr(self.split, self.config.deploy.split))

    def check_held_out(self) -> None:
        """Refuse to deploy on no value.

        Raises:
            ConfigError: the split that is deployed is empty.
        """
        split = self.config.deploy.split
        if not getattr(self.split, split):
            raise ConfigError(f"deploy.split={split} has no values; set scene.parameters.{split}")

    # -- runs: where each stage's result lies ---------------------------------------------------------------

    def simulation(self, value: float, scene: Scene | None = None) -> Run:
        """The run of one full-order trajectory, of the scene of training by default."""
        c = self.config
        scene = scene or self.scene
        content = self._physics(scene)
        content |= {"precision": c.precision, "dtype": c.data.dtype}
        content["parameter"] = {"key": self.scene.parameters.key, "value": float(value)}
        if scene.files:
            # A changed mesh under the same path is another simulation.
            content["files"] = scene.files
        return Run.open("simulate", self.scene.name, content, root=self.root)

    def truth(self, value: float) -> Run:
        """The run of the full-order trajectory that a deployed one is held to."""
        return self.simulation(value, self.deployed)

    @property
    def training(self) -> Run:
        """The run of the manifold."""
        keys = ("field", "trainer", "latent_dim", "seed")
        parents = [self.simulation(v) for v in self.split.train]
        return Run.open("train", self.scene.name, self._content(keys), parents, root=self.root)

    @property
    def deployment(self) -> Run:
        """The run of the reduced trajectories."""
        keys = ("method", "sampler", "projector", "integration", "precision")
        content = (
            self._content(keys)
            | self._physics(self.deployed)
            | {
                "values": list(self.held_out),
                "split": self.config.deploy.split,
                "dt_multiplier": self.config.deploy.dt_multiplier,
                "on_distrust": self.config.deploy.on_distrust,
                "device": self.device,
            }
        )
        return Run.open("deploy", self.scene.name, content, [self.training], root=self.root)

    @property
    def evaluation(self) -> Run:
        """The run of errors and costs."""
        content = self._content(("evaluation",))
        content["paper"] = self._content(("scene",))["scene"].get("paper")
        parents = [self.deployment, *(self.truth(v) for v in self.held_out)]
        return Run.open("evaluate", self.scene.name, content, parents, root=self.root)

    def evaluated(self) -> Run:
        """The complete run of errors and costs, of this device or another: it may have been brought here.

        Raises:
            MissingRunError: there is none; says how far it came.
        """
        for device in (self.device, "cuda:0", "cpu"):
            there = copy(self)
            there.device = device
            if there.evaluation.complete:
                return there.evaluation
        return self.evaluation.require()

    @property
    def superresolution(self) -> Run:
        """The run of the deployed fields at more points."""
        content = self._content(("super_resolution",))
        parents = [self.deployment, *(self.truth(v) for v in self.held_out)]
        return Run.open("superresolve", self.scene.name, content, parents, root=self.root)

    @staticmethod
    def _physics(scene: Scene) -> dict:
        """What the configuration says of a scene's physics."""
        plain = OmegaConf.to_container(scene.config)
        content = {key: plain[key] for key in _SCENE_KEYS}
        return content | {"scene": {k: v for k, v in plain["scene"].items() if k not in NOT_PHYSICS}}

    def _content(self, keys: Sequence[str]) -> dict:
        plain = OmegaConf.to_container(self.config)
        return {key: plain[key] for key in keys}

    # -- stages ---------------------------------------------------------------------------------------------

    def run(self, stage: str) -> Run | Path:
        """One stage by name; what it reads must be there, except that `simulate` needs nothing.

        Raises:
            MissingRunError: an earlier stage has not run; names the command.
        """
        return getattr(self, stage)()

    def simulate(self) -> list[Run]:
        """Full-order trajectories of every training, validation and held-out value."""
        # A changed scene that changes nothing, or trains on what it deploys, names one run twice.
        runs = {self.simulation(value, scene): (value, scene) for value, scene in self._needed()}
        missing = {run: needed for run, needed in runs.items() if not run.complete}
        if len(missing) < len(runs):
            self.say(f"simulate: {len(runs) - len(missing)} of {len(runs)} trajectories are there, reused")
        if missing:
            started = time.perf_counter()
            self._simulate(missing)
            self.say(f"simulate: {len(missing)} trajectories in {time.perf_counter() - started:.1f} s")
        return list(runs)

    def _needed(self) -> list[tuple[float, Scene]]:
        """Every value with the scene that is simulated there: the deployed one where values are held out."""
        held_out = getattr(self.split, self.config.deploy.split)
        plain = {*self.split.train, *self.split.validation, *self.split.test}.difference(
            () if self.config.deploy.split == "train" else held_out
        )
        needed = [(value, self.scene) for value in plain] + [(value, self.deployed) for value in held_out]
        return sorted(needed, key=lambda pair: pair[0])

    def _simulate(self, runs: dict[Run, tuple[float, Scene]]) -> None:
        c, name, unit = self.config, self.scene.parameters.name, self.scene.parameters.unit

        def job(run: Run, value: float, scene: Scene) -> Job:
            parameters = {name: value}
            build = partial(scene.full_order, parameters, c.precision, self.device)
            return Job(run, f"{name} {value:g}{unit}", parameters, build)

        jobs = [job(run, *needed) for run, needed in runs.items()]
        simulate(jobs, self.scene.steps, self.scene.dx, _STORED[c.data.dtype], self.device, c.precision)

    def train(self) -> Run:
        """The manifold of the training trajectories."""
        run = self.training
        if self._reused(run):
            return run
        c = self.config
        paths = [self.simulation(v).require().path / "trajectory.h5" for v in self.split.train]
        snapshots = Snapshots(
            [Trajectory.open(p) for p in paths], device=self.device, resident=c.data.resident
        )
        with run.record(device=self.device, seed=c.seed) as record:
            manifold, metrics = train(
                snapshots,
                self.field,
                self.trainer,
                c.latent_dim,
                c.seed,
                run.path,
                self.device,
                tracking=c.tracking,
            )
            manifold.datasets = [self.simulation(v).id for v in self.split.train]
            manifold.split = {"train": list(self.split.train), "test": list(self.split.test)}
            manifold.save(run.path / "manifold.pt")
            record.output("manifold.pt")
            record.metrics.update(metrics)
        snapshots.close()
        seconds = metrics["training_seconds"]
        self.say(f"train: field={manifold.field}, r={c.latent_dim} in {seconds:.1f} s → {run.id}")
        return run

    def solver_at(self, manifold: Manifold, value: float, device: str | None = None) -> ReducedMPM:
        """The configured reduced solver at a parameter value, at t = 0."""
        solver = self.deployed.reduced(
            manifold,
            {self.scene.parameters.name: value},
            self._phases or self.sampler,
            method=self.method,
            projector=self.projector,
            integration=self.integration,
            precision=self.config.precision,
            device=device or self.device,
            dt_multiplier=self.config.deploy.dt_multiplier,
            sets=self._sets,
        )
        # These depend on the manifold and the sampler alone: found once for all values.
        self._phases, self._sets = solver.phases, solver.sets
        return solver

    def deploy(self) -> Run:
        """Reduced trajectories of the held-out values, through Lightning's `Trainer.predict`."""
        run = self.deployment
        if self._reused(run):
            return run
        manifold = Manifold.load(self.training.require().path / "manifold.pt")
        with run.record(device=self.device, precision=self.config.precision) as record:
            build = partial(self.solver_at, manifold)
            started = time.perf_counter()
            trust = calibrate(build, manifold, self.device)
            record.metrics["trust"] = {
                "residual_m": trust.residual,
                "distance_m": trust.distance,
                "seconds": time.perf_counter() - started,
            }
            hand_over = self.config.deploy.on_distrust == "full_order"
            rollouts = deploy(build, self.held_out, self.device, trust, until_distrusted=hand_over)
            for index, rollout in enumerate(rollouts):
                rollout.save(run.path / f"rollout_{index}.h5")
                record.output(f"rollout_{index}.h5")
                self._warn(rollout)
                if rollout.handed_over >= 0:
                    self._go_on(manifold, rollout, run.path / continuation(index))
                    record.output(continuation(index))
            record.metrics["seconds"] = [r.seconds for r in rollouts]
            record.metrics["needed_outside"] = max(r.needed_outside for r in rollouts)
            record.metrics["diverged"] = [r.parameter for r in rollouts if r.diverged >= 0]
            record.metrics["distrusted"] = [r.parameter for r in rollouts if r.distrusted >= 0]
        self.say(
            f"deploy: method={self.config.method.name}, |S|={rollouts[0].sample}, "
            f"{len(rollouts)} values → {run.id}"
        )
        return run

    def _go_on(self, manifold: Manifold, rollout: Rollout, path: Path) -> None:
        solver = self.solver_at(manifold, rollout.parameter)
        beyond = go_on(solver, rollout, path, _STORED[self.config.data.dtype])
        if beyond:
            self.say(
                f"deploy: warning: {self._named(rollout)}: at the hand-over the stress of {beyond} particles "
                "was beyond what the law carries, and was scaled down to that"
            )

    def _named(self, rollout: Rollout) -> str:
        return f"{self.scene.parameters.name}={rollout.parameter:g}"

    def _warn(self, rollout: Rollout) -> None:
        value = self._named(rollout)
        if rollout.diverged >= 0:
            self.say(
                f"deploy: warning: {value} diverged at step {rollout.diverged} (off the grid or not finite); "
                "its errors are reported as ∞"
            )
        if (step := rollout.distrusted) >= 0:
            n, t = rollout.handed_over, rollout.t
            then = (
                f"; the full-order solver goes on from t = {t[n]:.4g} s"
                if n >= 0
                else f": {rollout.trust.max():.3g} times as far as training data are from themselves"
            )
            self.say(
                f"deploy: warning: {value} left what the model was trained on at t = {t[step]:.4g} s{then}"
            )
        if rollout.needed_outside:
            self.say(
                f"deploy: warning: {value}: a step needed {rollout.needed_outside} particles or nodes "
                "outside the superset or the grid; raise integration.margin or use integration=search"
            )

    def evaluate(self) -> Run:
        """Errors and costs of the reduced trajectories."""
        run = self.evaluation
        if self._reused(run):
            return run
        deployment = self.deployment.require()
        manifold = Manifold.load(self.training.require().path / "manifold.pt")
        e = self.config.evaluation
        comparisons, rollouts = [], []
        with run.record(device=self.device, precision=self.config.precision) as record:
            for index, value in enumerate(self.held_out):
                rollouts.append(Rollout.open(deployment.path / f"rollout_{index}.h5"))
                with contextlib.ExitStack() as files:
                    truth = self.truth(value).require().path / "trajectory.h5"
                    trajectory, rest = files.enter_context(Trajectory.open(truth)), None
                    if rollouts[-1].handed_over >= 0:
                        path = deployment.path / continuation(index)
                        rest = files.enter_context(Trajectory.open(path))
                    solver = self.solver_at(manifold, value)
                    shown = (e.picture_particles, e.picture_frames)
                    split = self.config.deploy.split
                    comparisons.append(compare(solver, trajectory, rollouts[-1], split, shown, rest))
            del solver
            cost = self._cost(manifold)
            table = results.rows(
                self.config, manifold, rollouts, comparisons, cost, self.device, run.manifest
            )
            seconds = self.training.manifest["metrics"]["training_seconds"]
            summary = results.summarise(self.deployed, manifold, table, comparisons, rollouts, seconds)
            results.write(record, table, comparisons, cost, summary)
        self.say(f"evaluate: mean δ {100 * table['delta'].mean():.3g} % over {len(table)} values → {run.id}")
        return run

    def _cost(self, manifold: Manifold) -> dict:
        trials, value = self.config.evaluation.trials, self.held_out[0]
        name = self.scene.parameters.name
        scene, multiplier = self.deployed, self.config.deploy.dt_multiplier
        cost = measure(
            {
                "full_order": Subject(
                    lambda: scene.full_order({name: value}, self.config.precision, self.device), scene.steps
                ),
                "reduced": Subject(
                    lambda: self.solver_at(manifold, value), reduced_steps(scene.steps, multiplier)
                ),
            },
            trials,
            self.device,
        )
        return results.costs(cost["full_order"], cost["reduced"])

    def report(self) -> Path:
        """The report of every evaluated variant of this scene at these held-out trajectories."""
        from nsf.reporting.build import build_report

        truths = {self.truth(v).id for v in self.held_out}
        found = Run.find("evaluate", self.scene.name, root=self.root)
        runs = [
            r for r in found if r.complete and truths == {p for p in r.parents if p.startswith("simulate/")}
        ]
        if not runs:
            raise MissingRunError(
                "no evaluate run of these held-out values is there; run `nsf run` with the same keys"
            )
        folder = Path(self.config.report.folder) / self.config.report.name
        page = build_report(runs, folder, self.config.scene.title, first=self.evaluation)
        self.say(f"report: {len(runs)} evaluated variants → {page}")
        return page

    def superresolve(self) -> Run:
        """The reduced trajectories at many more points, beside full-order ones of as many particles."""
        run = self.superresolution
        if self._reused(run):
            return run
        c, deployment = self.config, self.deployment.require()
        manifold = Manifold.load(self.training.require().path / "manifold.pt")
        steps, count = self.scene.steps, c.super_resolution.frames
        frames = np.unique(np.linspace(0, steps, min(count, steps) + 1).round().astype(int))[1:].tolist()
        paths = [self.truth(value).require().path / "trajectory.h5" for value in self.held_out]
        with run.record(device=self.device, precision=c.precision) as record:
            fine = []
            for index, path in enumerate(paths):
                rollout = Rollout.open(deployment.path / f"rollout_{index}.h5")
                with Trajectory.open(path) as trajectory:
                    fine.append(
                        superresolve(
                            manifold,
                            self.deployed,
                            trajectory,
                            rollout,
                            c.super_resolution.factor,
                            frames,
                            c.super_resolution.substeps,
                            c.precision,
                            self.device,
                        )
                    )
            table = results.write_superresolution(record, self.deployed, fine)
        self.say(
            f"superresolve: {table['points'][0]:,} points, mean δ {100 * table['delta'].mean():.3g} % "
            f"({100 * table['particles_delta'].mean():.3g} % at the {len(manifold.X):,} particles), "
            f"queried in {table['seconds'].sum():.1f} s → {run.id}"
        )
        return run

    def _reused(self, run: Run) -> bool:
        if run.complete:
            self.say(f"{run.stage}: inputs unchanged, reused → {run.id}")
            return True
        return False


def continuation(index: int) -> str:
    """File of a deploy run in which the full-order solver goes on with rollout `index`."""
    return f"continuation_{index}.h5"


#: Precision of stored frames by the name of their type.
_STORED = {"float32": FP32, "float64": FP64}


def _one_of(key: str, value, options: Sequence) -> None:
    if not any(value == option and type(value) is type(option) for option in options):
        shown = [str(o).lower() if isinstance(o, bool) else "null" if o is None else o for o in options]
        raise ConfigError(f"{key}={value} is unknown; choose {', '.join(shown[:-1])} or {shown[-1]}")
