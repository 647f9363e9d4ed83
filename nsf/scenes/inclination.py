"""A scene in the frame of an inclined plane."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.scalars import number
from nsf.vectors import direction, rotation


@dataclass(frozen=True)
class Inclination:
    """The scene is in the frame of a plane that is inclined by `angle` about `axis`, against the clock.

    Gravity and initial velocities are stated upright, and turned into that frame. So the grid and the solids
    stay as they are: a plane across the grid would be a stair, whose steps jump as its angle changes.

    Attributes:
        angle: [°], right-handed.
        axis: [3] about which gravity and velocities are turned, any length.

    Raises:
        ConfigError: the angle is no finite number, or the axis has no direction.
    """

    angle: float
    axis: Sequence[float] = (0.0, -1.0, 0.0)

    def __post_init__(self):
        number("scene.inclination.angle", self.angle)
        direction("scene.inclination.axis", self.axis)

    def turned(self, upright: Sequence[float]) -> tuple[float, float, float]:
        """[3] of a vector that is stated upright."""
        turn = rotation(direction("scene.inclination.axis", self.axis), self.angle)
        return tuple((turn @ np.asarray(upright, float)).tolist())
