"""The values of one configuration: scene, cases, model, and what the stages need."""

from functools import cached_property
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.config.scenes import changed_scene, scene_of
from nsf.data.case import Case
from nsf.errors import ConfigError
from nsf.gpu import has_driver
from nsf.models import Model
from nsf.mpm import FP32, FP64, Precision
from nsf.paths import groups, option
from nsf.pipeline.values import check_every, check_values, factors
from nsf.scenes import Scene

if TYPE_CHECKING:
    from nsf.dynamics import Sources

#: Precision of stored frames by the name of their type.
_STORED = {"float32": FP32, "float64": FP64}


def _part(key: str) -> cached_property:
    """The object that a section of the configuration names, built at its first use."""
    return cached_property(lambda pipeline: configuration.build(pipeline.config[key], key))


class Configured:
    """A configuration as values: its scene, cases, model, device, and the parts that the stages need.

    Args:
        config: as `nsf.config.load` gives it; resolved here.

    Attributes:
        config: resolved; template: the same before its interpolations were resolved.
        scene: that is trained on; deployed: that of the held-out simulations and of deployment.
        configured: the model that the configuration names, which may be `auto`.
        coarse: factors of Δx of the full-order runs that a reduced one is held to.
        split: cases by their use.
        device: chosen once, so that a missing GPU is reported before any work.
        field, trainer, sampler, projector, integration: as the configuration names them, built at first use.

    Raises:
        ConfigError: a value is missing or refused; names it.
        DeviceError: the device does not exist.
    """

    def __init__(self, config: DictConfig):
        with configuration.naming_the_missing():
            self._begin(config)

    def _begin(self, config: DictConfig) -> None:
        self.template = configuration.checked(with_candidates(config))
        c = self.config = configuration.resolve(self.template)
        check_values(c)
        self.scene = scene_of(self.template, c)
        self.split = self.scene.split
        names, count = self.split.names, len(self.split.train)
        if count <= len(names):
            raise ConfigError(
                f"scene.design has {count} training cases, and {', '.join(names)} "
                f"need{'s' * (len(names) == 1)} at least {len(names) + 1}; add some"
            )
        self.configured: Model = configuration.build(c.model, "model")
        self.coarse = factors("evaluation.coarse", c.evaluation.coarse)
        self.configured.refuse(self)
        self.deployed = self._deployed(c.deploy.changes)
        for scene in (self.scene, self.deployed):
            check_every(c.data.every, scene.steps)
        self.device = _device(c.device)

    def _deployed(self, changes: DictConfig | None) -> Scene:
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

    field = _part("field")
    trainer = _part("trainer")
    sampler = _part("sampler")
    projector = _part("projector")
    integration = _part("integration")

    @cached_property
    def sources(self) -> "Sources":
        """Where a projected step takes τ and C from."""
        from nsf.dynamics import Sources

        return Sources(self.config.stress, self.config.affine)

    @property
    def stored(self) -> Precision:
        """Precision of the frames of trajectories."""
        return _STORED[self.config.data.dtype]

    @property
    def stored_frames(self) -> int:
        """Of a trajectory."""
        return self.scene.steps // self.config.data.every + 1

    @property
    def is_taught(self) -> bool:
        """Whether the stage `teach` makes a file of the configured model."""
        return self.configured.learns

    @property
    def forced(self) -> bool:
        """Whether programs force the scene."""
        return bool(self.scene.forcing)

    @property
    def held_out(self) -> tuple[Case, ...]:
        """Cases that are deployed and evaluated.

        Raises:
            ConfigError: the split that is deployed is empty.
        """
        split = self.config.deploy.split
        if not (cases := getattr(self.split, split)):
            raise ConfigError(f"deploy.split={split} has no cases; set scene.design.{split}")
        return cases

    def needed(self) -> list[tuple[Case, Scene]]:
        """Every case with the scene that is simulated in it: the deployed one where cases are held out."""
        split = self.config.deploy.split
        held_out = getattr(self.split, split)
        plain = {*self.split.cases}.difference(() if split == "train" else held_out)
        needed = [(case, self.scene) for case in plain] + [(case, self.deployed) for case in held_out]
        return sorted(needed, key=lambda pair: pair[0])


def with_candidates(config: DictConfig) -> DictConfig:
    """A configuration with the candidates of `model=auto`, as their files have them; others as they are."""
    model = configuration.section(config, "model")
    if model.get("name") != "auto":
        return config
    config = config.copy()
    names = model.get("candidates") or [name for name in groups()["model"] if name not in ("auto", "full")]
    files = {name: OmegaConf.load(option("model", name)) for name in names}
    config.model.candidates = list(names)
    config.model.of = OmegaConf.merge(files, model.get("of") or {})
    return config


def _device(name) -> str:
    """The name of the device that is asked for."""
    if str(name) in ("auto", "cpu") and not has_driver():
        return "cpu"
    from nsf.mpm.device import warp_device

    device = warp_device(name)
    return str(device) if device.is_cuda else "cpu"
