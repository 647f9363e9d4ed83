"""The files of an evaluate run: one place that knows what reporting reads (docs/design.md)."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf

from nsf.data import Case
from nsf.deployment import FULL_ORDER, Rollout
from nsf.evaluation import Comparison, Rivals, SolverCost, SuperResolution
from nsf.evaluation.surroundings import surroundings
from nsf.models import describe
from nsf.quantities import QUANTITIES
from nsf.results.columns import EVALUATED
from nsf.runs import Record
from nsf.runs.provenance import provenance
from nsf.scenes import Scene
from nsf.storage import write_json, writing

_OF_STEPS = ("step_ms", "step_ms_p10", "step_ms_p90", "total_ms", "memory_mib")
#: Columns of which the mean over cases is a metric of the run.
_METRICS = (
    *("delta", "displacement_error", "stress_error", "error_bound", "step_ms_full", "step_ms"),
    *("total_ms_full", "total_ms", "decode_ms", "memory_full_mib", "memory_mib"),
)


def costs(measured: Mapping[str, SolverCost], decode_ms: float) -> dict:
    """Content of `cost.json`: the cost of each solver by name; without a solver, that nothing was measured.

    `decode_ms` is the time that decoding all frames of a reduced run takes [ms].
    """
    if not measured:
        return {"trials": 0}
    breakdown = {name: measured[name].stages for name in ("reduced", "full_order")}
    solvers = {name: asdict(cost) for name, cost in measured.items()}
    trials = measured["reduced"].trials
    return {"trials": trials, "decode_ms": decode_ms, "breakdown": breakdown, **solvers}


def rows(
    pipeline,
    manifold,
    rollouts: Sequence[Rollout],
    comparisons: Sequence[Comparison],
    rivals: Sequence[Rivals],
    measured: Mapping[str, SolverCost],
    decode_ms: float,
) -> pd.DataFrame:
    """Content of `results.csv`, a row a case with the columns `EVALUATED`; ∞ where a run diverged.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`; manifold: its fields.
        rollouts, comparisons, rivals: of each case.
        measured, decode_ms: as for `costs`. A run costs what the steps of the model that took it cost.
    """
    config, device, origin = pipeline.config, pipeline.device, provenance()
    training = pipeline.training.metric("training_seconds")
    teaching = pipeline.taught.metric("teach_seconds") if pipeline.model.learns else 0.0
    shared = describe(config, pipeline.model.name) | {
        "scene": config.scene.name,
        "material": _material(config),
        "field": manifold.field,
        "r": manifold.latent_dim,
        "particles": len(manifold.X),
        "seed": int(config.seed),
        "split": config.deploy.split,
        "train_seconds": training if measured else math.nan,
        "teach_seconds": teaching,
        "precision": config.precision,
        "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu",
        "commit": str(origin["commit"] or "unknown")[:12] + ("-dirty" if origin["dirty"] else ""),
    }
    content = []
    for rollout, comparison, rival in zip(rollouts, comparisons, rivals, strict=True):
        numbers = list(rollout.case.values())
        of_case = {
            "case": rollout.case.named,
            "value": numbers[0] if len(numbers) == 1 else math.nan,
            "sample": rollout.sample,
            "integration": rollout.integration_mean,
            "delta": comparison.delta,
            "displacement_error": comparison.displacement_error,
            "stress_error": comparison.stress_error,
            "distance": comparison.distance,
            "distance_max": comparison.distance_max,
            "fallback_share": float(bool(rollout.by)),
            "error_bound": rollout.verdict.bound_share,
            "flag": rollout.verdict.flag,
            "flag_reason": rollout.verdict.reason,
        }
        off = {f"{name}_error": comparison.quantities.get(name, math.nan) for name in QUANTITIES}
        times = _times(measured, decode_ms, rollout, next(iter(rival.coarse), 0), training + teaching)
        content.append(shared | of_case | _beside(rival) | times | off)
    return pd.DataFrame(content).reindex(columns=list(EVALUATED))


def _material(config: DictConfig) -> str:
    """The name of the law, as `von_mises`."""
    name = str(config.material.get("_target_", "")).rpartition(".")[2]
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def _beside(rivals: Rivals) -> dict[str, float]:
    """Columns of `results.csv`; the coarse run is that of the first factor, NaN where there is none."""
    first = next(iter(rivals.coarse.values()), {})
    return {
        "displacement_static": rivals.static,
        "displacement_nearest": rivals.nearest,
        "displacement_interpolated": rivals.interpolated,
        "displacement_coarse": first.get("displacement_error", math.nan),
    }


def _times(
    measured: Mapping[str, SolverCost], decode_ms: float, rollout: Rollout, factor: int, seconds: float
) -> dict[str, float]:
    """Columns of costs of a run; those that were not measured are left out.

    A step whose particles have left the grid costs no one's speedup, nor does a full-order run.

    Args:
        measured, decode_ms: as for `costs`.
        rollout: the run; factor: of Δx of the coarse run.
        seconds: spent beforehand, for the runs after which it has paid: ∞ where a reduced run saves no time.
    """
    if not measured:
        return {}
    full, coarse = measured["full_order"], measured.get(f"coarse_{factor}")
    times = {"step_ms_full": full.step_ms, "total_ms_full": full.total_ms, "memory_full_mib": full.memory_mib}
    if coarse:
        times |= {"step_ms_coarse": coarse.step_ms, "total_ms_coarse": coarse.total_ms}
    if rollout.diverged >= 0 or rollout.by == FULL_ORDER:
        return times
    reduced = measured.get(rollout.by, measured["reduced"])
    saved = 1e-3 * (full.total_ms - reduced.total_ms)
    times |= {"decode_ms": decode_ms, "break_even_runs": seconds / saved if saved > 0.0 else math.inf}
    return times | {name: getattr(reduced, name) for name in _OF_STEPS}


def summarise(
    config: DictConfig,
    comparisons: Sequence[Comparison],
    rivals: Sequence[Rivals],
    rollouts: Sequence[Rollout],
) -> dict:
    """Content of `summary.json`: what `results.csv` has no column for."""
    names = ("reconstruction_delta", "reconstruction_stress_error")
    cases = [rollout.case.named for rollout in rollouts]
    return {
        "title": config.scene.title,
        "scale": config.scale,
        "changes": OmegaConf.to_container(config.deploy).get("changes") or {},
        **{name: float(np.mean([getattr(one, name) for one in comparisons])) for name in names},
        "rivals": [{"case": case} | asdict(rival) for case, rival in zip(cases, rivals, strict=True)],
        "paper": OmegaConf.to_container(config.scene).get("paper"),
    }


def write(
    record: Record, results: pd.DataFrame, comparisons: Sequence[Comparison], cost: dict, summary: dict
) -> None:
    """Write the five files of an evaluate run into its folder."""
    path = record.path
    tables = {"results.csv": results, "series.csv": pd.concat([c.series for c in comparisons])}
    for name, table in tables.items():
        with writing(path / name) as partial:
            table.to_csv(partial, index=False)
    pictures = [c.pictures for c in comparisons]
    with writing(path / "frames.npz") as partial:
        np.savez_compressed(
            partial,
            cases=results["case"].to_numpy(dtype=str),
            t=pictures[0]["t"],
            **{name: np.stack([p[name] for p in pictures]) for name in pictures[0] if name != "t"},
        )
    write_json(path / "cost.json", cost)
    write_json(path / "summary.json", summary)
    for name in (*tables, "frames.npz", "cost.json", "summary.json"):
        record.output(name)
    record.metrics["reconstruction_delta"] = summary["reconstruction_delta"]
    averages = results[list(_METRICS)].mean(skipna=False)
    record.metrics.update(averages[np.isfinite(averages)].to_dict())
    record.metrics["diverged"] = results.loc[np.isinf(results["delta"]), "case"].tolist()


def write_superresolution(
    record: Record, scene: Scene, cases: Sequence[Case], fine: Sequence[SuperResolution]
) -> pd.DataFrame:
    """Write `superresolution.csv` and `superresolution.png` into a run's folder; gives the table."""
    from nsf.bodies.colors import STRESS_COLORS
    from nsf.results.pictures import fine_shapes
    from nsf.results.style import PIXELS, write_png

    table = pd.DataFrame([f.row for f in fine])
    with writing(record.path / "superresolution.csv") as partial:
        table.to_csv(partial, index=False)
    end = np.array([scene.dt * scene.steps])
    around = [surroundings(scene.at(case), end) for case in cases]
    picture = fine_shapes(fine, around)
    with writing(record.path / "superresolution.png") as partial:
        write_png(picture, partial, PIXELS, [STRESS_COLORS])
    for name in ("superresolution.csv", "superresolution.png"):
        record.output(name)
    record.metrics.update(table.drop(columns="case").mean().to_dict())
    return table
