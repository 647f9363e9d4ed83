"""Problems with published answers: `nsf validate` runs them at full order and tables both.

A problem is a scene, `conf/scene/NAME.yaml`, and a module of its name with `TITLE`, `LIMITS` (a sentence on
what keeps the answer off) and `answers(scene, finer, device)`, which gives an `Answer` for each published
quantity; `finer` is the scene with half the cell, or None.
"""

from nsf.validation.command import PROBLEMS, validate

__all__ = ["PROBLEMS", "validate"]
