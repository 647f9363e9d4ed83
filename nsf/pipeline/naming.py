"""The run of each stage of a pipeline: named by the values that determine it, and by nothing else.

A scene enters as it is in its cases, so the value that a problem parameter has without a case names no run,
and neither do titles, keys that nothing reads, or the path of a file.
"""

from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf

from nsf.code import code_of
from nsf.data.case import Case
from nsf.engines.modal.mirrors import edits
from nsf.errors import ConfigError
from nsf.models import Model
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.identity import plain_scene

#: Fields without `arithmetic`, known without importing them.
_EXACT = ("nsf.kinematics.fields.basis.BasisField",)


def simulation(pipeline, case: Case, scene: Scene) -> Run:
    """The run of one full-order trajectory."""
    c = pipeline.config
    content = _physics(c.scale, scene, case) | {"precision": c.precision, "dtype": c.data.dtype}
    for name, value in case.items():
        content["parameters"][name]["value"] = value
    if c.data.every > 1:
        content["every"] = c.data.every
    return _run(pipeline, "simulate", content)


def training(pipeline) -> Run:
    """The run of the manifold."""
    content = _content(pipeline, "field", "trainer", "latent_dim", "seed")
    content["field"].pop("arithmetic", None)  # of deployment
    return _run(pipeline, "train", content, pipeline.training_data)


def deployment(pipeline) -> Run:
    """The run of the reduced trajectories."""
    deploy, cases = pipeline.config.deploy, pipeline.held_out
    keys = (
        "model",
        "stress",
        "affine",
        "fallback",
        "trust",
        "sampler",
        "projector",
        "integration",
        "precision",
    )
    content = _content(pipeline, *keys) | _physics(pipeline.config.scale, pipeline.deployed, cases[0])
    content |= {"cases": list(map(dict, cases)), "split": deploy.split, "device": pipeline.device}
    content |= {"dt_multiplier": deploy.dt_multiplier}
    if _of_networks(pipeline):
        content["arithmetic"] = pipeline.field.arithmetic
    parents = [pipeline.training, pipeline.taught] if pipeline.is_taught else [pipeline.training]
    parents += [other.deployment for other in pipeline.calibrating]
    return _run(pipeline, "deploy", content | _edited(), parents)


def encoding(pipeline) -> Run:
    """The run of full-order runs in latent coordinates, from which the model learns.

    Raises:
        ConfigError: the model learns nothing.
    """
    model, c = _learning(pipeline), pipeline.config
    training, drawn, _ = pipeline.lessons
    content = _content(pipeline, "precision") | _physics(c.scale, pipeline.scene, training[0])
    content |= {"cases": [list(map(dict, cases)) for cases in (training, drawn)], "device": pipeline.device}
    if not pipeline.scene.forcing.gravity:
        content |= {"gravity": model.gravity, "seed": c.seed}
    return _run(pipeline, "encode", content | _edited(), [pipeline.training])


def taught(pipeline) -> Run:
    """The run of what the model learns.

    Raises:
        ConfigError: the model learns nothing.
    """
    model, case = _learning(pipeline), pipeline.split.train[0]
    content = _content(pipeline, "precision", "seed") | _physics(pipeline.config.scale, pipeline.scene, case)
    content |= {"cases": [list(map(dict, cases)) for cases in pipeline.lessons], "device": pipeline.device}
    content |= {"model": model.lesson}
    return _run(pipeline, "teach", content | _edited(), [pipeline.training, pipeline.encoding])


def _learning(pipeline) -> Model:
    """The model, which learns."""
    if not pipeline.model.learns:
        raise ConfigError(f"model={pipeline.model.name} is not taught; set model=recurrence")
    return pipeline.model


def evaluation(pipeline) -> Run:
    """The run of errors and costs."""
    content = _content(pipeline, "evaluation")
    content |= {"columns": "one table", "paper": _plain(pipeline.config.scene.get("paper"))}
    return _run(pipeline, "evaluate", content, _compared(pipeline))


def superresolution(pipeline) -> Run:
    """The run of the deployed fields at more points."""
    return _run(pipeline, "superresolve", _content(pipeline, "super_resolution"), _compared(pipeline))


def _run(pipeline, stage: str, content: dict[str, Any], parents: Sequence[Run] = ()) -> Run:
    return Run.open(stage, pipeline.scene.name, content, parents, pipeline.root)


def _compared(pipeline) -> list[Run]:
    """The reduced trajectories, and the full-order ones that they are held to."""
    return [pipeline.deployment, *map(pipeline.truth, pipeline.held_out)]


def _physics(scale: str, scene: Scene, case: Case) -> dict[str, Any]:
    """A scene in one of its cases; scale and files are told, and name no run by themselves."""
    content = plain_scene(scene.at(case))
    law = code_of({key: content[key] for key in ("material", "transfer")})
    parameters = {name: {"key": scene.varied[name].key} for name in case}
    return content | {"law": law, "scale": str(scale), "files": scene.files, "parameters": parameters}


def _content(pipeline, *keys: str) -> dict[str, Any]:
    """Some keys of the configuration, with the text of the classes that they name."""
    content = {key: _plain(pipeline.config[key]) for key in keys}
    code = code_of(content)
    return content | {"code": code} if code else content


def _edited() -> dict[str, Any]:
    """An edited step is another run, whose result is not there yet."""
    changed = edits()
    return {"edited": changed} if changed else {}


def _of_networks(pipeline) -> bool:
    """Whether the field is the paper's networks."""
    if pipeline.config.field.get("_target_") in _EXACT:
        return False
    from nsf.kinematics.fields.mlp import MlpField

    return isinstance(pipeline.field, MlpField)


def _plain(value: Any) -> Any:
    return OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
