"""A model as a page takes it: the header, and fields of modes as arrays."""

import numpy as np
import torch

from nsf.errors import ConfigError
from nsf.live import page
from nsf.live.model import LiveModel

FIELDS = ("basis",)  # the fields of linear modes
_RADIUS = 0.7  # of a point, over the edge of the cube that it fills: neighbours touch
_WITHIN = (0.5, 99.5)  # [%] percentiles of places in training, about which the camera stands


def field_message(model: LiveModel) -> bytes:
    """The deformation field g at the shown particles, and the header that a page needs.

    The message also has the closure's weights. The browser evaluates the closure, so that a frame is x̂ alone.

    Returns:
        As `nsf.live.page.packed` has it: rest [n, 3] float32 [m] and the arrays of `modal_field`.

    Raises:
        ConfigError: the field does not consist of linear modes.
    """
    check_field(model)
    entry, arrays = modal_field(model.at.fields["deformation"], np.int16)
    header = shown(model) | {"fields": {"deformation": entry | {"parameters": False}}}
    return page.packed(header, {"rest": model.X} | {f"deformation.{name}": a for name, a in arrays.items()})


def shown(model: LiveModel) -> dict:
    """The part of the header that every page of a model has."""
    lower, upper = np.percentile(model.training_frames[0], _WITHIN, axis=(0, 1))
    moved = model.tops["displacement"]
    return {
        "title": model.title,
        "run": model.run.id,
        "points": len(model.X),
        "particles": model.particles,
        "radius": _RADIUS * model.spacing,
        "lower": lower.tolist(),
        "upper": upper.tolist(),
        "floor": model.floor,
        "colors": page.colors(),
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
