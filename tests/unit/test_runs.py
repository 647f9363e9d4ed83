"""Run folders: identity, status, resume."""

import hashlib
import multiprocessing
import os
import signal
import subprocess

import numpy as np
import pytest
import yaml

import nsf.runs.provenance
import nsf.runs.record
import nsf.runs.run
from nsf.canonical import content_hash, plain
from nsf.errors import ConfigError, MissingRunError, StorageError
from nsf.runs import Run

CONFIG = {"mu": 1e6, "name": "1e-5", "list": [1, 2.5, None, True], "nested": {"b": 1, "a": "x: y"}}


@pytest.fixture
def run(tmp_path):
    return Run.open("simulate", "sand", CONFIG, root=tmp_path)


def recorded(run, text="payload", **metrics):
    with run.record(device="cpu", seed=3, precision="fp64") as record:
        (run.path / "data.bin").write_text(text)
        record.output("data.bin")
        record.metrics.update(metrics)
    return run


def test_the_hash_is_that_of_the_documented_content(run):
    content = '{"config":{"mu":5},"format":3,"parents":[],"scene":"sand","stage":"simulate"}'
    expected = hashlib.sha256(content.encode()).hexdigest()[:12]
    assert Run.open("simulate", "sand", {"mu": 5}, root=run.root).hash == expected


def test_the_hash_is_of_content_and_not_of_spelling(tmp_path):
    first = Run.open("simulate", "sand", {"a": 1, "b": (2.0, np.float64(3))}, root=tmp_path)
    assert first.hash == Run.open("simulate", "sand", {"b": [2, 3], "a": np.int64(1)}, root="elsewhere").hash
    assert content_hash(True) != content_hash(1)
    assert content_hash("1") != content_hash(1)


def test_everything_that_determines_the_content_changes_the_hash(tmp_path, monkeypatch):
    parent, other = (Run.open("simulate", "sand", {"mu": mu}, root=tmp_path) for mu in (1, 2))
    runs = [
        Run.open("train", "sand", {"r": 5}),
        Run.open("train", "sand", {"r": 6}),
        Run.open("train", "jelly", {"r": 5}),
        Run.open("deploy", "sand", {"r": 5}),
        Run.open("train", "sand", {"r": 5}, parents=[parent]),
        Run.open("train", "sand", {"r": 5}, parents=[other]),
        Run.open("train", "sand", {"r": 5}, parents=[parent, other]),
    ]
    monkeypatch.setattr(nsf.runs.run, "FORMAT", 4)
    runs.append(Run.open("train", "sand", {"r": 5}))
    assert len({run.hash for run in runs}) == len(runs)


def test_the_root_comes_from_the_argument_then_the_environment_then_here(tmp_path, monkeypatch):
    monkeypatch.delenv("NSF_RUNS", raising=False)
    assert str(Run.open("s", "t", {}).root) == "runs"
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "env"))
    assert Run.open("s", "t", {}).root == tmp_path / "env"
    run = Run.open("s", "t", {}, root=tmp_path)
    assert run.path == tmp_path / "s" / "t" / run.hash
    assert run.id == f"s/t/{run.hash}"


def test_a_recorded_run(run):
    parent = recorded(run)
    child = Run.open("train", "sand", {"r": 5}, parents=[parent], root=run.root)
    assert not child.path.exists()
    with child.record(device="cuda:0", seed=1, precision="fp32") as record:
        assert child.manifest["status"] == "running"
        assert not child.complete
        record.metrics |= {"loss": np.float32(0.5), "curve": np.arange(2), "ratio": float("inf")}
        (child.path / "nets").mkdir()
        for name in ("a", "b"):
            (child.path / "nets" / name).write_text(name)
        record.output(child.path / "nets")
    manifest = child.manifest
    assert child.complete
    assert child.require() is child
    assert manifest["parents"] == [parent.id]
    assert manifest["status"] == "complete"
    assert manifest["metrics"] == {"loss": 0.5, "curve": [0, 1], "ratio": None}
    assert [output["path"] for output in manifest["outputs"]] == ["nets/a", "nets/b"]
    assert manifest["outputs"][0]["bytes"] == 1
    assert manifest["outputs"][0]["sha256"].startswith("ca978112ca1bbdca")
    assert (manifest["device"], manifest["seed"], manifest["precision"]) == ("cuda:0", 1, "fp32")
    assert manifest["seconds"] >= 0
    assert manifest.keys() >= {"stage", "scene", "hash", "commit", "dirty", "versions", "created"}
    assert sorted(os.listdir(child.path)) == [".lock", "config.yaml", "manifest.json", "nets"]


