"""Cases of the sand column, whose one problem parameter is its friction angle."""

from nsf.data import Case
from nsf.deployment import rollouts


def angle(value: float) -> Case:
    """The case of a friction angle [°]."""
    return Case(("friction_angle",), (value,), ("°",))


def rollout(solver, case, trust):
    """The rollout of one reduced solver."""
    return rollouts(solver.together, [case], trust)[0]
