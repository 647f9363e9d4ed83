"""Every experiment can be run: each of its jobs composes and builds."""

import pytest

from nsf import config
from nsf.paths import EXPERIMENTS
from nsf.pipeline import Pipeline
from nsf.pipeline.experiment import Experiment

NAMES = sorted(path.stem for path in EXPERIMENTS.glob("*.yaml"))
# At small scale, whose particles are placed at once; the scenes at the paper's are built in test_groups.py.
JOBS = sorted({job.overrides for name in NAMES for job in Experiment.load(name, ["scale=small"]).jobs})


def test_there_are_experiments():
    assert {"sand", "table1"} <= set(NAMES)


def test_the_ablation_is_every_method_on_every_scene():
    jobs = {job.overrides for job in Experiment.load("ablation").jobs}
    methods = {path.stem for path in (config.CONF / "method").glob("*.yaml")}
    scenes = {path.stem for path in (config.CONF / "scene").glob("*.yaml")} - {"drop"}  # not of the paper
    assert jobs == {
        (f"scene={scene}", "scale=paper", f"method={method}") for scene in scenes for method in methods
    }


@pytest.mark.parametrize("overrides", JOBS, ids=" ".join)
def test_every_job_builds(overrides):
    Pipeline(config.load([*overrides, "device=cpu"]))


@pytest.mark.parametrize("name", NAMES)
def test_jobs_are_told_apart(name):
    """By a column of results.csv or by their setting."""
    experiment = Experiment.load(name)
    assert all((experiment.title, experiment.question, experiment.paper))
    told = set()
    for job in experiment.jobs:
        c = config.load(job.overrides)
        told.add((c.scene.name, c.method.name, c.field._target_, c.latent_dim, c.sampler.size, job.setting))
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
