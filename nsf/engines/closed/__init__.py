"""Projected steps with a closure: what they lack of full-order runs, learned (docs/method.md).

Names are imported on first use: how a closure is fitted can be checked without torch.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.engines.closed.closing import Closing
    from nsf.engines.closed.engine import Closed
    from nsf.engines.closed.fit import Fit
    from nsf.engines.closed.linear import Linearised

__all__ = ["Closed", "Closing", "Fit", "Linearised"]

__getattr__ = on_first_use(__name__)
