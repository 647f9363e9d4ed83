"""Every solver of a scene beside the others: the full-order one and each engine, by error and by time."""

import pandas as pd

from nsf.reporting.tables import Merged, mean_rows, rows_of, variant_labels, variants
from nsf.reporting.text.columns import SOLVER, device_type
from nsf.reporting.text.page import Table

_FULL = "full order"
_TIMES = ("step_ms", "total_ms", "shown_ms", "memory_mib")
_NOTE = (
    "Errors are means over held-out values, and the full-order run is what they are measured from. A run is "
    "all steps from t = 0. A reduced run ends with latent vectors: the last time is that of the run and of "
    "decoding the positions of all particles at every frame, which stay on the device."
)


def solvers(merged: Merged) -> pd.DataFrame:
    """A row a scene and solver, with errors (fractions), times [ms] and memory [MiB]; NaN where not measured.

    A variant stands once, with the means of its held-out values; the full-order solver once for each
    precision and type of device.
    """
    places: dict[tuple, list[dict]] = {}
    for members in variants(merged):
        row = mean_rows(merged, members)[0]  # held-out values come first
        places.setdefault((row["scene"], row["precision"], device_type(row["device"])), []).append(row)
    return pd.DataFrame([row for same in places.values() for row in _of_place(same)])


def _of_place(same: list[dict]) -> list[dict]:
    """The full-order solver, then the variants of one scene, precision and type of device."""
    head = {name: same[0][name] for name in ("scene", "precision", "device")}
    cost = pd.DataFrame(same)[["step_ms_full", "total_ms_full", "memory_full_mib"]].astype(float).median()
    full = head | {SOLVER: _FULL, "delta": 0.0, "displacement_error": 0.0, "stress_error": 0.0}
    full |= {"step_ms": cost["step_ms_full"], "total_ms": cost["total_ms_full"]}
    full |= {"shown_ms": cost["total_ms_full"], "memory_mib": cost["memory_full_mib"]}
    rows = [full] if cost.notna().any() else []
    for row, label in zip(same, variant_labels(same), strict=True):
        errors = {name: row[name] for name in ("delta", "displacement_error", "stress_error")}
        times = {"step_ms": row["step_ms_reduced"], "total_ms": row["total_ms_reduced"]}
        times |= {"shown_ms": row["total_ms_reduced"] + row["decode_ms"]}
        times |= {"memory_mib": row["memory_reduced_mib"]}
        rows.append(head | {SOLVER: label} | errors | times)
    return rows


def side_by_side(merged: Merged) -> list[Table]:
    """The table of `solvers`, without columns that say nothing; none where nothing was timed."""
    frame = solvers(merged)
    if frame[list(_TIMES)].isna().all(axis=None):
        return []
    alike = [name for name in ("scene", "precision", "device") if frame[name].nunique() == 1]
    empty = [name for name in _TIMES if frame[name].isna().all()]
    return [Table("Solvers side by side", rows_of(frame.drop(columns=[*alike, *empty])), _NOTE)]
