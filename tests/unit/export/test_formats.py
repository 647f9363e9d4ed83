"""Exported files, opened in the programs that they are for."""

import itertools
import logging
import logging.handlers
import queue
import re
from importlib import import_module

import numpy as np
import pytest
import torch
from decoded import whole
from PIL import Image

from nsf import config
from nsf.errors import ConfigError, MissingExtraError
from nsf.evaluation import metrics
from nsf.export import frames, onnx, playback, usd, vtk
from nsf.export.playback import Playback
from nsf.kinematics.training.phases import PHASES
from nsf.pipeline import Pipeline

# -- VTK ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [None, 1100])
def test_vtk_reads_every_step(played, tmp_path, points, monkeypatch):
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    monkeypatch.setattr(playback, "POINTS", 250)  # several blocks
    shown = played(points)
    x, tau = whole(shown)
    path = vtk.write(shown, tmp_path)
    assert path == tmp_path / "friction_angle_26.vtkhdf"
    reader = vtkHDFReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    np.testing.assert_allclose(times, shown.t)
    for step in (0, len(times) - 1):
        reader.SetStep(step)
        reader.Update()
        grid = reader.GetOutput()
        assert grid.GetNumberOfCells() == grid.GetNumberOfPoints() == len(shown.X)
        np.testing.assert_allclose(vtk_to_numpy(grid.GetPoints().GetData()), x[step], rtol=1e-6)
        found = {name: vtk_to_numpy(grid.GetPointData().GetArray(name)) for name in vtk.ARRAYS}
        np.testing.assert_allclose(found["displacement"], x[step] - shown.X, atol=1e-7)
        np.testing.assert_allclose(found["von_mises"], metrics.von_mises(tau[step]), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found["pressure"], metrics.pressure(tau[step]), rtol=1e-4, atol=1e-5)
        xx, yy, zz, xy, yz, xz = found["kirchhoff_stress"].T  # VTK's order
        np.testing.assert_allclose(np.stack([xx, xy, xz, yy, yz, zz], -1), tau[step], rtol=1e-5, atol=1e-6)


# -- USD ----------------------------------------------------------------------------------------------------


