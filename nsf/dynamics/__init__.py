"""Reduced-order dynamics: latent time-stepping (paper section 5)."""

from nsf.dynamics.batch import ReducedBatch
from nsf.dynamics.cells import CellSampler
from nsf.dynamics.cubature import CubatureSampler
from nsf.dynamics.deployment import (
    Rollout,
    calibrate,
    continuation_file,
    deploy,
    rollout,
    rollout_file,
    rollouts,
)
from nsf.dynamics.handover import go_on, hand_over
from nsf.dynamics.integration import Integration, NeighbourSearch, ParticleSets
from nsf.dynamics.latent import Decoder, LatentState, LatentTrajectory
from nsf.dynamics.projection import STOP_REASONS, GaussNewton, ProjectionResult, Taylor, stop_reasons
from nsf.dynamics.qdeim import QdeimSampler
from nsf.dynamics.sampling import GreedySampler, RandomSampler, SamplePhase, Sampler, UnweightedSampler
from nsf.dynamics.solver import NSF, ReducedMPM, ReducedRun
from nsf.dynamics.stress import Method
from nsf.dynamics.trust import Trust

__all__ = [
    "NSF",
    "STOP_REASONS",
    "CellSampler",
    "CubatureSampler",
    "Decoder",
    "GaussNewton",
    "GreedySampler",
    "Integration",
    "LatentState",
    "LatentTrajectory",
    "Method",
    "NeighbourSearch",
    "ParticleSets",
    "ProjectionResult",
    "QdeimSampler",
    "RandomSampler",
    "ReducedBatch",
    "ReducedMPM",
    "ReducedRun",
    "Rollout",
    "SamplePhase",
    "Sampler",
    "Taylor",
    "Trust",
    "UnweightedSampler",
    "calibrate",
    "continuation_file",
    "deploy",
    "go_on",
    "hand_over",
    "rollout",
    "rollout_file",
    "rollouts",
    "stop_reasons",
]
