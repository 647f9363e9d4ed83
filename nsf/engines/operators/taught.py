"""What operators were taught on, so that they are used on nothing else."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np
import torch
from omegaconf import OmegaConf

from nsf.canonical import content_hash, plain
from nsf.dynamics.setup import Setup
from nsf.errors import SchemaError
from nsf.scenes.scene import NOT_PHYSICS

_DIGITS = 12
_SAME = 1e-9  # of a range: what round-off may move


@dataclass(frozen=True)
class Taught:
    """Identity of all that a step of the teacher depends on, but for what the operators take as input.

    Gravity and the initial velocity are input, so a scene's identity leaves them out.

    Attributes:
        manifold, scene, sample: hashes; the sample's is of particles, weights and first steps of all spans.
        dt: step [s].
        method, projector: as text.
        parameters: names of the problem parameters.
        ranges: [n, 2] smallest and largest training value of each.
        gravity: [3] about which gravity was varied [m/s²]; reach: how far [m/s²].
    """

    manifold: str
    scene: str
    sample: str
    dt: float
    method: str
    projector: str
    parameters: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach: float = 0.0

    @classmethod
    def of(cls, setup: Setup, gravity: Sequence[float] = (0.0, 0.0, 0.0), reach: float = 0.0) -> "Taught":
        """The identity of what a run is given."""
        known = setup.manifold.training_parameters
        return cls(
            manifold=manifold_hash(setup.manifold),
            scene=scene_hash(setup.scene),
            sample=_sample_hash(setup),
            dt=setup.dt,
            method=str(setup.method),
            projector=str(setup.projector),
            parameters=tuple(setup.manifold.parameter_names),
            ranges=tuple(zip(known.amin(0).tolist(), known.amax(0).tolist(), strict=True)),
            gravity=tuple(float(value) for value in gravity),
            reach=float(reach),
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
            raise SchemaError(
                f"operators do not say what they were taught on ({error}); teach them again"
            ) from error

    def plain(self) -> dict:
        """Plain containers."""
        return plain(asdict(self))

    def differing(self, other: "Taught") -> str:
        """The first thing in which another identity differs; empty where none does."""
        for name in ("manifold", "scene", "sample", "dt", "method", "projector", "parameters"):
            one, asked = getattr(self, name), getattr(other, name)
            if one != asked:
                shown = "Δt [s]" if name == "dt" else name
                return f"another {shown}: {one}, not {asked}"
        if not np.allclose(self.ranges, other.ranges, rtol=_SAME, atol=0.0):
            return f"other ranges: {self.ranges}, not {other.ranges}"
        return ""

    def outside(self, parameters: Mapping[str, float], gravity: Sequence[float]) -> str:
        """What of a run's input lies outside of what was taught; empty where nothing does."""
        for name, (low, high) in zip(self.parameters, self.ranges, strict=True):
            slack = _SAME * max(abs(low), abs(high))
            if not low - slack <= parameters[name] <= high + slack:
                return f"{name}={parameters[name]:g} is outside the taught range {low:g} … {high:g}"
        off = float(np.linalg.norm(np.subtract(gravity, self.gravity)))
        if off > self.reach * (1 + _SAME):
            return (
                f"gravity={[round(float(value), 6) for value in gravity]} m/s² is {off:.3g} m/s² from that "
                f"about which the operators were taught, {self.reach:.3g} m/s² at most"
            )
        return ""


def manifold_hash(manifold) -> str:
    """Hash of every tensor of a manifold."""
    found = hashlib.sha256(manifold.field.encode())
    for name, tensor in manifold.state_dict().items():
        found.update(name.encode())
        found.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return found.hexdigest()[:_DIGITS]


def scene_hash(scene) -> str:
    """Hash of a scene's physics but for gravity, initial velocities and the value of its parameter."""
    template = scene.template.copy()
    OmegaConf.update(template, scene.parameters.key, None)
    template = OmegaConf.to_container(template, resolve=False)
    content = {key: template[key] for key in ("scale", "material", "transfer")}
    content["scene"] = {k: v for k, v in template["scene"].items() if k not in (*NOT_PHYSICS, "gravity")}
    bodies = content["scene"]["bodies"]
    content["scene"]["bodies"] = {
        name: {key: value for key, value in body.items() if key != "velocity"}
        for name, body in bodies.items()
    }
    return content_hash(content)


def _sample_hash(setup: Setup) -> str:
    found = hashlib.sha256()
    for start, sample in zip(setup.starts, setup.samples, strict=True):
        found.update(np.int64(start).tobytes())
        found.update(np.asarray(sample.particles, np.int64).tobytes())
        if sample.weights is not None:
            found.update(np.asarray(sample.weights, np.float64).tobytes())
    return found.hexdigest()[:_DIGITS]
