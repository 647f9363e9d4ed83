"""Reduced runs of held-out cases: their rollouts, whether to believe them, who goes on where not."""

from typing import TYPE_CHECKING

from nsf.deployment.handover import go_on, hand_over
from nsf.deployment.levels import FULL_ORDER, OPERATORS, PROJECTED, Levels
from nsf.deployment.rollout import (
    Rollout,
    continuation_file,
    rollout,
    rollout_file,
    rollouts,
)
from nsf.deployment.trust import Trust, calibrate
from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.deployment.prediction import deploy

__all__ = [
    "FULL_ORDER",
    "OPERATORS",
    "PROJECTED",
    "Levels",
    "Rollout",
    "Trust",
    "calibrate",
    "continuation_file",
    "deploy",
    "go_on",
    "hand_over",
    "rollout",
    "rollout_file",
    "rollouts",
]

# On demand, so that a live run does not wait for Lightning.
__getattr__ = on_first_use(__name__)
