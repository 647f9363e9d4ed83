"""Snapshots: rows, identity of particles, resident or streamed."""

import numpy as np
import pytest
import torch

from nsf.data import Snapshots, Standardizer, Trajectory, hash_of_positions, snapshots
from nsf.data.schema import COMPONENTS
from nsf.errors import ConfigError, DeviceError, SchemaError, ShapeError


@pytest.fixture
def paths(write):
    return [
        write(f"{i}.h5", frames=frames, parameters={"mu": float(mu), "angle": 30.0}, seed=100 * i)[0]
        for i, (frames, mu) in enumerate([(4, 1), (2, 2), (3, 5)])
    ]


@pytest.fixture(params=[True, False], ids=["resident", "streamed"])
def snaps(paths, request):
    return Snapshots(paths, resident=request.param)


@pytest.fixture
def whole(paths):
    """Every field by a plain read of every file."""
    return {
        field: torch.from_numpy(np.concatenate([Trajectory.open(path).read(field) for path in paths]))
        for field in COMPONENTS
    }


def test_rows(snaps, constants):
    assert (snaps.M, snaps.P) == (9, 11)
    assert snaps.trajectory.tolist() == [0, 0, 0, 0, 1, 1, 2, 2, 2]
    assert snaps.frame.tolist() == [0, 1, 2, 3, 0, 1, 0, 1, 2]
    assert snaps.t.tolist() == [0.0, 0.5, 1.0, 1.5, 0.0, 0.5, 0.0, 0.5, 1.0]
    assert snaps.parameter_names == ("angle", "mu")
    assert snaps.parameters[:, 0].tolist() == [30] * 9
    assert snaps.parameters[:, 1].tolist() == [1, 1, 1, 1, 2, 2, 5, 5, 5]
    assert snaps.parameters.dtype == snaps.t.dtype == torch.float64
    assert snaps.X.dtype == torch.float64
    assert snaps.x_sha256 == hash_of_positions(snaps.X.numpy()) == hash_of_positions(constants["X"])


PARTICLES = [slice(None), slice(3, 7), slice(8, 1000), [4, 0, 4], torch.tensor([2]), []]
ROWS = [slice(2, 6), [8, 0, 4, 4], torch.tensor([5]), np.array([-1]), []]


def listed(indices):
    return indices if isinstance(indices, slice) else torch.as_tensor(indices, dtype=torch.long)


@pytest.mark.parametrize("particles", PARTICLES, ids=str)
def test_resident_and_streamed_give_what_is_in_the_files(snaps, whole, particles):
    for field, values in whole.items():
        slab = snaps.slab(field, particles)
        assert slab.dtype == torch.float32
        assert torch.equal(slab, values[:, listed(particles)])
        for rows in ROWS:
            found = snaps.gather(field, rows, particles)
            assert found.dtype == torch.float32
            assert torch.equal(found, values[listed(rows)][:, listed(particles)])


def test_float64_files_give_float32(write):
    path, values = write(dtype="float64")
    for resident in (True, False):
        x = Snapshots([path], resident=resident).slab("x", slice(None))
        assert torch.equal(x, torch.from_numpy(np.stack([value["x"] for value in values]).astype("f4")))


def test_an_unknown_field_names_the_fields(snaps):
    for call in (lambda: snaps.slab("stress", slice(2)), lambda: snaps.gather("stress", [0], [0])):
        with pytest.raises(ShapeError, match=r"field='stress'.*tau"):
            call()


def test_auto_goes_by_free_memory(paths, monkeypatch):
    need = Snapshots(paths, resident=False).nbytes
    assert need == 9 * 11 * 18 * 4
    monkeypatch.setattr(snapshots, "_free", lambda device: int(need / 0.6) + 1)
    assert Snapshots(paths).resident
    monkeypatch.setattr(snapshots, "_free", lambda device: int(need / 0.6) - 1)
    assert not Snapshots(paths).resident


def test_resident_data_outlive_their_files(paths):
    snaps = Snapshots(paths, resident=True)
    expected = snaps.slab("tau", slice(None)).clone()
    snaps.close()
    assert torch.equal(snaps.gather("tau", slice(None), slice(None)), expected)


def test_trajectories_of_other_particles(write, constants):
    a, _ = write("a.h5")
    b, _ = write("b.h5", X=constants["X"] + 1e-12)
    with pytest.raises(SchemaError, match=r"a\.h5.*b\.h5.*different particles"):
        Snapshots([a, b])


def test_trajectories_of_other_parameters(write):
    a, _ = write("a.h5")
    b, _ = write("b.h5", parameters={"mu": 1.0})
    with pytest.raises(SchemaError, match=r"a\.h5.*friction_angle.*b\.h5.*mu"):
        Snapshots([a, b])


def test_a_scene_without_parameters(write):
    snaps = Snapshots([write(parameters={})[0]])
    assert snaps.parameters.shape == (4, 0)


def test_bad_arguments(paths):
    with pytest.raises(ConfigError, match="at least one"):
        Snapshots([])
    with pytest.raises(ConfigError, match="resident='yes'"):
        Snapshots(paths, resident="yes")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_no_gpu(paths):
    with pytest.raises(DeviceError, match="device=cuda"):
        Snapshots(paths, device="cuda")


@pytest.mark.gpu
@pytest.mark.parametrize("resident", [True, False, "auto"])
def test_on_a_gpu(paths, whole, resident, monkeypatch):
    monkeypatch.setattr(snapshots, "_STAGING_BYTES", 4 * 11 * 6 * 3)  # several blocks a trajectory
    snaps = Snapshots(paths, device="cuda", resident=resident)
    assert snaps.resident is (resident is not False)
    rows, particles = torch.tensor([8, 0, 4], device="cuda"), torch.tensor([10, 3], device="cuda")
    for field, values in whole.items():
        assert torch.equal(snaps.slab(field, slice(2, 9)).cpu(), values[:, 2:9])
        assert torch.equal(snaps.gather(field, rows, particles).cpu(), values[rows.cpu()][:, particles.cpu()])
    assert torch.allclose(Standardizer.of(snaps, "tau").mean.cpu(), whole["tau"].mean((0, 1)), rtol=1e-4)
