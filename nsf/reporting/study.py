"""What a report of an experiment is about."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


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
