"""The run of each stage of a configuration, named before anything of it is built.

Torch is not imported, so that a mistake, or a chain whose results are all there, takes a second or two.
"""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.code import code_of
from nsf.config.scenes import changed_scene, scene_of
from nsf.data.case import Case
from nsf.engines.modal.mirrors import edits
from nsf.engines.operators.teaching import Teaching, random_cases
from nsf.errors import ConfigError
from nsf.gpu import has_driver
from nsf.models import Auto, Model, Recurrence
from nsf.paths import CONF, groups
from nsf.pipeline.values import check_numbers, check_words, factors
from nsf.results.folder import check_place
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.identity import plain_scene

#: Of the chain, in order; each reads the files of the one before it and nothing else.
STAGES = ("simulate", "train", "teach", "deploy", "evaluate", "report")
#: Keys that hold others, none of which is left out.
_SECTIONS = (
    *("material", "transfer", "field", "trainer", "model", "sampler", "projector", "integration"),
    *("data", "deploy", "evaluation", "super_resolution", "report"),
)
#: Cases between the training ones whose runs decide which round of teaching is kept.
HELD_BACK = 3
#: Fields without `arithmetic`, known without importing them.
_EXACT = ("nsf.kinematics.fields.basis.BasisField",)


class Names:
    """The stages of one configuration, as runs.

    Args:
        config: configuration, as `nsf.config.load` gives it; resolved here.
        root: folder of runs; `NSF_RUNS` or `runs` by default.

    Attributes:
        config: resolved; template: the same before its interpolations were resolved.
        scene: that is trained on; deployed: that of the held-out simulations and of deployment.
        configured: the model that the configuration names, which may be `auto`.
        coarse: factors of Δx of the full-order runs that a reduced one is held to.
        split: cases by their use.
        device: found once, so that a missing GPU is reported before any work.

    Raises:
        ConfigError: a value is missing or refused; names it.
        DeviceError: the device does not exist.
    """

    def __init__(self, config: DictConfig, root: Path | None = None):
        self.root = root
        with configuration.naming_the_missing():
            self._begin(config)

    def _begin(self, config: DictConfig) -> None:
        for key in _SECTIONS:
            configuration.section(config, key)
        check_numbers(config)
        self.template = configuration.checked(with_candidates(config))
        c = self.config = configuration.resolve(self.template)
        self.scene = scene_of(self.template)
        self.split = self.scene.split
        if len(self.split.train) <= len(self.split.names):
            raise ConfigError(
                f"scene.design has {len(self.split.train)} training cases, and {', '.join(self.split.names)} "
                f"need{'s' * (len(self.split.names) == 1)} at least {len(self.split.names) + 1}; add some"
            )
        self.configured: Model = configuration.build(c.model, "model")
        self._chosen: Model | None = None
        self.coarse = factors("evaluation.coarse", c.evaluation.coarse)
        check_words(c)
        self.configured.refuse(self)
        self.deployed = self._changed(c.deploy.changes)
        self.device = _device(c.device)

    def _changed(self, changes: DictConfig | None) -> Scene:
        """The scene of the held-out simulations and of deployment."""
        if not changes:
            return self.scene
        if not isinstance(changes, DictConfig):
            raise ConfigError(f"deploy.changes={changes} must map keys to values, as {{material.nu:0.25}}")
        if wrong := [key for key in changes if not isinstance(key, str)]:
            raise ConfigError(f"deploy.changes has the key {wrong[0]}; give dotted keys, as material.nu")
        try:
            return changed_scene(self.template, self.scene, OmegaConf.to_container(changes))
        except ConfigError as error:
            raise ConfigError(f"deploy.changes: {error}") from error

    @property
    def model(self) -> Model:
        """The model that takes the steps; of `model=auto` the one that its deployment chose.

        Raises:
            MissingRunError: it has not chosen yet.
        """
        if not isinstance(self.configured, Auto):
            return self.configured
        if self._chosen is None:
            self.choose(self.deployment.require().manifest["metrics"]["model"])
        return self._chosen

    def choose(self, name: str) -> None:
        """Take one of the candidates of `model=auto`."""
        self._chosen = self.configured.of[name]

    def alone(self, name: str) -> DictConfig:
        """The configuration of a candidate of `model=auto` by itself, deployed at the validation cases."""
        config = self.template.copy()
        config.model = config.model.of[name]
        config.deploy.split, config.fallback = "validation", "none"
        return config

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of the chain, `teach` only where the model learns by itself."""
        return tuple(name for name in STAGES if name != "teach" or self.is_taught)

    @property
    def is_taught(self) -> bool:
        """Whether the configured model is of a file that the stage `teach` writes."""
        return self.configured.learns

    @property
    def teaching(self) -> Teaching | None:
        """How the recurrence is taught; None for another model."""
        return self.model.teaching if isinstance(self.model, Recurrence) else None

    #: The engine of projected steps: the compiled one where it can, else the reference.
    projecting = "auto"

    @property
    def of_runs(self) -> bool:
        """Whether a recurrence learns from the full-order runs of training, not from projected steps."""
        return isinstance(self.model, Recurrence) and self.model.of_runs

    @property
    def held_out(self) -> tuple[Case, ...]:
        """Cases that are deployed and evaluated."""
        self.check_held_out()
        return getattr(self.split, self.config.deploy.split)

    def check_held_out(self) -> None:
        """Refuse to deploy in no case.

        Raises:
            ConfigError: the split that is deployed is empty.
        """
        split = self.config.deploy.split
        if not getattr(self.split, split):
            raise ConfigError(f"deploy.split={split} has no cases; set scene.design.{split}")

    @property
    def report_folder(self) -> Path:
        """Where the report goes."""
        return Path(self.config.report.folder) / self.config.report.name

    def check_report_folder(self) -> None:
        """Refuse a place where no report could be written.

        Raises:
            ConfigError: something else stands there.
            StorageError: the folder above it cannot be written.
        """
        check_place(self.report_folder)

    def needed(self) -> list[tuple[Case, Scene]]:
        """Every case with the scene that is simulated in it: the deployed one where cases are held out."""
        held_out = getattr(self.split, self.config.deploy.split)
        plain = {*self.split.cases}.difference(() if self.config.deploy.split == "train" else held_out)
        needed = [(case, self.scene) for case in plain] + [(case, self.deployed) for case in held_out]
        return sorted(needed, key=lambda pair: pair[0])

    @property
    def inputs(self) -> list[Run]:
        """The runs from which the chain makes others: trajectories, the manifold, and the taught model."""
        simulations = [self.simulation(case, scene) for case, scene in self.needed()]
        return [*simulations, self.training, *([self.taught] if self.is_taught else [])]

    def simulation(self, case: Case, scene: Scene | None = None) -> Run:
        """The run of one full-order trajectory, of the scene of training by default."""
        c = self.config
        content = self._physics(scene or self.scene, case)
        content |= {"precision": c.precision, "dtype": c.data.dtype}
        for name, value in case.items():
            content["parameters"][name]["value"] = value
        return Run.open("simulate", self.scene.name, content, root=self.root)

    def truth(self, case: Case) -> Run:
        """The run of the full-order trajectory that a deployed one is held to."""
        return self.simulation(case, self.deployed)

    @property
    def training_data(self) -> list[Run]:
        """The runs of the trajectories that are trained on."""
        return [self.simulation(case) for case in self.split.train]

    @property
    def training(self) -> Run:
        """The run of the manifold."""
        content = self._content(("field", "trainer", "latent_dim", "seed"))
        content["field"].pop("arithmetic", None)  # of deployment
        return Run.open("train", self.scene.name, content, self.training_data, root=self.root)

    @property
    def deployment(self) -> Run:
        """The run of the reduced trajectories."""
        keys = ("model", "stress", "affine", "fallback", "sampler", "projector", "integration", "precision")
        content = (
            self._content(keys)
            | self._physics(self.deployed, self.held_out[0])
            | {
                "cases": list(map(dict, self.held_out)),
                "split": self.config.deploy.split,
                "dt_multiplier": self.config.deploy.dt_multiplier,
                "device": self.device,
            }
        )
        if self._of_networks:
            content["arithmetic"] = self.field.arithmetic
        if changed := edits():  # an edited step is another run, whose result is not there yet
            content["edited"] = changed
        parents = [self.training, self.taught] if self.is_taught else [self.training]
        return Run.open("deploy", self.scene.name, content, parents, root=self.root)

    @cached_property
    def field(self):
        """What is trained; to build it, torch is imported."""
        return configuration.build(self.config.field, "field")

    @cached_property
    def _of_networks(self) -> bool:
        """Whether the field is the paper's networks."""
        if self.config.field.get("_target_") in _EXACT:
            return False
        from nsf.kinematics.fields.mlp import MlpField

        return isinstance(self.field, MlpField)

    @property
    def taught(self) -> Run:
        """The run of what the model learns.

        Raises:
            ConfigError: the model learns nothing.
        """
        if not self.model.learns:
            raise ConfigError(f"model={self.model.name} is not taught; set model=recurrence")
        keys = ("stress", "affine", "sampler", "projector", "integration", "precision", "seed")
        content = (
            self._content(keys)
            | self._physics(self.scene, self.split.train[0])
            | {"cases": [list(map(dict, cases)) for cases in self.lessons], "device": self.device}
            | {"model": self.model.lesson, "dt_multiplier": self.config.deploy.dt_multiplier}
        )
        if changed := edits():
            content["edited"] = changed
        return Run.open("teach", self.scene.name, content, [self.training], root=self.root)

    @property
    def lessons(self) -> list[list[Case]]:
        """Cases of three kinds that the teacher is asked in: of training, between them, and held back.

        Runs in those held back decide which round of teaching is kept. None is a validation or test case.
        Where runs are the teacher there is one round; how far its runs at validation values are off, or, if
        there are none, at training, is what `model.error_ratio` is held to. Between are as many as asked.
        """
        known, seed = sorted(self.split.train), int(self.config.seed)
        taken = [*known, *self.split.validation, *self.split.test]
        if self.teaching is None:
            return [known]
        if self.of_runs:
            drawn = self.teaching.runs
            between = random_cases(self.split.box, drawn, seed, taken) if drawn else []
            return [known, between, sorted(self.split.validation) or known]
        between = random_cases(self.split.box, len(known), seed, taken)
        back = random_cases(self.split.box, HELD_BACK, seed + 1, [*taken, *between])
        return [known, between, back]

    @property
    def evaluation(self) -> Run:
        """The run of errors and costs."""
        content = self._content(("evaluation",)) | {"columns": "one table"}  # before, a table had others
        content["paper"] = self._content(("scene",))["scene"].get("paper")
        parents = [self.deployment, *map(self.truth, self.held_out)]
        return Run.open("evaluate", self.scene.name, content, parents, root=self.root)

    @property
    def superresolution(self) -> Run:
        """The run of the deployed fields at more points."""
        content = self._content(("super_resolution",))
        parents = [self.deployment, *map(self.truth, self.held_out)]
        return Run.open("superresolve", self.scene.name, content, parents, root=self.root)

    def evaluated(self) -> Run:
        """The complete run of errors and costs, of this device or another: it may have been brought here.

        Raises:
            MissingRunError: there is none; says how far it came.
        """
        return self._found("evaluation")

    def superresolved(self) -> Run:
        """The complete run of the deployed fields at more points, likewise.

        Raises:
            MissingRunError: there is none.
        """
        return self._found("superresolution")

    def _found(self, name: str) -> Run:
        for device in (self.device, "cuda:0", "cpu"):
            there = copy(self)
            there.device = device
            if getattr(there, name).complete:
                return getattr(there, name)
        return getattr(self, name).require()

    def spare(self, later: Sequence[str]) -> set[str]:
        """Trajectories, by id, that later stages need not read, as their results are there."""
        truths = {self.truth(case).id for case in self.held_out}
        read = {"evaluate": self.evaluation, "superresolve": self.superresolution}
        over = "evaluate" in later and all(run.complete for name, run in read.items() if name in later)
        trained = {run.id for run in self.training_data}
        needed = (set() if over else truths) | (set() if self.training.complete else trained)
        return (truths | trained) - needed

    def reported(self) -> list[Run]:
        """Every evaluated variant of this scene at these held-out trajectories."""
        truths = {self.truth(case).id for case in self.held_out}
        found = Run.find("evaluate", self.scene.name, root=self.root)
        return [
            run
            for run in found
            if run.complete and truths == {p for p in run.parents if p.startswith("simulate/")}
        ]

    def _physics(self, scene: Scene, case: Case) -> dict:
        """A scene's physics in one of its cases: what it would be without a case changes nothing."""
        content = plain_scene(scene.at(case))
        content |= {"law": code_of({key: content[key] for key in ("material", "transfer")})}
        content |= {"scale": str(self.config.scale), "files": scene.files}
        return content | {"parameters": {name: {"key": scene.varied[name].key} for name in case}}

    def _content(self, keys: Sequence[str]) -> dict:
        content = {key: _container(self.config[key]) for key in keys}
        code = code_of(content)
        return content | {"code": code} if code else content


def with_candidates(config: DictConfig) -> DictConfig:
    """A configuration with the candidates of `model=auto`, as their files have them; others as they are."""
    model = config.model
    if model.get("name") != "auto":
        return config
    config = config.copy()
    names = model.get("candidates") or [name for name in groups()["model"] if name not in ("auto", "full")]
    files = {name: OmegaConf.load(CONF / "model" / f"{name}.yaml") for name in names}
    config.model.candidates = list(names)
    config.model.of = OmegaConf.merge(files, model.get("of") or {})
    return config


def _container(value):
    return OmegaConf.to_container(value) if OmegaConf.is_config(value) else value


def _device(asked) -> str:
    """The name of the device that is asked for."""
    if str(asked) in ("auto", "cpu") and not has_driver():
        return "cpu"
    from nsf.mpm.device import warp_device

    device = warp_device(asked)
    return str(device) if device.is_cuda else "cpu"
