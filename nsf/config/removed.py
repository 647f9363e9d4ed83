"""Keys and options that an earlier version had, which are refused by naming their replacement."""

from collections.abc import Iterable, Mapping
from typing import Any

from nsf.errors import ConfigError

#: A dotted key, or `key=option`, and the remedy.
REMOVED = {
    "scene.reduced.latent_dim": "set latent_dim",
    "reduction.teacher": "leave it out: a recurrence learns from full-order runs",
    "reduction.unroll": "leave it out: windows grow to half a run",
    "reduction.descent": "set model.descents",
    "reduction.memory": "set model.stress: a state of stress holds what a run went through",
    "reduction.symmetry": "set model.runs: drawn runs take the place of mirror images",
    "scene.reduced": "set reduction, whose keys are those of scene.reduced, at the top",
    "field=joint": "use field=basis",
    "sampler=greedy": "use sampler=qdeim or sampler=cubature",
    "trainer.budget_minutes": "set trainer.steps; a training's log says how many it takes a second",
    "deploy.tolerance": "set fallback=projected, which goes on where a run is not believed",
    "trainer.devices": "a manifold trains on one device; hydra/launcher=joblib spreads jobs over GPUs",
    "deploy.on_distrust": "set fallback=none, projected or full",
    "deploy.error_ratio": "leave it out; fallback=projected takes runs that are not believed",
    "engine=operators": "choose model=recurrence",
    "engine=closed": "choose model=projected, or model=recurrence",
    "method=nsf": "leave it out: stress=field affine=field are the paper's, and the default",
    "method=deformation_only": "set stress=deformation affine=none, the baseline",
    "method=neural_stress_only": "set affine=none",
    "method=neural_affine_only": "set stress=deformation",
    "method=history": "set stress=particles affine=particles",
    "engine": "choose model=projected, or recurrence in place of engine=operators",
    "engine.teacher": "leave it out: a recurrence learns from full-order runs, whose number is model.runs",
    "engine.check": "set model.members, whose spread is the estimated error",
    "engine.teaching": "set model.runs and model.descents, of model=recurrence",
    "model.teacher": "leave it out: a recurrence learns from full-order runs, whose number is model.runs",
    "model.check": "set model.members, whose spread is the estimated error",
    "model.error_ratio": "leave it out; fallback=projected takes runs that are not believed",
    "model.teaching.runs": "set model.runs",
    "model.teaching.width": "set model.width",
    "model.teaching.descent": "set model.descents",
    "model.teaching.memory": "set model.stress: a state of stress holds what a run went through",
    "model.teaching": "set model.runs, model.stress and model.descents, of model=recurrence",
    "method": "set stress=field, deformation or particles, and affine=field, none or particles",
}


def refuse_overrides(overrides: Iterable[str]) -> None:
    """Refuse an override of a removed key, or that chooses a removed option.

    Raises:
        ConfigError: names the replacement.
    """
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        parts = key.split(".")
        for candidate in (f"{key}={value}", *(".".join(parts[:n]) for n in range(len(parts), 0, -1))):
            _refuse(candidate)


def refuse_keys(plain: Mapping[str, Any]) -> None:
    """Refuse a configuration that has a removed key.

    Args:
        plain: containers, as of a file.

    Raises:
        ConfigError: names the replacement.
    """
    for key in REMOVED:
        node: Any = plain
        *parents, last = key.split(".")
        for parent in parents:
            node = node.get(parent) if isinstance(node, Mapping) else None
        if isinstance(node, Mapping) and last in node:
            _refuse(key)


def _refuse(name: str) -> None:
    if name in REMOVED:
        raise ConfigError(f"{name} was removed; {REMOVED[name]}")
