"""Made-up evaluate runs: a sand column that collapses, and a reduced model that follows it closely."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.reporting.sources import FILES
from nsf.runs import Run

TEST, VALIDATION = (22.5, 27.5, 32.5, 36.0), (25.0,)
STAGES = {"inference": 0.41, "p2g": 0.62, "grid": 0.11, "g2p": 0.18, "inversion": 0.33, "transfer": 0.05}
FULL_STAGES = {"stress": 1.9, "p2g": 3.1, "grid": 0.12, "g2p": 1.2}


@dataclass
class Made:
    """What to make up; the defaults are a small run."""

    method: str = "nsf"
    sample: int = 150
    noise: float = 0.004  # [m] size of the reduced model's error at the end
    scene: str = "sand"
    parameters: tuple = TEST
    splits: tuple = ("test",) * len(TEST)
    particles: int = 300  # in pictures
    frames: int = 6
    r: int = 6
    device: str = "cuda:0"
    commit: str = "1f2e3d4c5b6a79880123456789abcdef01234567"
    dirty: bool = False
    created: str = "2024-05-01T10:00:00+00:00"
    status: str = "complete"
    paper: bool = True
    field: str = "mlp"
    engine: str = ""
    scale: str = "paper"
    training_seconds: float = 5400
    trust: tuple = ()  # ratio of each parameter value; None is not finite
    seed: int = 0
    full_order: int = 71363  # particles of its full-order model
    rivals: bool = False  # whether it was held to them


def write_run(root: Path, made: Made, parents=(), **config) -> Run:
    """Record one evaluate run under root, with the date, code and state that `made` asks for.

    `parents` are the runs that it is made from, `config` is more of its configuration.
    """
    run = Run.open("evaluate", made.scene, asdict(made) | config, parents, root)
    with run.record(device=made.device, seed=made.seed, precision="fp64") as record:
        write_payload(run.path, made)
        for name in FILES:
            record.output(name)
    versions = {"python": "3.11.7", "warp": "1.9.1", "torch": "2.9.0", "lightning": None}
    keys = {"commit": made.commit, "dirty": made.dirty, "created": made.created, "status": made.status}
    rewrite_manifest(run, **keys, versions=versions)
    return run


def rewrite_manifest(run: Run, **keys) -> None:
    """Change keys of a run's manifest."""
    (run.path / "manifest.json").write_text(json.dumps(run.manifest | keys))


def seal(run: Run) -> None:
    """Record the files as they now stand, as if the run had just made them."""
    files = [(name, (run.path / name).read_bytes()) for name in FILES]
    hashed = [(name, data, hashlib.sha256(data).hexdigest()) for name, data in files]
    rewrite_manifest(run, outputs=[{"path": n, "bytes": len(d), "sha256": h} for n, d, h in hashed])


def write_payload(path: Path, made: Made) -> None:
    """The five files of an evaluate run."""
    rng = np.random.default_rng(made.seed)
    t = np.linspace(0, 0.6, made.frames)
    motions = [collapse(made, rng, value, t) for value in made.parameters]
    columns = ("x_full", "x_reduced", "stress_full", "stress_reduced")
    arrays = {key: np.stack([m[key] for m in motions]).astype(np.float32) for key in columns}
    arrays["role"] = rng.integers(0, 3, arrays["stress_full"].shape, np.int8)
    np.savez(
        path / "frames.npz", parameters=np.array(made.parameters), splits=np.array(made.splits), t=t, **arrays
    )
    parts = [
        _series(made, rng, value, split, t, m)
        for value, split, m in zip(made.parameters, made.splits, motions, strict=True)
    ]
    pd.concat(parts).to_csv(path / "series.csv", index=False)
    results = [
        _result(made, v, s, m, part)
        for v, s, m, part in zip(made.parameters, made.splits, motions, parts, strict=True)
    ]
    pd.DataFrame(results).to_csv(path / "results.csv", index=False)
    breakdown = {"reduced": STAGES, "full_order": FULL_STAGES}
    cost = {"full_order": {}, "reduced": {}, "breakdown": breakdown, "trials": 10}
    if made.rivals:
        cost["full_order"], cost["reduced"] = {"steps": 24}, {"steps": 24}
        cost["coarse"] = {"2": {"step_ms": 1.0, "total_ms": 12.0, "memory_mib": 90.0, "steps": 12}}
    (path / "cost.json").write_text(json.dumps(cost))
    summary = {
        "parameter_name": "friction angle",
        "parameter_unit": "°",
        "particles": made.full_order,
        "training_seconds": made.training_seconds,
        "scale": made.scale,
    }
    if made.rivals:
        coarse = {"2": {"displacement_error": 0.2}, "3": {"why": "a wall is too thin"}}
        summary["rivals"] = [{"parameter": value, "coarse": coarse} for value in made.parameters]
    if made.trust:
        summary["trust"] = [
            {"parameter": value, "trust": ratio, "distrusted": ratio is None or ratio > 1.0,
             "distrusted_at": None if ratio is not None and ratio <= 1.0 else 0.2, "handed_over_at": None}
            for value, ratio in zip(made.parameters, made.trust, strict=True)
        ]  # fmt: skip
    paper = (
        {"paper": {"place": "Table 1, Sand", "nsf": {"delta": 0.004, "sample": 150, "gamma": 36000}}}
        if made.paper
        else {}
    )
    (path / "summary.json").write_text(json.dumps(summary | paper | {"floor": 0.13}))


