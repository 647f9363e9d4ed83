"""From a scene and its fields to a reduced solver at t = 0."""

from collections.abc import Mapping, Sequence

import numpy as np

from nsf.dynamics import ParticleSets, ReducedBatch, ReducedMPM, Setup
from nsf.dynamics.interop import torch_device
from nsf.engines.base import Engine
from nsf.engines.choice import choose
from nsf.errors import ConfigError, ShapeError
from nsf.mpm.device import warp_device
from nsf.sampling.sampler import RandomSampler, Sampler, SampleSpan, check_well_posed

#: Sample particles of a solver that is built without a number.
SAMPLE = 150
#: What `sample=` may be: particle indices, their number, a sampler, or the `samples` of an earlier solver.
Sample = int | Sequence[int] | Sampler | Sequence[SampleSpan] | None


def reduced(
    scene,
    manifold,
    parameters: Mapping[str, float] | None = None,
    sample: Sample = None,
    engine: str | Engine = "auto",
    **options,
) -> ReducedMPM:
    """The reduced solver of a scene, at t = 0.

    Args:
        scene: an `nsf.scenes.Scene`.
        manifold: trained fields.
        parameters: `{name: value}`; those left out are as configured.
        sample: particle indices, a number (drawn at random), a `Sampler`, the `samples` of an earlier
            solver, or None for `SAMPLE` of them.
        engine: how steps are computed: `auto`, the fastest engine that can; `reference`, `modal`, a taught
            recurrence (`RecurrenceEngine.load`), or an engine of the user.
        **options: further arguments of `nsf.dynamics.Setup`.

    Raises:
        ConfigError: the engine cannot take the steps; and see `nsf.dynamics.Setup`.
    """
    return _together([_setup(scene, manifold, parameters, sample, engine, options)], engine).runs[0]


def reduced_batch(
    scene,
    manifold,
    parameters: Sequence[Mapping[str, float]],
    sample: Sample = None,
    engine: str | Engine = "auto",
    xhat: Sequence | None = None,
    velocity: Sequence | None = None,
    **options,
) -> ReducedBatch:
    """Reduced runs of one scene that take their steps together, at t = 0.

    Args:
        scene, manifold, sample, engine, options: as for `reduced`.
        parameters: `{name: value}` of each run.
        xhat, velocity: [B, r] and [B, P, 3], as for `nsf.dynamics.Setup`; None in place of one for its
            default.

    Raises:
        ConfigError: no parameters, or another number of xhat or velocity; and as for `reduced`.
    """
    starts: list[dict] = [{} for _ in parameters]
    for name, values in (("xhat", xhat), ("velocity", velocity)):
        if values is not None and len(values) != len(starts):
            raise ConfigError(f"{name} is given for {len(values)} of {len(starts)} runs")
        for start, value in zip(starts, values or (), strict=False):
            start[name] = value
    setups: list[Setup] = []
    for values, start in zip(parameters, starts, strict=True):
        if setups:  # the sample and the sets depend on the manifold alone
            sample, options = setups[0].samples, options | {"sets": setups[0].sets}
        setups.append(_setup(scene, manifold, values, sample, engine, options | start))
    return _together(setups, engine)


def _together(setups: Sequence[Setup], name: str | Engine) -> ReducedBatch:
    engine, why = choose(name, setups)
    return ReducedBatch(setups, engine, why)


def _setup(scene, manifold, parameters, sample: Sample, engine: str | Engine, options: dict) -> Setup:
    """The setup of one run of a scene."""
    parameters = scene.case(parameters or {})
    scene = scene.at(parameters)
    if sample is None:
        sample = getattr(engine, "samples", None) or min(SAMPLE, len(manifold.X))
    if isinstance(sample, int | np.integer):
        check_well_posed(int(sample), manifold.latent_dim)
        sample = RandomSampler(size=int(sample))
    if isinstance(sample, Sampler):
        samples = _sampled(scene, manifold, sample, engine, options)
    elif len(sample) and isinstance(sample[0], SampleSpan):
        samples = list(sample)
    else:
        samples = [SampleSpan(0.0, _indices(sample, len(manifold.X)))]
    if not moves_particles(engine) and not options.get("sets"):  # nothing is moved but the latent vector
        options = options | {"sets": [ParticleSets(s.particles, s.particles, None) for s in samples]}
    return Setup(manifold, scene, samples, parameters, **options)


def _sampled(scene, manifold, sampler: Sampler, engine: str | Engine, options: dict) -> list[SampleSpan]:
    """The sample of a sampler; one that learns from steps gets solvers whose sample is every particle."""
    if not moves_particles(engine):
        engine = "auto"
    everyone = np.arange(len(manifold.X))
    options_of_all = {"sample": everyone, "sets": [ParticleSets(everyone, everyone, None)], "engine": engine}
    options_of_all |= {k: options[k] for k in ("sources", "precision", "device") if k in options}
    device = torch_device(warp_device(options.get("device", "auto")))
    return sampler.spans_of(
        manifold, device, lambda parameters: reduced(scene, manifold, parameters, **options_of_all)
    )


def moves_particles(engine: str | Engine) -> bool:
    """Whether the steps of an engine move particles, and not latent vectors alone."""
    return isinstance(engine, str) or engine.moves_particles


def _indices(sample, particles: int) -> np.ndarray:
    sample = np.asarray(sample)
    if sample.ndim != 1 or not np.issubdtype(sample.dtype, np.integer) or not len(sample):
        raise ShapeError(
            "sample must be a number or a non-empty list of particle indices; "
            f"got {sample.dtype} {sample.shape}; give np.flatnonzero(mask) for a mask"
        )
    sample = np.unique(sample)
    if sample[0] < 0 or sample[-1] >= particles:
        raise ShapeError(f"sample indices {sample[0]} … {sample[-1]} must lie in [0, {particles})")
    return sample