def test_packages_without_metadata_are_recorded_as_such(run, monkeypatch):
    """As of a package that lies on the path and was not installed."""
    monkeypatch.setattr(nsf.runs.provenance, "_version", lambda distribution: None)
    monkeypatch.setattr(nsf.runs.run, "provenance", nsf.runs.provenance.provenance.__wrapped__)
    recorded(run)
    assert Run.named(run.id, root=run.root).manifest["versions"]["numpy"] is None


def test_the_config_on_disk_is_plain_and_the_same(run):
    recorded(run)
    text = (run.path / "config.yaml").read_text()
    assert yaml.safe_load(text)["nested"] == CONFIG["nested"]
    loaded = Run.named(run.id, root=run.root)
    assert loaded == run
    assert loaded.config == CONFIG
    assert isinstance(loaded.config["name"], str)
    assert Run.open("simulate", "sand", loaded.config, root=run.root) == run


@pytest.mark.parametrize(
    ("error", "status"), [(ValueError("bad mu"), "failed"), (KeyboardInterrupt(), "interrupted")]
)
def test_an_exception_is_recorded_and_goes_on(run, error, status):
    def work():
        with run.record() as record:
            record.metrics["loss"] = 1.0
            raise error

    with pytest.raises(type(error)) as caught:
        work()
    assert caught.value is error
    assert run.manifest["status"] == status
    assert run.manifest["metrics"] == {"loss": 1.0}
    assert not run.complete
    with pytest.raises(MissingRunError, match=f"{status}.*nsf simulate"):
        run.require()
    assert "bad mu" in run.manifest["error"] or status == "interrupted"
    assert recorded(run).complete  # tried again
    assert "error" not in run.manifest


def test_a_metric_that_json_cannot_hold_fails_the_run(run):
    with pytest.raises(ConfigError, match=r"metrics\.net"), run.record() as record:
        record.metrics["net"] = object()
    assert run.manifest["status"] == "failed"


def test_a_full_disk_at_the_end_does_not_hide_the_error(run, monkeypatch):
    def full(path, value):
        raise StorageError("full")

    def work():
        with run.record():
            monkeypatch.setattr(nsf.runs.record, "write_json", full)
            raise ValueError("first")

    with pytest.raises(ValueError, match="first"):
        work()


SPAWN = multiprocessing.get_context("spawn")


def hold(run, started, finish):
    """Record a run, and say when it has begun; the end waits for a word."""
    with run.record() as record:
        (run.path / "data.bin").write_text("theirs")
        record.output("data.bin")
        started.set()
        finish.wait(60)


@pytest.fixture
def held(run):
    """(run, its other process, the word that lets it finish): another process is recording the run."""
    started, finish = SPAWN.Event(), SPAWN.Event()
    process = SPAWN.Process(target=hold, args=(run, started, finish))
    process.start()
    assert started.wait(60)
    yield run, process, finish
    process.kill()
    process.join()


def test_a_second_process_waits_and_finds_the_run_complete(held):
    run, _, finish = held
    told = []

    def say(line):
        told.append(line)
        finish.set()

    assert run.status == "running"
    with run.claimed() as mine:
        assert not mine
    assert not run.complete
    with run.claimed(say) as mine:
        assert mine
        assert run.complete
    assert told == [f"simulate: waiting for another process, which is making {run.id}"]
    with run.claimed(say):
        assert len(told) == 1  # a free run is not waited for


def test_a_killed_process_leaves_its_run_free(held):
    run, process, _ = held
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert run.manifest["status"] == "running"
    assert run.status == "killed"
    with pytest.raises(MissingRunError, match="is killed; run `nsf simulate"):
        run.require()
    with run.claimed() as mine:
        assert mine
    assert recorded(run).complete


def test_what_a_killed_process_left_half_written_is_removed(run):
    for folder in (run.path / ".partial-1", run.path / "g" / ".partial-2"):
        folder.mkdir(parents=True)
        (folder / "trajectory.h5").write_text("half")
    recorded(run)
    assert not list(run.path.rglob(".partial-*"))


def test_a_run_is_claimed_by_a_process_and_not_by_a_thread(run):
    with run.claimed() as mine, run.claimed() as again, run.record():
        assert mine
        assert again
        assert run.status == "running"
    assert run.status == "complete"
    with run.claimed() as mine:
        assert mine


def test_find_is_newest_first_and_by_scene(tmp_path):
    runs = [recorded(Run.open("train", "sand", {"r": r}, root=tmp_path)) for r in (3, 1, 2)]
    jelly = recorded(Run.open("train", "jelly", {"r": 1}, root=tmp_path))
    recorded(Run.open("simulate", "sand", {"r": 1}, root=tmp_path))
    assert Run.find("train", "sand", root=tmp_path) == runs[::-1]
    assert Run.find("train", root=tmp_path) == [jelly, *runs[::-1]]
    assert Run.find("deploy", root=tmp_path) == []
    assert Run.find("train", "jelly", root=tmp_path)[0].config == {"r": 1}


