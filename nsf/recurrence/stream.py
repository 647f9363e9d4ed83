"""Full-order runs, encoded as they are made: what stays are x̂ and ŝ, a few dozen numbers a frame."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp as wp
from torch import Tensor

from nsf.data import archives
from nsf.errors import ConfigError, SchemaError
from nsf.kinematics.blocks import coordinates
from nsf.mpm import FP32
from nsf.mpm.recording import FrameRecorder
from nsf.storage import writing

_FRAMES = 64  # that are encoded together, at most
_ROOM = {True: 2**30, False: 2**26}  # [byte] of these frames on a GPU, and on a CPU


@dataclass(frozen=True)
class Encoded:
    """A full-order run in latent coordinates.

    Attributes:
        xhat: [N + 1, r] at each step; stress: [N + 1, n_s] ŝ; both float32.
        seconds: wall time of the run [s]; 0 of one that was stored.
    """

    xhat: np.ndarray
    stress: np.ndarray
    seconds: float

    @property
    def finite(self) -> bool:
        """Whether every number is."""
        return bool(np.isfinite(self.xhat).all() and np.isfinite(self.stress).all())

    def save(self, path: Path) -> None:
        """Write as npz with its own sha256, whole or not at all."""
        with writing(path, sealed=True) as partial, partial.open("wb") as file:
            np.savez(file, xhat=self.xhat, stress=self.stress, seconds=self.seconds)

    @classmethod
    def open(cls, path: Path) -> "Encoded":
        """Read one.

        Raises:
            SchemaError: the file holds none.
        """
        file = archives.arrays(path, "encoded run", "teach")
        try:
            return cls(file["xhat"], file["stress"], float(file["seconds"]))
        except (ValueError, TypeError, KeyError) as error:
            raise SchemaError(f"{path} holds no encoded run; delete it and run `nsf teach` again") from error


class Encoder:
    """x̂ and ŝ of frames. ŝ are the coordinates of τ in the leading POD modes of the training runs' stress.

    These modes are those of the manifold's stress field, so that a decoder of τ has them.

    Args:
        manifold: trained fields, on the device of the frames.
        stress: n_s; 0 for no ŝ.

    Raises:
        ConfigError: the stress field has no modes, or fewer.
    """

    def __init__(self, manifold, stress: int):
        self.manifold, self.stress = manifold, stress
        self._modes = stress_modes(manifold, stress).flatten(0, 1) if stress else None

    def __call__(self, x: Tensor, tau: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """x̂ [F, r] and ŝ [F, n_s], float32, of positions [F, P, 3] [m] and τ [F, P, 6] [Pa]."""
        xhat = self.manifold.encode(x)
        modes = self._modes
        shat = xhat[:, :0] if modes is None else coordinates(tau.flatten(1).to(modes), modes)
        return xhat.float().cpu().numpy(), shat.float().cpu().numpy()


def stress_modes(manifold, count: int) -> Tensor:
    """The leading orthonormal modes [P, 6, count] of a manifold's stress field.

    Raises:
        ConfigError: it has none, or fewer.
    """
    if not (most := modes_of_stress(manifold)):
        raise ConfigError("model.stress needs modes of stress, which field=mlp has not; set model.stress=0")
    if most < count:
        raise ConfigError(
            f"model.stress={count} coordinates, and the stress field has {most} modes; set "
            f"model.stress={most} or fewer, or train with more field.modes"
        )
    return manifold.fields["stress"].modes[..., :count]


def modes_of_stress(manifold) -> int:
    """How many modes a manifold's stress field has; 0 of networks."""
    fields = getattr(manifold, "fields", {})
    modes = getattr(fields["stress"], "modes", None) if "stress" in fields else None
    return 0 if modes is None else modes.shape[2]


def streamed(solver, steps: int, encoder: Encoder, after: Callable[[], object] = lambda: None) -> Encoded:
    """Take a full-order run to its end and encode each frame on the device where it is.

    Args:
        solver: a `nsf.mpm.FullOrderMPM` at t = 0.
        steps: N.
        encoder: of the frames; on the same device.
        after: called after each step.

    Raises:
        InstabilityError: the solver loses stability.
    """
    started = time.perf_counter()
    parts = [encoder(x, tau) for x, tau in _frames(solver, steps, after)]
    xhat, stress = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    return Encoded(xhat, stress, time.perf_counter() - started)


def _frames(solver, steps: int, after: Callable[[], object]) -> Iterator[tuple[Tensor, Tensor]]:
    """Positions [F, P, 3] and τ [F, P, 6] of the present state and after each step, some frames at once."""
    room = _ROOM[solver.device.is_cuda]
    recorder = FrameRecorder(solver.state, solver.precision, FP32, capacity=_FRAMES, room=room)
    for n in range(steps + 1):
        if n:
            solver.step()
            after()
        recorder.record()
        if recorder.full or n == steps:
            fields = recorder.on_device()
            yield wp.to_torch(fields["x"]), wp.to_torch(fields["tau"])
    solver.check()


def encoded_trajectory(trajectory, encoder: Encoder, device) -> Encoded:
    """A stored trajectory in latent coordinates; a `nsf.data.Trajectory` whose frames are its steps."""
    parts = []
    for first in range(0, trajectory.frames, _FRAMES):
        rows = range(first, min(first + _FRAMES, trajectory.frames))
        x, tau = (torch.as_tensor(trajectory.read(f, frames=list(rows))).to(device) for f in ("x", "tau"))
        parts.append(encoder(x, tau))
    xhat, stress = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    return Encoded(xhat, stress, 0.0)
