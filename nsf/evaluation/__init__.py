"""Errors and costs of reduced runs (paper section 6 and appendix "Runtime analysis")."""

from nsf.evaluation.compare import Comparison, at_frames, compare
from nsf.evaluation.cost import SolverCost, Subject, decoding_ms, measure
from nsf.evaluation.metrics import deformation_error, displacement_error, reduction_ratio, stress_error
from nsf.evaluation.superresolution import SuperResolution, query, superresolve

__all__ = [
    "Comparison",
    "SolverCost",
    "Subject",
    "SuperResolution",
    "at_frames",
    "compare",
    "decoding_ms",
    "deformation_error",
    "displacement_error",
    "measure",
    "query",
    "reduction_ratio",
    "stress_error",
    "superresolve",
]
