"""What a report of an experiment is about."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


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
    fine: Mapping[str, object] = dataclasses.field(default_factory=dict)
