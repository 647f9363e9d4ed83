"""The stages in order; each reads the files of the one before it and nothing else.

scene → simulate → dataset → train (→ teach) → deploy → evaluate → report
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from nsf import config as configuration
from nsf.data import Case
from nsf.dynamics import ParticleSets, ReducedBatch, ReducedMPM
from nsf.engines import Engine, Operators, reduced_batch
from nsf.kinematics.fields.mlp import MlpField
from nsf.kinematics.manifold import Manifold
from nsf.models import Auto
from nsf.mpm.stability import largest_stable_dt, multiplied_step_warning
from nsf.pipeline.plan import Plan
from nsf.pipeline.reuse import report, reused, simulations
from nsf.pipeline.stages.choosing import measure_candidates
from nsf.pipeline.stages.deployment import CONFIGURATION, deploy_held_out
from nsf.pipeline.stages.evaluation import evaluate, superresolve_held_out
from nsf.pipeline.stages.fitting import fit, fitted, loaded
from nsf.pipeline.stages.simulation import Job, Shared, simulate
from nsf.pipeline.stages.teaching import OPERATORS, teach
from nsf.pipeline.stages.training import train
from nsf.runs import Run
from nsf.sampling import SampleSpan
from nsf.scenes import Scene


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
        self._fitted: Any = None

    @classmethod
    def of_run(cls, run: Run, device: str = "auto", say: Callable[[str], None] = print) -> "Pipeline":
        """The chain that a deploy run is part of, for more than the run holds.

        Args:
            run: a complete deploy run.
            device: of what is done with it; the run may have been made on another.
            say: as for `Pipeline`.

        Raises:
            SchemaError: the configuration is not there, or was changed after the run.
        """
        config = configuration.read(run.file(CONFIGURATION))
        config.device = device
        pipeline = cls(config, say, run.root)
        if isinstance(pipeline.configured, Auto):
            pipeline.choose(run.manifest["metrics"]["model"])
        return pipeline

    def run(self, stage: str) -> Run | Path:
        """One stage by name; what it reads must be there, except that `simulate` needs nothing.

        Raises:
            MissingRunError: an earlier stage has not run; names the command.
        """
        return getattr(self, stage)()

    def simulate(self, later: Sequence[str] = ()) -> list[Run]:
        """Full-order trajectories of every training, validation and held-out case.

        Args:
            later: the stages that they are for, if no others: trajectories that only read are in these
                stages' results, where those are there, are not made again.
        """
        # A changed scene that changes nothing, or trains on what it deploys, names one run twice.
        runs = {self.simulation(*needed): needed for needed in self.needed()}
        missing = simulations(self, runs, later, self.say)
        warnings = {run: self._resolution(*runs[run]) for run in missing}
        known = {line for run in runs if run.complete for line in run.manifest.get("warnings", ())}
        for line in dict.fromkeys(line for lines in warnings.values() for line in lines):
            if line not in known:
                self.say(f"simulate: warning: {line}")
        if missing:
            started = time.perf_counter()
            made = self._simulate({run: runs[run] for run in missing}, warnings)
            elsewhere = f", {len(missing) - made} by another process" if made < len(missing) else ""
            self.say(f"simulate: {made} trajectories in {time.perf_counter() - started:.1f} s{elsewhere}")
        return list(runs)

    def _resolution(self, case: Case, scene: Scene) -> list[str]:
        """What a trajectory is too coarse for."""
        from nsf.scenes.resolution import resolution_warnings  # SciPy takes 0.2 s to load

        return resolution_warnings(scene.at(case))

    def _simulate(self, runs: dict[Run, tuple[Case, Scene]], warnings: dict[Run, list[str]]) -> int:
        c = self.config

        def job(run: Run, case: Case, scene: Scene) -> Job:
            build = partial(scene.full_order, case, c.precision, self.device)
            forcing = scene.at(case).forcing_at(scene.dt * np.arange(scene.steps + 1))
            return Job(run, case, build, forcing, warnings[run])

        self.check_room(runs)
        jobs = [job(run, *needed) for run, needed in runs.items()]
        shared = Shared(self.scene.steps, self.scene.dx, self.stored, self.device, c.precision)
        return simulate(jobs, shared, self.say)

    def full_order(self, cases: Sequence[Case]) -> list[Run]:
        """Full-order trajectories of any cases of the deployed scene; those that are there are reused."""
        runs = {self.truth(case): (case, self.deployed) for case in cases}
        if missing := {run: needed for run, needed in runs.items() if not run.complete}:
            self._simulate(missing, {run: [] for run in missing})
        return [self.truth(case) for case in cases]

    def train(self) -> Run:
        """The manifold of the training trajectories."""
        return self._made(self.training, partial(train, self))

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
        case: Case,
        device: str | None = None,
        precision: str | None = None,
        engine: str | Engine | None = None,
    ) -> ReducedMPM:
        """The reduced solver of a case, at t = 0; device, precision and model as configured."""
        return self.batch_at(manifold, [case], device, precision, engine).runs[0]

    def batch_at(
        self,
        manifold: Manifold,
        cases: Sequence[Case],
        device: str | None = None,
        precision: str | None = None,
        engine: str | Engine | None = None,
        scene: Scene | None = None,
    ) -> ReducedBatch:
        """Reduced runs of several cases that take their steps together, likewise.

        By the configured model, of the scene that is deployed, unless an engine or a scene is given.
        """
        if self.teaching is not None and self.taught.complete:
            self.operators()  # which bring the sample, whoever takes the steps
        if engine is None:
            engine = self.model.engine(self, manifold)
        batch = reduced_batch(
            scene or self.deployed,
            manifold,
            cases,
            self._samples or self.sampler,
            engine=engine,
            sources=self.sources,
            projector=self.projector,
            integration=self.integration,
            precision=precision or self.config.precision,
            device=device or self.device,
            dt_multiplier=self.config.deploy.dt_multiplier,
            # As the sample, these depend on the manifold and the sampler alone: found once for all cases.
            sets=self._sets,
        )
        self._samples, self._sets = batch.batch.shared.samples, batch.batch.shared.sets
        return batch

    def teach(self) -> Run:
        """What the configured model learns, once, that all its runs use.

        Raises:
            ConfigError: it learns nothing.
        """
        taught = self.taught
        return self._made(taught, partial(fit if self.teaching is None else teach, self))

    def operators(self) -> Operators:
        """The operators that were taught; their sample is that of all runs from here on.

        Raises:
            MissingRunError: none were taught.
        """
        if self._taught is None:
            self._taught = Operators.load(self.taught.require().file(OPERATORS))
            self._samples = self._taught.samples
        return self._taught

    def fitted(self, manifold: Manifold) -> Any:
        """What a model of latent vectors was fitted to, from its file where it learns.

        Raises:
            MissingRunError: it was not taught.
        """
        if self._fitted is None:
            self._fitted = loaded(self.taught) if self.model.learns else fitted(self, manifold)
        return self._fitted

    def deploy(self) -> Run:
        """Reduced trajectories of the held-out cases, through Lightning's `Trainer.predict`."""
        if self.is_taught and not self.taught.complete:
            self.teach()
        if not self.deployment.complete and (line := self._step_warning()):
            self.say(f"deploy: warning: {line}")
        return self._made(self.deployment, self._deploy)

    def _deploy(self, run: Run) -> None:
        measured = measure_candidates(self) if isinstance(self.configured, Auto) else []
        deploy_held_out(self, run, measured)

    def _step_warning(self) -> str | None:
        """Whether the reduced step is far too long for a case."""
        scenes = map(self.deployed.at, getattr(self.split, self.config.deploy.split))
        stable = min(largest_stable_dt(at.particles(), at.initial_velocity(), at.dx) for at in scenes)
        return multiplied_step_warning(self.config.deploy.dt_multiplier, self.deployed.dt, stable)

    def evaluate(self) -> Run:
        """Errors and costs of the reduced trajectories."""
        return self._made(self.evaluation, partial(evaluate, self))

    def report(self) -> Path:
        """The report of every evaluated variant of this scene at these held-out trajectories."""
        return report(self, self.say)

    def superresolve(self) -> Run:
        """The reduced trajectories at many more points, beside full-order ones of as many particles."""
        return self._made(self.superresolution, partial(superresolve_held_out, self))

    def _made(self, run: Run, make: Callable[[Run], None]) -> Run:
        """The run, made here unless it is there or another process makes it meanwhile."""
        if not run.complete:
            for parent in run.parent_runs:
                parent.require()
            with run.claimed(self.say):
                if not run.complete:
                    make(run)
                    return run
        return reused(run, self.say)
