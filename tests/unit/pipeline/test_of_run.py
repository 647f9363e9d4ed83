"""The chain that a deploy run is part of, from the run alone."""

import json
import shutil
from dataclasses import replace

import pytest
from omegaconf import OmegaConf

from nsf.errors import ConfigError, SchemaError
from nsf.pipeline import Pipeline
from nsf.pipeline.stages.deployment import CONFIGURATION
from nsf.runs import Run


def test_the_same_chain_comes_out(chain):
    run = chain.pipeline.deployment
    found = Pipeline.of_run(run, device="cpu")
    assert found.deployment == run
    assert found.training == chain.pipeline.training
    assert CONFIGURATION in {output["path"] for output in run.manifest["outputs"]}


def test_a_run_on_another_device_has_the_same_training(chain, tmp_path, seal):
    shutil.copytree(chain.root, tmp_path / "runs")
    run = replace(chain.pipeline.deployment, root=tmp_path / "runs")
    path = run.path / CONFIGURATION
    path.write_text(path.read_text().replace("device: cpu", "device: cuda:0"))
    with pytest.raises(SchemaError, match=r"configuration\.yaml has .* bytes, where its manifest records"):
        Pipeline.of_run(run, device="cpu")
    seal(run)
    assert Pipeline.of_run(run, device="cpu").training.complete


def test_what_was_learned_on_another_device_is_that_of_the_deployment(chain, tmp_path):
    shutil.copytree(chain.root, tmp_path / "runs")
    run = Run.named(chain.pipeline.deployment.id, "deploy", tmp_path / "runs")
    manifest = json.loads((run.path / "manifest.json").read_text())
    manifest["parents"].append("teach/sand/0123456789ab")  # whose name has the device
    (run.path / "manifest.json").write_text(json.dumps(manifest))
    assert Pipeline.of_run(run, device="cpu").taught.id == "teach/sand/0123456789ab"


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("model._target_", "nsf.workers.Worker", r"model: _target_: nsf\.workers\.Worker is refused"),
        ("scene.colliders.floor._target_", "nsf.storage.write_json", "write_json is refused"),
        ("sampler._target_", "os.system", r"sampler: _target_: os\.system is refused"),
        ("scene.title", "${oc.env:HOME}", "scene.title: .*oc.env.* is refused"),
        ("deploy", None, "deploy=null must map keys to values"),
    ],
)
def test_a_configuration_that_was_handed_over_runs_nothing(chain, tmp_path, monkeypatch, key, value, told):
    """As `nsf serve` opens one: whole by its manifest, which whoever wrote it wrote as well."""
    shutil.copytree(chain.root, tmp_path / "runs")
    run = replace(chain.pipeline.deployment, root=tmp_path / "runs")
    config = OmegaConf.load(run.path / CONFIGURATION)
    OmegaConf.update(config, key, value)
    with run.record() as record:
        (run.path / CONFIGURATION).write_text(OmegaConf.to_yaml(config))
        record.output(CONFIGURATION)
    with pytest.raises(ConfigError, match=told):
        Pipeline.of_run(run, device="cpu")


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"a: b\n"])
def test_a_configuration_that_is_none_is_told_by_name(chain, tmp_path, content):
    shutil.copytree(chain.root / "deploy", tmp_path / "deploy")
    run = replace(chain.pipeline.deployment, root=tmp_path)
    with run.record() as record:
        (run.path / CONFIGURATION).write_bytes(content)
        record.output(CONFIGURATION)
    with pytest.raises(ConfigError) as refusal:
        Pipeline.of_run(run, device="cpu")
    assert len(str(refusal.value).splitlines()) == 1


def test_a_run_without_its_configuration_says_what_to_do(chain, tmp_path):
    shutil.copytree(chain.root / "deploy", tmp_path / "deploy")
    run = replace(chain.pipeline.deployment, root=tmp_path)
    (run.path / CONFIGURATION).unlink()
    with pytest.raises(SchemaError, match="delete the run's folder and run `nsf deploy` again"):
        Pipeline.of_run(run)