def test_usd_holds_attributes_and_time_samples(played, tmp_path, monkeypatch):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    shown = played(fps=25.0, color="displacement")
    (block,) = shown.blocks()
    monkeypatch.setattr(playback, "POINTS", 300)  # two prims
    stage = Usd.Stage.Open(str(usd.write(shown, tmp_path)))
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 5, 25)
    root = stage.GetDefaultPrim()
    assert [root.GetAttribute("nsf:time").Get(k) for k in range(6)] == pytest.approx(shown.t.tolist())
    prims = [UsdGeom.Points(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]
    assert [len(p.GetPointsAttr().Get(0)) for p in prims] == [300, 200]

    def gathered(name, k):
        return np.concatenate([np.array(UsdGeom.PrimvarsAPI(p).GetPrimvar(name).Get(k)) for p in prims])

    for k in (0, 5):
        x = np.concatenate([np.array(p.GetPointsAttr().Get(k)) for p in prims])
        np.testing.assert_allclose(x, block.x[k], rtol=1e-6)
        np.testing.assert_allclose(gathered("displacement", k), block.displacement[k], atol=1e-7)
        np.testing.assert_allclose(gathered("vonMises", k), block.von_mises[k], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(gathered("pressure", k), block.pressure[k], rtol=1e-4, atol=1e-5)
        stress = gathered("kirchhoffStress", k).reshape(-1, 6)
        np.testing.assert_allclose(stress, block.tau[k], rtol=1e-5, atol=1e-6)
        extent = np.array(prims[0].GetExtentAttr().Get(k))
        assert (extent[0] < x[:300].min(0)).all()
        assert (extent[1] > x[:300].max(0)).all()
    color = gathered("displayColor", 5)
    least, most = np.argsort(block.magnitude("displacement")[5].numpy())[[0, -1]]
    assert color[most][0] > 0.9 > color[least][0]  # yellow, and darker
    assert all(
        UsdGeom.PrimvarsAPI(p).GetPrimvar("displayColor").GetInterpolation() == "vertex" for p in prims
    )


# -- ONNX ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mlp(own_root, tiny):
    """The tiny chain with the paper's networks, its stress field a function of μ too."""
    keys = [key for key in tiny if not key.startswith(("field.", "trainer."))]
    keys += ["field=mlp", "field.beta=3", "trainer.steps=100"]
    pipeline = Pipeline(config.load(keys), say=lambda line: None, root=own_root)
    pipeline.train()
    return pipeline.deploy()


@pytest.fixture(scope="module", params=["basis", "mlp"])
def graphs(request, deployed, tmp_path_factory):
    """A playback and the folder of its graphs; of networks, at points in between."""
    pytest.importorskip("onnxscript")
    run = deployed if request.param == "basis" else request.getfixturevalue("mlp")
    points = None if request.param == "basis" else 700
    shown = Playback(run, points=points, every=5, device="cpu")
    return shown, onnx.write(shown, tmp_path_factory.mktemp("graphs"))


@pytest.mark.slow
def test_onnx_round_trip(graphs):
    onnxruntime = pytest.importorskip("onnxruntime")
    shown, folder = graphs
    field = shown.manifold.field
    inputs = np.load(folder / "inputs.npz")
    np.testing.assert_array_equal(inputs["t"], shown.t)
    at, xhat = shown.restricted(), torch.as_tensor(shown.xhat)
    parameters = torch.tensor([26.0], dtype=torch.float64)
    for phase, outputs, of in (
        ("deformation", ["x"], at.position),
        ("stress", ["tau"], lambda latent: at.stress(latent, parameters)),
        ("affine", ["C"], lambda latent: at.affine(latent, parameters)),
    ):
        session = onnxruntime.InferenceSession(folder / f"{phase}.onnx")
        names = [i.name for i in session.get_inputs()]
        assert names == ["X"] * (field == "mlp") + ["xhat", "parameters"]
        assert [o.name for o in session.get_outputs()] == outputs
        assert session.get_outputs()[0].shape[0] == "frames"
        (found,) = session.run(None, {name: inputs[name] for name in names})
        exact = of(xhat).numpy()
        assert found.dtype == np.float32
        assert np.abs(found - exact).max() < 32 * np.finfo(np.float32).eps * np.abs(exact).max()
        told = session.get_modelmeta().custom_metadata_map
        assert (told["field"], told["phase"], told["run"]) == (field, phase, shown.run.id)
        assert told["tau_order"] == '["xx", "xy", "xz", "yy", "yz", "zz"]'
        (one,) = session.run(None, {name: inputs[name][:1] for name in names})  # one frame, one point
        np.testing.assert_allclose(one[0, 0], found[0, 0], rtol=1e-4, atol=1e-5 * np.abs(found).max())


@pytest.mark.slow
def test_onnx_passes_on_no_notes_of_the_exporter(graphs, tmp_path):
    """torch warns of an absent torchvision, which no graph here needs."""
    logger, notes = logging.getLogger("torch.onnx"), queue.SimpleQueue()
    handler = logging.handlers.QueueHandler(notes)
    logger.addHandler(handler)
    try:
        onnx.write(graphs[0], tmp_path)
    finally:
        logger.removeHandler(handler)
    assert notes.empty()


@pytest.mark.slow
def test_onnx_depends_on_the_parameter(graphs):
    onnxruntime = pytest.importorskip("onnxruntime")
    _, folder = graphs
    session = onnxruntime.InferenceSession(folder / "stress.onnx")
    inputs = {i.name: np.load(folder / "inputs.npz")[i.name] for i in session.get_inputs()}
    (tau,) = session.run(None, inputs)
    (other,) = session.run(None, inputs | {"parameters": np.array([38.0], np.float32)})
    assert np.abs(tau - other).max() > 1e-3 * np.abs(tau).max()


@pytest.mark.slow
def test_onnx_tells_of_no_paths(graphs):
    _, folder = graphs
    assert {p.name for p in folder.iterdir()} == {"inputs.npz", *(f"{phase}.onnx" for phase in PHASES)}
    for path in folder.glob("*.onnx"):
        assert b".py" not in path.read_bytes()


def test_onnx_refuses_more_than_a_file_holds(played, tmp_path, monkeypatch):
    pytest.importorskip("onnxscript")
    monkeypatch.setattr(onnx, "LARGEST", 1000)
    with pytest.raises(ConfigError, match=r"a field at 500 points takes .* choose points <= "):
        onnx.write(played(), tmp_path)


@pytest.mark.slow
def test_a_field_of_the_rate_has_it_as_an_input(played):
    """`field.affine=rate`: C follows from x̂ and dx̂/dt."""
    pytest.importorskip("onnxscript")

    class OfRate(torch.nn.Module):
        def forward(self, xhat, parameters, rate):
            return (xhat + 2.0 * rate) * parameters

    shown = played()
    assert shown.rate.shape == shown.xhat.shape
    inputs = {"xhat": shown.xhat, "parameters": np.ones(1), "rate": shown.rate}
    graph = onnx._graph(OfRate(), "C", {name: a.astype("f4") for name, a in inputs.items()}).graph
    assert [own.name for own in graph.input] == ["xhat", "parameters", "rate"]


# -- frames -------------------------------------------------------------------------------------------------


def test_frames_are_pictures_and_a_film(played, tmp_path, monkeypatch):
    imageio = pytest.importorskip("imageio")
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(frames, "WIDTH", 320)
    film = frames.write(played(every=12, color="displacement", fps=2.0), tmp_path)
    names = sorted(p.name for p in (tmp_path / "friction_angle_26_frames").iterdir())
    assert names == [f"frame_{k:04d}.png" for k in range(3)]
    pictures = [
        np.asarray(Image.open(tmp_path / "friction_angle_26_frames" / n).convert("RGB")) for n in names
    ]
    ((height, width, _),) = {p.shape for p in pictures}
    assert width == 370
    for one, other in itertools.pairwise(pictures):
        assert (np.abs(one.astype(int) - other).max(2) > 30).mean() > 0.005
    assert np.ptp(pictures[-1][: height // 2].astype(int), axis=2).max() > 60  # the points are in colours
    reader = imageio.get_reader(film)
    assert reader.get_meta_data()["fps"] == pytest.approx(2.0)
    shot = [frame for frame in reader]
    assert len(shot) == 3
    assert np.abs(shot[0].astype(int) - pictures[0][: height // 2 * 2]).mean() < 8  # compression's loss alone


# -- all ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("usd", "pxr.Usd"),
        ("onnx", "onnx"),
        ("onnx", "onnxscript"),
        ("frames", "imageio_ffmpeg"),
    ],
)
def test_a_missing_extra_names_the_remedy(played, tmp_path, monkeypatch, name, missing):
    from nsf import extras

    def import_module_without(module):
        if module == missing:
            raise ModuleNotFoundError(f"No module named {module!r}")
        return import_module(module)

    monkeypatch.setattr(extras.importlib, "import_module", import_module_without)
    with pytest.raises(
        MissingExtraError, match=re.escape(f"{missing} cannot be imported") + r".*pip install 'nsf\[export\]'"
    ):
        import_module(f"nsf.export.{name}").write(played(5), tmp_path)
    assert not list(tmp_path.rglob("*"))
