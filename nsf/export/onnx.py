"""`--onnx`: the fields g, h and l as ONNX graphs in single precision, and what to feed them."""

import inspect
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import nn

from nsf.data.schema import TAU_ORDER, UNITS
from nsf.errors import ConfigError
from nsf.export.playback import Playback
from nsf.extras import optional
from nsf.kinematics.training.phases import PHASES, TARGETS
from nsf.storage import writing

NEEDS = ("onnx", "onnxscript")
OPSET = 18
LARGEST = 2**31  # bytes; a protobuf message holds no more


def write(playback: Playback, folder: Path) -> Path:
    """Write `deformation.onnx`, `stress.onnx`, `affine.onnx` and `inputs.npz` into a folder of their own.

    Inputs: `xhat` [frames, r]; `parameters` [n], problem parameters in the order of the metadata's
    `parameter_names`; `X` [points, 3] m at rest, if the field is a function of X (`field=mlp`); and of the
    affine field `rate` [frames, r], dx̂/dt [1/s], if it is trained with `field.affine=rate`. Other
    fields (`field=basis`) are fixed to the points of the playback. A graph keeps an input on which its field
    does not depend. Outputs: `x` [frames, points, 3] m; `tau` [frames, points, 6] Pa in the order of the
    metadata's `tau_order`; `C` [frames, points, 3, 3] 1/s.

    `inputs.npz` holds the run's own inputs, and the time `t` [s] of its frames. All three
    trained fields are written, even if the run's method does not use each of them.

    Raises:
        MissingExtraError: onnx or onnxscript is not installed.
        ConfigError: the graph of so many points does not fit into an ONNX file.
    """
    onnx, _ = (optional(name, "export") for name in NEEDS)
    at = playback.restricted(dtype=torch.float32)
    inputs = {
        "X": playback.X.astype(np.float32),
        "xhat": playback.xhat.astype(np.float32),
        "parameters": np.array(playback.parameters, np.float32),
    }
    if at.takes_rate:
        inputs["rate"] = playback.rate.astype(np.float32)
    folder = folder / f"{playback.name}_onnx"
    modules = {phase: at.module(phase).cpu().eval() for phase in PHASES}
    for module in modules.values():
        _check_size(module, len(playback.X))
    for phase, module in modules.items():
        model = _graph(module, TARGETS[phase][0], inputs)
        onnx.helper.set_model_props(model, _properties(playback, phase))
        onnx.checker.check_model(model)
        with writing(folder / f"{phase}.onnx") as partial:
            onnx.save(model, str(partial))
    with writing(folder / "inputs.npz") as partial:
        np.savez(partial, t=playback.t[: len(inputs["xhat"])], **inputs)
    return folder


def _check_size(module: nn.Module, points: int) -> None:
    size = sum(t.nbytes for t in (*module.buffers(), *module.parameters()))
    if size >= LARGEST:
        raise ConfigError(
            f"a field at {points} points takes {size / 2**30:.1f} GiB, an ONNX file at most 2; "
            f"choose points <= {int(points * LARGEST / size) - 1}"
        )


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """Let errors through alone: the logger also warns of absent packages that are not needed."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _graph(module: nn.Module, output: str, inputs: dict[str, np.ndarray]):
    """The module's graph, with named axes without the exporter's notes, which hold paths of this machine."""
    names = list(inspect.signature(module.forward).parameters)
    axes = {"X": {0: "points"}, "xhat": {0: "frames"}, "parameters": {}, "rate": {0: "frames"}}
    # Example inputs for the trace. The graph does not depend on their numbers of frames and points.
    example = {name: torch.zeros(4 if axes[name] else len(a), *a.shape[1:]) for name, a in inputs.items()}
    with warnings.catch_warnings(), _quiet(logging.getLogger("torch.onnx")):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            tuple(example[name] for name in names),
            input_names=names,
            output_names=[output],
            dynamic_shapes={name: axes[name] for name in names},
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    model = program.model_proto
    model.producer_name = "nsf"
    graph = model.graph
    for noted in (
        model,
        graph,
        *graph.node,
        *graph.input,
        *graph.output,
        *graph.value_info,
        *graph.initializer,
    ):
        del noted.metadata_props[:]
        noted.doc_string = ""
    return model


def _properties(playback: Playback, phase: str) -> dict[str, str]:
    """Metadata for a reader who has the file alone."""
    manifold, (name, _) = playback.manifold, TARGETS[phase]
    properties = {
        "field": manifold.field,
        "phase": phase,
        "run": playback.run.id,
        "latent_dim": manifold.latent_dim,
        "parameter_names": list(manifold.parameter_names),
        "unit": UNITS[name],
        "tau_order": list(TAU_ORDER),
        "x_sha256": manifold.x_sha256,
    }
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in properties.items()}
