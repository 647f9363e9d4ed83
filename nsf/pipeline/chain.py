"""The stages in order; each reads the files of the one before it and nothing else.

scene → simulate → dataset → train (→ teach) → deploy → evaluate → report
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.data import Snapshots, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.deployment import Levels, Rollout, calibrate, continuation_file, deploy, go_on, rollout_file
from nsf.dynamics import ParticleSets, ReducedBatch, ReducedMPM
from nsf.dynamics.setup import reduced_steps
from nsf.engines import Engine, Operators
from nsf.errors import MissingRunError
from nsf.evaluation import (
    Comparison,
    Rivals,
    Subject,
    coarse_subjects,
    compare,
    decoding_ms,
    measure,
    rivals,
    superresolve,
)
from nsf.kinematics.fields.mlp import MlpField
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.ranks import train_together
from nsf.kinematics.training.train import train
from nsf.pipeline import results
from nsf.pipeline.plan import Plan
from nsf.pipeline.simulation import Job, Shared, simulate
from nsf.pipeline.teaching import OPERATORS, teach
from nsf.runs import Record, Run
from nsf.sampling import SampleSpan
from nsf.scenes import Scene
from nsf.storage import writing

STAGES = ("simulate", "train", "teach", "deploy", "evaluate", "report")
#: File of a deploy run with the configuration of its whole chain, interpolations kept.
CONFIGURATION = "configuration.yaml"


class Pipeline(Plan):
    """The chain for one configuration.

    Args:
        config, root: as for `Plan`, which checks them.
        say: called with a line for the user.
    """

    def __init__(self, config: DictConfig, say: Callable[[str], None] = print, root: Path | None = None):
        super().__init__(config, root)
        self.say = say
        self._samples: Sequence[SampleSpan] | None = None
        self._sets: Sequence[ParticleSets] | None = None
        self._taught: Operators | None = None

    @classmethod
    def of_run(cls, run: Run, device: str = "auto", say: Callable[[str], None] = print) -> "Pipeline":
        """The chain that a deploy run is part of, for more than the run holds.

        Args:
            run: a complete deploy run.
            device: of what is done with it; the run may have been made on another.
            say: as for `Pipeline`.

        Raises:
            MissingRunError: the run was made before its whole configuration was kept.
        """
        path = run.path / CONFIGURATION
        if not path.exists():
            raise MissingRunError(
                f"{run.path} has no {CONFIGURATION}: it was made by an earlier nsf; "
                f"delete the folder and run `nsf deploy scene={run.scene}` with the same keys"
            )
        config = configuration.read(run.file(CONFIGURATION))
        config.device = device
        return cls(config, say, run.root)

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of the chain, `teach` only where the engine that is asked for is taught."""
        return tuple(name for name in STAGES if name != "teach" or self.teaching is not None)

    def run(self, stage: str) -> Run | Path:
        """One stage by name; what it reads must be there, except that `simulate` needs nothing.

        Raises:
            MissingRunError: an earlier stage has not run; names the command.
        """
        return getattr(self, stage)()

    def simulate(self, later: Sequence[str] = ()) -> list[Run]:
        """Full-order trajectories of every training, validation and held-out value.

        Args:
            later: the stages that they are for, if no others: trajectories that only read are in these
                stages' results, where those are there, are not made again.
        """
        # A changed scene that changes nothing, or trains on what it deploys, names one run twice.
        runs = {self.simulation(value, scene): (value, scene) for value, scene in self.needed()}
        missing = {run: needed for run, needed in runs.items() if not run.complete}
        told = {line: None for run in runs if run.complete for line in run.manifest.get("warnings", ())}
        there, spare = len(runs) - len(missing), self._spare(later) if later else set()
        needless = [run for run in missing if run.id in spare]
        if there:
            self.say(f"simulate: {there} of {len(runs)} trajectories are there, reused")
        if needless:
            self.say(
                f"simulate: {len(needless)} of {len(runs)} trajectories are gone, and nothing needs them"
            )
            missing = {run: needed for run, needed in missing.items() if run not in needless}
        warnings = {run: self._resolution(*needed) for run, needed in missing.items()}
        for line in told | {line: None for lines in warnings.values() for line in lines}:
            self.say(f"simulate: warning: {line}")
        if missing:
            started = time.perf_counter()
            made = self._simulate(missing, warnings)
            elsewhere = f", {len(missing) - made} by another process" if made < len(missing) else ""
            self.say(f"simulate: {made} trajectories in {time.perf_counter() - started:.1f} s{elsewhere}")
        return list(runs)

    def _spare(self, later: Sequence[str]) -> set[str]:
        """Trajectories, by id, that the stages need not read, as their results are there."""
        truths = {self.truth(value).id for value in self.held_out}
        read = {"evaluate": self.evaluation, "superresolve": self.superresolution}
        over = "evaluate" in later and all(run.complete for name, run in read.items() if name in later)
        trained = {run.id for run in self.training_data}
        needed = (set() if over else truths) | (set() if self.training.complete else trained)
        return (truths | trained) - needed

    def _resolution(self, value: float, scene: Scene) -> list[str]:
        """What a trajectory is too coarse for."""
        from nsf.scenes.resolution import resolution_warnings  # SciPy takes 0.2 s to load

        return resolution_warnings(scene.with_parameters({self.scene.parameters.name: value}))

    def _simulate(self, runs: dict[Run, tuple[float, Scene]], warnings: dict[Run, list[str]]) -> int:
        c, name, unit = self.config, self.scene.parameters.name, self.scene.parameters.unit

        def job(run: Run, value: float, scene: Scene) -> Job:
            parameters = {name: value}
            build = partial(scene.full_order, parameters, c.precision, self.device)
            return Job(run, f"{name} {value:g}{unit}", parameters, build, warnings[run])

        self.check_room(runs)
        jobs = [job(run, *needed) for run, needed in runs.items()]
        shared = Shared(self.scene.steps, self.scene.dx, self.stored, self.device, c.precision)
        return simulate(jobs, shared, self.say)

    def train(self) -> Run:
        """The manifold of the training trajectories."""
        return self._made(self.training, self._train)

    def _train(self, run: Run) -> None:
        self.check_devices()
        c = self.config
        paths = [run.file(TRAJECTORY) for run in self.training_data]
        own = {"field": self.field, "latent_dim": c.latent_dim, "seed": c.seed, "tracking": c.tracking}
        one = partial(train, folder=run.path, **own)
        with run.record(device=self.device, seed=c.seed) as record:
            if self.trainer.devices > 1:
                manifold, metrics = train_together(paths, one, self.trainer, self.device, c.data.resident)
            else:
                with contextlib.closing(Snapshots(paths, self.device, c.data.resident)) as snapshots:
                    manifold, metrics = one(snapshots, trainer=self.trainer, device=self.device)
            manifold.datasets = [run.id for run in self.training_data]
            manifold.split = {"train": list(self.split.train), "test": list(self.split.test)}
            manifold.save(run.path / "manifold.pt")
            record.output("manifold.pt")
            record.metrics.update(metrics)
        seconds = metrics["training_seconds"]
        self.say(f"train: field={manifold.field}, r={c.latent_dim} in {seconds:.1f} s → {run.id}")

    def manifold(self) -> Manifold:
        """The trained manifold.

        Raises:
            MissingRunError: it is not trained.
        """
        manifold = Manifold.load(self.training.require().file("manifold.pt"))
        if isinstance(self.field, MlpField):
            manifold.arithmetic = self.field.arithmetic
        return manifold

    def solver_at(
        self,
        manifold: Manifold,
        value: float,
        device: str | None = None,
        precision: str | None = None,
        engine: str | Engine | None = None,
    ) -> ReducedMPM:
        """The reduced solver at a parameter value, at t = 0; device, precision and engine as configured."""
        return self.batch_at(manifold, [value], device, precision, engine).runs[0]

    def batch_at(
        self,
        manifold: Manifold,
        values: Sequence[float],
        device: str | None = None,
        precision: str | None = None,
        engine: str | Engine | None = None,
        scene: Scene | None = None,
    ) -> ReducedBatch:
        """Reduced runs at several parameter values that take their steps together, likewise.

        By the engine that is asked for, of the scene that is deployed, unless others are given.
        """
        if engine is None:
            engine = self._operators(manifold) if self.engine == Operators.name else self.engine
        batch = (scene or self.deployed).reduced_batch(
            manifold,
            [{self.scene.parameters.name: value} for value in values],
            self._samples or self.sampler,
            engine=engine,
            method=self.method,
            projector=self.projector,
            integration=self.integration,
            precision=precision or self.config.precision,
            device=device or self.device,
            dt_multiplier=self.config.deploy.dt_multiplier,
            # As the sample, these depend on the manifold and the sampler alone: found once for all values.
            sets=self._sets,
        )
        self._samples, self._sets = batch.batch.shared.samples, batch.batch.shared.sets
        return batch

    def teach(self) -> Run:
        """The operators of the deployed step, where the engine that is asked for steps by them.

        Raises:
            ConfigError: it does not.
        """
        return self._made(self.taught, self._teach)

    def _teach(self, run: Run) -> None:
        manifold = self.manifold().to(self.device)
        with run.record(device=self.device, seed=self.config.seed, precision=self.config.precision) as record:
            teach(self, manifold, record)
        found = record.metrics
        self.say(
            f"teach: {found['teacher_steps']} steps of the teacher in {found['teach_seconds']:.1f} s, "
            f"{100 * min(found['errors']):.2g} % off at values held back → {run.id}"
        )

    def _operators(self, manifold: Manifold) -> Operators:
        """The operators that were taught; with them the sample, which is that of the scene of training."""
        if self._taught is None:
            self._taught = Operators.load(self.taught.require().file(OPERATORS))
            self.batch_at(manifold, self.split.train[:1], engine=self.projecting, scene=self.scene)
        return self._taught

    def deploy(self) -> Run:
        """Reduced trajectories of the held-out values, through Lightning's `Trainer.predict`."""
        if self.teaching is not None:
            self.teach()
        return self._made(self.deployment, self._deploy)

    def _deploy(self, run: Run) -> None:
        manifold = self.manifold().to(self.device)  # many solvers take their rows from it
        with run.record(device=self.device, precision=self.config.precision) as record:
            started = time.perf_counter()
            solver_at = partial(self.solver_at, manifold, engine=self.projecting)
            trust = calibrate(solver_at, manifold, self.device)
            record.metrics["trust"] = {
                "residual_m": trust.residual,
                "distance_m": trust.distance,
                "seconds": time.perf_counter() - started,
            }
            hand_over = self.config.deploy.on_distrust == "full_order"
            together = min(self.config.deploy.batch, len(self.held_out))

            def batch_at(values: Sequence[float], device: str) -> ReducedBatch:
                batch = self.batch_at(manifold, values, device)
                record.metrics |= {"engine": batch.engine, "engine_why": batch.why}
                return batch

            levels = self._levels(manifold)
            rollouts = deploy(batch_at, self.held_out, self.device, trust, hand_over, together, levels)
            engine, why = record.metrics["engine"], record.metrics["engine_why"]
            self.say(f"deploy: engine {engine}" + (f", since {why}" if why else ""))
            for index, rollout in enumerate(rollouts):
                rollout.save(run.path / rollout_file(index))
                record.output(rollout_file(index))
                self._warn(rollout)
                if rollout.handed_over >= 0:
                    self._go_on(manifold, rollout, run.path / continuation_file(index))
                    record.output(continuation_file(index))
            self._write_configuration(record)
            # Runs that took their steps together share the time of these equally.
            record.metrics["batch"] = together
            record.metrics["seconds"] = [r.seconds for r in rollouts]
            record.metrics["by_operators"] = [r.by_operators for r in rollouts]
            record.metrics["needed_outside"] = max(r.needed_outside for r in rollouts)
            record.metrics["diverged"] = [r.parameter for r in rollouts if r.diverged >= 0]
            record.metrics["distrusted"] = [r.parameter for r in rollouts if r.distrusted >= 0]
        at_once = f", {together} together" if together > 1 else ""
        self.say(
            f"deploy: method={self.config.method.name}, |S|={rollouts[0].sample}, "
            f"{len(rollouts)} values{at_once} → {run.id}"
        )

    def _levels(self, manifold: Manifold) -> Levels | None:
        """How runs by operators are watched, and who goes on with them."""
        if self.teaching is None:
            return None
        asked = self.config.deploy
        return Levels(
            partial(self.batch_at, manifold, engine=self.projecting),
            self.config.engine.check,
            asked.tolerance,
            asked.on_distrust != "report",
        )

    def _write_configuration(self, record: Record) -> None:
        # config.yaml is resolved, so in it no key follows another value of the problem parameter.
        with writing(record.path / CONFIGURATION) as partial:
            OmegaConf.save(self.scene.template, partial)
        record.output(CONFIGURATION)

    def _go_on(self, manifold: Manifold, rollout: Rollout, path: Path) -> None:
        solver = self.solver_at(manifold, rollout.parameter)
        beyond = go_on(solver, rollout, path, self.stored)
        if beyond:
            self.say(
                f"deploy: warning: {self._named(rollout)}: at the hand-over the stress of {beyond} particles "
                "was beyond what the law carries, and was scaled down to that"
            )

    def _named(self, rollout: Rollout) -> str:
        return f"{self.scene.parameters.name}={rollout.parameter:g}"

    def _warn(self, rollout: Rollout) -> None:
        value = self._named(rollout)
        if (own := rollout.by_operators) < len(rollout.stops) and rollout.estimate is not None:
            self.say(f"deploy: {value}: the projected step goes on from t = {rollout.t[own]:.4g} s")
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
        return self._made(self.evaluation, self._evaluate)

    def _evaluate(self, run: Run) -> None:
        truths, manifold = self._truths(), self.manifold().to(self.device)  # as in deployment
        with run.record(device=self.device, precision=self.config.precision) as record:
            rollouts = self._rollouts(len(truths), manifold)
            found = [
                self._compare(manifold, rollout, truth, index)
                for index, (rollout, truth) in enumerate(zip(rollouts, truths, strict=True))
            ]
            comparisons, beside = zip(*found, strict=True)
            cost = self._cost(manifold, rollouts[0], beside[0].factors)
            engine = str(self.deployment.manifest["metrics"].get("engine", ""))
            seconds = self.training.metric("training_seconds")
            offline = seconds, 0.0 if self.teaching is None else self.taught.metric("teach_seconds")
            table = results.rows(
                self.config,
                manifold,
                rollouts,
                comparisons,
                beside,
                cost,
                self.device,
                run.manifest,
                engine,
                offline,
            )
            summary = results.summarise(
                self.deployed, manifold, table, comparisons, beside, rollouts, seconds
            )
            results.write(record, table, comparisons, cost, summary)
        self.say(f"evaluate: mean δ {100 * table['delta'].mean():.3g} % over {len(table)} values → {run.id}")

    def _truths(self) -> list[Path]:
        """Files of the full-order trajectories that the deployed ones are held to."""
        return [self.truth(value).file(TRAJECTORY) for value in self.held_out]

    def _rollouts(self, count: int, manifold: Manifold) -> list[Rollout]:
        """The reduced runs at the held-out values."""
        files = (self.deployment.file(rollout_file(index)) for index in range(count))
        return [Rollout.open(file, manifold.latent_dim) for file in files]

    def _compare(
        self, manifold: Manifold, rollout: Rollout, truth: Path, index: int
    ) -> tuple[Comparison, Rivals]:
        shown = (self.config.evaluation.picture_particles, self.config.evaluation.picture_frames)
        with contextlib.ExitStack() as files:
            trajectory = files.enter_context(Trajectory.open(truth))
            rest = None
            if rollout.handed_over >= 0:
                rest = files.enter_context(Trajectory.open(self.deployment.file(continuation_file(index))))
            solver = self.solver_at(manifold, rollout.parameter)
            found = compare(solver, trajectory, rollout, self.config.deploy.split, shown, rest)
            return found, rivals(solver, trajectory, self.coarse)

    def _cost(self, manifold: Manifold, rollout: Rollout, factors: Sequence[int]) -> dict:
        trials, value = self.config.evaluation.trials, self.held_out[0]
        name = self.scene.parameters.name
        scene, multiplier = self.deployed, self.config.deploy.dt_multiplier
        if not trials:
            return results.costs({})
        coarse = coarse_subjects(scene, {name: value}, factors, self.config.precision, self.device)
        cost = measure(
            {
                "full_order": Subject(
                    lambda: scene.full_order({name: value}, self.config.precision, self.device), scene.steps
                ),
                "reduced": Subject(
                    lambda: self.solver_at(manifold, value), reduced_steps(scene.steps, multiplier)
                ),
                **coarse,
            },
            trials,
            self.device,
        )
        decoding = decoding_ms(self.solver_at(manifold, value), rollout, trials)
        return results.costs(cost, decoding)

    @property
    def _report_folder(self) -> Path:
        return Path(self.config.report.folder) / self.config.report.name

    def check_report_folder(self) -> None:
        """Refuse a place where no report could be written.

        Raises:
            ConfigError: something else stands there.
            StorageError: the folder above it cannot be written.
        """
        from nsf.reporting.swap import check_place

        check_place(self._report_folder)

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
        page = build_report(runs, self._report_folder, self.config.scene.title, first=self.evaluation)
        self.say(f"report: {len(runs)} evaluated variants → {page}")
        return page

    def superresolve(self) -> Run:
        """The reduced trajectories at many more points, beside full-order ones of as many particles."""
        return self._made(self.superresolution, self._superresolve)

    def _superresolve(self, run: Run) -> None:
        c, asked = self.config, self.config.super_resolution
        truths, manifold = self._truths(), self.manifold()
        # Evenly spread, without frame 0, at which nothing has moved.
        steps = self.scene.steps
        frames = np.unique(np.linspace(0, steps, min(asked.frames, steps) + 1).round().astype(int))[1:]
        with run.record(device=self.device, precision=c.precision) as record:
            rollouts = self._rollouts(len(truths), manifold)
            with contextlib.ExitStack() as files:
                fine = superresolve(
                    manifold,
                    self.deployed,
                    [files.enter_context(Trajectory.open(truth)) for truth in truths],
                    rollouts,
                    asked.factor,
                    frames.tolist(),
                    asked.substeps,
                    c.precision,
                    self.device,
                    self.say,
                )
            table = results.write_superresolution(record, self.deployed, fine)
        self.say(
            f"superresolve: {table['points'][0]:,} points, mean δ {100 * table['delta'].mean():.3g} % "
            f"({100 * table['particles_delta'].mean():.3g} % at the {len(manifold.X):,} particles), "
            f"queried in {table['seconds'].sum():.1f} s → {run.id}"
        )

    def _made(self, run: Run, make: Callable[[Run], None]) -> Run:
        """The run, made here unless it is there or another process makes it meanwhile."""
        if not run.complete:
            for parent in run.parent_runs:
                parent.require()
            with run.claimed(self.say):
                if not run.complete:
                    make(run)
                    return run
        self.say(f"{run.stage}: inputs unchanged, reused → {run.id}")
        return run
