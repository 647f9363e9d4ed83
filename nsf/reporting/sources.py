"""What a report reads: evaluate runs, each file checked against its manifest before a number is used.

Besides the keys every evaluate run has, `summary.json` may hold these, all optional:
`title` and `scale` (of the scene), `parameter_name`, `parameter_unit`, `particles`, `training_seconds` and
`paper`: the `place` where the paper speaks of the scene, and by method the figures it prints, called as in
results.csv, and `training_seconds`. `trust` is a list, one entry a case: {"parameter", "away", "trust",
"distrusted", "distrusted_at", "handed_over_at"} (docs/design.md). `rivals` is likewise a list, with the
displacement errors of each rival; `coarse` holds, by factor of Δx, that of a coarse full-order run, or `why`
there is none.
"""

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.errors import MissingRunError, NSFError, SchemaError
from nsf.reporting.keeping import FILES
from nsf.reporting.text.columns import COLUMNS, LATER, TEXT
from nsf.runs import Run

_FRAMES = ("parameters", "splits", "t", "x_full", "x_reduced", "stress_full", "stress_reduced")
_AROUND = (
    "gravity",
    *(f"solid_{name}" for name in ("shape", "extents", "position", "orientation", "active")),
)
_SERIES = (
    "parameter",
    "split",
    "frame",
    "t",
    "delta",
    "displacement_error",
    "stress_error",
    "reconstruction_delta",
)


@dataclass(frozen=True)
class Motion:
    """One parameter value's particles for pictures: x [F,n,3] m, equivalents of τ [F,n] Pa, t [F] s.

    `stopped` is the time [s] up to which a reduced run that diverged was good (later frames hold that
    state), None for one that reached the end. `surroundings` are gravity and colliders, as
    `nsf.evaluation.surroundings` names them; `role` [F,n] is 2 in S, 1 in N alone, 0 in neither,
    of a projected step from there. Older runs have neither surroundings nor roles.
    """

    parameter: float | str
    split: str
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

    def __init__(self, run):
        self.run, self.id, self.manifest = run, run.id, run.manifest
        self.hashes = {name: checked_hash(run, name) for name in FILES}
        self.results = self._csv("results.csv", COLUMNS, text=TEXT)
        self.summary = json.loads(self._path("summary.json").read_text())
        self.cost = json.loads(self._path("cost.json").read_text())

    @property
    def parameter(self) -> tuple[str, str]:
        """Name and unit of the problem parameter, as a reader sees them."""
        name = self.summary.get("parameter_name", "parameter").replace("_", " ")
        return name, self.summary.get("parameter_unit", "")

    @property
    def created(self) -> str:
        """When the run was made (ISO), by its manifest."""
        return str(self.manifest.get("created", ""))

    @property
    def training_seconds(self) -> float | None:
        """How long its training took [s]; None of a run whose costs are not asked for.

        Such jobs go side by side, and their trainings tell nothing of what one costs.
        """
        return self.summary.get("training_seconds") if self.cost.get("trials") else None

    @property
    def particles(self) -> int:
        """Particles of the full-order model; from γ = 3P/r where the summary does not say."""
        first = self.results.iloc[0]
        return int(self.summary.get("particles") or round(first["gamma"] * float(first["r"]) / 3))

    @cached_property
    def material(self) -> str:
        """The name of the material it is deployed with; empty where the deploy run is not there."""
        material = self._deployed.config.get("material") if self._deployed else None
        target = str(material.get("_target_", "")) if isinstance(material, Mapping) else ""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", target.rpartition(".")[2]).lower()

    @cached_property
    def logarithmic(self) -> set[str]:
        """Names of the parameters that the design draws evenly in their logarithm, as far as it is known."""
        from nsf import config  # 0.3 s that most reports need not pay

        if self._deployed is None:
            return set()
        try:
            scene = config.read(self._deployed.file("configuration.yaml")).get("scene")
            parameters = scene.get("parameters") if isinstance(scene, Mapping) else None
        except NSFError:  # of an older nsf
            return set()
        found = parameters.items() if isinstance(parameters, Mapping) else ()
        return {str(name) for name, one in found if isinstance(one, Mapping) and one.get("log") is True}

    @cached_property
    def training_cases(self) -> list[dict[str, float]]:
        """The values of the parameters in each case that was trained on, as far as the runs are there."""
        trained = _whole(self._deployed, "train") if self._deployed else []
        told = [run.config.get("parameters") for train in trained for run in _whole(train, "simulate")]
        cases = [
            {name: one.get("value") for name, one in parameters.items() if isinstance(one, Mapping)}
            for parameters in told
            if isinstance(parameters, Mapping)
        ]
        return [case for case in cases if all(isinstance(value, int | float) for value in case.values())]

    @cached_property
    def _deployed(self) -> Run | None:
        return next(iter(_whole(self.run, "deploy")), None)

    @cached_property
    def series(self) -> pd.DataFrame:
        """Errors and latent coordinates, one row a frame and parameter value."""
        return self._csv("series.csv", _SERIES, text=("split",))

    def trust(self, parameter) -> dict | None:
        """What the run says of the trust of one parameter value, None for a run that does not know."""
        told = self.summary.get("trust", ())
        return next((entry for entry in told if same_parameter(entry["parameter"], parameter)), None)

    def rivals(self, parameter) -> dict | None:
        """What the run says of the rivals at one parameter value, None for a run that knows none."""
        told = self.summary.get("rivals", ())
        return next((entry for entry in told if same_parameter(entry["parameter"], parameter)), None)

    def motions(self, parameters) -> list[Motion]:
        """The particles of some parameter values, in the order asked for; values not stored are left out."""
        with np.load(self._path("frames.npz"), allow_pickle=False) as stored:
            absent = [key for key in _FRAMES if key not in stored]
            if absent:
                raise SchemaError(f"{self._path('frames.npz')} lacks {absent}; run `nsf evaluate` again")
            arrays = {key: stored[key] for key in _FRAMES}
            around = {key: stored[key] for key in _AROUND if key in stored}
            roles = stored.get("role")
        rows = [(value, _where(arrays["parameters"], value)) for value in parameters]
        return [
            Motion(
                value,
                str(arrays["splits"][row]),
                arrays["t"],
                *(arrays[key][row] for key in _FRAMES[3:]),
                stopped=self._stopped(value),
                surroundings={key: values[row] for key, values in around.items()},
                role=None if roles is None else roles[row],
            )
            for value, row in rows
            if row is not None
        ]

    def _stopped(self, parameter) -> float | None:
        own = self.series[[same_parameter(p, parameter) for p in self.series["parameter"]]]
        lost = np.isinf(own["delta"])
        return float(max(own.loc[~lost, "t"], default=0.0)) if lost.any() else None

    def _path(self, name: str) -> Path:
        return Path(self.run.path) / name

    def _csv(self, name: str, columns, text) -> pd.DataFrame:
        frame = pd.read_csv(self._path(name), dtype=dict.fromkeys(text, str))
        frame = frame.assign(
            **{
                name: "" if name in TEXT else math.nan
                for name in LATER
                if name in columns and name not in frame
            }
        )
        absent = [column for column in columns if column not in frame]
        if absent:
            raise SchemaError(f"{self._path(name)} lacks the columns {absent}; run `nsf evaluate` again")
        return frame


