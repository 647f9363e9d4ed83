"""Reduced runs of held-out cases: their rollouts, whether to believe them, who goes on where not."""

from nsf.deployment.handover import go_on, hand_over
from nsf.deployment.levels import FULL_ORDER, OPERATORS, PROJECTED, Levels
from nsf.deployment.rollout import (
    Rollout,
    continuation_file,
    deploy,
    rollout,
    rollout_file,
    rollouts,
)
from nsf.deployment.trust import Trust, calibrate

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
