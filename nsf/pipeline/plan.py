"""What a configuration asks for: everything that its stages need, checked, and the run of each stage."""

import os
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.data import Case
from nsf.dynamics.interop import torch_device
from nsf.engines import Operators
from nsf.engines.modal.mirrors import edits
from nsf.engines.operators import random_cases
from nsf.errors import ConfigError, DeviceError
from nsf.kinematics.fields.mlp import MlpField
from nsf.mpm import Precision
from nsf.mpm.device import visible_gpus, warp_device
from nsf.mpm.recording import frame_bytes
from nsf.mpm.stability import check_colliders, check_time_step
from nsf.pipeline.values import (
    STORED,
    TEACHERS,
    check_batch,
    check_numbers,
    check_words,
    factors,
    one_of,
)
from nsf.runs import Run
from nsf.sampling.sampler import check_well_posed
from nsf.scenes import Scene
from nsf.scenes.checks import check_memory, check_physics
from nsf.scenes.identity import NOT_PHYSICS
from nsf.storage import require_folder, require_space

#: Keys of the configuration that a simulation's content depends on.
_SCENE_KEYS = ("scale", "material", "transfer")
#: Keys that hold others, none of which is left out.
_SECTIONS = ("data", "deploy", "evaluation", "super_resolution", "report")
#: Keys that no scene is built from, without their values.
_REST = dict.fromkeys(("field", "trainer", "method", "sampler", "evaluation", "report", "latent_dim"))
#: Cases between the training ones whose runs decide which round of teaching is kept.
HELD_BACK = 3
#: What this process has checked; the jobs of a sweep ask the same thing again and again, for seconds.
_PASSED: set[str] = set()