def open_sources(evaluate_runs, first=None) -> list[Source]:
    """The complete runs among those given: the run `first`, then the newest first.

    Raises:
        MissingRunError: none is complete.
        SchemaError: one of them has a missing or altered file.
    """
    runs = list(evaluate_runs)
    # Not `run.complete`: a finished run whose file is gone must be named, not passed over.
    sources = [Source(run) for run in runs if run.manifest.get("status") == "complete"]
    if not sources:
        scene = runs[0].id.split("/")[1] if runs else "sand"
        raise MissingRunError(
            f"none of the {len(runs)} evaluate runs given is complete; run `nsf evaluate scene={scene}` first"
        )
    chosen = first.id if first else None
    return sorted(sources, key=lambda s: (s.id == chosen, s.created, s.id), reverse=True)


def _whole(run: Run, stage: str) -> list[Run]:
    """The runs of a stage that a run was made from, those that are there and whose configuration is whole."""
    found = [parent for parent in run.parent_runs if parent.stage == stage]
    return [parent for parent in found if parent.manifest and not parent.fault]


def same_parameter(a, b) -> bool:
    """Whether two stored values are one parameter value (files differ in precision)."""
    try:
        return bool(np.isclose(float(a), float(b), rtol=1e-5, atol=1e-9))
    except ValueError:
        return str(a) == str(b)


def checked_hash(run, name: str) -> str:
    """sha256 of a file of a run.

    Raises:
        SchemaError: the file is missing, or is not what the run's manifest records.
    """
    path = Path(run.path) / name
    if not path.is_file():
        raise SchemaError(
            f"{path} is missing from {run.stage} run {run.id}; run `nsf {run.stage}` for it again"
        )
    found, expected = file_hash(path), _recorded_hash(run.manifest, name)
    if found != expected:
        raise SchemaError(
            f"{path} has sha256 {found[:12]} but the manifest of {run.id} records {str(expected)[:12]}: "
            f"it was changed after the run; delete the run folder and run `nsf {run.stage}` again"
        )
    return found


def file_hash(path: Path) -> str:
    """sha256 of a file, in hex."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _where(parameters, value) -> int | None:
    return next(
        (row for row, stored in enumerate(np.ravel(parameters)) if same_parameter(stored, value)), None
    )


def _recorded_hash(manifest, name: str) -> str | None:
    recorded = {output["path"]: output["sha256"] for output in manifest.get("outputs", ())}
    return recorded.get(name)


def printed_delta(entries: Sequence[Mapping], known: Mapping[str, str]) -> float:
    """δ of the first entry of `Study.printed` that is of this, a fraction; NaN where none is.

    Args:
        entries: as of `Study`.
        known: what it is of, as text, by the entries' keys; an entry may say `null` of what is not there.
    """
    fits = (e["delta"] for e in entries if all(known.get(k, "null") == e[k] for k in e if k != "delta"))
    return next(fits, math.nan)


@dataclass(frozen=True)
class Study:
    """What a report is about, where it is of more than one scene's variants.

    Attributes:
        question: what it was made to find out.
        paper: what the paper reports on it.
        settings: by run id, what tells a run apart that no column of results.csv tells.
        keys: by run id, the keys of its job.
        missing: what was asked for and is not there, with the reason.
        printed: δ that the paper prints of single jobs: each {"delta": fraction} and, as text, what it is
            of: scene, method, parameter or keys of the job. None: what the scenes say of it holds.
        fine: by evaluate run id, the superresolve run of the same deployment, where there is one.
    """

    question: str
    paper: str
    settings: Mapping[str, str]
    keys: Mapping[str, Mapping[str, str]]
    missing: Sequence[str]
    printed: Sequence[Mapping] | None = None
    fine: Mapping[str, object] = field(default_factory=dict)
