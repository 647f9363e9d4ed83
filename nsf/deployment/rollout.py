"""The record of a reduced run, and its file."""

import io
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from nsf.data import Case, hdf5
from nsf.deployment.trust import first_distrusted
from nsf.dynamics import STOP_REASONS
from nsf.errors import SchemaError
from nsf.storage import writing

#: Who takes a step: a model of latent vectors alone, the projected step, the full-order solver.
LATENT_MODEL, PROJECTED, FULL_ORDER = range(3)
LEVELS = ("latent_model", "projected", "full_order")
#: Stands for a stop reason where a step of the latent vector alone ends in no inversion.
LATENT = "latent"

_VERSION = 4
_SCALARS = {
    "away": float, "sample": int, "integration_mean": float, "needed_outside": int, "seconds": float,
    "diverged": int, "handed_over": int,
}  # fmt: skip
_ARRAYS = ("t", "xhat", "residuals", "trust")
_REAL = ("<f4", "<f8")  # types of the arrays: that of the run


@dataclass
class Rollout:
    """One reduced run.

    Attributes:
        case: its problem parameters.
        t: [N + 1] time [s]; xhat: [N + 1, r] latent vectors.
        residuals: [N, k + 1] projection residuals [m]; stops: [N] stop reasons.
        trust: [N + 1] how far each step is from the training data, in units of how far these are from
            themselves (`Trust.ratios`, and `away` where that is above 1).
        away: how far the case is from the training cases, in units of their spacing (`CaseDistance`).
        sample: |S| of the first span of time; integration_mean: mean |N| over all steps taken.
        needed_outside: most particles or nodes outside the superset that a step needed.
        seconds: wall time of the steps, without set-up; of a batch, an equal share of it.
        diverged: step at which x̂ ceased to be finite or a sample particle left the grid, −1 when neither did.
        handed_over: step from whose state the full-order solver goes on, −1 when it does not. The steps then
            end with the first distrusted one.
        estimate: [N + 1] how far the members of a model are from their mean at S [m]; None of a single one.
        by: [N] who took each step (`LATENT_MODEL`, `PROJECTED`; `FULL_ORDER` from `handed_over` on); None for
            a run whose model projects itself.
        stress: [N + 1, n_s] ŝ, coordinates of τ, of a run whose model has them; None of others.
    """

    case: Case
    t: np.ndarray
    xhat: np.ndarray
    residuals: np.ndarray
    stops: list[str]
    trust: np.ndarray
    away: float
    sample: int
    integration_mean: float
    needed_outside: int
    seconds: float
    diverged: int
    handed_over: int = -1
    estimate: np.ndarray | None = None
    by: np.ndarray | None = None
    stress: np.ndarray | None = None

    @property
    def levels(self) -> np.ndarray:
        """[N] `by` of any run."""
        by = np.full(len(self.stops), PROJECTED) if self.by is None else self.by
        handed = (self.handed_over >= 0) & (np.arange(len(by)) >= self.handed_over)
        return np.where(handed, FULL_ORDER, by).astype(np.int8)

    @property
    def projected_share(self) -> float:
        """Share of steps, in a run of another model, that the projected step took; 0 of any other run."""
        return 0.0 if self.by is None else float((self.levels == PROJECTED).sum()) / max(1, len(self.by))

    @property
    def by_latent_model(self) -> int:
        """How many steps a model of latent vectors alone took."""
        return int((self.levels == LATENT_MODEL).sum())

    @property
    def estimated_error(self) -> float:
        """Largest of `estimate` [m]; NaN where nothing is estimated, or another model took every step."""
        return math.nan if self.estimate is None or not self.by_latent_model else float(self.estimate.max())

    @property
    def distrusted(self) -> int:
        """First step that is not to be believed (ratio above 1), −1 when there is none."""
        return first_distrusted(self.trust)

    def save(self, path: Path) -> None:
        """Write as HDF5, whole or not at all."""
        # In memory first: HDF5 cannot report a full disk when it closes a file.
        memory = io.BytesIO()
        with h5py.File(memory, "w") as file:
            file.attrs.update({"nsf_rollout": _VERSION} | {name: getattr(self, name) for name in _SCALARS})
            for name in _ARRAYS:
                file[name] = getattr(self, name)
            if self.by is not None:
                file["by"] = self.levels
            if self.estimate is not None:
                file["estimate"] = self.estimate
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
            shapes = {"xhat": (len(t), latent_dim), "residuals": (len(t) - 1, None), "trust": (len(t),)}
            arrays = {name: hdf5.array(file, name, _REAL, shape)[()] for name, shape in shapes.items()}
            stops = hdf5.texts(file, "stops", (len(t) - 1,))
            numbers = hdf5.values(file, "case", ("<f8",), (None,))
            names, units = (hdf5.texts(file, f"case_{name}", numbers.shape) for name in ("names", "units"))
            if "by" in file:
                arrays["by"] = hdf5.array(file, "by", ("|i1",), (len(t) - 1,))[()]
            if "estimate" in file:
                arrays["estimate"] = hdf5.array(file, "estimate", _REAL, (len(t),))[()]
            if "stress" in file:
                arrays["stress"] = hdf5.array(file, "stress", _REAL, (len(t), None))[()]
            rollout = cls(Case(names, numbers, units), **scalars, t=t, **arrays, stops=stops)
            rollout._check()
        return rollout

    def _check(self) -> None:
        """Raises SchemaError where the values are none that a run leaves."""
        steps = len(self.t) - 1
        for name, least, most in (
            ("sample", 1, np.inf),
            ("needed_outside", 0, np.inf),
            ("diverged", -1, steps),
            ("handed_over", -1, steps),
            ("seconds", 0, np.inf),
            ("away", 0, np.inf),
            ("integration_mean", 0, np.inf),
        ):
            if not least <= getattr(self, name) <= most:
                raise SchemaError(f"has {name}={getattr(self, name)}, in {steps} steps")
        # A run that diverged, or was handed over before it did, may end in what is not finite.
        last = (
            self.handed_over if self.handed_over >= 0 else self.diverged - 1 if self.diverged >= 0 else steps
        )
        hdf5.check("xhat", self.xhat[: max(0, last) + 1])
        hdf5.check("residuals", self.residuals[: max(0, last)])
        for name in ("trust", "estimate"):
            values = getattr(self, name)
            if values is not None and not (values >= 0).all():
                raise SchemaError(f"has values of {name} that are negative or no numbers")
        if self.by is not None and not np.isin(self.by, range(len(LEVELS))).all():
            raise SchemaError("has steps by none of " + ", ".join(LEVELS))
        if unknown := set(self.stops) - {*STOP_REASONS, LATENT}:
            raise SchemaError(f"has stops={sorted(unknown)[0]!r}, which is no reason to stop")


def rollout_file(index: int) -> str:
    """File of a deploy run with the reduced run of the held-out case of that index."""
    return f"rollout_{index}.h5"


def continuation_file(index: int) -> str:
    """File of a deploy run in which the full-order solver goes on with that reduced run."""
    return f"continuation_{index}.h5"
