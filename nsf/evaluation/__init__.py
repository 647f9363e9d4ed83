"""Errors and costs of reduced runs (paper section 6 and appendix "Runtime analysis")."""

from nsf.evaluation.compare import Comparison, at_frames, compare
from nsf.evaluation.cost import SolverCost, Subject, decoding_ms, measure
from nsf.evaluation.metrics import deformation_error, displacement_error, stress_error
from nsf.evaluation.rivals import Rivals, coarse_subjects, rivals
from nsf.evaluation.superresolution import SuperResolution, query, superresolve

__all__ = [
    "Comparison",
    "Rivals",
    "SolverCost",
    "Subject",
    "SuperResolution",
    "at_frames",
    "coarse_subjects",
    "compare",
    "decoding_ms",
    "deformation_error",
    "displacement_error",
    "measure",
    "query",
    "rivals",
    "stress_error",
    "superresolve",
]
