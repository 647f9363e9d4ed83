"""Messages of `nsf serve`: the deformation field once, then a latent vector a frame."""

import json

import numpy as np
import torch

from nsf.errors import ConfigError
from nsf.export import web
from nsf.live.model import LiveModel
from nsf.live.player import Moment

FIELDS = ("basis", "joint")  # the fields of linear modes


def field_message(model: LiveModel) -> bytes:
    """The deformation field g at the shown particles, and the header that a page needs.

    The message also has the closure's weights. The browser evaluates the closure, so that a frame is x̂ alone.

    Returns:
        As `nsf.export.web.packed` has it: rest [n, 3] float32 [m] and the arrays of `modal_field`.

    Raises:
        ConfigError: the field does not consist of linear modes.
    """
    check_field(model)
    told, arrays = modal_field(model.at.fields["deformation"], np.int16)
    header = shown(model) | {"fields": {"deformation": told | {"parameters": False}}}
    return web.packed(header, {"rest": model.X} | {f"deformation.{name}": a for name, a in arrays.items()})


def shown(model: LiveModel) -> dict:
    """What a page of a model is told of it, whatever it draws it from."""
    x, _ = model.training_frames()
    moved = float(np.percentile(np.linalg.norm(x - model.X, axis=2), 99.5)) or 1.0
    return {
        "title": model.title,
        "run": model.run.id,
        "points": len(model.X),
        "particles": model.particles,
        "radius": 0.62 * model.spacing,
        "lower": x.min((0, 1)).tolist(),
        "upper": x.max((0, 1)).tolist(),
        "floor": model.floor,
        "colors": web.colors(),
        "quantities": {"displacement": {"title": "displacement", "unit": "m", "top": moved}},
        "parameters": [
            {
                "name": p.name.replace("_", " "), "unit": p.unit, "lower": p.lower, "upper": p.upper,
                "step": p.step, "trained": p.trained,
            }
            for p in model.parameters
        ],
        "solids": model.solids(model.initial),
    }  # fmt: skip


def modal_field(field, kind: type, modes: int | None = None) -> tuple[dict, dict[str, np.ndarray]]:
    """A field of modes as `Field` in `field.mjs` reads it: what is told of it, and its arrays.

    mean + Σ_k scale_k modes_k a_k with a = [the first inputs ; network(inputs)], as in `BasisManifold`.

    Args:
        field: a `RestrictedField`.
        kind: whole numbers that the modes are kept in.
        modes: how many at most, those of most energy; all by default.

    Returns:
        mean [n, c] float32, scale [K] float32, modes [n, c, K], and for each layer of the network weight
        [out, in] and bias [out] float32. SiLU stands between the layers.
    """
    mean, table = _host(field.mean), _host(field.modes)[..., :modes]
    scale = np.maximum(np.abs(table).max((0, 1)), np.finfo(np.float32).tiny) / np.iinfo(kind).max
    arrays = {
        "mean": mean.astype("f4"),
        "scale": scale.astype("f4"),
        "modes": np.rint(table / scale).astype(kind),
    }
    layers = [] if field.network is None else field.network.layers
    return {"leading": field.leading, "layers": len(layers)}, arrays | network_arrays(layers, "f4")


def network_arrays(layers, kind: str) -> dict[str, np.ndarray]:
    """Weights [out, in] and biases [out] of linear layers, as `Network` in `field.mjs` reads them."""
    return {
        f"{name}{index}": _host(getattr(layer, name)).astype(kind)
        for index, layer in enumerate(layers)
        for name in ("weight", "bias")
    }


def frame_message(moment: Moment) -> bytes:
    """t [s], the distrust ratio and x̂, [2 + r] float32, little-endian."""
    return np.concatenate([[moment.t, moment.trust], moment.xhat]).astype("<f4").tobytes()


def state_message(moment: Moment) -> str:
    """The shown values of the parameters, how far they are from training, and whether the run diverged.

    As JSON; the second is `LiveRun.away`.
    """
    run = moment.run
    return json.dumps(
        {"values": list(run.case.parameters.values()), "away": run.away, "diverged": run.diverged}
    )


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


def check_field(model: LiveModel) -> None:
    """Refuse a field that a browser cannot evaluate.

    Raises:
        ConfigError: it does not consist of linear modes.
    """
    if model.manifold.field not in FIELDS:
        raise ConfigError(
            f"{model.run.id} has field={model.manifold.field}, which each browser would have to evaluate "
            f"at every particle; serve a deployment of field={FIELDS[0]}, or use nsf view"
        )


def _host(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy()
