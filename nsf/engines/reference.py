"""The engine that computes a step as section 5 says it: fields by torch, the grid by Warp."""

from collections.abc import Sequence
from typing import ClassVar

from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.history import HistoryStep
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import Span
from nsf.dynamics.step import SearchingStep, Step
from nsf.engines.base import Engine


class Reference(Engine):
    """Any field, projector and integration, one run at a time (`nsf.dynamics.step`)."""

    name: ClassVar[str] = "reference"

    @override
    def refusal(self, setups: Sequence[Setup]) -> str:
        if len(setups) > 1:
            return f"it evaluates fields for one run at a time, not {len(setups)}: set deploy.batch=1"
        if setups[0].sources.carried and len(setups[0].samples) > 1:
            return "stress=particles takes one sample in a run: set sampler.phases=[]"
        return ""

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        setup = batch.shared
        kind = SearchingStep if setup.integration.strategy == "search" else Step
        kind = HistoryStep if setup.sources.carried else kind
        return [kind(batch, sample, sets) for sample, sets in zip(setup.samples, setup.sets, strict=True)]
