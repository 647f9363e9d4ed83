"""Every experiment can be run: each variant of its command composes and builds."""

import pytest
import yaml
from expand import variants

from nsf import config
from nsf.paths import EXPERIMENTS
from nsf.pipeline import Pipeline

FILES = sorted(EXPERIMENTS.glob("*.yaml"))


@pytest.fixture(params=FILES, ids=lambda f: f.stem)
def experiment(request):
    return yaml.safe_load(request.param.read_text(encoding="utf-8"))


def test_there_are_experiments():
    assert FILES


def test_experiment_has_its_keys(experiment):
    assert set(experiment) == {"question", "paper", "command"}
    assert all(isinstance(text, str) and text for text in experiment.values())


def test_every_variant_builds(experiment):
    stage, runs = variants(experiment["command"])
    assert stage == "run"
    assert len({tuple(run) for run in runs}) == len(runs)
    for overrides in runs:
        Pipeline(config.load([*overrides, "device=cpu"]))


def test_the_sand_experiment_is_two_by_two():
    _, runs = variants(yaml.safe_load((EXPERIMENTS / "sand.yaml").read_text(encoding="utf-8"))["command"])
    chosen = {tuple(word for word in run if word.startswith(("field=", "method="))) for run in runs}
    assert len(chosen) == len(runs) == 4
