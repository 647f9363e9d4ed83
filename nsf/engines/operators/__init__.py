"""A reduced run as a recurrence of the latent vector, learned from the projected step (docs/method.md).

Names are imported on first use: what is asked of a teacher can be checked without torch.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.engines.operators.engine import Operators
    from nsf.engines.operators.lessons import Yardstick
    from nsf.engines.operators.model import Sizes, StepOperators
    from nsf.engines.operators.states import collider_states, mirrored_states, principal
    from nsf.engines.operators.taught import Taught
    from nsf.engines.operators.teach import Course
    from nsf.engines.operators.teacher import Mirrored, Recorded, Teacher
    from nsf.engines.operators.teaching import Teaching, random_cases

__all__ = [
    "Course",
    "Mirrored",
    "Operators",
    "Recorded",
    "Sizes",
    "StepOperators",
    "Taught",
    "Teacher",
    "Teaching",
    "Yardstick",
    "collider_states",
    "mirrored_states",
    "principal",
    "random_cases",
]

__getattr__ = on_first_use(__name__)
