"""The record of a reduced run, and its file."""

import io
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from nsf.data import Case, hdf5
from nsf.deployment.trust import Verdict
from nsf.dynamics import STOP_REASONS
from nsf.errors import SchemaError
from nsf.storage import writing

#: Who takes a run whose bound passes the limit.
PROJECTED, FULL_ORDER = "projected", "full"
#: Stands for a stop reason where a step of the latent vector alone ends in no inversion.
LATENT = "latent"

_VERSION = 5
_SCALARS = {
    "sample": int, "integration_mean": float, "needed_outside": int, "seconds": float, "diverged": int,
    "by": str,
}  # fmt: skip
_VERDICT = {"displacement": float, "limit": float, "reason": str, "beyond": bool}
_ARRAYS = ("t", "xhat", "residuals", "signal")
_REAL = ("<f4", "<f8")  # types of the arrays: that of the run


@dataclass
class Rollout:
    """One reduced run.

    Attributes:
        case: its problem parameters.
        t: [N + 1] time [s]; xhat: [N + 1, r] latent vectors.
        residuals: [N, k + 1] projection residuals [m]; stops: [N] stop reasons.
        signal: [N + 1] what the run says of its error [m] (`Trust.signal`).
        verdict: its error, as far as it can be told, and whether to believe it.
        sample: |S| of the first span of time; integration_mean: mean |N| over all steps taken.
        needed_outside: most particles or nodes outside the superset that a step needed.
        seconds: wall time of the steps, without set-up; of a batch, an equal share of it.
        diverged: step at which x̂ ceased to be finite or a sample particle left the grid, −1 when neither did.
        by: the model that took the run from its beginning in place of the first, `projected` or `full`; empty
            where none did. A run by the full-order solver has no steps here, and its frames in another file.
        stress: [N + 1, n_s] ŝ, coordinates of τ, of a run whose model has them; None of others.
    """

    case: Case
    t: np.ndarray
    xhat: np.ndarray
    residuals: np.ndarray
    stops: list[str]
    signal: np.ndarray
    verdict: Verdict
    sample: int
    integration_mean: float
    needed_outside: int
    seconds: float
    diverged: int
    by: str = ""
    stress: np.ndarray | None = None

    def save(self, path: Path) -> None:
        """Write as HDF5, whole or not at all."""
        # In memory first: HDF5 cannot report a full disk when it closes a file.
        memory = io.BytesIO()
        with h5py.File(memory, "w") as file:
            file.attrs.update({"nsf_rollout": _VERSION} | {name: getattr(self, name) for name in _SCALARS})
            file.attrs.update({name: getattr(self.verdict, name) for name in _VERDICT})
            for name in _ARRAYS:
                file[name] = getattr(self, name)
            for name in ("error", "bound"):
                file[name] = getattr(self.verdict, name)
            if self.stress is not None:
                file["stress"] = self.stress
            file["stops"] = np.array(self.stops, dtype=h5py.string_dtype())
            file["case"] = self.case.numbers
            for name in ("names", "units"):
                texts = getattr(self.case, name) or ("",) * len(self.case)
                file[f"case_{name}"] = np.array(texts, dtype=h5py.string_dtype())
        with writing(path) as partial:
            partial.write_bytes(memory.getbuffer())

    @classmethod
    def open(cls, path: Path, latent_dim: int | None = None) -> "Rollout":
        """Read a rollout.

        Args:
            path: of the file.
            latent_dim: r of the manifold it is of; None for any.

        Raises:
            MissingRunError: there is no such file.
            SchemaError: the file was changed after its run, is truncated, foreign or newer, or says what no
                run does.
        """
        with hdf5.opened(path, "rollout", "deploy") as file, hdf5.reading(path, "rollout", "deploy"):
            version = None
            with suppress(KeyError, SchemaError):
                version = hdf5.attribute(file, "nsf_rollout", int)
            if version != _VERSION:
                raise SchemaError(f"is not a rollout of version {_VERSION} (found {version})")
            scalars = {name: hdf5.attribute(file, name, kind) for name, kind in _SCALARS.items()}
            t = hdf5.values(file, "t", _REAL, (None,), increasing=True)
            shapes = {"xhat": (len(t), latent_dim), "residuals": (len(t) - 1, None), "signal": (len(t),)}
            arrays = {name: hdf5.array(file, name, _REAL, shape)[()] for name, shape in shapes.items()}
            told = {name: hdf5.attribute(file, name, kind) for name, kind in _VERDICT.items()}
            errors = [hdf5.array(file, name, ("<f8",), (len(t),))[()] for name in ("error", "bound")]
            stops = hdf5.texts(file, "stops", (len(t) - 1,))
            numbers = hdf5.values(file, "case", ("<f8",), (None,))
            names, units = (hdf5.texts(file, f"case_{name}", numbers.shape) for name in ("names", "units"))
            if "stress" in file:
                arrays["stress"] = hdf5.array(file, "stress", _REAL, (len(t), None))[()]
            verdict = Verdict(*errors, **told)
            rollout = cls(Case(names, numbers, units), **scalars, t=t, **arrays, stops=stops, verdict=verdict)
            rollout._check()
        return rollout

    def _check(self) -> None:
        """Raises SchemaError where the values are none that a run leaves."""
        steps = len(self.t) - 1
        for name, least, most in (
            ("sample", 1, np.inf),
            ("needed_outside", 0, np.inf),
            ("diverged", -1, steps),
            ("seconds", 0, np.inf),
            ("integration_mean", 0, np.inf),
        ):
            if not least <= getattr(self, name) <= most:
                raise SchemaError(f"has {name}={getattr(self, name)}, in {steps} steps")
        # A run that diverged may end in what is not finite.
        last = self.diverged - 1 if self.diverged >= 0 else steps
        hdf5.check("xhat", self.xhat[: max(0, last) + 1])
        hdf5.check("residuals", self.residuals[: max(0, last)])
        if not (self.signal >= 0).all() or not self.verdict.displacement >= 0 or not self.verdict.limit > 0:
            raise SchemaError("has a signal, displacement or limit that is negative or no number")
        for errors in (self.verdict.error, self.verdict.bound):
            if (errors < 0).any():
                raise SchemaError("has errors that are negative")
        if self.by not in ("", PROJECTED, FULL_ORDER):
            raise SchemaError(f"has by={self.by!r}, which is no model that takes runs")
        if unknown := set(self.stops) - {*STOP_REASONS, LATENT}:
            raise SchemaError(f"has stops={sorted(unknown)[0]!r}, which is no reason to stop")


def rollout_file(index: int) -> str:
    """File of a deploy run with the reduced run of the held-out case of that index."""
    return f"rollout_{index}.h5"


def continuation_file(index: int) -> str:
    """File of a deploy run with the frames of that run where the full-order solver took it."""
    return f"continuation_{index}.h5"
