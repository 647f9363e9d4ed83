"""Table of how far each reduced run went from its training data, beside its true error."""

import math

import pandas as pd

from nsf.reporting.columns import COLUMN
from nsf.reporting.tables import Merged, variant_labels

RENAMED = {
    "method": "variant",
    "trust": "distrust ratio",
    "distrusted_at": "first distrusted [s]",
    "handed_over_at": "full order from [s]",
}
_FEWEST = 3  # rows of which a rank correlation says anything


def trust_rows(merged: Merged) -> pd.DataFrame:
    """Parameter, ratio, times [s] and true δ of each row of `merged` whose run tells them."""
    rows = []
    for i, label in enumerate(variant_labels(merged.frame.to_dict("records"))):
        row, told = merged.frame.iloc[i], merged.source[i].trust(merged.frame["parameter"].iloc[i])
        if told is None:
            continue
        ratio = math.inf if told["trust"] is None else told["trust"]
        times = {name: _or_nan(told[name]) for name in ("distrusted_at", "handed_over_at")}
        known = {name: row[name] for name in ("parameter", "split")}
        rows.append({"method": label, **known, "trust": ratio, **times, "delta": row["delta"]})
    frame = pd.DataFrame(rows)
    same = len(frame) and frame["method"].nunique() == 1
    return frame.drop(columns="method") if same else frame


def trust_note(rows: pd.DataFrame) -> str:
    """What the ratio is, and how its ranks agree with those of δ."""
    said = (
        "The distrust ratio is the largest of a run's steps: how far it went from the training data, by the "
        "residual of its projections or by its latent vector, where 1 is as far as training data are from "
        "themselves. It needs no full-order run; a ratio above 1 says not to believe what follows."
    )
    # The rest of a run that was handed over is the full-order solver's, and so is its error.
    reduced = rows[rows["handed_over_at"].isna()]
    if len(reduced) < _FEWEST:
        return said
    agreement = spearman(reduced["trust"], reduced["delta"])
    return (
        f"{said} Over the {len(reduced)} reduced runs of this table its Spearman rank correlation with the "
        f"true {COLUMN['delta'].title} is {agreement:.2f}."
    )


def spearman(a: pd.Series, b: pd.Series) -> float:
    """Spearman's rank correlation: the correlation of ranks, in which ∞ is a value like any other."""
    return float(a.rank().corr(b.rank()))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
