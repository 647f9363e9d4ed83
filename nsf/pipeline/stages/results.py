"""The files of an evaluate run: one place that knows what reporting reads (docs/design.md)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf

from nsf.data import Case
from nsf.deployment import Rollout
from nsf.dynamics.setup import reduced_steps
from nsf.evaluation import Comparison, Rivals, SolverCost, SuperResolution, reduction_ratio
from nsf.evaluation.quantities import QUANTITIES
from nsf.evaluation.surroundings import surroundings
from nsf.models import describe
from nsf.runs import Record
from nsf.scenes import Scene
from nsf.storage import write_json, writing

_COARSE = "coarse_"
_METHODS = {
    ("field", "field"): "nsf",
    ("deformation", "none"): "deformation_only",
    ("field", "none"): "neural_stress_only",
    ("deformation", "field"): "neural_affine_only",
    ("particles", "particles"): "history",
}


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
            name.removeprefix(_COARSE): found.as_dict()
            for name, found in measured.items()
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
    engine: str = "",
    offline: tuple[float, float] = (math.nan, 0.0),
) -> pd.DataFrame:
    """Content of `results.csv`, one row a case; errors are fractions, ∞ where a run diverged.

    `model` took the steps of the rollouts, where `model=auto` chose it. `offline` are the times of training
    and of teaching [s]. A run costs what its steps cost, those by operators and projected ones.
    """
    commit = str(manifest.get("commit") or "unknown")[:12] + ("-dirty" if manifest.get("dirty") else "")
    variant = {
        "scene": config.scene.name,
        **describe(config, model),
        # Until reports read the three columns above.
        "method": _METHODS.get((config.stress, config.affine), ""),
        "engine": engine,
        "field": manifold.field,
        "r": manifold.latent_dim,
    }
    # What a step costs whose particles have left the grid is no one's speedup, nor is half a reduced run's.
    costly = (
        "step_ms_reduced", "total_ms_reduced", "decode_ms", "speedup_step", "speedup_total",
        "memory_reduced_mib", "break_even_runs",
    )  # fmt: skip
    device_name = torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu"
    found = []
    for rollout, comparison, beside in zip(rollouts, comparisons, rivals, strict=True):
        own = {
            "sample": rollout.sample,
            "integration_mean": rollout.integration_mean,
            "parameter": rollout.case.column,
            "split": config.deploy.split,
            "delta": comparison.delta,
            "displacement_error": comparison.displacement_error,
            "stress_error": comparison.stress_error,
            **_beside(beside),
        }
        as_run = _cost_of_share(cost, rollout.projected_share)
        times = _costs_in_a_row(as_run, next(iter(rivals[0].coarse), None))
        times |= {"teach_seconds": offline[1], "break_even_runs": _break_even(as_run, sum(offline))}
        if rollout.diverged >= 0 or rollout.handed_over >= 0:
            times |= dict.fromkeys(costly, math.nan)
        off = {
            "handed_over": _handed_over(rollout, config),
            "estimated_error": math.nan if rollout.estimate is None else rollout.estimate.max(),
            "true_error": comparison.true_error,
            **{f"{name}_error": math.nan for name in QUANTITIES},
            **{f"{name}_error": off for name, off in comparison.quantities.items()},
        }
        gamma = {"gamma": reduction_ratio(len(manifold.X), manifold.latent_dim)}
        place = {"precision": config.precision, "device": device_name, "commit": commit}
        found.append(variant | own | gamma | times | off | place)
    return pd.DataFrame(found)


def _beside(rivals: Rivals) -> dict[str, float]:
    """Columns of `results.csv`; the coarse run is that of the first factor, NaN where there is none."""
    first = next(iter(rivals.coarse.values()), {})
    return {
        "displacement_static": rivals.static,
        "displacement_nearest": rivals.nearest,
        "displacement_interpolated": rivals.interpolated,
        "displacement_coarse": first.get("displacement_error", math.nan),
    }


def _cost_of_share(cost: dict, share: float) -> dict:
    """`cost.json` of a run with operators, of which the projected step took a share."""
    if not share or "projected" not in cost:
        return cost
    own, other = cost["reduced"], cost["projected"]
    times = {name: (1.0 - share) * own[name] + share * other[name] for name in ("step_ms", "total_ms")}
    memory = max(own["memory_mib"], other["memory_mib"])
    return cost | {"reduced": own | times | {"memory_mib": memory}}


def _costs_in_a_row(cost: dict, factor: int | None) -> dict[str, float]:
    """Columns of `results.csv`, of the coarse run at a factor of Δx; NaN where nothing was measured."""

    def pair(key: str) -> tuple[float, float]:
        return tuple(cost.get(solver, {}).get(key, math.nan) for solver in ("full_order", "reduced"))

    coarse = cost.get("coarse", {}).get(str(factor), {})
    step, total, memory = pair("step_ms"), pair("total_ms"), pair("memory_mib")
    return {
        "step_ms_full": step[0],
        "step_ms_reduced": step[1],
        "step_ms_coarse": coarse.get("step_ms", math.nan),
        "total_ms_full": total[0],
        "total_ms_reduced": total[1],
        "total_ms_coarse": coarse.get("total_ms", math.nan),
        "decode_ms": cost.get("decode_ms", math.nan),
        "speedup_step": step[0] / step[1],
        "speedup_total": total[0] / total[1],
        "memory_full_mib": memory[0],
        "memory_reduced_mib": memory[1],
    }


def _break_even(cost: dict, seconds: float) -> float:
    """Runs after which what was spent beforehand [s] has paid; ∞ where a reduced run saves no time."""
    full, reduced = (cost.get(solver, {}).get("total_ms", math.nan) for solver in ("full_order", "reduced"))
    saved = 1e-3 * (full - reduced)
    return math.inf if saved <= 0.0 else seconds / saved


def _handed_over(rollout: Rollout, config: DictConfig) -> float:
    """Share of the steps that were not taken by the first level: operators, or else the projected step."""
    steps = reduced_steps(config.scene.steps, config.deploy.dt_multiplier)
    own = steps if rollout.handed_over < 0 else rollout.handed_over
    if rollout.by is not None:
        own = min(own, rollout.by_operators)
    return 1.0 - own / steps


def trust_of(rollout: Rollout) -> dict:
    """Entry of `summary.json`: times in s, null where nothing happened; a ratio of ∞ is null too."""
    largest = float(rollout.trust.max())

    def when(step: int) -> float | None:
        return float(rollout.t[step]) if step >= 0 else None

    return {
        "parameter": rollout.case.column,
        "away": rollout.away if math.isfinite(rollout.away) else None,
        "trust": largest if math.isfinite(largest) else None,
        "distrusted": rollout.distrusted >= 0,
        "distrusted_at": when(rollout.distrusted),
        "handed_over_at": when(rollout.handed_over),
    }


def summarise(
    scene: Scene,
    manifold,
    results: pd.DataFrame,
    comparisons: Sequence[Comparison],
    rivals: Sequence[Rivals],
    rollouts: Sequence[Rollout],
    seconds: float,
) -> dict:
    """Content of `summary.json`; `seconds` is the training's wall time."""
    config = scene.config

    def mean(name: str) -> float:
        return float(np.mean([getattr(c, name) for c in comparisons]))

    summary = {
        "title": config.scene.title,
        "scale": scene.scale,
        "parameter_name": _parameter(scene)[0],
        "parameter_unit": _parameter(scene)[1],
        "cases": [dict(rollout.case) for rollout in rollouts],
        "particles": len(manifold.X),
        "training_seconds": seconds,
        "changes": OmegaConf.to_container(config.deploy).get("changes") or {},
        "delta": mean("delta") if math.isfinite(mean("delta")) else None,
        "reconstruction_delta": mean("reconstruction_delta"),
        "reconstruction_stress_error": mean("reconstruction_stress_error"),
        "trust": [trust_of(rollout) for rollout in rollouts],
        "rivals": [
            {"parameter": rollout.case.column} | asdict(beside)
            for rollout, beside in zip(rollouts, rivals, strict=True)
        ],
        "variant": {
            name: results[name].tolist()[0]
            for name in ("method", "model", "stress", "affine", "field", "r", "sample")
        },
    }
    if config.scene.get("paper"):
        summary["paper"] = OmegaConf.to_container(config.scene.paper)
    return summary