def test_outputs_must_lie_in_the_run(run, tmp_path):
    (tmp_path / "out").write_text("x")
    for path in (tmp_path / "out", "../../../out", "absent"):
        with pytest.raises(ConfigError, match="no file inside"), run.record() as record:
            record.output(path)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"a": {"b": [1, float("nan")]}}, r"config\.a\.b\[1\]=nan"),
        ({"a": object()}, r"config\.a="),
        ({"a": {1, 2}}, r"config\.a="),
    ],
)
def test_a_config_that_names_no_run(config, message):
    with pytest.raises(ConfigError, match=message):
        Run.open("train", "sand", config)


@pytest.mark.parametrize("name", ["", "..", "a/b", "a b", ".hidden"])
def test_names_are_folder_names(name):
    with pytest.raises(ConfigError, match="folder name"):
        Run.open("train", name, {})


def test_a_run_is_named_by_any_clear_beginning(tmp_path, monkeypatch):
    runs = [
        recorded(Run.open("deploy", s, {"k": k}, root=tmp_path)) for s in ("sand", "cake") for k in (1, 2)
    ]
    for run in runs:
        names = (run.id, run.id[:-3], run.hash, run.hash[:8], f"{run.scene}/{run.hash[:8]}", str(run.path))
        assert {Run.named(name, "deploy", tmp_path) for name in names} == {run}
    monkeypatch.chdir(runs[0].path.parent)
    assert Run.named(runs[0].hash, "deploy", "elsewhere").id == runs[0].id  # its folder, from here
    assert Run.newest("deploy", tmp_path) == runs[-1]
    newest = Run.open("deploy", "sand", {"k": 3}, root=tmp_path)
    with pytest.raises(ValueError, match="lost"), newest.record():
        raise ValueError("lost")
    assert Run.newest("deploy", tmp_path) == runs[-1]  # the newest that is complete
    assert Run.named(newest.hash, root=tmp_path).status == "failed"


def test_a_run_named_badly_lists_what_is_there(tmp_path):
    with pytest.raises(MissingRunError, match=r"no complete deploy run .* run `nsf deploy` first"):
        Run.newest("deploy", tmp_path)
    with pytest.raises(MissingRunError, match=r"begins with, 'sand' .* run `nsf deploy` first"):
        Run.named("sand", "deploy", tmp_path)
    runs = [recorded(Run.open("deploy", "sand", {"k": k}, root=tmp_path)) for k in (1, 2)]
    for name, told in (("sand", "2 deploy runs begin with 'sand'"), ("cake", "no deploy run is, or begins")):
        with pytest.raises(MissingRunError, match=told) as caught:
            Run.named(name, "deploy", tmp_path)
        assert all(f"{run.id}  (complete)" in str(caught.value) for run in runs)
    train = recorded(Run.open("train", "sand", {}, root=tmp_path))
    with pytest.raises(MissingRunError, match="3 runs begin with ''"):
        Run.named("", root=tmp_path)
    with pytest.raises(MissingRunError, match="is a train run; name a deploy run"):
        Run.named(str(train.path), "deploy")


def test_plain_of_tensors_and_paths(tmp_path):
    torch = pytest.importorskip("torch")
    assert plain({"a": torch.tensor(2.0), "p": tmp_path}) == {"a": 2.0, "p": str(tmp_path)}


def test_provenance_in_and_outside_a_checkout(tmp_path, monkeypatch):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e@x"]
    package = tmp_path / "pkg" / "runs"
    package.mkdir(parents=True)
    (package / "provenance.py").write_text("")
    monkeypatch.setattr(nsf.runs.provenance, "__file__", str(package / "provenance.py"))
    fresh = nsf.runs.provenance.provenance.__wrapped__
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert (fresh()["commit"], fresh()["dirty"]) == (None, None)
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "m"], check=True)
    assert fresh()["commit"] is None  # the package lies in the checkout but is not of it
    subprocess.run([*git, "add", "."], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "m"], check=True)
    (tmp_path / "notes").write_text("outside the package")
    assert len(fresh()["commit"]) == 40
    assert fresh()["dirty"] is False
    (package / "new.py").write_text("")
    assert fresh()["dirty"] is True
    assert fresh()["versions"]["numpy"] == np.__version__
    monkeypatch.setenv("PATH", "")
    assert fresh()["commit"] is None
