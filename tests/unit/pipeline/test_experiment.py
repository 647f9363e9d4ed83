"""Experiments: jobs from grids, overrides on top, and what tells jobs apart."""

import textwrap

import pytest

from nsf.errors import ConfigError
from nsf.pipeline.experiment import Experiment

TEXT = """
title: A title
question: Which?
paper: Nothing.
jobs:
  - {scene: sand, scale: small, field: [basis, mlp]}
  - scene: sand
    scale: small
    sampler: [random, greedy]
    deploy.dt_multiplier: 1.5
    scene.parameters.test: [[44, 55]]
    field.modes: null
"""


@pytest.fixture
def written(tmp_path):
    def write(text, *overrides):
        (tmp_path / "one.yaml").write_text(textwrap.dedent(text))
        return Experiment.load("one", overrides, tmp_path)

    return write


def test_every_combination_is_a_job(written):
    jobs = written(TEXT).jobs
    first = ("scene=sand", "scale=small")
    rest = ("deploy.dt_multiplier=1.5", "scene.parameters.test=[44,55]", "field.modes=null")
    assert [job.overrides for job in jobs] == [
        *((*first, f"field={field}") for field in ("basis", "mlp")),
        *((*first, f"sampler={sampler}", *rest) for sampler in ("random", "greedy")),
    ]


def test_a_setting_tells_what_columns_do_not(written):
    """results.csv has columns for the scene, the field and |S|, but none for the sampler."""
    settings = [job.setting for job in written(TEXT).jobs]
    assert settings == ["", "", "sampler=random", "sampler=greedy"]


def test_keys_of_a_job(written):
    *_, last = written(TEXT).jobs
    assert last.keys["sampler"] == "greedy"
    assert last.keys["scene.parameters.test"] == "[44,55]"


def test_what_the_paper_prints_is_text_as_in_the_keys_of_jobs(written):
    assert written(TEXT).printed is None
    assert written(TEXT + "printed: []\n").printed == ()
    (entry,) = written(
        TEXT + "printed: [{parameter: 44, deploy.changes: {a.b: 0.3}, field.modes: null, delta: 0.02}]\n"
    ).printed
    changes = {"parameter": "44", "deploy.changes": "{a.b:0.3}", "field.modes": "null"}
    assert entry == changes | {"delta": 0.02}


def test_overrides_take_the_place_of_the_files(written):
    experiment = written(TEXT, "field=mlp", "seed=1,2")
    assert [job.overrides for job in experiment.jobs][:2] == [
        ("scene=sand", "scale=small", "field=mlp", "seed=1"),
        ("scene=sand", "scale=small", "field=mlp", "seed=2"),
    ]
    assert [job.setting for job in experiment.jobs][:2] == ["seed=1", "seed=2"]


def test_equal_jobs_are_one(written):
    assert len(written(TEXT, "field=basis", "sampler=random").jobs) == 2


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("title: [", "correct the yaml"),
        ("title: a", "must have the keys"),
        (TEXT.replace("question", "aim"), "must have the keys"),
        (TEXT[: TEXT.index("jobs")] + "jobs: 3", "jobs is a list"),
        (TEXT + "stages: [point]\n", r"stages=\['point'\] must be a list of superresolve"),
        (TEXT + "printed: [0.2]\n", "printed must be a list of mappings"),
        (TEXT + "printed: [{scene: sand}]\n", "each with a number delta"),
        ("", "must have the keys"),
    ],
)
def test_a_file_that_is_no_experiment(written, text, told):
    with pytest.raises(ConfigError, match=told):
        written(text)


def test_the_nearest_name_is_told():
    with pytest.raises(ConfigError, match=r"unknown experiment=tabel1.*did you mean table1"):
        Experiment.load("tabel1")