def _parameter(scene: Scene) -> tuple[str, str]:
    """Name and unit of what tells the cases of a scene apart, for headings."""
    (name, one), *more = scene.varied.items()
    return ("case", "") if more else (name, one.unit)


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
            parameters=np.array(results["parameter"].tolist()),
            splits=results["split"].to_numpy(dtype=str),
            t=pictures[0]["t"],
            **{name: np.stack([p[name] for p in pictures]) for name in pictures[0] if name != "t"},
        )
    write_json(path / "cost.json", cost)
    write_json(path / "summary.json", summary)
    for name in (*tables, "frames.npz", "cost.json", "summary.json"):
        record.output(name)
    record.metrics.update({name: summary[name] for name in ("delta", "reconstruction_delta")})
    record.metrics["diverged"] = results.loc[np.isinf(results["delta"]), "parameter"].tolist()


def write_superresolution(
    record: Record, scene: Scene, cases: Sequence[Case], fine: Sequence[SuperResolution]
) -> pd.DataFrame:
    """Write `superresolution.csv` and `superresolution.png` into a run's folder; gives the table."""
    from nsf.bodies.colors import STRESS_COLORS
    from nsf.reporting.bodies.shapes import fine_shapes
    from nsf.results.style import PIXELS, write_png

    table = pd.DataFrame([f.row for f in fine])
    with writing(record.path / "superresolution.csv") as partial:
        table.to_csv(partial, index=False)
    name, unit = _parameter(scene)
    end = np.array([scene.dt * scene.steps])
    around = [surroundings(scene.with_parameters(case), end) for case in cases]
    picture = fine_shapes(fine, around, name.replace("_", " "), unit)
    with writing(record.path / "superresolution.png") as partial:
        write_png(picture, partial, PIXELS, [STRESS_COLORS])
    for name in ("superresolution.csv", "superresolution.png"):
        record.output(name)
    record.metrics.update(table.drop(columns="parameter").mean().to_dict())
    return table
