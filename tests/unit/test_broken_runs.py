"""Run folders that were damaged or made by someone else: each is named with its fault, and harms no other."""

import contextlib
import json
import os
import shutil
import zlib

import pytest

import nsf.manifest
from nsf.cli import main
from nsf.errors import ConfigError, MissingRunError, SchemaError, StorageError
from nsf.results.overview.index import write_index
from nsf.results.overview.tables import difference_table
from nsf.runs import Run
from nsf.runs.listing import entries


def made(root, stage, config, parents=()):
    run = Run.open(stage, "sand", config, parents, root=root)
    with run.record(device="cpu", seed=0, precision="fp64") as record:
        (run.path / "data.bin").write_text("payload")
        record.output("data.bin")
        record.metrics.update(delta=0.01, stages={"p2g": 1.5})
    return run


@pytest.fixture
def runs(tmp_path):
    """Three runs, each made from the one before."""
    simulated = made(tmp_path, "simulate", {"parameters": {"mu": {"key": "material.mu", "value": 26.0}}})
    trained = made(tmp_path, "train", {"latent_dim": 4, "field": {"modes": [8, 8, 8]}}, [simulated])
    return simulated, trained, made(tmp_path, "evaluate", {"evaluation": {"trials": 2}}, [trained])


def said_by(runs, capsys, monkeypatch, *words):
    """(code, out, err) of `nsf runs`."""
    monkeypatch.setenv("NSF_RUNS", str(runs[0].root))
    with pytest.raises(SystemExit) as stop:
        main(["runs", *words])
    return stop.value.code, *capsys.readouterr()


def rewritten(name, **keys):
    def change(folder):
        content = json.loads((folder / "manifest.json").read_text())
        (folder / "manifest.json").write_text(json.dumps(content | keys))

    return pytest.param(change, id=name)


def replaced(name, file, text):
    def change(folder):
        (folder / file).unlink()
        (folder / file).write_bytes(text if isinstance(text, bytes) else text.encode())

    return pytest.param(change, id=name)


def nested(depth):
    return "[" * depth + "]" * depth


def pipe(folder):
    (folder / "manifest.json").unlink()
    os.mkfifo(folder / "manifest.json")


def pipe_of_config(folder):
    (folder / "config.yaml").unlink()
    os.mkfifo(folder / "config.yaml")


def link(folder):
    shutil.move(folder / "config.yaml", folder.parent / "elsewhere.yaml")
    (folder / "config.yaml").symlink_to(folder.parent / "elsewhere.yaml")


