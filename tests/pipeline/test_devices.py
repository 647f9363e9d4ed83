"""Training on several devices, for which processes on the CPU stand."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from nsf.errors import ConfigError, DeviceError
from nsf.kinematics.training.descent import CHECKPOINT

MLP = ("field=mlp", "~field.modes", "~field.depth", "trainer.frames_per_batch=8")


@pytest.fixture
def on(tmp_path, tiny):
    """(*overrides, said) → the tiny chain."""
    from nsf import config
    from nsf.pipeline import Pipeline

    def make(*overrides, said=None):
        keys = {override.split("=")[0].lstrip("~") for override in overrides}
        base = [override for override in tiny if override.split("=")[0] not in keys]
        own = [override for override in overrides if not override.startswith("~")]
        say = (lambda line: None) if said is None else said.append
        return Pipeline(config.load([*base, *own]), say, tmp_path / "runs")

    return make


def test_one_device_is_the_training_that_it_was(on):
    """Runs of before there was the key, and of configurations that lack it, keep their names."""
    one, two = (on(*MLP, f"trainer.devices={n}") for n in (1, 2))
    assert "devices" not in one.training.config["trainer"]
    assert two.training.config["trainer"]["devices"] == 2
    assert two.training != one.training
    del one.config.trainer.devices
    assert one.training == on(*MLP).training


def test_how_networks_are_multiplied_is_of_deployment(on):
    one, two = (on(*MLP, f"field.arithmetic={name}") for name in ("tf32", "null"))
    assert one.training == two.training == on(*MLP).training
    assert one.deployment != two.deployment
    assert one.deployment == on(*MLP).deployment
    with pytest.raises(ConfigError, match=r"field\.arithmetic=fp8 is unknown; choose tf32, bf16 or null"):
        on(*MLP, "field.arithmetic=fp8")


@pytest.mark.skipif(os.cpu_count() == 1, reason="two processes want two cores")
@pytest.mark.slow
def test_training_on_two_devices(on, tmp_path):
    said = []
    pipeline = on(*MLP, "trainer.devices=2", "trainer.steps=20", said=said)
    pipeline.simulate()
    assert pipeline.train().complete
    assert said[-1].startswith("train: field=mlp")
    assert pipeline.manifold().field == "mlp"
    assert pipeline.training.manifest["metrics"]["stress_steps"] == 20
    assert not [path for path in tmp_path.rglob("*") if ".partial" in str(path)]


def ranks_of(process):
    """Processes that train for it."""
    started = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [
        Path(f"/proc/{pid}") for pid in started if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()
    ]


def ended(path):
    """Whether a process has gone, or is only not yet waited for."""
    return not path.exists() or "State:\tZ" in (path / "status").read_text()


@pytest.fixture
def interrupted(tiny):
    """(pipeline, signal) → exit code and error of a training that got the signal as it trained."""

    def call(pipeline, number):
        keys = pipeline.config.trainer
        arguments = [
            o for o in tiny if o.split("=")[0] not in ("field.modes", "field.depth", "trainer.steps")
        ]
        arguments += [f"trainer.{key}={keys[key]}" for key in ("devices", "steps", "frames_per_batch")]
        process = subprocess.Popen(
            [sys.executable, "-m", "nsf.cli", "train", "field=mlp", *arguments],
            env=os.environ | {"NSF_RUNS": str(pipeline.root)}, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        kept = pipeline.training.path / "deformation" / CHECKPOINT
        before, began = kept.stat().st_mtime_ns if kept.exists() else 0, time.monotonic()
        while process.poll() is None and time.monotonic() - began < 120:
            if kept.exists() and kept.stat().st_mtime_ns != before:
                break
            time.sleep(0.01)
        ranks = ranks_of(process)
        process.send_signal(number)
        err = process.communicate(timeout=120)[1]
        assert len(ranks) == 2, err
        while not all(map(ended, ranks)) and time.monotonic() - began < 240:
            time.sleep(0.05)
        assert all(map(ended, ranks))
        return process.returncode, err

    return call


@pytest.mark.skipif(os.cpu_count() == 1, reason="two processes want two cores")
@pytest.mark.slow
def test_no_rank_outlives_who_asked_and_a_resumed_training_has_the_same_bits(on, interrupted, tmp_path):
    pipeline = on(*MLP, "trainer.devices=2", "trainer.steps=600")
    pipeline.simulate()
    shutil.copytree(pipeline.root, tmp_path / "undisturbed")
    code, err = interrupted(pipeline, signal.SIGTERM)
    assert code == 130
    assert err.splitlines()[-1].startswith("interrupted; the same command goes on")
    assert "Traceback" not in err
    assert pipeline.training.status == "interrupted"
    assert not [path for path in tmp_path.rglob("*") if ".partial" in str(path)]
    assert interrupted(pipeline, signal.SIGKILL)[0] == -signal.SIGKILL
    assert pipeline.training.status == "killed"
    pipeline.train()
    resumed = pipeline.manifold().state_dict()
    pipeline.root = tmp_path / "undisturbed"
    pipeline.train()
    assert all(torch.equal(value, resumed[name]) for name, value in pipeline.manifold().state_dict().items())


def test_what_is_refused(on, monkeypatch):
    with pytest.raises(ConfigError, match=r"trainer\.devices=2 is for field=mlp"):
        on("trainer.devices=2")
    with pytest.raises(ConfigError, match=r"frames_per_batch=8 cannot be shared evenly among devices=3"):
        on(*MLP, "trainer.devices=3")
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    many = on(*MLP, "trainer.devices=8")
    with pytest.raises(DeviceError, match=r"trainer\.devices=8 is more than this process has: 4 processor"):
        many.check_devices()
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    with pytest.raises(DeviceError, match=r"3 processor cores; set trainer\.devices=2"):
        many.check_devices()
    many.device = "cuda:0"
    monkeypatch.setattr("nsf.pipeline.plan.visible_gpus", lambda: ("0",))
    with pytest.raises(DeviceError, match=r"this process has: 1 GPU; set trainer\.devices=1"):
        many.check_devices()
    many.device = many.config.device = "cuda:1"
    with pytest.raises(DeviceError, match=r"and not device=cuda:1; set device=auto"):
        many.check_devices()
