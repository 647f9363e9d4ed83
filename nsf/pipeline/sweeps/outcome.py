"""The outcome of each job of a sweep: a table over the keys that it varied, and the best job."""

import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from nsf import config as configuration
from nsf.errors import MissingRunError
from nsf.pipeline.sweeps.chains import chain_of
from nsf.results.columns import COLUMNS, axis, number
from nsf.results.formats import Rows

#: Metrics of an evaluate run that are shown: means over its cases.
_ERRORS = ("displacement_error", "stress_error", "delta")
_TIMES = ("step_ms_full", "step_ms")
#: Keys that change what is validated.
_OTHER_CASES = ("scene", "scale", "deploy")
_VALIDATION = "validation_error"


def outcome(sweeps: Sequence[Sequence[str]], failed: Mapping[str, str]) -> tuple[Rows, str] | None:
    """A row a job, and which one is best, with its command; None where there is only one job.

    Jobs whose validation cases may differ, or that have none, have no best.

    Args:
        sweeps: overrides whose keys may have several values.
        failed: error by what tells the job apart, as of `nsf.pipeline.sweeps.jobs.Failure`.
    """
    jobs = [dict(override.split("=", 1) for override in job) for job in configuration.jobs(sweeps)]
    keys = list(dict.fromkeys(key for job in jobs for key in job))
    varied = [key for key in keys if len({job.get(key) for job in jobs}) > 1]
    if len(jobs) < 2 or not varied:
        return None
    tells = [_words({key: job[key] for key in keys if key in varied and key in job}) for job in jobs]
    results = [_result(_words(job)) for job in jobs]
    for setting, result in zip(tells, results, strict=True):
        if "run" not in result:
            result["run"] = "failed" if " ".join(setting) in failed else "not evaluated"
    leaves = [key.rpartition(".")[2] for key in varied]
    names = [leaf if leaves.count(leaf) == 1 else key for key, leaf in zip(varied, leaves, strict=True)]
    timed = [name for name in _TIMES if any(name in result for result in results)]
    shown = [COLUMNS[name] for name in (*_ERRORS, *timed)]
    headings = [*names, axis("validation error", "%"), "run", *(one.heading for one in shown)]
    body = [
        [
            *(job.get(key, "") for key in varied),
            number(result.get(_VALIDATION), 100),
            result["run"],
            *(one.cell(result.get(one.name)) for one in shown),
        ]
        for job, result in zip(jobs, results, strict=True)
    ]
    rows = Rows(headings, body, [False] * len(varied) + [True, False] + [True] * len(shown))
    validated = [at for at, result in enumerate(results) if _VALIDATION in result]
    if any(key.split(".")[0] in _OTHER_CASES for key in varied) or not validated:
        return rows, ""
    best = min(validated, key=lambda at: results[at][_VALIDATION])
    score = f"displacement error {number(results[best][_VALIDATION], 100)} %"
    return rows, best_text(score, tells[best], _words(jobs[best]))


def best_text(score: str, setting: Sequence[str], words: Sequence[str]) -> str:
    """Which job is best at the validation values, and the command that deploys it.

    Args:
        score: there, with its name and unit.
        setting: overrides that tell the job apart.
        words: all its overrides.
    """
    return (
        f"best at the validation values, {score}: {' '.join(setting)}\n{shlex.join(['nsf', 'run', *words])}"
    )


def _words(keys: Mapping[str, str]) -> list[str]:
    return [f"{key}={value}" for key, value in keys.items()]


def _result(words: Sequence[str]) -> dict[str, Any]:
    """Metrics of a job's evaluate run, ∞ for errors of runs that diverged, and its hash; empty without it."""
    try:
        run = chain_of(configuration.load(words)).evaluated()
    except MissingRunError:
        return {}
    metrics = run.manifest["metrics"]
    lost = dict.fromkeys(_ERRORS, math.inf) if metrics.get("diverged") else {}
    return lost | {name: value for name, value in metrics.items() if value is not None} | {"run": run.hash}