def folder_of_manifest(folder):
    (folder / "manifest.json").unlink()
    (folder / "manifest.json").mkdir()


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
DAMAGES = [
    rewritten("created-number", created=5),
    rewritten("parents-text", parents="train/sand/0123"),
    rewritten("parents-outside", parents=["../../etc"]),
    rewritten("status-list", status=["complete"]),
    rewritten("status-unknown", status="splendid"),
    rewritten("metrics-list", metrics=[1]),
    rewritten("seconds-huge", seconds=10**400),
    rewritten("outputs-odd", outputs=[{"path": 5, "bytes": "x", "sha256": None}]),
    rewritten("outputs-outside", outputs=[{"path": "../data.bin", "bytes": 7, "sha256": "0" * 64}]),
    rewritten("format", format=1),
    rewritten("hash", hash="0" * 12),
    rewritten("surrogate", error="\ud800"),
    replaced("manifest-list", "manifest.json", "[1, 2]"),
    replaced("manifest-nan", "manifest.json", '{"status": "complete", "seconds": NaN}'),
    replaced("manifest-binary", "manifest.json", bytes(range(256))),
    replaced("manifest-deeper", "manifest.json", nested(500_000)),
    replaced("manifest-large", "manifest.json", "{" + " " * 3_000_000 + "}"),
    replaced("config-text", "config.yaml", "just words"),
    replaced("config-binary", "config.yaml", bytes(range(256))),
    replaced("config-tag", "config.yaml", "a: !!python/object/apply:os.system [true]\n"),
    replaced("config-inf", "config.yaml", "a: .inf\n"),
    replaced("config-deeper", "config.yaml", "a: " + "[" * 250_000),
    replaced("config-questions", "config.yaml", "? " * 100_000),
    replaced("config-bomb", "config.yaml", BOMB),
    replaced("config-large", "config.yaml", "a: 1\n" + "# \n" * 100_000),
    replaced("config-changed", "config.yaml", "latent_dim: 5\n"),
    pytest.param(lambda folder: (folder / "config.yaml").unlink(), id="config-gone"),
    pytest.param(pipe, id="manifest-pipe"),
    pytest.param(pipe_of_config, id="config-pipe"),
    pytest.param(link, id="config-link"),
    pytest.param(folder_of_manifest, id="manifest-folder"),
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_broken_run_is_listed_with_its_fault_and_breaks_no_other(
    runs, tmp_path, damage, capsys, monkeypatch, request
):
    which = zlib.crc32(request.node.name.encode()) % 3
    broken = runs[which]
    damage(broken.path)
    assert broken.fault
    assert broken.status == "broken"
    assert not broken.complete
    with pytest.raises(MissingRunError, match=r"is broken \("):
        broken.require()
    assert sorted(run.id for run in Run.find(root=tmp_path)) == sorted(run.id for run in runs)
    assert [run.status for run in runs if run != broken] == ["complete"] * 2
    for filters, sort in (({"latent_dim": "4"}, "created"), ({"delta": "*"}, "parameters.mu.value")):
        with contextlib.suppress(ConfigError):  # no other run may have such a key
            entries(filters, sort, tmp_path)
    code, out, err = said_by(runs, capsys, monkeypatch)
    assert code == 0
    assert out.count("complete") == 2
    assert f"broken: {broken.path}: " in err
    page = write_index(tmp_path / "page", tmp_path).read_text()
    assert 'class="broken" title=' in page
    assert page.count('class="complete"') == 2
    with pytest.raises(SchemaError, match="is broken"):
        difference_table(runs[which - 1], broken)


def test_a_broken_run_is_made_again(runs):
    for damage in DAMAGES:
        if damage.id != "manifest-folder":
            damage.values[0](runs[1].path)
            made(runs[1].root, "train", {"latent_dim": 4, "field": {"modes": [8, 8, 8]}}, [runs[0]])
            assert runs[1].complete, damage.id


def test_a_folder_in_the_place_of_a_manifest_is_an_error_of_ours(runs):
    folder_of_manifest(runs[1].path)
    with pytest.raises(StorageError, match="a folder stands"):
        made(runs[1].root, "train", {"latent_dim": 4, "field": {"modes": [8, 8, 8]}}, [runs[0]])


def test_runs_that_go_back_to_themselves_end(tmp_path):
    """The names are those of their configurations, so that nothing else is wrong with them."""
    parents = [f"train/sand/{i:012d}" for i in range(40)]
    for i, own in enumerate(parents):
        folder = tmp_path / own
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text("a: 1\n")
        about = {"format": 2, "stage": "train", "scene": "sand", "hash": folder.name, "status": "complete",
                 "created": "2024-01-01T00:00:00", "seconds": 1.0, "metrics": {}}  # fmt: skip
        above = [parents[i - 1]] * 2 + [own]
        (folder / "manifest.json").write_text(json.dumps(about | {"parents": above, "outputs": []}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "fault", None)  # no such names could be found: they hash each other
        found = entries({"a": "1"}, root=tmp_path)
    assert len(found) == 40


def test_folders_that_no_run_could_have_are_no_runs(runs, tmp_path):
    for name in ("a b", "<img>", ".hidden", "\x1b[2J", "\udcff"):
        shutil.copytree(runs[0].path, tmp_path / "simulate" / "sand" / name)
    assert len(Run.find(root=tmp_path)) == 3


def test_what_a_terminal_would_obey_is_not_printed(runs, capsys, monkeypatch):
    manifest = json.loads((runs[2].path / "manifest.json").read_text())
    manifest |= {"metrics": {"delta": "\x1b[2J[bold]"}}
    (runs[2].path / "manifest.json").write_text(json.dumps(manifest))
    code, out, err = said_by(runs, capsys, monkeypatch)
    assert (code, "\x1b" in out + err) == (0, False)
    assert "[bold]" in out


@pytest.mark.parametrize("words", [[], ["show", "{}"], ["diff", "{}", "{}"], ["E\x1b[2J=*"], ["verify"]])
def test_keys_that_a_terminal_would_obey_are_not_printed(tmp_path, capsys, monkeypatch, words):
    hostile = "E\x1b[2J\x9b31m\u202e"
    made_of = [made(tmp_path, "simulate", {hostile: {hostile: value}}) for value in (1, 2)]
    for at, run in enumerate(made_of):
        manifest = json.loads((run.path / "manifest.json").read_text())
        manifest |= {"metrics": {hostile: at}, "versions": {hostile: str(at)}, "warnings": [hostile]}
        (run.path / "manifest.json").write_text(json.dumps(manifest))
    ids = iter([run.hash for run in made_of] * 2)
    words = [next(ids) if word == "{}" else word for word in words]
    _, out, err = said_by(made_of, capsys, monkeypatch, *words)
    assert not [c for c in out + err if c in hostile[1:] and not c.isprintable()]
    assert "E?[2J?31m?" in out or words in (["verify"], ["E\x1b[2J=*"])


# ---- altered files --------------------------------------------------------------------------------------


def turned(path):
    """Change one bit, and neither size nor time."""
    stamp, content = path.stat(), bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def linked(path):
    target = path.parent.parent / "secret"
    target.write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(target)


def piped(path):
    path.unlink()
    os.mkfifo(path)


FILES = [
    (turned, "sha256"),
    (lambda path: path.write_text("longer than before"), "has 18 bytes, where its manifest records 7"),
    (lambda path: path.unlink(), "is missing"),
    (linked, "no regular file"),
    (piped, "no regular file"),
]


@pytest.mark.parametrize(("change", "told"), FILES)
def test_a_changed_file_is_refused_and_found(runs, change, told, capsys, monkeypatch):
    run = runs[1]
    assert run.file("data.bin").read_text() == "payload"
    assert run.verify() == []
    assert said_by(runs, capsys, monkeypatch, "verify")[::2] == (0, "3 runs, 0 faults\n")
    change(run.path / "data.bin")
    with pytest.raises(SchemaError, match=rf"data\.bin .*{told}"):
        run.file("data.bin")
    (fault,) = run.verify()
    assert str(run.path / "data.bin") in fault
    assert told in fault
    code, _, err = said_by(runs, capsys, monkeypatch, "verify")
    assert code == 2
    assert err.splitlines() == [fault, "3 runs, 1 faults"]
    assert said_by(runs, capsys, monkeypatch, "verify", "stage=simulate")[0] == 0


def test_a_link_on_the_way_to_a_file_is_refused(tmp_path):
    run = Run.open("train", "sand", {"r": 1}, root=tmp_path / "runs")
    with run.record() as record:
        (run.path / "nets").mkdir()
        (run.path / "nets" / "a").write_text("a")
        record.output("nets")
    assert run.file("nets/a").read_text() == "a"
    shutil.move(run.path / "nets", tmp_path / "nets")
    (run.path / "nets").symlink_to(tmp_path / "nets")
    assert not run.complete
    with pytest.raises(SchemaError, match="link"):
        run.file("nets/a")


def test_a_folder_of_runs_may_be_a_link(runs, tmp_path):
    (tmp_path / "link").symlink_to(tmp_path)
    run = Run.named(runs[0].id, root=tmp_path / "link")
    assert run.require().file("data.bin").read_text() == "payload"


def test_what_is_not_recorded_is_refused(runs):
    (runs[1].path / "extra").write_text("x")
    for name in ("extra", "absent", "../sand", "manifest.json"):
        with pytest.raises(SchemaError, match="is not recorded"):
            runs[1].file(name)


def test_verify_tells_of_a_broken_run(runs):
    (runs[1].path / "config.yaml").write_text("latent_dim: 5\n")
    assert runs[1].verify() == [f"{runs[1].path}: config.yaml was changed after the run"]


def test_a_file_is_read_for_its_sum_once_a_process(runs, monkeypatch):
    monkeypatch.setattr(nsf.manifest, "_SETTLED", -1.0)  # as if the file were older
    monkeypatch.setattr(nsf.manifest, "_KNOWN", {})
    read = []
    monkeypatch.setattr(
        nsf.manifest,
        "_sha256",
        lambda path, plain=nsf.manifest._sha256: read.append(path) or plain(path),
    )
    for _ in range(3):
        runs[1].file("data.bin")
    assert read == [runs[1].path / "data.bin"]
    turned(runs[1].path / "data.bin")
    with pytest.raises(SchemaError, match="sha256"):
        runs[1].file("data.bin")
    assert len(read) == 2


@pytest.mark.parametrize("odd", [None, {}, {"loss": "small"}, {"loss": True}, {"loss": {"g": 1}}, "loss"])
def test_a_metric_is_a_number_or_is_named(runs, odd):
    assert runs[1].metric("stages", "p2g") == 1.5
    manifest = json.loads((runs[1].path / "manifest.json").read_text())
    (runs[1].path / "manifest.json").write_text(json.dumps(manifest | {"metrics": odd}))
    with pytest.raises(SchemaError, match=r"among its metrics loss=.* must be a number"):
        runs[1].metric("loss")
