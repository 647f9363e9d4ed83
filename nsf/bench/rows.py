"""What a benchmark is asked for, and what it gives."""

from dataclasses import dataclass, field, fields

from nsf.runs.provenance import provenance


@dataclass(frozen=True)
class Settings:
    """What to measure.

    Attributes:
        particles: numbers of particles; empty for those that suit the benchmark and the device.
        precisions: `fp32`, `fp64` or both, measured turn by turn.
        device: `cpu` or `cuda:N`.
        trials: measurements of each side.
        scenes: of benchmarks of reduced steps; empty for all that these have.
    """

    particles: tuple[int, ...]
    precisions: tuple[str, ...]
    device: str
    trials: int
    scenes: tuple[str, ...] = ()


#: How sample particles are chosen in another case of a scene, beside the scene's own way.
OTHER_SAMPLER = {"cake": "region", "metal": "cells"}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One side of a benchmark: a row of results.csv.

    Attributes:
        bench, case: the benchmark, and what of it.
        particles, sample, integration: P, |S| and |N|; None where there is none.
        batch: simulations that are stepped together, or points (particles of frames) of a training step.
        precision, device: of the solver.
        ms_median, ms_p10, ms_p90: over the trials, of the mean time of a step in one [ms]; that of one
            simulation, so the step of a batch over its size.
        peak_mib: what every allocator holds at most beyond what was held before the solver was built [MiB];
            None where several processes work.
        delta: δ of the run that is timed, or begun for the time of its first steps, a fraction; None for a
            full-order run.
        commit: of the code.
        speed_up: how many times as fast as the full-order step of the same call.
        run_mib: of a run by operators, all that it holds but for the fields that decode a frame [MiB].
        decode_ms: time of the positions of all particles of one frame [ms].
        checked_ms: of a step by operators in runs that are checked as `nsf deploy` checks them [ms].
        teach_seconds, teacher_steps: of its operators' teaching.
    """

    bench: str
    case: str
    particles: int
    sample: int | None = None
    integration: int | None = None
    batch: int = 1
    precision: str
    device: str
    ms_median: float
    ms_p10: float
    ms_p90: float
    peak_mib: float | None
    delta: float | None = None
    commit: str
    speed_up: float | None = None
    run_mib: float | None = None
    decode_ms: float | None = None
    checked_ms: float | None = None
    teach_seconds: float | None = None
    teacher_steps: int | None = None


@dataclass(frozen=True)
class KernelRow:
    """One pass of a step: a row of kernels.csv.

    Attributes:
        bench, case, particles, precision, device, commit: as in `Row`.
        kernel: the pass, or how many launches of nothing.
        ms: median time [ms].
        mib: what it has to read and write, each value once [MiB].
        gb_per_s: their ratio [GB/s].
        floor_ms: the time that these bytes take a copy of this run; of empty launches their own [ms].
    """

    bench: str
    case: str
    particles: int
    precision: str
    device: str
    kernel: str
    ms: float
    mib: float
    gb_per_s: float
    floor_ms: float
    commit: str


@dataclass(frozen=True)
class StageRow:
    """One stage of a step, on a GPU within the captured one: a row of stages.csv.

    Attributes:
        bench, case, particles, precision, device, commit: as in `Row`.
        stage: of the step.
        ms: median time over steps spread through a run [ms].
    """

    bench: str
    case: str
    particles: int
    precision: str
    device: str
    stage: str
    ms: float
    commit: str


@dataclass(frozen=True)
class Result:
    """What a benchmark found."""

    rows: list[Row] = field(default_factory=list)
    kernels: list[KernelRow] = field(default_factory=list)
    stages: list[StageRow] = field(default_factory=list)


def columns(kind: type) -> list[str]:
    """Names of a row's columns, in order."""
    return [f.name for f in fields(kind)]


def commit() -> str:
    """The commit that runs, with a plus sign where files differ from it."""
    found = provenance()
    return str(found["commit"] or "unknown")[:12] + ("+" if found["dirty"] else "")


def size_name(particles: int) -> str:
    """`71k`, `200k`, `1m`; the number itself below 1000."""
    if particles >= 1_000_000 and particles % 100_000 == 0:
        return f"{particles / 1e6:g}m"
    return f"{particles / 1e3:.0f}k" if particles >= 1000 else f"{particles}"
