"""A reduced run as a recurrence of the latent vector, learned from the projected step (docs/method.md)."""

from nsf.engines.operators.engine import Operators
from nsf.engines.operators.lessons import Teaching, Yardstick, random_cases
from nsf.engines.operators.model import Sizes, StepOperators, Terms
from nsf.engines.operators.states import collider_states, principal
from nsf.engines.operators.taught import Taught
from nsf.engines.operators.teach import Course
from nsf.engines.operators.teacher import Teacher

__all__ = [
    "Course",
    "Operators",
    "Sizes",
    "StepOperators",
    "Taught",
    "Teacher",
    "Teaching",
    "Terms",
    "Yardstick",
    "collider_states",
    "principal",
    "random_cases",
]
