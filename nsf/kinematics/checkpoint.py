"""The file of a manifold: plain data that names a class of this package, and its tensors."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import math
import re
import reprlib
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from nsf import schemas
from nsf.data import Standardizer, archives, hash_of_positions
from nsf.errors import SchemaError
from nsf.schemas import Number

FORMAT = "nsf-manifold"
FORMAT_VERSION = 3
FIELDS = "nsf.kinematics.fields"  # the package that holds every class a file may name

_CLASS = re.compile(rf"({re.escape(FIELDS)}\.[A-Za-z]\w*)\.([A-Za-z]\w*)", re.ASCII)
_SCHEMA = {
    "latent_dim": Number(1, whole=True),
    "x_sha256": str,
    "parameter_names": [str],
    "hyperparameters": dict,
    "state": dict,
}
_REPR = reprlib.Repr()
_REPR.maxstring = 100


def class_of(name: Any, base: type) -> type:
    """The class that a file names: a public one, defined in a module of `nsf.kinematics.fields`.

    No other module is imported: a new module in that package is all that a new field needs.

    Args:
        name: dotted, such as "nsf.kinematics.fields.basis.BasisManifold".
        base: of which it must be.

    Raises:
        SchemaError: it is no such class.
    """
    match = _CLASS.fullmatch(name) if isinstance(name, str) else None
    if match and importlib.util.find_spec(match[1]):
        kind = vars(importlib.import_module(match[1])).get(match[2])
        public = isinstance(kind, type) and issubclass(kind, base) and kind.__module__ == match[1]
        if public and not inspect.isabstract(kind):
            return kind
    raise SchemaError(
        f"names the manifold {_REPR.repr(name)}, which is no {base.__name__} of a module of {FIELDS}; "
        "install the nsf that wrote it"
    )


def read(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, each value of its kind, tensors mapped and not read.

    Raises:
        MissingRunError: there is no such file.
        SchemaError: it was changed after its run, is truncated, foreign, of another format, or holds more
            than plain data.
    """
    content = archives.tensors(path, "manifold", "train", (FORMAT, FORMAT_VERSION), mapped=True)
    try:
        schemas.check(content, _SCHEMA)
        _check_leaves(content, path.stat().st_size)
    except SchemaError as error:
        raise SchemaError(f"{path} {error}; train again with `nsf train`") from error
    return content


def fill(manifold: nn.Module, state: dict[str, Tensor]) -> None:
    """Give a manifold that was built without memory its tensors.

    Every value is looked at once: a file of a GB takes some tenths of a second.

    Raises:
        SchemaError: a tensor is missing or unknown, of another type or shape, or not finite; or the
            particles are not those of the manifold's `x_sha256`.
    """
    expected = manifold.state_dict()
    if odd := sorted(expected.keys() ^ state.keys()):
        raise SchemaError(f"has other tensors than its field ({', '.join(odd[:3])})")
    for name, like in expected.items():
        tensor = state[name]
        if (tensor.dtype, tensor.shape) != (like.dtype, like.shape):
            raise SchemaError(
                f"has {name} of {_type(tensor)}{list(tensor.shape)}, not {_type(like)}{list(like.shape)}"
            )
        if not is_finite(tensor):
            raise SchemaError(f"has non-finite values of {name}")
    manifold.load_state_dict(state, assign=True)
    for name, part in manifold.named_modules():
        if isinstance(part, Standardizer) and not (part.std > 0).all():
            raise SchemaError(f"has values of {name}.std that are not positive")
    if hash_of_positions(manifold.X.numpy()) != manifold.x_sha256:
        raise SchemaError("has an X of other particles than its x_sha256")


def is_finite(tensor: Tensor) -> bool:
    """Whether every value of a tensor is finite."""
    # A sum goes at the speed of memory, and is not finite if one of the values is not.
    return bool(tensor.sum().isfinite()) or bool(tensor.isfinite().all())


def _check_leaves(content: dict[str, Any], size: int) -> None:
    """Raises SchemaError where a leaf is of another kind than a checkpoint's."""
    for leaf in archives.leaves({key: value for key, value in content.items() if key != "state"}):
        if isinstance(leaf, Tensor) or (isinstance(leaf, float) and not math.isfinite(leaf)):
            raise SchemaError(f"holds {_REPR.repr(leaf)} beside its tensors, which is no plain value")
    # These size what is built, of which each entry takes a byte or more of the file.
    for leaf in archives.leaves([content["latent_dim"], content["hyperparameters"]]):
        if isinstance(leaf, int) and abs(leaf) > size:
            raise SchemaError(f"asks for {_REPR.repr(leaf)} entries, with {size:,} bytes")
    for name, tensor in content["state"].items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise SchemaError(f"has {_REPR.repr(name)} among its tensors, which is none")


def _type(tensor: Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")


def check_filled(manifold: nn.Module) -> None:
    """Refuse a manifold of which a tensor is in no file, such as a plain attribute of a module.

    Raises:
        SchemaError: names the attribute.
    """
    for module in manifold.modules():
        for name, value in vars(module).items():
            if isinstance(value, Tensor) and value.is_meta:
                raise SchemaError(
                    f"has no tensor {name!r} of {type(module).__name__}, which is a plain attribute; "
                    f"call register_buffer({name!r}, …) in its class, so that it is stored and moved"
                )
