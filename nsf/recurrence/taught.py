"""The file of a recurrence, and the identity of what taught it, so that it is used on nothing else."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import torch

from nsf.canonical import plain
from nsf.data import archives
from nsf.errors import ConfigError, SchemaError, first_line
from nsf.recurrence.form import Form, Sizes
from nsf.storage import writing

FORMAT = "nsf-recurrence"
FORMAT_VERSION = 1
_DIGITS = 12
_SAME = 1e-9  # of a range: what round-off may move
#: Of manifolds, with the places and versions of their tensors.
_HASHES: WeakKeyDictionary = WeakKeyDictionary()


@dataclass(frozen=True)
class Taught:
    """Identity of all that the runs depend on which taught a recurrence, but for its inputs.

    Gravity and the initial velocity are inputs, so a scene's identity leaves them out.

    Attributes:
        manifold, scene: hashes.
        dt: step of the runs [s].
        parameters: names of the problem parameters.
        ranges: [n, 2] smallest and largest training value of each.
        gravity: [3] middle of all gravity in the runs [m/s²]; reach: how far from it any was [m/s²].
    """

    manifold: str
    scene: str
    dt: float
    parameters: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach: float = 0.0

    @classmethod
    def of(cls, manifold, scene: str, dt: float, gravity: np.ndarray | None = None) -> "Taught":
        """The identity of runs.

        Args:
            manifold: trained fields.
            scene: hash of the scene's physics (`nsf.scenes.identity.physics_hash`).
            dt: step [s].
            gravity: [n, 3] of all steps of all runs [m/s²]; None where it does not matter.
        """
        parameters = manifold.training_parameters
        middle = np.zeros(3) if gravity is None else gravity.mean(0)
        reach = 0.0 if gravity is None else float(np.linalg.norm(gravity - middle, axis=1).max())
        return cls(
            manifold=manifold_hash(manifold),
            scene=scene,
            dt=float(dt),
            parameters=tuple(manifold.parameter_names),
            ranges=tuple(zip(parameters.amin(0).tolist(), parameters.amax(0).tolist(), strict=True)),
            gravity=tuple(map(float, middle)),
            reach=reach,
        )

    @classmethod
    def read(cls, content: Mapping) -> "Taught":
        """From plain containers, as `plain` gives them.

        Raises:
            SchemaError: one is missing or of another kind.
        """
        try:
            values = {field.name: content[field.name] for field in fields(cls)}
            values["parameters"] = tuple(map(str, values["parameters"]))
            values["ranges"] = tuple((float(low), float(high)) for low, high in values["ranges"])
            values["gravity"] = tuple(map(float, values["gravity"]))
            values["dt"], values["reach"] = float(values["dt"]), float(values["reach"])
            return cls(**values)
        except (KeyError, TypeError, ValueError) as error:
            raise SchemaError(f"it does not say what taught it ({error}); run `nsf teach` again") from error

    def plain(self) -> dict:
        """Plain containers."""
        return plain(asdict(self))

    def differing(self, other: "Taught") -> str:
        """The first thing in which another identity differs; empty where none does."""
        for name in ("manifold", "scene", "dt", "parameters"):
            mine, others = getattr(self, name), getattr(other, name)
            if mine != others:
                shown = "Δt [s]" if name == "dt" else name
                return f"another {shown}: {mine}, not {others}"
        if not np.allclose(self.ranges, other.ranges, rtol=_SAME, atol=0.0):
            return f"other ranges: {self.ranges}, not {other.ranges}"
        return ""

    def outside(self, parameters: Mapping[str, float], gravity: np.ndarray) -> tuple[float, str]:
        """How far a run's input lies outside of what was taught.

        Args:
            parameters: of the run, by name.
            gravity: [3] or [n, 3] in the course of the run [m/s²].

        Returns:
            Largest distance from the middle of a range in units of its half, at most 1 inside; and which
            input is outside, empty where none is.
        """
        ratios = [(0.0, "")]
        for name, (low, high) in zip(self.parameters, self.ranges, strict=True):
            off = _ratio(abs(parameters[name] - 0.5 * (low + high)), 0.5 * (high - low), abs(high) + abs(low))
            ratios.append((off, f"{name}={parameters[name]:g} is outside of {low:g} … {high:g}"))
        away = float(np.linalg.norm(np.subtract(gravity, self.gravity), axis=-1).max())
        around = float(np.linalg.norm(self.gravity))
        text = f"gravity is {away:.3g} m/s² from that which was taught, {self.reach:.3g} m/s² at most"
        ratios.append((_ratio(away, self.reach, around), text))
        off, text = max(ratios)
        return off, text if off > 1.0 else ""


def _ratio(off: float, reach: float, size: float) -> float:
    """How far off, in units of the reach; round-off of values of that size counts for nothing."""
    if off <= reach + _SAME * size:
        return min(off / reach, 1.0) if reach else 0.0
    return off / reach if reach else np.inf


def manifold_hash(manifold) -> str:
    """Hash of every tensor of a manifold, taken once for all runs of it."""
    tensors = manifold.state_dict()
    now = tuple((tensor.data_ptr(), tensor._version) for tensor in tensors.values())
    if _HASHES.get(manifold, ((), ""))[0] != now:
        _HASHES[manifold] = now, _hash_of(manifold.field, tensors)
    return _HASHES[manifold][1]


def _hash_of(field: str, tensors: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256(field.encode())
    for name, tensor in tensors.items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()[:_DIGITS]


def save(form: Form, taught: Taught, path: Path | str) -> None:
    """Write weights, scales and what taught them; whole or not at all."""
    content = {
        "format": FORMAT, "format_version": FORMAT_VERSION, "sizes": vars(form.sizes), "dt": form.dt,
        "stride": form.stride, "taught": taught.plain(), "state": dict(form.state_dict()),
    }  # fmt: skip
    with writing(Path(path)) as temporary:
        torch.save(content, temporary)


def load(path: Path | str) -> tuple[Form, Taught]:
    """Read a recurrence, in fp64 on the host, and what taught it.

    Raises:
        MissingRunError: there is no such file.
        SchemaError: the file is truncated, foreign or of another version, or does not fit together.
    """
    path = Path(path)
    content = archives.tensors(path, "recurrence", "teach", (FORMAT, FORMAT_VERSION))
    try:
        taught, sizes = Taught.read(content["taught"]), Sizes(**content["sizes"])
        with torch.device("meta"):  # whatever sizes the file claims, nothing of theirs is made
            form = Form(sizes, taught.dt, _whole(content["stride"]))
        form.load_state_dict(content["state"], assign=True)
        if not all(bool(torch.isfinite(values).all()) for values in form.state_dict().values()):
            raise ValueError("a value is not finite")
    except (RuntimeError, KeyError, TypeError, AttributeError, ValueError, ConfigError) as error:
        raise SchemaError(
            f"{path}: its contents do not fit each other ({first_line(error)}); run `nsf teach` again"
        ) from error
    return form.double().requires_grad_(False).eval(), taught


def _whole(value) -> int:
    if not isinstance(value, int) or value < 1:
        raise ValueError(f"a stride of {value!r} steps")
    return value
