"""Reduced runs of held-out cases: records, an estimate of trust, and who goes on where it is lost."""

from typing import TYPE_CHECKING

from nsf.deployment.fallback import Fallback, go_on, hand_over
from nsf.deployment.rollout import (
    FULL_ORDER,
    LATENT_MODEL,
    PROJECTED,
    Rollout,
    continuation_file,
    rollout_file,
)
from nsf.deployment.trust import Trust, calibrate
from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.deployment.running import deploy, rollouts

__all__ = [
    "FULL_ORDER",
    "LATENT_MODEL",
    "PROJECTED",
    "Fallback",
    "Rollout",
    "Trust",
    "calibrate",
    "continuation_file",
    "deploy",
    "go_on",
    "hand_over",
    "rollout_file",
    "rollouts",
]

# On demand, so that a live run does not wait for Lightning.
__getattr__ = on_first_use(__name__)