def collapse(made: Made, rng, angle: float, t: np.ndarray) -> dict[str, np.ndarray]:
    """x [F,n,3] m, stress [F,n] Pa of both models; the column slumps the more the lower its angle."""
    n, floor, half, tall = made.particles, 0.13, 0.09, 0.42
    X = rng.uniform((0.5 - half, 0.5 - half, floor), (0.5 + half, 0.5 + half, floor + tall), (n, 3))
    height = (X[:, 2] - floor) / tall
    slump = (0.75 - 0.011 * (angle - 20)) * _smooth(t / 0.55)[:, None]
    x = np.broadcast_to(X, (len(t), n, 3)).copy()
    x[..., 2] = floor + (X[:, 2] - floor) * (1 - slump * (0.55 + 0.45 * height**0.5))
    spread = 1 + slump * (3.1 * (1 - height) ** 0.7 + 0.15)
    x[..., :2] = 0.5 + (X[:, :2] - 0.5) * spread[..., None]
    ripple = np.sin(17 * X[:, [1, 2, 0]] + angle) * (0.15 + _smooth(t / 0.6))[:, None, None]
    x_reduced = x + made.noise * ripple * np.array([1, 1, 0.3])
    x_reduced[0] = x[0]
    x_reduced[..., 2] = np.maximum(x_reduced[..., 2], floor)
    top = x[..., 2].max(axis=1, keepdims=True)
    centre = np.hypot(*np.moveaxis(x[..., :2] - 0.5, -1, 0))
    depth = np.clip(
        (top - x[..., 2]) * (1 - centre / (centre.max(axis=1, keepdims=True) + 1e-9)) ** 0.5, 0, None
    )
    pressure = 200 * 4 * depth * (0.9 + 0.2 * rng.random(n)) * (0.3 + 0.7 * _smooth(t / 0.1))[:, None]
    off_axis = 1 + 0.2 * np.sign(X[:, 0] - 0.5)
    stress = 0.6 * pressure * off_axis
    stress_reduced = stress * (1 + 8 * made.noise * np.sin(9 * X[:, 0] + 3))
    return {"x_full": x, "x_reduced": x_reduced, "stress_full": stress, "stress_reduced": stress_reduced}


def _series(made: Made, rng, value: float, split: str, t: np.ndarray, m: dict) -> pd.DataFrame:
    X, apart = m["x_full"][0], _norm(m["x_reduced"] - m["x_full"])
    moved = np.maximum(_norm(m["x_full"] - X), 1e-3 * _norm(X))
    frame = pd.DataFrame({"parameter": value, "split": split, "frame": np.arange(len(t)), "t": t})
    frame["delta"] = apart / _norm(m["x_full"])
    frame["displacement_error"] = apart / moved
    wrong, size = (
        np.linalg.norm(s, axis=1) for s in (m["stress_reduced"] - m["stress_full"], m["stress_full"])
    )
    frame["stress_error"] = wrong / np.maximum(size, 1e-9)
    frame["linear_momentum_error"] = frame["delta"] * (2 + np.sin(20 * t))
    frame["angular_momentum_error"] = frame["delta"] * (3 + np.cos(23 * t))
    frame["reconstruction_delta"] = 0.35 * frame["delta"].mean() * (1 + 0.3 * np.sin(9 * t))
    s, a = _smooth(t / 0.55), (value - 29) / 10
    for k in range(1, made.r + 1):
        path = np.sin(k * s + 0.3 * k * a) * (1.4 / k) - a * s * np.cos(k) + 0.1 * k * a
        frame[f"xhat_{k}"] = path + made.noise * np.cumsum(rng.normal(size=len(t))) / np.sqrt(len(t)) * 8
        frame[f"encoded_{k}"] = path
    return frame[1:]


def _result(made: Made, value: float, split: str, m: dict, series: pd.DataFrame) -> dict:
    x, X = m["x_full"][1:], m["x_full"][0]
    apart = _total(m["x_reduced"][1:] - x)
    full, reduced = sum(FULL_STAGES.values()), sum(STAGES.values()) * (0.8 + made.sample / 750)
    timed = (
        {
            "engine": made.engine,
            "total_ms_full": 24 * full,
            "total_ms_reduced": 24 * reduced,
            "decode_ms": 3.0,
        }
        if made.engine
        else {}  # as of runs from before there were engines
    )
    beside = {"static": 1.0, "nearest": 0.09, "interpolated": 0.05, "coarse": 0.2} if made.rivals else {}
    return timed | {f"displacement_{name}": error for name, error in beside.items()} | {
        "scene": made.scene, "method": made.method, "field": made.field, "r": made.r, "sample": made.sample,
        "integration_mean": 24.6 * made.sample, "parameter": value, "split": split,
        "delta": apart / _total(x),
        "displacement_error": apart / _total(x - X), "stress_error": float(series["stress_error"].mean()),
        "gamma": 3 * made.full_order / made.r, "step_ms_full": full, "step_ms_reduced": reduced,
        "speedup_step": full / reduced, "speedup_total": 0.93 * full / reduced, "memory_full_mib": 931.0,
        "memory_reduced_mib": 402.0 + made.sample, "precision": "fp64", "device": made.device,
        "commit": made.commit[:12],
    }  # fmt: skip


def _smooth(s) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return s * s * (3 - 2 * s)


def _norm(x: np.ndarray) -> np.ndarray:
    return np.sqrt((x**2).sum(axis=(-2, -1)))


def _total(x: np.ndarray) -> float:
    return float(np.sqrt((x**2).sum()))
