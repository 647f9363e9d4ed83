"""Folders of finished reports, without the runs and the pictures."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from nsf.reporting import COLUMNS
from nsf.reporting.sources import file_hash
from nsf.reporting.text.columns import RIVALS

PAPER = {"sand": {"nsf": {"r": 6, "sample": 150, "delta": 0.004}, "deformation_only": {"delta": 0.05}}}


def job(
    scene: str = "sand", delta: float = 0.001, stress: float = 0.02, parameter: float = 26.0, **keys
) -> dict:
    """A held-out row: columns of results.csv, and in `keys` the keys of its job."""
    particles = int(keys.get("scene.bodies.column.particles", 2))
    row = dict.fromkeys(COLUMNS, 1.0) | dict.fromkeys(RIVALS, math.nan) | {
        "scene": scene, "method": keys.get("method", "nsf"), "field": keys.get("field", "basis"),
        "r": int(keys.get("latent_dim", 6)), "sample": keys.get("sampler.size", "150"),
        "parameter": parameter, "split": "test", "delta": delta, "displacement_error": 10 * delta,
        "gamma": 3 * particles / int(keys.get("latent_dim", 6)), "stress_error": stress,
        "precision": "fp64", "device": "NVIDIA H200", "commit": "1f2e3d4c5b6a",
    }  # fmt: skip
    return row | {"keys": {"scene": scene} | keys}


def write_report(folder: Path, jobs: Sequence[dict], chart: str | None = None, **told) -> Path:
    """results.csv and sources.json; a run a row. `told` goes into sources.json."""
    folder.mkdir(parents=True)
    pd.DataFrame(jobs).drop(columns="keys").to_csv(folder / "results.csv", index=False)
    run = {"commit": "1f2e3d4c5b6a79", "dirty": False, "created": "2026-11-22T10:00:00+00:00"}
    runs = {
        f"run{i}": run | {"scale": "paper", "keys": row["keys"], "paper": PAPER.get(row["scene"])}
        for i, row in enumerate(jobs)
    }
    if chart:
        (folder / chart).touch()
    content = {
        "title": folder.name.title(),
        "question": f"What of {folder.name}?",
        "files": {path.name: file_hash(path) for path in sorted(folder.iterdir())},
        "runs": runs,
        "rows": [{"row": i, "run": f"run{i}"} for i in range(len(jobs))],
        "chart": {"file": chart, "caption": "What the chart shows."} if chart else None,
    }
    (folder / "sources.json").write_text(json.dumps(content | told))
    return folder
