"""The stages of one configuration, in order; each reads the files of the one before it and nothing else.

scene → simulate → dataset → train (→ teach) → deploy → evaluate → report

A configuration becomes values in `nsf.pipeline.configured`, and values become stages here: the run of each,
whether it is there, and the work that makes it. Torch is imported where a stage works, so that a mistake, or
a chain whose results are all there, takes a second or two.
"""

from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.data.case import Case
from nsf.errors import MissingRunError
from nsf.models import Auto, Model
from nsf.models.drawn import Drawn
from nsf.paths import option
from nsf.pipeline import naming, reuse, solvers
from nsf.pipeline.configured import Configured
from nsf.pipeline.durations import measured
from nsf.pipeline.reuse import question_of
from nsf.pipeline.tracking import Tracked
from nsf.progress import START, timed
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.designs import random_cases

#: Of the chain, in order.
STAGES = ("simulate", "train", "teach", "deploy", "evaluate", "report")


class Pipeline(Configured):
    """The chain of one configuration: the run of each stage, and the work that makes it.

    Args:
        config: as `nsf.config.load` gives it.
        say: called with a line for the user.
        root: folder of runs; `NSF_RUNS` or `runs` by default.

    Attributes:
        training, encoding, taught, deployment, evaluation, superresolution: runs of the stages
            (`nsf.pipeline.naming`); `encoding` is a part of `teach`.

    Raises:
        ConfigError: a value is missing or refused; names it. What only a stage's work needs is built, and
            refused, by `check`: before the work of a stage, and of `simulate` while its first runs go on.
        DeviceError: the device does not exist.
    """

    #: Name of the sweep that the chain is a job of; empty for none.
    group = ""
    #: The engine of projected steps: the compiled one where it can, else the reference.
    projecting = "auto"

    def __init__(self, config: DictConfig, say: Callable[[str], object] = print, root: Path | None = None):
        self.say, self.root = say, root
        self._chosen: Model | None = None
        self._learned: Run | None = None
        self._simulations: dict[tuple[Case, int], Run] = {}
        self._deployments: dict[tuple[int, Run | None], Run] = {}
        self._samples = self._sets = self._taught = self._fitted = None
        super().__init__(config)

    @classmethod
    def of_run(cls, run: Run, device: str = "auto", say: Callable[[str], object] = print) -> "Pipeline":
        """The chain that a deploy run is part of, for more than the run holds.

        Args:
            run: a complete deploy run.
            device: of what is done with it; the run may have been made on another.
            say: as for `Pipeline`.

        Raises:
            SchemaError: the configuration is not there, or was changed after the run.
        """
        from nsf.pipeline.stages.deployment import CONFIGURATION

        config = configuration.read(run.file(CONFIGURATION))
        config.device = device
        pipeline = cls(config, say, run.root)
        if isinstance(pipeline.configured, Auto):
            pipeline.choose(run.metric("model", kind=str))
        pipeline._learned = next((parent for parent in run.parent_runs if parent.stage == "teach"), None)
        return pipeline

    def _repr_html_(self) -> str:
        """Its runs and, once it is evaluated, its errors and a strip, for a notebook."""
        from nsf.results.notebook import html

        return html([self.training, self.deployment, self.evaluation])

    def check(self) -> "Pipeline":
        """This pipeline, once everything that its stages need is built and checked.

        Raises:
            ConfigError: a value is refused; names it.
            InstabilityError: Δt is unstable in a case.
        """
        from nsf.pipeline.checks import check

        check(self)
        return self

    @cached_property
    def tracked(self) -> Tracked:
        """The chain as a tracked run."""
        return Tracked(self)

    # -- models and cases --------------------------------------------------------------------------------

    @property
    def model(self) -> Model:
        """The model that takes the steps; of `model=auto` the one that its deployment chose.

        Raises:
            MissingRunError: it has not chosen yet.
        """
        if not isinstance(self.configured, Auto):
            return self.configured
        if self._chosen is None:
            self.choose(self.deployment.require().metric("model", kind=str))
        return self._chosen

    def choose(self, name: str) -> None:
        """Take one of the candidates of `model=auto`."""
        self._chosen = self.configured.of[name]

    def alone(self, name: str) -> "Pipeline":
        """The chain of a candidate of `model=auto` by itself, deployed at the validation cases."""
        return self._with(self.template.model.of[name], split="validation")

    @cached_property
    def validating(self) -> "Pipeline | None":
        """The chain that deploys the same model at validation cases, whose runs tell how large errors are.

        None where there are no such cases, or these are deployed anyway.
        """
        if not self.split.validation or self.config.deploy.split == "validation":
            return None
        if isinstance(self.configured, Auto):
            return self.alone(self.model.name)
        return self._with(self.template.model, split="validation", changes=None)

    @property
    def calibrating(self) -> "list[Pipeline]":
        """The chains whose deployments bound the errors of this one's runs, and of those by its fallback."""
        own = [] if isinstance(self.configured, Auto) else [self.validating]
        taking = [self.projected.validating] if self.config.fallback == "projected" else []
        return [other for other in own + taking if other is not None]

    @cached_property
    def projected(self) -> "Pipeline":
        """The chain of the projected model, which takes runs of another that is not believed."""
        return self._with(OmegaConf.load(option("model", "projected")))

    def _with(self, model: DictConfig, **deploy: Any) -> "Pipeline":
        """The chain of another model without fallback, and other keys of `deploy`."""
        config = self.template.copy()
        config.model, config.fallback = model, "none"
        config.deploy = OmegaConf.merge(config.deploy, deploy)
        other = Pipeline(config, self.say, self.root)
        other.device = self.device
        return other

    def on(self, device: str) -> "Pipeline":
        """This chain on a device that need not be here, for the names of its runs."""
        if device == self.device:
            return self
        other = copy(self)
        other.device, other._deployments = device, {}
        for name in ("validating", "projected"):
            vars(other).pop(name, None)
        return other

    @property
    def lessons(self) -> list[list[Case]]:
        """Cases that a model learns from: of training, those drawn and of validation.

        Validation runs choose its weights; where there are none, and no programs, those of training do.
        """
        training = sorted(self.split.train)
        if not isinstance(self.model, Drawn):
            return [training]
        taken = [*training, *self.split.validation, *self.split.test]
        count = self.model.runs_of(self.forced)
        drawn = random_cases(self.split.box, count, int(self.config.seed), taken) if count else []
        return [training, drawn, sorted(self.split.validation) or training]

    # -- the run of each stage ---------------------------------------------------------------------------

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of the chain, `teach` only where the model learns by itself."""
        return tuple(name for name in STAGES if name != "teach" or self.is_taught)

    def simulation(self, case: Case, scene: Scene | None = None) -> Run:
        """The run of one full-order trajectory, of the scene of training by default."""
        scene = self.scene if scene is None else scene
        key = case, id(scene)  # a name is asked for often, and takes a millisecond
        if scene is not self.scene and scene is not self.deployed:
            return naming.simulation(self, case, scene)
        if key not in self._simulations:
            self._simulations[key] = naming.simulation(self, case, scene)
        return self._simulations[key]

    def truth(self, case: Case) -> Run:
        """The run of the full-order trajectory that a deployed one is held to."""
        return self.simulation(case, self.deployed)

    @property
    def training_data(self) -> list[Run]:
        """The runs of the trajectories that are trained on."""
        return [self.simulation(case) for case in self.split.train]

    training = property(naming.training)
    encoding = property(naming.encoding)
    evaluation = property(naming.evaluation)
    superresolution = property(naming.superresolution)

    @property
    def deployment(self) -> Run:
        """The run of the reduced trajectories."""
        key = id(self._chosen), self._learned  # a name is asked for often, and takes some milliseconds
        if key not in self._deployments:
            self._deployments[key] = naming.deployment(self)
        return self._deployments[key]

    @property
    def taught(self) -> Run:
        """The run of what the model learned; of a chain opened from a deployment, on whatever device."""
        return self._learned or naming.taught(self)

    def runs_of(self, stage: str) -> list[Run]:
        """The runs of a stage, each once; none of `encode` and `teach` where nothing is taught."""
        if stage == "simulate":
            return list(dict.fromkeys(self.simulation(*needed) for needed in self.needed()))
        names = {
            "train": "training", "teach": "taught", "deploy": "deployment", "evaluate": "evaluation",
            "superresolve": "superresolution", "encode": "encoding",
        }  # fmt: skip
        return [] if stage in ("encode", "teach") and not self.is_taught else [getattr(self, names[stage])]

    @property
    def inputs(self) -> list[Run]:
        """The runs from which the chain makes others: trajectories, the manifold, encoded runs, a fit."""
        return [run for stage in ("simulate", "train", "encode", "teach") for run in self.runs_of(stage)]

    evaluated = reuse.evaluated
    complete = reuse.complete
    spare = reuse.spare
    reported = reuse.reported
    kept_report = reuse.kept_report

    @property
    def report_folder(self) -> Path:
        """Where the report goes."""
        return Path(self.config.report.folder) / self.config.report.name

    # -- the work ----------------------------------------------------------------------------------------

    def run(self, stage: str) -> Run | Path | list[Run]:
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
        runs = self.runs_of("simulate")
        there = [run for run in runs if run.complete]
        spare = self.spare(later) if later and len(there) < len(runs) else set()
        needless = [run for run in runs if run not in there and run.id in spare]
        if there:
            self.say(f"simulate: {len(there)} of {len(runs)} trajectories are there, reused")
        if needless:
            self.say(
                f"simulate: {len(needless)} of {len(runs)} trajectories are gone, and nothing needs them"
            )
        warned = dict.fromkeys(line for run in there for line in run.manifest.get("warnings", ()))
        for line in warned:
            self.say(f"simulate: warning: {line}")
        if missing := {run for run in runs if run not in there and run not in needless}:
            with timed(START):
                from nsf.pipeline.stages.simulation import helpers_ahead, simulate_missing

            with helpers_ahead(self, missing) as pool, measured(self, "simulate") as works:
                if simulate_missing(self, missing, warned, pool) < len(missing) or needless:
                    works.clear()
        return runs

    def full_order(self, cases: Sequence[Case]) -> list[Run]:
        """Full-order trajectories of any cases of the deployed scene; those that are there are reused."""
        from nsf.pipeline.stages.simulation import make

        runs = {self.truth(case): (case, self.deployed) for case in cases}
        if missing := {run: needed for run, needed in runs.items() if not run.complete}:
            make(self, missing)
        return list(runs)

    def train(self) -> Run:
        """The manifold of the training trajectories."""
        return self._made(self.training, "training.train")

    def teach(self) -> Run:
        """The part that the configured model learns once, for all its runs.

        Raises:
            ConfigError: it learns nothing.
        """
        if not self.taught.complete:
            self._made(self.encoding, "encoding.encode")
        return self._made(self.taught, "teaching.teach")

    def deploy(self) -> Run:
        """Reduced trajectories of the held-out cases, through Lightning's `Trainer.predict`."""
        if self.is_taught and not self.taught.complete:
            self.teach()
        if not self.deployment.complete:
            for other in self.calibrating:
                other.deploy()
                self._samples, self._sets = other._samples, other._sets
        return self._made(self.deployment, "deployment.deploy_held_out")

    def evaluate(self) -> Run:
        """Errors and costs of the reduced trajectories."""
        return self._made(self.evaluation, "evaluation.evaluate")

    def superresolve(self) -> Run:
        """The reduced trajectories at many more points, beside full-order ones of as many particles."""
        return self._made(self.superresolution, "evaluation.superresolve_held_out")

    def report(self) -> Path:
        """The page of every evaluated variant of this scene, written anew where something has changed.

        Raises:
            MissingRunError: there is none.
        """
        runs = self.reported()
        if not runs:
            raise MissingRunError(
                "no evaluate run of these held-out cases is there; run `nsf run` with the same keys"
            )
        said = f"report: evaluated runs: {len(runs)}"
        if page := self.kept_report():
            self.say(f"{said}, unchanged, reused → {page}")
            return page
        from nsf.results.report import build_report

        with measured(self, "report"):
            page = build_report(runs, self.report_folder, question_of(self), first=self.evaluation)
        self.say(f"{said} → {page}")
        return page

    def _made(self, run: Run, work: str) -> Run:
        """The run, made here unless it is there or another process makes it meanwhile.

        Args:
            run: of a stage.
            work: `module.function` of `nsf.pipeline.stages` that makes it, of the pipeline and the run.
        """
        if not run.complete:
            self.check()
            for parent in run.parent_runs:
                parent.require()
            with run.claimed(self.say):
                if not run.complete:
                    module, _, function = work.partition(".")
                    with timed(START):
                        make = getattr(import_module(f"nsf.pipeline.stages.{module}"), function)
                    with measured(self, run.stage):
                        make(self, run)
                    return run
        self.say(f"{run.stage}: inputs unchanged, reused → {run.id}")
        return run

    # -- reduced solvers ---------------------------------------------------------------------------------

    manifold = solvers.manifold
    solver_at = solvers.solver_at
    batch_at = solvers.batch_at
    recurrence = solvers.recurrence
    fitted = solvers.fitted
