"""Sample particles S: those whose new positions determine the latent vector (paper section 5.4)."""

from nsf.sampling.cells import CellSampler
from nsf.sampling.cubature import CubatureSampler
from nsf.sampling.qdeim import QdeimSampler
from nsf.sampling.sampler import RandomSampler, Sampler, SampleSpan, UnweightedSampler

__all__ = [
    "CellSampler",
    "CubatureSampler",
    "QdeimSampler",
    "RandomSampler",
    "SampleSpan",
    "Sampler",
    "UnweightedSampler",
]
