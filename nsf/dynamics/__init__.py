"""Reduced-order dynamics: latent time-stepping (paper section 5)."""

from nsf.dynamics.batch import ReducedBatch
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.latent import Decoder, LatentState, LatentTrajectory
from nsf.dynamics.projection import STOP_REASONS, GaussNewton, ProjectionResult, Taylor, stop_reasons
from nsf.dynamics.solver import NSF, ReducedMPM, ReducedRun
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
    "ReducedBatch",
    "ReducedMPM",
    "ReducedRun",
    "Taylor",
    "stop_reasons",
]