@dataclass
class Plan:
    """The stages of one configuration, before any work.

    Args:
        config: configuration, as `nsf.config.load` gives it; resolved here.
        root: folder of runs; `NSF_RUNS` or `runs` by default.

    Attributes:
        scene: that is trained on; deployed: that of the held-out simulations and of deployment.
        engine: name of the engine that is asked for.
        coarse: factors of Δx of the full-order runs that a reduced one is held to.
        split: cases by their use.
        device: found once, so that a missing GPU is reported before any work.

    Raises:
        ConfigError: a value is missing or refused; names it.
        InstabilityError: Δt is unstable in a case.
    """

    config: DictConfig
    root: Path | None = None

    def __post_init__(self):
        with configuration.naming_the_missing():
            self._build()

    def _build(self) -> None:
        """Build and check everything, so that a bad value is refused before any work."""
        self.scene = Scene.from_config(self.config)
        c = self.config = self.scene.config
        for key in _SECTIONS:
            configuration.section(c, key)
        self.split = self.scene.split
        if len(self.split.train) <= len(self.split.names):
            raise ConfigError(
                f"scene.design has {len(self.split.train)} training cases, and {', '.join(self.split.names)} "
                f"need{'s' * (len(self.split.names) == 1)} at least {len(self.split.names) + 1}; add some"
            )
        for name in ("field", "trainer", "method", "sampler", "projector", "integration"):
            setattr(self, name, configuration.build(c[name], name))
        # A configuration from before there were engines has no such key.
        self.engine = OmegaConf.select(c, "engine.name", default="auto")
        self.teaching = None
        if self.engine == Operators.name:
            self.teaching = configuration.build(c.engine.teaching, "engine.teaching")
            one_of("engine.teacher", c.engine.teacher, TEACHERS)
        check_numbers(c)
        self.coarse = factors("evaluation.coarse", OmegaConf.select(c, "evaluation.coarse", default=[]))
        check_words(c, self.engine)
        if self.trainer.devices > 1 and not self.field.shardable:
            raise ConfigError(
                f"trainer.devices={self.trainer.devices} is for field=mlp; this field takes all snapshots in "
                "every step, in seconds: set trainer.devices=1"
            )
        check_batch(c, self.engine, self.field, self.integration.strategy)
        self.deployed = self._changed(c.deploy.changes)
        X = self.scene.particles().X
        for region in self.sampler.regions:
            check_well_posed(region.size, c.latent_dim)
            region.candidates(X)
        self.device = str(torch_device(warp_device(c.device)))
        self._check_cases()

    def _changed(self, changes: DictConfig | None) -> Scene:
        """The scene of the held-out simulations and of deployment."""
        if not changes:
            return self.scene
        if not isinstance(changes, DictConfig):
            raise ConfigError(f"deploy.changes={changes} must map keys to values, as {{material.nu:0.25}}")
        if wrong := [key for key in changes if not isinstance(key, str)]:
            raise ConfigError(f"deploy.changes has the key {wrong[0]}; give dotted keys, as material.nu")
        try:
            return self.scene.with_changes(OmegaConf.to_container(changes))
        except ConfigError as error:
            raise ConfigError(f"deploy.changes: {error}") from error

    def _check_cases(self) -> None:
        """Build the scene in every case: a value out of range fails before any work."""
        asked = repr(
            [OmegaConf.to_container(of, resolve=False) | _REST for of in (self.config, self.scene.template)]
        )
        if asked in _PASSED:
            return
        for case, scene in self.needed():
            scene = scene.with_parameters(case)
            grid = scene.grid
            check_physics(scene)
            check_time_step(scene.particles(), scene.initial_velocity(), grid.dx, scene.dt)
            for multiplier in (1.0, self.config.deploy.dt_multiplier):
                check_colliders(scene.colliders, grid, multiplier * scene.dt)
        _PASSED.add(asked)

    @property
    def projecting(self) -> str:
        """The engine of steps that are projected: that which is asked for, or which operators learn from."""
        return self.engine if self.teaching is None else self.config.engine.teacher

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

    def check_devices(self) -> None:
        """Refuse to train on more devices than this machine has; what was trained elsewhere may be used.

        Raises:
            DeviceError: says how many there are.
        """
        asked, on_gpu = self.trainer.devices, self.device.startswith("cuda")
        if asked == 1 or self.training.complete:
            return
        if self.device not in ("cpu", "cuda:0"):
            raise DeviceError(
                f"trainer.devices={asked} takes the first GPUs and not device={self.config.device}; "
                "set device=auto"
            )
        there = len(visible_gpus()) if on_gpu else os.cpu_count() or 1
        if asked > there:
            most = max(n for n in range(1, there + 1) if self.trainer.frames_per_batch % n == 0)
            raise DeviceError(
                f"trainer.devices={asked} is more than this process has: {there} "
                f"{'GPU' if on_gpu else 'processor core'}{'' if there == 1 else 's'}; "
                f"set trainer.devices={most}"
            )

    def check_room(self, runs: Mapping[Run, tuple[Case, Scene]]) -> None:
        """Refuse trajectories that fit neither into memory nor, all together, on the disk.

        Args:
            runs: that are to be made, at least one, each with its case and scene.

        Raises:
            ConfigError: names the bytes of memory that are needed and available.
            StorageError: names the bytes of the disk.
        """
        for _, scene in runs.values():
            check_memory(scene, self.config.precision, self.device, self.stored)
        folder = next(iter(runs)).path.parent
        require_folder(folder)
        frames = sum((s.steps + 1) * frame_bytes(s.particle_count, self.stored) for _, s in runs.values())
        require_space(folder / f"{len(runs)} trajectories", frames)

    @property
    def stored(self) -> Precision:
        """Precision of the frames of trajectories."""
        return STORED[self.config.data.dtype]

    def needed(self) -> list[tuple[Case, Scene]]:
        """Every case with the scene that is simulated in it: the deployed one where cases are held out."""
        held_out = getattr(self.split, self.config.deploy.split)
        plain = {*self.split.cases}.difference(() if self.config.deploy.split == "train" else held_out)
        needed = [(case, self.scene) for case in plain] + [(case, self.deployed) for case in held_out]
        return sorted(needed, key=lambda pair: pair[0])

    def simulation(self, case: Case, scene: Scene | None = None) -> Run:
        """The run of one full-order trajectory, of the scene of training by default."""
        c = self.config
        scene = scene or self.scene
        content = self._physics(scene)
        content |= {"precision": c.precision, "dtype": c.data.dtype}
        content["parameters"] = {
            name: {"key": self.scene.varied[name].key, "value": value} for name, value in case.items()
        }
        if scene.files:
            # A changed mesh under the same path is another simulation.
            content["files"] = scene.files
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
        if self.trainer.devices == 1:
            # The bits, and so the name, of a training from before there was the key.
            content["trainer"].pop("devices", None)
        content["field"].pop("arithmetic", None)  # of deployment
        return Run.open("train", self.scene.name, content, self.training_data, root=self.root)

    @property
    def deployment(self) -> Run:
        """The run of the reduced trajectories."""
        keys = ("method", "sampler", "projector", "integration", "precision")
        content = (
            self._content(keys)
            | self._physics(self.deployed)
            | {
                "cases": list(map(dict, self.held_out)),
                "split": self.config.deploy.split,
                "dt_multiplier": self.config.deploy.dt_multiplier,
                "on_distrust": self.config.deploy.on_distrust,
                "device": self.device,
            }
        )
        if isinstance(self.field, MlpField):
            content["arithmetic"] = self.field.arithmetic
        if self.engine != "auto":
            content["engine"] = self.engine
        if self.teaching is not None:
            content |= {"check": self.config.engine.check, "tolerance": self.config.deploy.tolerance}
        if changed := edits():  # an edited step is another run, whose result is not there yet
            content["edited"] = changed
        parents = [self.training] if self.teaching is None else [self.training, self.taught]
        return Run.open("deploy", self.scene.name, content, parents, root=self.root)

    @property
    def taught(self) -> Run:
        """The run of the operators.

        Raises:
            ConfigError: the engine that is asked for learns nothing.
        """
        if self.teaching is None:
            raise ConfigError(f"engine={self.engine} is not taught; set engine=operators")
        content = (
            self._content(("method", "sampler", "projector", "integration", "precision", "seed"))
            | self._physics(self.scene)
            | {
                "teaching": asdict(self.teaching),
                "teacher": self.config.engine.teacher,
                "cases": [list(map(dict, cases)) for cases in self.lessons],
                "validation": list(map(dict, self.split.validation)),
                "dt_multiplier": self.config.deploy.dt_multiplier,
                "device": self.device,
            }
        )
        if changed := edits():
            content["edited"] = changed
        return Run.open("teach", self.scene.name, content, [self.training], root=self.root)

    @property
    def lessons(self) -> list[list[Case]]:
        """Cases of three kinds that the teacher is asked in: of training, between them, and held back.

        Runs in those held back decide which round of teaching is kept, where there are no validation cases.
        None is a validation or test case.
        """
        known, seed = sorted(self.split.train), int(self.config.seed)
        taken = [*known, *self.split.validation, *self.split.test]
        between = random_cases(self.split.box, len(known), seed, taken)
        back = random_cases(self.split.box, HELD_BACK, seed + 1, [*taken, *between])
        return [known, between, back]

    @property
    def evaluation(self) -> Run:
        """The run of errors and costs."""
        content = self._content(("evaluation",))
        content["paper"] = self._content(("scene",))["scene"].get("paper")
        parents = [self.deployment, *map(self.truth, self.held_out)]
        return Run.open("evaluate", self.scene.name, content, parents, root=self.root)

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

    @property
    def superresolution(self) -> Run:
        """The run of the deployed fields at more points."""
        content = self._content(("super_resolution",))
        parents = [self.deployment, *map(self.truth, self.held_out)]
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
