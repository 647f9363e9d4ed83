"""Experiments: jobs from grids, overrides on top, and what tells jobs apart."""

import textwrap

import pytest

from nsf import config
from nsf.errors import ConfigError
from nsf.pipeline.sweeps.experiment import Experiment, _defaults
from nsf.results.question import Question

TEXT = """
title: A title
question: Which?
paper: Nothing.
jobs:
  - {scene: sand, scale: small, field: [basis, mlp]}
  - scene: sand
    scale: small
    sampler: [random, qdeim]
    deploy.dt_multiplier: 1.5
    scene.design.test: [[44, 55]]
    field.modes: null
"""


PARTS = """
title: A whole
question: Which of them?
parts:
  first: {title: First, question: "Which?", paper: Nothing., jobs: [{scene: sand, seed: [0, 1]}]}
  second: {title: Second, question: "Why?", paper: Nothing., each: {seed: 2}, jobs: [{scene: [sand, metal]}]}
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
    rest = ("deploy.dt_multiplier=1.5", "scene.design.test=[44,55]", "field.modes=null")
    assert [job.overrides for job in jobs] == [
        *((*first, f"field={field}") for field in ("basis", "mlp")),
        *((*first, f"sampler={sampler}", *rest) for sampler in ("random", "qdeim")),
    ]


def test_how_runs_are_measured_is_no_setting(written):
    jobs = "jobs: [{scene: sand, seed: 0}, {scene: sand, seed: 1, evaluation.trials: 0}]"
    found = written(TEXT[: TEXT.index("jobs:")] + jobs).jobs
    assert "evaluation.trials=0" in found[1].overrides
    assert [set(job.keys) for job in found] == [set(found[0].keys)] * 2


def test_keys_of_a_job(written):
    *_, last = written(TEXT).jobs
    assert last.keys["sampler"] == "qdeim"
    assert last.keys["scene.design.test"] == "[44,55]"


def test_what_the_paper_prints_is_text_as_in_the_keys_of_jobs(written):
    assert written(TEXT).printed is None
    assert written(TEXT + "printed: []\n").printed == ()
    (entry,) = written(
        TEXT + "printed: [{parameter: 44, deploy.changes: {a.b: 0.3}, field.modes: null, delta: 0.02}]\n"
    ).printed
    changes = {"parameter": "44", "deploy.changes": "{a.b:0.3}", "field.modes": "null"}
    assert entry == changes | {"delta": 0.02}


def test_overrides_take_the_place_of_the_files(written):
    experiment = written(TEXT.replace("    field.modes: null\n", ""), "field=mlp", "seed=1,2")
    assert [job.overrides for job in experiment.jobs][:2] == [
        ("scene=sand", "scale=small", "field=mlp", "seed=1"),
        ("scene=sand", "scale=small", "field=mlp", "seed=2"),
    ]


def test_equal_jobs_are_one(written):
    assert len(written(TEXT, "field=basis", "sampler=random").jobs) == 2


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("title: [", "correct the yaml"),
        (TEXT.replace("question", "aim"), "must have the keys"),
        (TEXT[: TEXT.index("jobs")] + "jobs: 3", "jobs is a list"),
        (TEXT + "stages: [point]\n", r"stages=\['point'\] must be a list of superresolve"),
        (TEXT + "printed: [0.2]\n", "printed must be a list of mappings"),
        (TEXT + "printed: [{scene: sand}]\n", "each with a number delta"),
        ("title: !!python/name:os.system", "could not determine a constructor"),
        (TEXT[: TEXT.index("jobs")] + "jobs: [5]", r"jobs\[0\]=5 must be keys with their values"),
        (TEXT[: TEXT.index("jobs")] + "jobs: [{5: 5}]", r"jobs\[0\]=\{5: 5\} must be keys"),
        (TEXT[: TEXT.index("jobs")] + "jobs: [{scene: []}]", r"jobs\[0\]: scene=\[\] has no value"),
        (TEXT + "each: 3\n", "each=3 must be keys"),
        (TEXT + "printed: [{delta: .inf}]\n", "each with a number delta"),
        (TEXT.replace("A title", "[1, 2]"), r"title=\[1, 2\] must be text"),
        (TEXT.replace("Which?", "null"), "question=null must be text"),
        ("title: a\0b", "control character"),
        ("a: &a [*a]", "holds itself"),
        ("a: 2024-99-99", "month must be in"),
        (PARTS + "jobs: [{scene: sand}]\n", "and no other; parts is a mapping"),
        (PARTS[: PARTS.index("parts")] + "parts: {}\n", "parts is a mapping"),
        (PARTS + "  third: 3\n", r"one\.yaml: third must have the keys jobs"),
    ],
)
def test_a_file_that_is_no_experiment(written, text, told):
    with pytest.raises(ConfigError, match=told):
        written(text)


def test_a_part_is_an_experiment(written, tmp_path):
    whole = written(PARTS, "scale=small")
    assert [part.name for part in whole.parts] == ["one/first", "one/second"]
    assert len(whole.jobs) == 4
    part = Experiment.load("one/second", ["scale=small"], tmp_path)
    assert (part.title, part.question, part.parts) == ("Second", "Why?", ())
    assert [job.overrides for job in part.jobs] == [
        ("seed=2", f"scene={scene}", "scale=small") for scene in ("sand", "metal")
    ]


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("one/third", r"choose one of one/first, one/second"),
        ("second", r"did you mean one/second\?"),
    ],
)
def test_an_unknown_part(written, tmp_path, name, told):
    written(PARTS)
    with pytest.raises(ConfigError, match=told):
        Experiment.load(name, folder=tmp_path)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_file_in_another_encoding(tmp_path, encoding):
    (tmp_path / "one.yaml").write_bytes(TEXT.replace("A title", "Ein Säulentitel").encode(encoding))
    with pytest.raises(ConfigError, match=r"one\.yaml.*save it as UTF-8"):
        Experiment.load("one", folder=tmp_path)


@pytest.mark.parametrize(
    ("job", "told"),
    [
        ("{seed: 'range(0,1000000000)'}", "has more than 10000 values"),
        ("{seed: 'range(0,5,0)'}", "give start, stop and step"),
        ("{seed: 'range(0,900)', latent_dim: 'range(0,900)'}", "810000 jobs are more than the 10000"),
        ("{seed: 'interval(0,1)'}", "has no end of values"),
        ("{seed: '[1'}", "is not Hydra's key=value"),
    ],
)
def test_jobs_that_no_one_can_mean(written, job, told):
    with pytest.raises(ConfigError, match=told):
        _ = written(TEXT[: TEXT.index("jobs")] + f"jobs: [{job}]").jobs


def test_a_name_leads_nowhere_else(tmp_path):
    (tmp_path / "one.yaml").write_text(TEXT)
    (tmp_path / "inner").mkdir()
    with pytest.raises(ConfigError, match=r"unknown experiment=\.\./one"):
        Experiment.load("../one", folder=tmp_path / "inner")


def test_the_nearest_name_is_told():
    with pytest.raises(ConfigError, match=r"unknown experiment=tabel1.*did you mean table1"):
        Experiment.load("tabel1")


def test_an_option_that_lacks_a_key_of_the_experiment_is_named(written):
    text = TEXT.replace("field.modes: null", "field.modes: null\n    model.runs: 9\n    model: recurrence")
    with pytest.raises(ConfigError, match=r"sets model\.runs, which model=interpolate does not have"):
        written(text, "model=interpolate")
    assert written(text, "model=recurrence")
    of_scene = TEXT.replace("field.modes: null", "scene.design.test_seed: 1")
    assert written(of_scene, "scene=tray")  # whose file holds `scene.` itself
    with pytest.raises(ConfigError, match=r"sets scene\.design\.test_seed, which scene=sand does not have"):
        written(of_scene, "scene=sand")


def test_keys_of_another_part_refuse_no_option(tmp_path):
    text = PARTS.replace("each: {seed: 2}", "each: {seed: 2, model: recurrence, model.runs: 9}")
    (tmp_path / "one.yaml").write_text(text)
    assert Experiment.load("one/first", ["model=interpolate"], tmp_path).jobs
    with pytest.raises(ConfigError, match=r"second sets model\.runs"):
        Experiment.load("one", ["model=interpolate"], tmp_path)


@pytest.mark.parametrize(
    ("overrides", "same"),
    [
        ([], True),
        (["device=cpu", "data.keep=held_out", "tracking=none"], True),  # how, not what, is computed
        (["scale=small"], True),  # as in the file
        (["scale=paper"], False),
        (["stress=deformation"], False),
        (["sampler=random"], False),  # fewer jobs
        (["evaluation.trials=0"], False),  # a report without times
    ],
)
def test_jobs_of_other_settings_have_a_report_of_their_own(written, tmp_path, monkeypatch, overrides, same):
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path))
    places = []
    monkeypatch.setattr("nsf.results.folder.check_place", lambda folder: places.append(folder.name))
    written(TEXT, *overrides).check_report_folder()
    assert (places == ["one"]) == same
    if not same:
        assert places == [f"one_{overrides[0]}"]


def test_names_of_reports_differ_where_their_settings_do(written, tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path))
    places = []
    monkeypatch.setattr("nsf.results.folder.check_place", places.append)
    several = [["scene.steps=5", "seed=1"], ["seed=1", "scene.steps=5"], ["seed=1,2"]]
    lists = [[f"scene.design.train=[{train}]"] for train in ("20,30", "'20,30'", ",".join(["20"] * 90))]
    for overrides in several + lists:
        written(TEXT, *overrides).check_report_folder()
    assert len(set(places)) == len(places) - 1  # the order of overrides is no setting
    assert {place.parent for place in places} == {tmp_path}
    assert max(len(place.name) for place in places) < 120


def test_a_job_that_leaves_a_number_out_has_its_default(written):
    of = "{scene: sand}, {scene: sand, field.noise: 0.1, model.stress: 4, model: recurrence}, {scene: metal}"
    jobs = written(TEXT[: TEXT.index("jobs:")] + f"jobs: [{of}]").jobs
    keys = {str(k): job.keys for k, job in enumerate(jobs)}
    configs = {str(k): config.load(job.overrides) for k, job in enumerate(jobs)}
    settings = Question("one", "", keys=keys, defaults=_defaults(keys, configs)).settings
    # Not where no job of the scene sets the key, nor where there is none, or no number.
    assert settings == {
        "0": {"field.noise": "0.01"},
        "1": {"field.noise": "0.1", "model.stress": "4"},
        "2": {},
    }
