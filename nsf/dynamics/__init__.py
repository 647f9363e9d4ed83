"""Reduced-order dynamics: the reference that every engine is held to (paper section 5)."""

from nsf.dynamics.batch import Batch
from nsf.dynamics.inference import Decoder
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.latent import LatentState, LatentTrajectory
from nsf.dynamics.methods import History, Method
from nsf.dynamics.projection import STOP_REASONS, GaussNewton, ProjectionResult, Taylor, stop_reasons
from nsf.dynamics.setup import NSF, Setup
from nsf.dynamics.solver import ReducedBatch, ReducedMPM

__all__ = [
    "NSF",
    "STOP_REASONS",
    "Batch",
    "Decoder",
    "GaussNewton",
    "History",
    "Integration",
    "LatentState",
    "LatentTrajectory",
    "Method",
    "NeighbourSearch",
    "ParticleSets",
    "ProjectionResult",
    "ReducedBatch",
    "ReducedMPM",
    "Setup",
    "Taylor",
    "stop_reasons",
]
