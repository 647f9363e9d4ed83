"""The engine of projected steps with a closure, and what it refuses."""

from collections.abc import Sequence
from typing import ClassVar

from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.setup import Setup, first_changes
from nsf.dynamics.span import Span
from nsf.engines.choice import choose
from nsf.engines.closed.closure import Closure
from nsf.engines.operators.engine import Operators
from nsf.errors import ConfigError


class Closed(Operators):
    """The projected step of the fastest engine that can, plus a learned correction, the closure.

    x̂_{n+1} = x̂_n + P(x̂_n, d_n) + c(x̂_n, d_n, μ, g_n): P projects; c, the closure, is affine in d and in
    gravity as operators are, and was fitted for one manifold, scene, sample and Δt.
    """

    name: ClassVar[str] = "closed"

    @override
    def refusal(self, setups: Sequence[Setup]) -> str:
        try:
            choose("auto", setups)
        except ConfigError as error:
            return str(error)
        return super().refusal(setups)

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        engine, _ = choose("auto", batch.setups)
        spans = engine.spans(batch)
        first = first_changes(spans[0].at_sample, spans[0].sets.sample, batch.setups)
        closure = Closure(self.model, batch, first)
        for span in spans:
            span.closure = closure
        return spans
