"""Every experiment can be run: its jobs compose and build."""

import itertools
import re

import pytest
import yaml

from nsf import config
from nsf.paths import CONF, EXPERIMENTS, groups
from nsf.pipeline import Pipeline
from nsf.pipeline.experiment import Experiment
from nsf.pipeline.plan import Plan

NAMES = sorted(path.stem for path in EXPERIMENTS.glob("*.yaml"))


def _small(name):
    return Experiment.load(name, ["scale=small"]).jobs


def _jobs():
    """Jobs in which each pair of groups' options that some job has occurs, and each other value but a seed.

    At small scale, whose particles are placed at once; the scenes at the paper's are built in test_groups.py.
    """
    known, left = groups(), {}
    for job in sorted({job for name in NAMES for job in _small(name)}, key=lambda job: job.overrides):
        options = [f"{key}={value}" for key, value in job.keys.items() if key in known]
        others = {f"{key}={value}" for key, value in job.keys.items() if not key.endswith("seed")}
        left[job] = others.union(itertools.combinations(options, 2))
    chosen = []
    while any(left.values()):
        richest = max(left, key=lambda job: len(left[job]))
        told = left.pop(richest)
        chosen.append(richest)
        left = {job: new - told for job, new in left.items()}
    # Those of a scene one after another, whose checks are the same.
    return [job.overrides for job in sorted(chosen, key=lambda job: (job.keys["scene"], job.overrides))]


def test_there_are_experiments():
    assert {"sand", "table1"} <= set(NAMES)


def test_all_experiments_with_a_report_of_their_own_are_reproduced():
    text = (EXPERIMENTS.parent / "Makefile").read_text()
    (listed,) = re.findall(r"^REPRODUCED := ((?:.*\\\n)*.*)$", text, re.MULTILINE)
    calibrated = {"inverse", "tilt"}  # by make calibration
    assert sorted(listed.replace("\\\n", "").split()) == sorted({*NAMES} - calibrated - {"quickstart"})


def test_the_ablation_is_every_method_of_the_paper_on_every_scene():
    jobs = [job.keys for job in Experiment.load("ablation").jobs]
    methods = {path.stem for path in (CONF / "method").glob("*.yaml")} - {"history"}
    of_the_paper = {
        path.stem
        for path in (CONF / "scene").glob("*.yaml")
        if "paper" in yaml.safe_load(path.read_text())["scene"]
    }
    assert sorted((job["scene"], job["method"]) for job in jobs) == sorted(
        itertools.product(of_the_paper, methods)
    )
    assert {job["scale"] for job in jobs} == {"paper"}


@pytest.mark.slow
def test_the_experiments_of_table1s_scenes_share_its_runs():
    """Hours of work are done once: an evaluate run has one identity in all of them."""
    table1 = {Plan(config.load(job.overrides)).evaluation.id for job in _small("table1")}
    jobs = [job for job in _small("ablation") if job.keys["method"] == "nsf"]
    assert {Plan(config.load(job.overrides)).evaluation.id for job in jobs} <= table1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mlp_steps", "table1", "sand"])
def test_the_papers_networks_are_trained_once(name):
    """Where no job asks for another number of steps."""

    def trained(experiment):
        jobs = [job for job in _small(experiment) if job.keys.get("field") == "mlp"]
        alike = [job for job in jobs if "trainer.steps" not in job.keys]
        return {Plan(config.load(job.overrides)).training.id for job in alike}

    found = trained(name)
    assert found
    assert found <= trained("mlp")


@pytest.mark.slow
@pytest.mark.parametrize("overrides", _jobs(), ids=" ".join)
def test_every_kind_of_job_builds(overrides):
    Pipeline(config.load([*overrides, "device=cpu"]))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_jobs_are_told_apart(name):
    """By a column of results.csv or by their setting."""
    experiment = Experiment.load(name)
    assert all((experiment.title, experiment.question, experiment.paper))
    told = set()
    for job in experiment.jobs:
        c = config.load(job.overrides)
        columns = (c.scene.name, c.method.name, c.field._target_, c.latent_dim, c.engine.name, c.sampler.size)
        told.add((*columns, job.setting))
    assert len(told) == len(experiment.jobs)


@pytest.mark.parametrize("name", NAMES)
def test_what_the_paper_prints_is_of_a_job(name):
    experiment = Experiment.load(name)
    jobs = [job.keys for job in experiment.jobs]
    for entry in experiment.printed or ():
        wanted = {key: value for key, value in entry.items() if key not in ("delta", "parameter")}
        assert any(all(job.get(key, "null") == wanted[key] for key in wanted) for job in jobs), entry


def test_table1_has_the_papers_seven_scenes():
    jobs = [set(job.overrides) for job in Experiment.load("table1").jobs]
    scenes = {"bread", "cake", "sand", "metal", "toothpaste", "jelly_cube", "squishy_ball"}
    for kind in ({"method=nsf"}, {"method=deformation_only"}, {"field=mlp"}):
        assert {f"scene={scene}" for scene in scenes} == {
            next(o for o in job if o.startswith("scene=")) for job in jobs if kind <= job
        }
