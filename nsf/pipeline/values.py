"""Values of a configuration that nothing is built from before the stage that needs them, checked first."""

from pathlib import Path

from omegaconf import DictConfig, ListConfig, OmegaConf

from nsf import config as configuration
from nsf.errors import ConfigError
from nsf.models.base import FALLBACKS
from nsf.pipeline.tracking import TRACKING, check_tracking
from nsf.scalars import one_of

#: Keys that hold others, none of which is left out.
_SECTIONS = (
    *("material", "transfer", "field", "trainer", "model", "sampler", "projector", "integration"),
    *("data", "deploy", "trust", "evaluation", "super_resolution", "report"),
)
#: Types of stored frames.
STORED = ("float32", "float64")
PRECISIONS = ("fp32", "fp64")
#: Least deployment step in units of the scene's: a thousand reduced steps for one are no reduction.
_LEAST_STEP = 1e-3
#: Least share of the displacement that may be asked for [%].
_LEAST_LIMIT = 1e-3


def check_values(c: DictConfig) -> None:
    """Refuse a configuration without a section, or with a value that is none of those that it may be.

    Raises:
        ConfigError: names the key.
    """
    for key in _SECTIONS:
        configuration.section(c, key)
    for key, least in (("latent_dim", 1), ("seed", 0)):
        configuration.number(key, c[key], least=least, whole=True)
    for key, least in (("trials", 0), ("picture_particles", 1), ("picture_frames", 1)):
        configuration.number(f"evaluation.{key}", c.evaluation[key], least=least, whole=True)
    for key, least in (("factor", 2), ("substeps", 1), ("frames", 1)):
        configuration.number(f"super_resolution.{key}", c.super_resolution[key], least=least, whole=True)
    configuration.number("deploy.dt_multiplier", c.deploy.dt_multiplier, least=_LEAST_STEP)
    configuration.number("trust.limit", c.trust.limit, least=_LEAST_LIMIT)
    configuration.number("deploy.batch", c.deploy.batch, least=1, whole=True)
    configuration.number("data.every", c.data.every, least=1, whole=True)
    one_of("deploy.split", c.deploy.split, ("test", "validation", "train"))
    one_of("fallback", c.fallback, FALLBACKS)
    if c.tracking is not None:  # as in configurations of earlier runs
        one_of("tracking", c.tracking, TRACKING)
    check_tracking(c.tracking)
    one_of("data.resident", c.data.resident, (True, False, "auto"))
    one_of("data.keep", c.data.keep, ("all", "held_out"))
    one_of("data.dtype", c.data.dtype, STORED)
    configuration.text("report.folder", c.report.folder)
    name = c.report.name if isinstance(c.report.name, str | int) else ""
    if str(name) in ("", "..") or Path(str(name)).name != str(name):
        raise ConfigError(f"report.name={c.report.name} must be one folder's name; set report.folder")
    one_of("precision", c.precision, PRECISIONS)
    _check_paper(c.scene.get("paper"))


def factors(key: str, value) -> list[int]:
    """Different whole numbers of at least 2.

    Raises:
        ConfigError: the key's value is no list of them.
    """
    if not isinstance(value, list | ListConfig):
        raise ConfigError(f"{key}={value} must be a list of factors, as [2] or []")
    numbers = [int(configuration.number(key, factor, least=2, whole=True)) for factor in value]
    if len(set(numbers)) < len(numbers):
        raise ConfigError(f"{key}={value} names a factor twice; give each once")
    return numbers


def check_every(every: int, steps: int) -> None:
    """Refuse stored frames between which the end of a run lies.

    Raises:
        ConfigError: the steps from a frame to the next do not divide those of a run; says what does.
    """
    if steps % every:
        near = max(k for k in range(1, every) if steps % k == 0)
        raise ConfigError(
            f"data.every={every} does not divide the {steps} steps of a run; set data.every={near}"
        )


def _check_paper(stated) -> None:
    """The paper's place and figures of a scene, by method."""
    if stated is None:
        return
    stated = OmegaConf.to_container(stated) if isinstance(stated, DictConfig) else {"": stated}
    place = stated.pop("place", "")
    figures = all(isinstance(of, dict) for of in stated.values())
    if not figures or not isinstance(place, str):
        raise ConfigError(
            "scene.paper must have place, a text, and figures by method, as {nsf: {delta: 0.01}}"
        )
    for method, of in stated.items():
        for name, value in of.items():
            configuration.number(f"scene.paper.{method}.{name}", value)
