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
from nsf.deployment import FULL_ORDER, PROJECTED, Rollout, Verdict
from nsf.evaluation import Comparison, Rivals, SolverCost, SuperResolution
from nsf.evaluation.quantities import QUANTITIES
from nsf.evaluation.surroundings import surroundings
from nsf.models import describe
from nsf.results.columns import EVALUATED
from nsf.runs import Record
from nsf.scenes import Scene
from nsf.storage import write_json, writing

_COARSE = "coarse_"
_OF_WHOLE_RUNS = (
    *("step_ms", "step_ms_p10", "step_ms_p90", "total_ms", "decode_ms", "memory_mib", "break_even_runs"),
)
#: Columns of which the mean over cases is a metric of the run.
_METRICS = (
    *("displacement_error", "stress_error", "error_bound", "step_ms_full", "step_ms", "total_ms_full"),
    *("total_ms", "decode_ms", "memory_full_mib", "memory_mib"),
)


def costs(measured: Mapping[str, SolverCost], decode_ms: float = math.nan) -> dict:
    """Content of `cost.json`, by solver; without a solver, that nothing was measured.

    `decode_ms` is the time that decoding all frames of a reduced run takes [ms].
    """
    if not measured:
        return {"trials": 0}
    full, reduced = measured["full_order"], measured["reduced"]
    return {
        "full_order": full.as_dict(),
        "reduced": reduced.as_dict(),
        **{name: measured[name].as_dict() for name in ("projected",) if name in measured},
        "coarse": {
            name.removeprefix(_COARSE): solver.as_dict()
            for name, solver in measured.items()
            if name.startswith(_COARSE)
        },
        "breakdown": {"reduced": reduced.stages, "full_order": full.stages},
        "trials": full.trials,
        "memory_full_mib": full.memory_mib,
        "memory_reduced_mib": reduced.memory_mib,
        "step_ms_full": full.step_ms,
        "step_ms_reduced": reduced.step_ms,
        "decode_ms": decode_ms,
    }


def rows(
    config: DictConfig,
    manifold,
    rollouts: Sequence[Rollout],
    comparisons: Sequence[Comparison],
    rivals: Sequence[Rivals],
    cost: dict,
    device: str,
    manifest: dict,
    model: str = "",
    offline: tuple[float, float] = (math.nan, 0.0),
) -> pd.DataFrame:
    """Content of `results.csv`, a row a case with the columns `EVALUATED`; ∞ where a run diverged.

    Args:
        config: of the whole chain, resolved.
        manifold: the fields.
        rollouts, comparisons, rivals: of each case.
        cost: content of `cost.json`. A run costs what its steps cost, those of the model and of its fallback.
        device, manifest: where, and from what code, the rows are made.
        model: that took the steps, where `model=auto` chose it.
        offline: times of training and of teaching [s].
    """
    commit = str(manifest.get("commit") or "unknown")[:12] + ("-dirty" if manifest.get("dirty") else "")
    shared = describe(config, model) | {
        "scene": config.scene.name,
        "material": _material(config),
        "field": manifold.field,
        "r": manifold.latent_dim,
        "particles": len(manifold.X),
        "seed": int(config.seed),
        "split": config.deploy.split,
        "train_seconds": offline[0] if cost.get("trials") else math.nan,
        "teach_seconds": offline[1],
        "precision": config.precision,
        "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu",
        "commit": commit,
    }
    content = []
    for rollout, comparison, rival in zip(rollouts, comparisons, rivals, strict=True):
        as_run = _cost_by(cost, rollout.by)
        times = _costs_in_a_row(as_run, next(iter(rivals[0].coarse), None))
        times |= {"break_even_runs": _break_even(as_run, sum(offline))}
        if rollout.diverged >= 0 or rollout.by == FULL_ORDER:
            # A step whose particles have left the grid costs no one's speedup, nor does a full-order run.
            times |= dict.fromkeys(_OF_WHOLE_RUNS, math.nan)
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


def _cost_by(cost: dict, by: str) -> dict:
    """`cost.json` of a run that another model took."""
    return cost | {"reduced": cost[PROJECTED]} if by == PROJECTED and PROJECTED in cost else cost


def _costs_in_a_row(cost: dict, factor: int | None) -> dict[str, float]:
    """Columns of `results.csv`, of the coarse run at a factor of Δx; NaN where nothing was measured."""
    solvers = {
        "": cost.get("reduced", {}),
        "_full": cost.get("full_order", {}),
        "_coarse": cost.get("coarse", {}).get(str(factor), {}),
    }
    times = {f"{name}{end}": of.get(name) for end, of in solvers.items() for name in ("step_ms", "total_ms")}
    times |= {name: solvers[""].get(name) for name in ("step_ms_p10", "step_ms_p90", "memory_mib")}
    times |= {"memory_full_mib": solvers["_full"].get("memory_mib"), "decode_ms": cost.get("decode_ms")}
    return {name: math.nan if value is None else value for name, value in times.items()}


def _break_even(cost: dict, seconds: float) -> float:
    """Runs after which what was spent beforehand [s] has paid; ∞ where a reduced run saves no time."""
    full, reduced = (cost.get(solver, {}).get("total_ms", math.nan) for solver in ("full_order", "reduced"))
    saved = 1e-3 * (full - reduced)
    return math.inf if saved <= 0.0 else seconds / saved


def trust_of(case: Case, verdict: Verdict) -> dict:
    """Entry of `summary.json`; a number that is not finite is null."""
    numbers = {"error": verdict.error_share, "error_bound": verdict.bound_share}
    finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    return {"case": case.named, **finite, "flag": verdict.flag, "reason": verdict.reason}


def summarise(
    config: DictConfig,
    comparisons: Sequence[Comparison],
    rivals: Sequence[Rivals],
    rollouts: Sequence[Rollout],
    seconds: float,
) -> dict:
    """Content of `summary.json`; `seconds` is the training's wall time."""

    def mean(name: str) -> float:
        return float(np.mean([getattr(c, name) for c in comparisons]))

    summary = {
        "title": config.scene.title,
        "scale": config.scale,
        "cases": [dict(rollout.case) for rollout in rollouts],
        "training_seconds": seconds,
        "changes": OmegaConf.to_container(config.deploy).get("changes") or {},
        "delta": mean("delta") if math.isfinite(mean("delta")) else None,
        "reconstruction_delta": mean("reconstruction_delta"),
        "reconstruction_stress_error": mean("reconstruction_stress_error"),
        "trust": [trust_of(rollout.case, rollout.verdict) for rollout in rollouts],
        "rivals": [
            {"case": rollout.case.named} | asdict(beside)
            for rollout, beside in zip(rollouts, rivals, strict=True)
        ],
    }
    if config.scene.get("paper"):
        summary["paper"] = OmegaConf.to_container(config.scene.paper)
    return summary


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
    record.metrics.update({name: summary[name] for name in ("delta", "reconstruction_delta")})
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
