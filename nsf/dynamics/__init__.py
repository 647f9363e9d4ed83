"""Reduced-order dynamics: latent time-stepping (paper section 5)."""

from nsf.dynamics.deployment import Rollout, deploy, rollout
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.latent import Decoder, LatentState, LatentTrajectory
from nsf.dynamics.projection import STOP_REASONS, GaussNewton, ProjectionResult, Taylor, stop_reasons
from nsf.dynamics.sampling import SamplePhase, Sampler
from nsf.dynamics.solver import NSF, ReducedMPM
from nsf.dynamics.stress import Method

__all__ = [
    "NSF",
    "STOP_REASONS",
    "Decoder",
    "GaussNewton",
    "Integration",
    "LatentState",
    "LatentTrajectory",
    "Method",
    "NeighbourSearch",
    "ParticleSets",
    "ProjectionResult",
    "ReducedMPM",
    "Rollout",
    "SamplePhase",
    "Sampler",
    "Taylor",
    "deploy",
    "rollout",
    "stop_reasons",
]
