"""Reduced runs of held-out cases: records, a bound of their errors, and whether to believe them."""

from typing import TYPE_CHECKING

from nsf.deployment.bound import AMBER, FLAGS, GREEN, RED, UNKNOWN, Calibration
from nsf.deployment.reach import Band, Reach, Usual
from nsf.deployment.rollout import FULL_ORDER, PROJECTED, Rollout, continuation_file, rollout_file
from nsf.deployment.trust import TRUST, Trust, Verdict
from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.deployment.running import deploy, rollouts

__all__ = [
    "AMBER",
    "FLAGS",
    "FULL_ORDER",
    "GREEN",
    "PROJECTED",
    "RED",
    "TRUST",
    "UNKNOWN",
    "Band",
    "Calibration",
    "Reach",
    "Rollout",
    "Trust",
    "Usual",
    "Verdict",
    "continuation_file",
    "deploy",
    "rollout_file",
    "rollouts",
]

# On demand, so that a live run does not wait for Lightning.
__getattr__ = on_first_use(__name__)
