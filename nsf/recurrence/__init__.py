"""A recurrence of the latent state of shape and stress, taught by streamed full-order runs (docs/method.md).

Names are imported on first use: sizes and keys can be checked without torch.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.recurrence.descent import Runs, Yardstick, fit
    from nsf.recurrence.engine import RecurrenceEngine, first_change
    from nsf.recurrence.fitting import Fitting, check_stride
    from nsf.recurrence.form import Form, Sizes, State
    from nsf.recurrence.loop import Loop
    from nsf.recurrence.scales import standardised
    from nsf.recurrence.solids import collider_states, principal
    from nsf.recurrence.stream import Encoded, Encoder, encoded_trajectory, streamed
    from nsf.recurrence.taught import Taught

__all__ = [
    "Encoded",
    "Encoder",
    "Fitting",
    "Form",
    "Loop",
    "RecurrenceEngine",
    "Runs",
    "Sizes",
    "State",
    "Taught",
    "Yardstick",
    "check_stride",
    "collider_states",
    "encoded_trajectory",
    "first_change",
    "fit",
    "principal",
    "standardised",
    "streamed",
]

__getattr__ = on_first_use(__name__)
