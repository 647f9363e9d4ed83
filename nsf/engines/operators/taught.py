"""What operators were taught on, so that they are used on nothing else."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np
import torch

from nsf.canonical import plain
from nsf.dynamics.setup import Setup
from nsf.errors import SchemaError
from nsf.scenes.identity import physics_hash

_DIGITS = 12
_SAME = 1e-9  # of a range: what round-off may move


@dataclass(frozen=True)
class Taught:
    """Identity of all that a step of the teacher depends on, but for what the operators take as input.

    Gravity and the initial velocity are input, so a scene's identity leaves them out.

    Attributes:
        manifold, scene, sample: hashes; the sample's is of particles, weights and first steps of all spans.
        dt: step [s].
        sources, projector: as text.
        parameters: names of the problem parameters.
        ranges: [n, 2] smallest and largest training value of each.
        gravity: [3] about which gravity was varied [m/s²]; reach: how far, at most [m/s²].
    """

    manifold: str
    scene: str
    sample: str
    dt: float
    sources: str
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
            scene=physics_hash(setup.scene),
            sample=_sample_hash(setup),
            dt=setup.dt,
            sources=str(setup.sources),
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
        for name in ("manifold", "scene", "sample", "dt", "sources", "projector", "parameters"):
            one, asked = getattr(self, name), getattr(other, name)
            if one != asked:
                shown = "Δt [s]" if name == "dt" else name
                return f"another {shown}: {one}, not {asked}"
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
        found = [(0.0, "")]
        for name, (low, high) in zip(self.parameters, self.ranges, strict=True):
            off = _ratio(abs(parameters[name] - 0.5 * (low + high)), 0.5 * (high - low), abs(high) + abs(low))
            found.append((off, f"{name}={parameters[name]:g} is outside of {low:g} … {high:g}"))
        away = float(np.linalg.norm(np.subtract(gravity, self.gravity), axis=-1).max())
        around = float(np.linalg.norm(self.gravity))
        text = f"gravity is {away:.3g} m/s² from that which was taught, {self.reach:.3g} m/s² at most"
        found.append((_ratio(away, self.reach, around), text))
        off, text = max(found)
        return off, text if off > 1.0 else ""


def _ratio(off: float, reach: float, size: float) -> float:
    """How far off, in units of the reach; round-off of values of that size counts for nothing."""
    if off <= reach + _SAME * size:
        return min(off / reach, 1.0) if reach else 0.0
    return off / reach if reach else np.inf


def manifold_hash(manifold) -> str:
    """Hash of every tensor of a manifold."""
    found = hashlib.sha256(manifold.field.encode())
    for name, tensor in manifold.state_dict().items():
        found.update(name.encode())
        found.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return found.hexdigest()[:_DIGITS]


def _sample_hash(setup: Setup) -> str:
    found = hashlib.sha256()
    for start, sample in zip(setup.starts, setup.samples, strict=True):
        found.update(np.int64(start).tobytes())
        found.update(np.asarray(sample.particles, np.int64).tobytes())
        if sample.weights is not None:
            found.update(np.asarray(sample.weights, np.float64).tobytes())
    return found.hexdigest()[:_DIGITS]
