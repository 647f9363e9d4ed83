"""Made-up evaluate runs: a sand column that sinks, and models that follow it closely."""

import hashlib
import json
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from nsf.results.columns import EVALUATED
from nsf.results.question import FILES
from nsf.runs import Run

STAGES = {"inference": 0.4, "p2g": 0.6, "g2p": 0.2}
FRAMES, POINTS = 4, 60


@dataclass(frozen=True)
class Made:
    """A run: each case's δ, and whatever columns differ from the first model's."""

    delta: tuple[float, ...] = (0.01, 0.02)
    cases: tuple[str, ...] = ("friction_angle=26°", "friction_angle=30°")
    scene: str = "sand"
    model: str = "projected"
    stress: str = "field"
    affine: str = "field"
    seed: int = 0
    r: int = 6
    particles: int = 3000
    timed: bool = True
    created: str = "2026-11-01T10:00:00+00:00"
    paper: float | None = 0.004


def write_run(root, made: Made, **config) -> Run:
    """Record an evaluate run under root."""
    run = Run.open("evaluate", made.scene, asdict(made) | config, root=root)
    with run.record(device="cpu", precision="fp64") as record:
        _payload(run.path, made)
        for name in FILES:
            record.output(name)
    rewrite(run, created=made.created, commit="1f2e3d4c5b6a7988", dirty=False, versions={"torch": "2.9"})
    return Run.open("evaluate", made.scene, asdict(made) | config, root=root)


def rewrite(run: Run, **keys) -> None:
    """Change keys of a run's manifest."""
    path = run.path / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | keys))


def seal(run: Run, *more: str) -> None:
    """Record the files as they now stand, and more than an evaluate run has."""
    files = [(name, (run.path / name).read_bytes()) for name in (*FILES, *more)]
    outputs = [{"path": n, "bytes": len(d), "sha256": hashlib.sha256(d).hexdigest()} for n, d in files]
    rewrite(run, outputs=outputs)


def frame(*runs: Made) -> pd.DataFrame:
    """The rows that evaluate runs write."""
    rows = [row for made in runs for row in _rows(made)]
    return pd.DataFrame(rows).reindex(columns=list(EVALUATED))


def _rows(made: Made) -> list[dict]:
    shared = {
        "scene": made.scene, "material": "drucker_prager", "model": made.model,
        "stress": made.stress, "affine": made.affine, "field": "basis", "r": made.r, "sample": 50,
        "integration": 900.0, "particles": made.particles, "seed": made.seed, "split": "test",
        "displacement_static": 1.0, "displacement_nearest": 0.2, "displacement_interpolated": 0.05,
        "displacement_coarse": 0.3, "teach_seconds": 0.0, "fallback_share": 0.0, "distance": 1e-3,
        "distance_max": 2e-3, "error_bound": 0.3, "flag": "green",
        "flag_reason": "", "beyond": 0, "precision": "fp64", "device": "cpu", "commit": "1f2e3d4c5b6a",
    }  # fmt: skip
    times = {
        "step_ms_full": 6.0, "step_ms": 1.5, "step_ms_p10": 1.4, "step_ms_p90": 1.6, "step_ms_coarse": 2.0,
        "total_ms_full": 60.0, "total_ms": 15.0, "total_ms_coarse": 10.0, "decode_ms": 5.0,
        "memory_full_mib": 90.0, "memory_mib": 40.0, "train_seconds": 9.0, "break_even_runs": 200.0,
    }  # fmt: skip
    return [
        shared
        | (times if made.timed else {})
        | {
            "case": case,
            "value": float(case.partition("=")[2].rstrip("°")) if case.count("=") == 1 else np.nan,
        }
        | {"delta": delta, "displacement_error": 10 * delta, "stress_error": 5 * delta}
        for case, delta in zip(made.cases, made.delta, strict=True)
    ]


def _payload(path, made: Made) -> None:
    """The five files of an evaluate run."""
    frame(made).to_csv(path / "results.csv", index=False)
    t, rng = np.linspace(0, 0.3, FRAMES), np.random.default_rng(0)
    X = rng.uniform(0.3, 0.7, (POINTS, 3))
    x = X - np.linspace(0, 0.1, FRAMES)[:, None, None] * [0, 0, 1] * X
    stress = np.linspace(1, 900, FRAMES * POINTS).reshape(FRAMES, POINTS)
    count = len(made.cases)
    arrays = {"x_full": x, "x_reduced": x + 0.01, "stress_full": stress, "stress_reduced": 1.1 * stress}
    np.savez(
        path / "frames.npz", cases=np.array(made.cases), t=t,
        **{name: np.repeat(values[None].astype(np.float32), count, 0) for name, values in arrays.items()},
        role=rng.integers(0, 3, (count, FRAMES, POINTS), np.int8),
    )  # fmt: skip
    parts = []
    for case, delta in zip(made.cases, made.delta, strict=True):
        part = pd.DataFrame({"case": case, "split": "test", "frame": range(FRAMES), "t": t})
        errors = dict.fromkeys(("delta", "displacement_error", "stress_error"), delta * t)
        paths = {f"{of}_{k}": k * t for of in ("xhat", "encoded") for k in (1, 2)}
        parts.append(part.assign(**errors, reconstruction_delta=0.3 * delta, **paths))
    pd.concat(parts).to_csv(path / "series.csv", index=False)
    breakdown = {"reduced": STAGES, "full_order": STAGES} if made.timed else {}
    (path / "cost.json").write_text(json.dumps({"breakdown": breakdown, "trials": 5}))
    paper = {"nsf": {"delta": made.paper, "r": 6}, "place": "Table 1"} if made.paper else None
    summary = {"title": "Sand", "scale": "small", "paper": paper, "delta": 0.01}
    (path / "summary.json").write_text(json.dumps(summary))
