"""Reduced-order dynamics: the reference that every engine is held to (paper section 5)."""

from nsf.dynamics.batch import Batch
from nsf.dynamics.inference import Decoder
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.latent import (
    STOP_REASONS,
    LatentState,
    LatentTrajectory,
    ProjectionResult,
    stop_reasons,
)
from nsf.dynamics.projection import GaussNewton, Taylor
from nsf.dynamics.setup import Setup
from nsf.dynamics.solver import ReducedBatch, ReducedMPM
from nsf.dynamics.sources import Sources

__all__ = [
    "STOP_REASONS",
    "Batch",
    "Decoder",
    "GaussNewton",
    "Integration",
    "LatentState",
    "LatentTrajectory",
    "NeighbourSearch",
    "ParticleSets",
    "ProjectionResult",
    "ReducedBatch",
    "ReducedMPM",
    "Setup",
    "Sources",
    "Taylor",
    "stop_reasons",
]
