"""The run of a stage that a command makes, found by the same keys."""

from pathlib import Path
from typing import Any

from nsf import config
from nsf.errors import ConfigError, MissingRunError
from nsf.pipeline.chain import Pipeline
from nsf.runs import Run
from nsf.runs.listing import flat

_MOST = 4  # runs, and settings of each, that a message names
_STAGES = ("train", "teach", "deploy", "evaluate", "superresolve")


def find(*words: str, stage: str = "train", root: str | Path | None = None, **keys: Any) -> Run:
    """The complete run of a stage that `nsf run` makes with exactly these keys, all others at their defaults.

    Args:
        words: keys with a dot, in Hydra's grammar, as `"sampler.size=50"`.
        stage: `train`, `teach`, `deploy`, `evaluate` or `superresolve`.
        root: folder of all runs; NSF_RUNS, else ./runs.
        **keys: keys of the configuration, as `scene="sand", latent_dim=6`.

    Raises:
        ConfigError: a key or value is refused, or the stage is none of those.
        MissingRunError: there is no such run, or it is not complete; says how far it came, and names those
            that are complete with the settings that differ.
    """
    if stage not in _STAGES:
        raise ConfigError(f"stage={stage} is none of {', '.join(_STAGES)}")
    overrides = [*words, *(f"{key}={config.grammar(value)}" for key, value in keys.items())]
    if not any(map(config.names_scene, overrides)):
        raise ConfigError('name a scene, as scene="sand"')
    pipeline = Pipeline(config.load(overrides), root=None if root is None else Path(root))
    if stage in ("evaluate", "superresolve"):
        return pipeline.evaluated(stage)
    run = (pipeline.runs_of(stage) or [pipeline.taught])[0]
    try:
        return run.require()
    except MissingRunError as error:
        others = [other for other in Run.find(stage, run.scene, run.root) if other.complete][:_MOST]
        listed = "; ".join(f"{other.hash} ({_differing(run, other)})" for other in others)
        raise MissingRunError(f"{error}; complete are {listed}" if others else str(error)) from error


def _differing(run: Run, other: Run) -> str:
    """The settings of another run that one does not have, in short."""
    settings = flat(run.config)
    pairs = [f"{key}={value}" for key, value in flat(other.config).items() if settings.get(key) != value]
    shown = ", ".join(pairs[:_MOST]) + (", …" if len(pairs) > _MOST else "")
    return shown or "made from other runs"
