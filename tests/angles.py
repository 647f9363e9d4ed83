"""Cases of the sand column, whose one problem parameter is its friction angle."""

from nsf.data import Case
from nsf.deployment import Fallback, rollouts


def angle(value: float) -> Case:
    """The case of a friction angle [°]."""
    return Case(("friction_angle",), (value,), ("°",))


class AnyCase:
    """In the place of a `CaseDistance`: every case is a training case, so that the steps alone tell."""

    def of(self, case):
        return 0.0


def rollout(solver, case, trust, to="none"):
    """The rollout of one reduced solver."""
    return rollouts(solver.together, [case], trust, Fallback(to))[0]
