"""Messages of `nsf serve`: the deformation field once, then a latent vector a frame."""

import json
import struct

import numpy as np
import torch

from nsf.errors import ConfigError
from nsf.live.model import LiveModel
from nsf.live.player import Moment

_LEVELS = 32767  # of a signed 16-bit number
FIELDS = ("basis", "joint")  # the fields of linear modes


def field_message(model: LiveModel) -> bytes:
    """The deformation field g at the shown particles, and the header that a page needs.

    g(X, x̂) = mean + Σ_k scale_k modes_k a_k with a = [x̂ ; closure(x̂)], as in `BasisManifold`. The message
    also has the closure's weights. The browser evaluates the closure, so that a frame is x̂ alone.

    Returns:
        Length of the header as uint32, the header (JSON, padded with spaces to whole words), then the arrays,
        all little-endian: rest and mean [n, 3] float32 [m], scale [K] float32, modes [n, 3, K] int16, and for
        each layer of the closure weight [out, in] and bias [out] float32. SiLU stands between the layers.

    Raises:
        ConfigError: the field does not consist of linear modes.
    """
    _check_field(model)
    field = model.at.fields["deformation"]
    modes = _host(field.modes)
    scale = np.maximum(np.abs(modes).max((0, 1)), np.finfo(np.float32).tiny) / _LEVELS
    layers = [] if field.network is None else field.network.layers
    arrays = {
        "rest": model.X,
        "mean": _host(field.mean),
        "scale": scale,
        "modes": np.round(modes / scale).astype("<i2"),
    }
    for index, layer in enumerate(layers):
        arrays |= {f"weight{index}": _host(layer.weight), f"bias{index}": _host(layer.bias)}
    arrays = {k: a if a.dtype == np.dtype("<i2") else a.astype("<f4") for k, a in arrays.items()}
    x, _ = model.training_frames()
    header = {
        "title": model.title,
        "run": model.run.id,
        "particles": model.particles,
        "spacing": model.spacing,
        "low": x.min((0, 1)).tolist(),
        "high": x.max((0, 1)).tolist(),
        "moved": float(np.percentile(np.linalg.norm(x - model.X, axis=2), 99.5)),
        "parameters": [
            {
                "name": p.name.replace("_", " "),
                "unit": p.unit,
                "lower": p.lower,
                "upper": p.upper,
                "step": p.step,
                "trained": p.trained,
            }
            for p in model.parameters
        ],
        "latent_dim": model.manifold.latent_dim,
        "layers": len(layers),
        "arrays": {name: {"shape": a.shape, "type": a.dtype.str[1:]} for name, a in arrays.items()},
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    # Each array begins at a whole word, so that a browser can view it in place.
    body = b"".join(a.tobytes() + b"\0" * (-a.nbytes % 4) for a in arrays.values())
    return struct.pack("<I", len(text)) + text + body


def frame_message(moment: Moment) -> bytes:
    """t [s], the distrust ratio and x̂, [2 + r] float32, little-endian."""
    return np.concatenate([[moment.t, moment.trust], moment.xhat]).astype("<f4").tobytes()


def state_message(moment: Moment) -> str:
    """The shown values of the parameters, how far they are from training, and whether the run diverged.

    As JSON; the second is `LiveRun.away`.
    """
    run = moment.run
    return json.dumps({"values": run.case.numbers, "away": run.away, "diverged": run.diverged})


def asked_values(message: str | bytes) -> list[float]:
    """The values that a client asks for by `{"values": [31.5]}`, in the parameters' order.

    Raises:
        ConfigError: the message is anything else.
    """
    try:
        asked = json.loads(message) if isinstance(message, str) else None
    except (ValueError, RecursionError):
        asked = None
    values = asked.get("values") if isinstance(asked, dict) and len(asked) == 1 else None
    if not isinstance(values, list) or any(type(value) not in (int, float) for value in values):
        raise ConfigError('a client may only send {"values": [number, …]}')
    try:
        return list(map(float, values))
    except OverflowError as error:
        raise ConfigError("the value is too large") from error


def _check_field(model: LiveModel) -> None:
    if model.manifold.field not in FIELDS:
        raise ConfigError(
            f"{model.run.id} has field={model.manifold.field}, which each browser would have to evaluate "
            f"at every particle; serve a deployment of field={FIELDS[0]}, or use nsf view"
        )


def _host(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy()
