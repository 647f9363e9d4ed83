"""The chain that a deploy run is part of, from the run alone."""

import shutil
from dataclasses import replace

import pytest

from nsf.errors import MissingRunError, SchemaError
from nsf.pipeline import Pipeline
from nsf.pipeline.chain import CONFIGURATION


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


def test_keys_still_follow_the_parameter(pipeline_at, tmp_path):
    """A resolved configuration would keep E where it was."""
    pipeline = pipeline_at(tmp_path, "material.E=${material.friction_angle}")
    run = pipeline.deployment
    with run.record() as record:
        pipeline._write_configuration(record)
    scenes = [Pipeline.of_run(run, "cpu").scene.with_parameters({"friction_angle": v}) for v in (20.0, 30.0)]
    assert [scene.material.E for scene in scenes] == [20.0, 30.0]


def test_a_run_without_its_configuration_says_what_to_do(chain, tmp_path):
    shutil.copytree(chain.root / "deploy", tmp_path / "deploy")
    run = replace(chain.pipeline.deployment, root=tmp_path)
    (run.path / CONFIGURATION).unlink()
    with pytest.raises(MissingRunError, match="delete the folder and run `nsf deploy scene=sand`"):
        Pipeline.of_run(run)
