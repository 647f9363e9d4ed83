"""Every experiment can be run: each key and option of its jobs is one that composes and builds."""

import itertools
import re

import pytest
import yaml

from nsf import config
from nsf.paths import CONF, EXPERIMENTS, groups
from nsf.pipeline import Pipeline
from nsf.pipeline.sweeps.experiment import Experiment

NAMES = sorted(path.stem for path in EXPERIMENTS.glob("*.yaml"))
#: The same, with a name for each part.
QUESTIONS = [one for name in NAMES for one in Experiment.load(name).parts or (Experiment.load(name),)]


def _small(name):
    return Experiment.load(name, ["scale=small"]).jobs


def _jobs():
    """Jobs in which each key, each group's option, and each key of an option that some job has occurs.

    At small scale, whose particles are placed at once; the scenes at the paper's are built in test_groups.py.
    """
    known, left = groups(), {}
    for job in sorted({job for name in NAMES for job in _small(name)}, key=lambda job: job.overrides):
        options = {f"{key}={value}" for key, value in job.keys.items() if key in known}
        of_options = {
            (option, key)
            for option, key in itertools.product(options, job.keys)
            if key.lstrip("+").startswith(option.split("=")[0] + ".")
        }
        left[job] = options | of_options | set(job.keys)
    chosen = []
    while any(left.values()):
        richest = max(left, key=lambda job: len(left[job]))
        covered = left.pop(richest)
        chosen.append(richest)
        left = {job: rest - covered for job, rest in left.items()}
    return [job.overrides for job in chosen]


@pytest.mark.slow
def test_every_kind_of_job_builds():
    for overrides in _jobs():
        Pipeline(config.load([*overrides, "device=cpu"])).check()


def test_all_experiments_with_a_report_of_their_own_are_reproduced():
    text = (EXPERIMENTS.parent / "Makefile").read_text()
    (listed,) = re.findall(r"^REPRODUCED := ((?:.*\\\n)*.*)$", text, re.MULTILINE)
    assert sorted(listed.replace("\\\n", "").split()) == sorted({*NAMES} - {"inverse", "quickstart"})


def test_the_list_of_experiments_has_each_with_its_parts():
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|", (EXPERIMENTS / "README.md").read_text(), re.MULTILINE)
    listed = {name: [f"{name}/{part}" for part in re.findall(r"`(\w+)`", parts)] for name, parts in rows}
    assert {name: listed.get(name) for name in NAMES} == {
        name: [part.name for part in Experiment.load(name).parts] for name in NAMES
    }


def test_the_ablation_is_every_method_of_the_paper_on_every_scene():
    jobs = [job.keys for job in Experiment.load("table1/ablation").jobs]
    of_the_paper = {
        path.stem
        for path in (CONF / "scene").glob("*.yaml")
        if "paper" in yaml.safe_load(path.read_text())["scene"]
    }
    assert sorted(
        (job["scene"], job.get("stress", "field"), job.get("affine", "field")) for job in jobs
    ) == sorted(itertools.product(of_the_paper, ("field", "deformation"), ("field", "none")))


def _ids(name, stage, keys):
    """Names of the runs of a stage, of those jobs that have these values."""
    jobs = [job for job in _small(name) if keys.items() <= job.keys.items()]
    assert jobs
    return {getattr(Pipeline(config.load(job.overrides)), stage).id for job in jobs}


@pytest.mark.slow
def test_parts_of_table1_share_runs():
    """Hours of work are done once: a run has one identity in all of them."""
    ablation = _ids("table1/ablation", "evaluation", {"stress": "field", "affine": "field", "scene": "sand"})
    assert ablation <= _ids(
        "table1/scenes", "evaluation", {"stress": "field", "affine": "field", "scene": "sand"}
    )
    networks = _ids("table1/networks", "training", {"field": "mlp", "scene": "metal"})
    assert _ids("table1/scenes", "training", {"field": "mlp", "scene": "metal"}) == networks
    assert networks < _ids("training/networks", "training", {"field": "mlp", "scene": "metal"})


@pytest.mark.parametrize("experiment", QUESTIONS, ids=lambda experiment: experiment.name)
def test_jobs_are_told_apart_and_have_what_the_paper_prints(experiment):
    """By what a run is, not only by how it is measured."""
    jobs = [job.keys for job in experiment.jobs]
    assert len({frozenset(keys.items()) for keys in jobs}) == len(jobs)
    for entry in experiment.printed or ():
        wanted = {key: value for key, value in entry.items() if key not in ("delta", "parameter")}
        assert any(all(job.get(key, "null") == wanted[key] for key in wanted) for job in jobs), entry


def test_table1_has_the_papers_seven_scenes():
    jobs = [set(job.overrides) for job in Experiment.load("table1/scenes").jobs]
    scenes = {"bread", "cake", "sand", "metal", "toothpaste", "jelly_cube", "squishy_ball"}
    for kind in ({"stress=field", "affine=field"}, {"stress=deformation", "affine=none"}, {"field=mlp"}):
        assert {f"scene={scene}" for scene in scenes} == {
            next(o for o in job if o.startswith("scene=")) for job in jobs if kind <= job
        }
