"""`nsf export` as a user calls it."""

import sys

import pytest

from nsf.cli import main


@pytest.fixture
def export(chain, tmp_path, monkeypatch, capsys):
    """(*arguments) → (exit code, standard output, standard error)."""
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["export", *arguments])
        return (end.value.code or 0, *capsys.readouterr())

    return call


@pytest.mark.parametrize(
    "words",
    [
        ["{run}", "--html", "--vtk", "--every", "12", "--device", "cpu"],
        ["run={run}", "html=true", "vtk=true", "usd=false", "every=12", "device=cpu"],
    ],
)
def test_a_run_by_its_hash(export, chain, deployed, tmp_path, words):
    code, out, err = export(*(word.format(run=deployed.hash[:6]) for word in words))
    assert (code, err) == (0, "")
    folder = tmp_path / "reports/export" / f"sand-{deployed.hash}"
    assert {p.name for p in folder.iterdir()} == {"friction_angle_26.html", "friction_angle_26.vtkhdf"}
    assert "sand, friction angle=26°, 3 frames, 500 points" in out
    assert str(folder / "friction_angle_26.html") in out


def test_a_missing_extra_is_told_before_any_work(export, deployed, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    code, out, err = export(deployed.id, "--vtk", "--usd", "--points", "5000")
    assert (code, out) == (2, "")
    assert "pxr.Usd cannot be imported" in err
    assert "pip install 'nsf[export]'" in err
    assert not (tmp_path / "reports").exists()


def test_a_run_by_its_folder(export, deployed, tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "elsewhere"))
    code, _, _ = export(str(deployed.path), "--vtk", "--output", "out", "--device", "cpu")
    assert code == 0
    assert (tmp_path / "out/friction_angle_26.vtkhdf").is_file()


def test_the_newest_run_is_named(export, deployed):
    code, out, _ = export("--vtk", "--points", "20", "--device", "cpu")
    assert code == 0
    assert f"the newest deploy run, {deployed.id}" in out


@pytest.mark.parametrize(
    ("arguments", "quoted"),
    [
        (["--html", "zzz"], ["no deploy run is, or begins with, 'zzz'", "deploy/sand/"]),
        (["--gltf"], ["unrecognized arguments: --gltf", "nsf export --help"]),
        ([], ["no format; give one or more of --html, --live, --usd, --vtk, --onnx, --frames"]),
        (["--vtk", "--points", "0"], ["points=0", "a whole number from 1"]),
        (["--vtk", "--points", "-3"], ["points=-3", "a whole number from 1"]),
        (["--vtk", "--points", "many"], ["--points", "many"]),
        (["--vtk", "--every", "0"], ["every=0"]),
        (["--vtk", "--fps", "nan"], ["fps=nan"]),
        (["--vtk", "--color", "red"], ["color=red", "von_mises or displacement"]),
        (["--vtk", "--parameter", "27"], ["parameter=27", "choose one of 26"]),
        (["--vtk", "--device", "tpu"], ["device=tpu"]),
        (["--vtk", "--output", "/proc/no/such"], ["cannot write /proc/no/such"]),
    ],
)
def test_bad_input_is_one_clear_error(export, deployed, tmp_path, arguments, quoted):
    named = [] if "zzz" in arguments else [deployed.id]
    code, _, err = export(*named, *arguments)
    assert code == 2
    assert err.startswith("error: ")
    for text in quoted:
        assert text in err
    assert not (tmp_path / "reports").exists()
