"""Trajectories and training on several devices; GPUs that are not there stand for processes on the CPU."""

import os
import time
from functools import partial

import pytest
import torch

from nsf.data import Trajectory
from nsf.errors import ConfigError, DeviceError
from nsf.mpm.device import visible_gpus
from nsf.pipeline import chain as module
from nsf.pipeline import simulation
from nsf.progress import Progress
from nsf.runs import Run

VALUES = (22.0, 26.0, 30.0, 38.0)
MLP = ("field=mlp", "~field.modes", "~field.depth", "trainer.frames_per_batch=8")


@pytest.fixture
def on(tmp_path, tiny, monkeypatch):
    """(*overrides, gpus, said) → the tiny chain on a machine with these GPUs."""
    from nsf import config
    from nsf.pipeline import Pipeline

    def make(*overrides, gpus=("0", "1"), said=None):
        monkeypatch.setattr(module, "visible_gpus", lambda: gpus)
        keys = {override.split("=")[0].lstrip("~") for override in overrides}
        base = [override for override in tiny if override.split("=")[0] not in keys]
        own = [override for override in overrides if not override.startswith("~")]
        say = (lambda line: None) if said is None else said.append
        return Pipeline(config.load([*base, *own]), say, tmp_path / "runs")

    return make


def start_after(happened, monkeypatch):
    """Start no trajectory in this process before something has happened in another one."""
    start = simulation._start

    def late(job, *arguments):
        began = time.monotonic()
        while not happened() and time.monotonic() - began < 60:
            time.sleep(0.02)
        return start(job, *arguments)

    monkeypatch.setattr(simulation, "_start", late)


@pytest.fixture
def shared_with_another(tmp_path, monkeypatch):
    """Another process makes the first trajectory; gives all amounts that the bar of this one was told."""
    advance, amounts = Progress.advance, []
    start_after(lambda: Run.find("simulate", root=tmp_path / "runs"), monkeypatch)
    monkeypatch.setattr(
        Progress, "advance", lambda self, amount=1: amounts.append(amount) or advance(self, amount)
    )
    return amounts


def positions(pipeline):
    found = []
    for value in VALUES:
        with Trajectory.open(pipeline.simulation(value).path / "trajectory.h5") as trajectory:
            found.append(trajectory.read("x"))
    return found


def test_trajectories_are_shared_out(on, chain, shared_with_another):
    said = []
    pipeline = on("device=auto", said=said)
    pipeline.simulate()
    assert max(shared_with_another) > 1  # told by the other process; here a frame counts at a time
    assert sum(shared_with_another) == 4 * 25
    assert [line.split(" in ")[0] for line in said] == ["simulate: 4 trajectories"]
    for one, other in zip(positions(pipeline), positions(chain.pipeline), strict=True):
        assert (one == other).all()


def fails_beside(build, marker):
    if os.environ.get("CUDA_VISIBLE_DEVICES") == "7":
        marker.touch()
        raise DeviceError("out of memory")
    return build()


def test_what_another_process_fails_to_make_is_made_here(on, chain, tmp_path, monkeypatch):
    said, marker = [], tmp_path / "failed"
    start_after(marker.exists, monkeypatch)
    pipeline = on("device=auto", gpus=("6", "7"), said=said)
    job = module.Job
    monkeypatch.setattr(module, "Job", lambda *own: job(*own[:-1], partial(fails_beside, own[-1], marker)))
    pipeline.simulate()
    assert said[0] == "simulate: warning: a further GPU was left idle after an error: out of memory"
    assert said[1].startswith("simulate: 4 trajectories in")
    for one, other in zip(positions(pipeline), positions(chain.pipeline), strict=True):
        assert (one == other).all()


def test_a_named_device_is_used_alone(on, monkeypatch):
    monkeypatch.setattr(simulation, "working", None)
    on("device=cpu").simulate()


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


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_the_same_bits_on_either_gpu(on, chain, shared_with_another, tmp_path):
    both = on("device=auto", "transfer.deterministic=true", gpus=visible_gpus()[:2])
    both.simulate()
    assert max(shared_with_another) > 1
    both_x = positions(both)
    both.root = tmp_path / "alone"
    on("device=auto", gpus=())
    both.simulate()
    for one, other in zip(both_x, positions(both), strict=True):
        assert (one == other).all()
