"""The evaluate runs behind a report: each file is checked against its manifest before a number is used.

`summary.json` holds `title` and `scale` of the scene, and `paper`: the `place` where the paper speaks of it,
and by method the figures that it prints.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from nsf import schemas
from nsf.data import archives
from nsf.errors import MissingRunError, NSFError, SchemaError
from nsf.manifest import digest
from nsf.results import table
from nsf.results.question import FILES
from nsf.runs import Run
from nsf.schemas import Maybe, Number

KEPT = ("commit", "dirty", "device", "precision", "seed", "created", "versions")
"""Keys of a manifest that a report has of the origin of a run."""
_PARTICLES = ("x_full", "x_reduced", "stress_full", "stress_reduced")
_AROUND = {
    Maybe("gravity"): "f case frame 3",
    Maybe("solid_shape"): "U case solid*",
    Maybe("solid_extents"): "f case solid* 3",
    Maybe("solid_position"): "f case frame solid* 3",
    Maybe("solid_orientation"): "f case frame solid* 3 3",
    Maybe("solid_active"): "b case frame solid*",
}
#: Arrays of `frames.npz`.
FRAMES = {
    "cases": "U case",
    "t": "f frame",
    **{name: "f case frame particle 3" for name in _PARTICLES[:2]},
    **{name: "f case frame particle" for name in _PARTICLES[2:]},
    Maybe("role"): "i case frame particle",
    **_AROUND,
}
_SERIES = ("case", "split", "frame", "t", "delta", "displacement_error", "stress_error")
_STATED = {Maybe("r"): int, Maybe("sample"): int, Maybe("delta"): Number(0)}
_SUMMARY = {
    Maybe("scale"): (str, None),
    Maybe("paper"): ({Maybe("nsf"): _STATED, Maybe("deformation_only"): _STATED}, None),
}
_COST = {Maybe("breakdown"): {...: {...: Number(0)}}}


@dataclass(frozen=True)
class Motion:
    """The particles of one case for pictures.

    Attributes:
        case: its text.
        t: [F] [s].
        x_full, x_reduced: [F, n, 3] [m] of the full-order run and of the model.
        stress_full, stress_reduced: [F, n] von Mises equivalents of τ [Pa].
        stopped: time [s] up to which a run that diverged was good; None of one that reached the end.
        surroundings: gravity and colliders, as `nsf.evaluation.surroundings` names them.
        role: [F, n] 2 of a sample particle, 1 of an integration particle alone, 0 of others.
    """

    case: str
    t: np.ndarray
    x_full: np.ndarray
    x_reduced: np.ndarray
    stress_full: np.ndarray
    stress_reduced: np.ndarray
    stopped: float | None = None
    surroundings: Mapping[str, np.ndarray] = field(default_factory=dict)
    role: np.ndarray | None = None


class Source:
    """One complete evaluate run whose files are whole.

    Raises:
        SchemaError: a file is missing, differs from its manifest, or lacks a column.
    """

    def __init__(self, run: Run):
        self.run, self.id, self.manifest = run, run.id, run.manifest
        self.hashes = {name: digest(run.file(name)) for name in FILES}
        self.rows = table.complete(self._csv("results.csv", ("case",)), self._path("results.csv"))
        if self.rows.empty:
            raise SchemaError(f"{self._path('results.csv')} has no rows; run `nsf evaluate` again")
        self.summary = self._json("summary.json", _SUMMARY)
        self.cost = self._json("cost.json", _COST)

    @property
    def created(self) -> str:
        """When the run was made (ISO)."""
        return str(self.manifest.get("created", ""))

    @cached_property
    def series(self) -> pd.DataFrame:
        """Errors and latent coordinates, one row a frame and case."""
        path, frame = self._path("series.csv"), self._csv("series.csv", _SERIES)
        for head in ("xhat_", "encoded_"):
            names = {name for name in frame if name.startswith(head)}
            if names != {f"{head}{k + 1}" for k in range(len(names))}:
                raise SchemaError(
                    f"{path} has {', '.join(sorted(names))}, not {head}1 to {head}r; run `nsf evaluate` again"
                )
        return table.numbers(frame, path, ("case", "split"))

    @cached_property
    def logarithmic(self) -> set[str]:
        """Names of the parameters that the design draws evenly in their logarithm, as far as it is known."""
        from nsf import config  # 0.3 s that most reports need not pay

        try:
            whole = config.read(self._deployed.file("configuration.yaml")) if self._deployed else {}
        except NSFError:  # of another version
            return set()
        scene = whole.get("scene")
        parameters = scene.get("parameters") if isinstance(scene, Mapping) else None
        items = parameters.items() if isinstance(parameters, Mapping) else ()
        return {str(name) for name, one in items if isinstance(one, Mapping) and one.get("log") is True}

    @cached_property
    def training_cases(self) -> list[dict[str, float]]:
        """The parameter values of each training case, as far as the runs are there."""
        trained = _whole(self._deployed, "train") if self._deployed else []
        configured = [run.config.get("parameters") for train in trained for run in _whole(train, "simulate")]
        cases = [
            {name: one.get("value") for name, one in parameters.items() if isinstance(one, Mapping)}
            for parameters in configured
            if isinstance(parameters, Mapping)
        ]
        return [case for case in cases if all(isinstance(value, int | float) for value in case.values())]

    @property
    def warnings(self) -> list[str]:
        """Warnings of the simulations behind the run."""
        waiting, lines = list(self.run.parent_runs), {}
        for run in waiting:
            waiting += [parent for parent in run.parent_runs if parent not in waiting]
            if run.stage == "simulate":
                lines |= dict.fromkeys(map(str, run.manifest.get("warnings", [])))
        return list(lines)

    def motions(self, cases: Sequence[str]) -> list[Motion]:
        """The particles of some cases; those that were not stored are left out."""
        arrays = archives.arrays(self._path("frames.npz"), "frames", "evaluate", FRAMES)
        around = [one.key for one in _AROUND]
        around = around if all(name in arrays for name in around) else []
        rows = {str(case): row for row, case in enumerate(arrays["cases"])}
        return [
            Motion(
                case,
                arrays["t"],
                *(arrays[key][rows[case]] for key in _PARTICLES),
                stopped=self._stopped(case),
                surroundings={key: arrays[key][rows[case]] for key in around},
                role=arrays["role"][rows[case]] if "role" in arrays else None,
            )
            for case in cases
            if case in rows
        ]

    def _stopped(self, case: str) -> float | None:
        series = self.series[self.series["case"] == case]
        lost = np.isinf(series["delta"])
        return float(max(series.loc[~lost, "t"], default=0.0)) if lost.any() else None

    @cached_property
    def _deployed(self) -> Run | None:
        return next(iter(_whole(self.run, "deploy")), None)

    def _path(self, name: str) -> Path:
        return Path(self.run.path) / name

    def _json(self, name: str, schema: Mapping) -> dict:
        try:
            return schemas.read(self._path(name), schema)
        except SchemaError as error:
            raise SchemaError(f"{self.run.path}: {error}; run `nsf evaluate` again") from error

    def _csv(self, name: str, columns: Sequence[str]) -> pd.DataFrame:
        frame = table.parsed(self._path(name), ("case", *table.TEXT))
        if absent := [column for column in columns if column not in frame]:
            raise SchemaError(
                f"{self._path(name)} lacks the columns {absent}: another version wrote it; "
                "delete the run folder and run `nsf evaluate` again"
            )
        return frame


def open_sources(runs: Iterable[Run], first: Run | None = None) -> list[Source]:
    """The complete ones among evaluate runs: `first`, then the newest first.

    Raises:
        MissingRunError: none is complete.
        SchemaError: one of them has a missing or altered file.
    """
    runs = list(runs)
    # Not `run.complete`: a finished run whose file is gone must be named, not passed over.
    sources = [Source(run) for run in runs if run.manifest.get("status") == "complete"]
    if not sources:
        scene = runs[0].scene if runs else "sand"
        raise MissingRunError(
            f"none of the {len(runs)} evaluate runs is complete; run `nsf evaluate scene={scene}` first"
        )
    chosen = first.id if first else None
    return sorted(sources, key=lambda s: (s.id == chosen, s.created, s.id), reverse=True)


def _whole(run: Run, stage: str) -> list[Run]:
    """The runs of a stage that a run was made from, those that are there and whole."""
    parents = [parent for parent in run.parent_runs if parent.stage == stage]
    return [parent for parent in parents if parent.manifest and not parent.fault]
