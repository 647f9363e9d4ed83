"""Files of observations, and the commands that read them."""

import json
import re

import h5py
import numpy as np
import pandas as pd
import pytest

from nsf.errors import ConfigError
from nsf.inverse.call import ranges_of
from nsf.inverse.observations import Observations, View
from nsf.inverse.reports.command import calibrate
from nsf.results.committed import faults, write_list

POINT = {"t": 0.1, "particle": 5, "x": 0.5, "z": 0.2, "deviation": 1e-3}


def csv(tmp_path, rows):
    pd.DataFrame(rows).to_csv(tmp_path / "seen.csv", index=False)
    return tmp_path / "seen.csv"


def test_points_and_quantities_of_one_file(tmp_path, model):
    rows = [POINT, {"quantity": "height", "value": 0.1, "deviation": 2e-3}]
    found = Observations.read(csv(tmp_path, rows), model)
    assert found.what == ("x", "z", "height")
    np.testing.assert_allclose(found.t, [0.1, 0.1, model.t[-1]])
    np.testing.assert_allclose(found.points[0], model.manifold.X[5])
    np.testing.assert_allclose(found.values, [0.5, 0.2, 0.1])
    np.testing.assert_allclose(found.deviations, [1e-3, 1e-3, 2e-3])
    assert View(found, model).of_runs(model([[27.0, 0.2]])).shape == (1, 3)


def test_hdf5(tmp_path, model):
    with h5py.File(tmp_path / "seen.h5", "w") as file:
        for name, values in POINT.items():
            file[name] = np.array([values])
    assert Observations.read(tmp_path / "seen.h5", model).what == ("x", "z")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"pressure": 1.0}, "has the column 'pressure'"),
        ({"deviation": None}, "no column deviation"),
        ({"t": np.nan}, "row 1 has no t"),
        ({"particle": 10**6}, "particle=1e[+]06 must be a whole number below 500"),
        ({"particle": np.nan}, "names no point"),
        ({"quantity": "width"}, "unknown quantity 'width'; choose one of height, run_out"),
        ({"quantity": "height"}, "height has no value"),
        ({"x": "left"}, "row 1: x=left must be a number"),
        ({"deviation": np.nan}, r"row 1: deviation=nan m must be positive and finite"),
        ({"deviation": 0.0}, r"row 1: deviation=0 m must be positive"),
        ({"z": np.inf}, r"row 1: an observed value is inf m"),
        ({"t": 9.0}, r"row 1: t=9 s is outside of the run"),
        ({"particle": None, "X": 3.0, "Y": 0.0, "Z": 0.0}, r"row 1: the point \(3, 0, 0\) m lies"),
    ],
)
def test_rows_are_refused(tmp_path, model, change, told):
    row = {name: value for name, value in (POINT | change).items() if value is not None}
    with pytest.raises(ConfigError, match=told):
        Observations.read(csv(tmp_path, [row]), model).check(model)


def test_no_file(tmp_path, model):
    with pytest.raises(ConfigError, match="is no file; name a CSV or HDF5 file"):
        Observations.read(tmp_path / "none.csv", model)


def test_ranges():
    assert ranges_of({"a": "25..35", "b": "1e-2", "c": "-1.5..2"}) == {
        "a": [25, 35],
        "b": 0.01,
        "c": [-1.5, 2],
    }
    with pytest.raises(
        ConfigError, match=r"a=wide is neither a value nor a range; give it as 30 or 25\.\.35"
    ):
        ranges_of({"a": "wide"})


# -- commands -------------------------------------------------------------------------------------------


@pytest.fixture
def seen(tmp_path, model, deployed):
    """A file of what a full-order run shows of ten points."""
    from nsf.data import Trajectory

    case = deployed.split.test[0]
    with Trajectory.open(deployed.simulation(case).file("trajectory.h5")) as truth:
        x = truth.read("x", frames=[12, 24])[:, ::50]
    rows = [
        {"t": model.t[n], "particle": 50 * k, **dict(zip("xyz", x[j, k], strict=True)), "deviation": 1e-3}
        for j, n in enumerate((12, 24))
        for k in range(x.shape[1])
    ]
    return csv(tmp_path, rows), case


def test_calibrate(tmp_path, deployed, seen):
    file, case = seen
    folder = tmp_path / "reports" / "heap"
    words, said = [f"run={deployed.deployment.path}", f"observations={file}", "device=cpu"], []
    page = calibrate([*words, f"folder={folder}"], said.append)
    assert not any("no run passes" in line for line in said)
    assert page == folder / "index.html"
    estimate = pd.read_csv(folder / "estimate.csv").set_index("parameter")
    low, high = np.array([[22.0, 38.0], [0.05, 0.3]]).T
    off = np.abs(estimate["estimate"] - list(case.parameters.values())) / (high - low)
    assert (off < 0.25).all()
    residuals = pd.read_csv(folder / "residuals.csv")
    assert len(residuals) == 60
    assert (residuals["value"] - residuals["full_order"]).abs().max() < 0.02
    assert {"points.png", "residuals.png", "correlation.csv"} <= {p.name for p in folder.iterdir()}
    told = json.loads((folder / "sources.json").read_text())
    assert deployed.deployment.id in told["runs"]
    assert any(run.startswith("simulate/") for run in told["runs"])
    assert "friction angle" in write_list(folder.parent).read_text()
    assert faults(folder.parent) == []
    (folder / "estimate.csv").write_text("changed")
    assert faults(folder.parent)


def test_an_observation_that_no_run_passes_is_said(tmp_path, deployed, seen):
    file, _ = seen
    rows = pd.read_csv(file)
    words = [f"run={deployed.deployment.path}", "device=cpu", "full_order=false", f"folder={tmp_path / 'a'}"]
    said: list[str] = []
    rows.loc[6, "x"] *= 1000.0  # in mm, unlike the others
    calibrate([*words, f"observations={csv(tmp_path, rows)}"], said.append)
    assert any(re.search(r"no run passes the observations.*row 7: x at t = 0\.06 s", line) for line in said)


def test_trials(tmp_path, deployed, monkeypatch):
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path))
    folder = calibrate([f"run={deployed.deployment.path}", "trials=2", "device=cpu"]).parent
    assert folder == tmp_path / f"calibration_{deployed.scene.name}_2_seed0"
    table = pd.read_csv(folder / "results.csv")
    assert list(table) == [
        "scene", "parameter", "trial", "truth", "estimate", "standard_error", "inside_90", "seconds",
        "error_bound",
    ]  # fmt: skip
    assert table["trial"].tolist() == [0, 0, 1, 1]
    assert set(table["inside_90"]) <= {0, 1}
    taken = {case[name] for case in deployed.split.cases for name in case}
    assert not set(table["truth"]) & taken


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "takes observations=FILE, or trials=N"),
        (["trials=0"], "trials=0 must be a whole number from 1"),
        (["trials=2", "speed=0.2"], "takes no speed=; leave it out"),
        (["colour=red"], "has no key 'colour'; it takes .* and the parameters friction_angle, speed"),
        (["observations=none.csv"], "is no file"),
        (["friction"], "'friction' is not key=value"),
        (["trials=2", "trials=3"], "trials= is given twice"),
    ],
)
def test_words_are_refused(deployed, words, told):
    with pytest.raises(ConfigError, match=told):
        calibrate([f"run={deployed.deployment.path}", "device=cpu", *words])
