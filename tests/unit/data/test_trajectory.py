"""Trajectories on disk: round trip, partial reads, and every way a file can be bad."""

import errno
import multiprocessing
import os
import pickle
import resource
import shutil
import subprocess

import h5py
import numpy as np
import pytest

from nsf.data import Trajectory, TrajectoryWriter, hash_of_positions
from nsf.data.schema import COMPONENTS, packed
from nsf.data.sink import Sink
from nsf.deployment import Rollout
from nsf.errors import InstabilityError, MissingRunError, SchemaError, ShapeError, StorageError
from nsf.inverse.columns import read_columns


def stacked(values, field):
    return np.stack([packed(field, value[field]) for value in values])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_round_trip(write, constants, dtype):
    path, values = write(dtype=dtype, parameters={"b": 2.0, "a": 1})
    with Trajectory.open(path) as trajectory:
        assert np.array_equal(trajectory.X, constants["X"])
        assert np.array_equal(trajectory.mass, constants["mass"])
        assert np.array_equal(trajectory.volume0, constants["volume0"])
        assert trajectory.t.tolist() == [0.0, 0.5, 1.0, 1.5]
        assert (trajectory.dt, trajectory.dx) == (1e-4, 0.1)
        assert list(trajectory.parameters.items()) == [("a", 1.0), ("b", 2.0)]
        assert trajectory.cost == {"seconds": 1.25}
        assert (trajectory.particles, trajectory.frames) == (11, 4)
        assert trajectory.x_sha256 == hash_of_positions(constants["X"])
        for field, c in COMPONENTS.items():
            found = trajectory.read(field)
            assert found.dtype == dtype
            assert found.shape == (4, 11, c)
            assert np.array_equal(found, stacked(values, field).astype(dtype))


def test_the_file_says_what_it_holds(write):
    path, _ = write()
    with h5py.File(path) as file:
        assert file.attrs["schema_version"] == 1
        assert file.attrs["tau_order"] == "xx,xy,xz,yy,yz,zz"
        assert '"tau": "Pa"' in file.attrs["units"]
        assert file["frames/tau"].chunks is None
        assert file["particles/X"].dtype == "<f8"


SELECTIONS = [
    slice(None), slice(1, 3), slice(None, None, 2), slice(5, 5), slice(None, None, -1), 2, -1, [0], [3, 1, 1],
    np.array([2, 0]), [], np.array([-1, 0]),
]  # fmt: skip


def indices(selection, size):
    selection = np.array(selection, int) if isinstance(selection, list) else selection
    return np.atleast_1d(np.arange(size)[selection])


@pytest.mark.parametrize("frames", SELECTIONS, ids=str)
def test_partial_reads_are_those_of_numpy(write, frames):
    path, values = write()
    whole = stacked(values, "C").astype("f4")[indices(frames, 4)]
    with Trajectory.open(path) as trajectory:
        assert np.array_equal(trajectory.read("C", frames), whole)
        for particles in SELECTIONS:
            assert np.array_equal(trajectory.read("C", frames, particles), whole[:, indices(particles, 11)])


def test_reading_into_an_array(write):
    path, values = write(dtype="float64")
    out = np.full((2, 3, 3), np.nan, "f4")
    with Trajectory.open(path) as trajectory:
        assert trajectory.read("x", [3, 0], slice(2, 5), out=out) is out
        assert np.array_equal(out, stacked(values, "x").astype("f4")[[3, 0], 2:5])
        with pytest.raises(ShapeError, match="out has shape"):
            trajectory.read("x", out=out)


@pytest.mark.parametrize(
    ("field", "frames", "particles", "message"),
    [
        ("stress", slice(None), None, "field='stress'"),
        ("x", 4, None, "frames reach 4..4; there are 4"),
        ("x", [0], [3, -12], "particles reach -12..3; there are 11"),
        ("x", [0.5], None, "integer"),
        ("x", [True, False, True, False], None, "integer"),
    ],
)
def test_reads_outside(write, field, frames, particles, message):
    path, _ = write()
    with Trajectory.open(path) as trajectory, pytest.raises(ShapeError, match=message):
        trajectory.read(field, frames, particles)


def test_another_process_gets_its_own_file(write):
    path, _ = write()
    with Trajectory.open(path) as trajectory:
        copy = pickle.loads(pickle.dumps(trajectory))
    assert copy.read("x").shape == (4, 11, 3)


# ---- Bad files ------------------------------------------------------------------------------------------


def test_a_file_cut_short_anywhere_is_refused(write, tmp_path):
    path, _ = write()
    whole = path.read_bytes()
    cut = tmp_path / "cut.h5"
    step = max(1, len(whole) // 100)
    for size in sorted({*range(0, len(whole), step), *range(len(whole) - 40, len(whole)), 1, 8, 95, 96, 97}):
        cut.write_bytes(whole[:size])
        with pytest.raises(SchemaError, match=r"cut\.h5 is truncated or not HDF5"):
            Trajectory.open(cut)


def test_damaged_bytes_never_give_another_error(write, tmp_path):
    path, _ = write()
    whole = path.read_bytes()
    damaged = tmp_path / "damaged.h5"
    refused = 0
    for start in range(0, len(whole), max(1, len(whole) // 60)):
        damaged.write_bytes(whole[:start] + b"\xff" * 16 + whole[start + 16 :])
        try:
            with Trajectory.open(damaged) as trajectory:
                for field in COMPONENTS:
                    trajectory.read(field)
        except SchemaError:
            refused += 1
    assert refused > 10


@pytest.mark.parametrize("content", [b"", b"x y z\n1 2 3\n", b"\x89HDF\r\n\x1a\n"])
def test_what_is_not_hdf5(tmp_path, content):
    path = tmp_path / "a.h5"
    path.write_bytes(content)
    with pytest.raises(SchemaError, match=r"a\.h5"):
        Trajectory.open(path)
    with pytest.raises(SchemaError, match="is no regular file"):
        Trajectory.open(tmp_path)


def test_what_is_not_there(tmp_path):
    with pytest.raises(MissingRunError, match="nsf simulate"):
        Trajectory.open(tmp_path / "absent.h5")


def test_foreign_hdf5(tmp_path):
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["data"] = np.zeros(3)
    with pytest.raises(SchemaError, match=r"foreign\.h5 is HDF5, but not written by nsf"):
        Trajectory.open(path)


def remove(name):
    return lambda file: file.__delitem__(name)


def replace(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return change


def attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def laid_out(name, **how):
    """The same values in another layout."""

    def change(file):
        values = file[name][()]
        del file[name]
        file.create_dataset(name, data=values, **how)

    return change


def claims(name, shape, **how):
    """An array of which not a byte is there."""

    def change(file):
        del file[name]
        file.create_dataset(name, shape, "f4", **how)

    return change


def outside(file):
    """HDF5's external storage: the values are those of another file."""
    del file["frames/x"]
    file.create_dataset("frames/x", (4, 11, 3), "f4", external=[(__file__, 0, h5py.h5f.UNLIMITED)])


def virtual(file):
    del file["frames/x"]
    layout = h5py.VirtualLayout((4, 11, 3), "f4")
    layout[:] = h5py.VirtualSource("other.h5", "secret", (4, 11, 3))
    file.create_virtual_dataset("frames/x", layout)


def at(name, index, value):
    return lambda file: file[name].__setitem__(index, value)


def swap_particles(file):
    file["particles/X"][:2] = file["particles/X"][:2][::-1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (attribute("schema_version", 2), "schema_version=2, this nsf reads 1; simulate again with `nsf sim"),
        (attribute("complete", False), "not finished"),
        (attribute("tau_order", "xx,yy,zz,xy,xz,yz"), "tau_order=xx,yy"),
        (lambda file: file.attrs.__delitem__("dt"), "lacks"),
        *[
            (attribute(name, value), f"attribute {name}, which is no single")
            for name, value in {"dt": "soon", "dx": [1.0, 2.0], "complete": "yes", "tau_order": 5}.items()
        ],
        (attribute("units", '{"x": "mm"}'), "has units that are not those of this schema"),
        (attribute("dt", 0.0), "values of dt and dx that are not positive"),
        (attribute("dt", 1e300), "longer than from frame to frame"),
        (attribute("dx", 1e300), "far beyond its particles"),
        *[
            (at(f"particles/{name}", 3, value), rf"{told} particles/{name}")
            for name in ("mass", "volume0")
            for value, told in (
                (np.nan, "non-finite values of"),
                (np.inf, "non-finite values of"),
                (0.0, "values of"),
            )
        ],
        (at("frames/t", 2, np.nan), "non-finite values of frames/t"),
        (at("frames/t", 2, 0.1), "frames/t that does not increase"),
        (at("parameters/friction_angle", (), np.inf), "non-finite values of friction_angle"),
        (replace("frames/x", np.zeros((4, 11, 3), "i4")), "frames/x of <i4, not <f4 or <f8"),
        (replace("frames", 1.0), "lacks"),
        (replace("particles/X", h5py.Empty("f8")), r"particles/X of shape \[\], not \[any, 3\]"),
        (laid_out("frames/C", chunks=(1, 11, 9)), "frames/C in chunks"),
        (claims("frames/x", (4, 11, 3)), "ends before frames/x does"),
        (outside, "frames/x in chunks or outside the file"),
        (virtual, "frames/x in chunks or outside the file"),
        (replace("frames/x", h5py.ExternalLink("other.h5", "/secret")), "a link in the place of frames/x"),
        (replace("frames", h5py.ExternalLink("other.h5", "/")), "a link in the place of frames"),
        (swap_particles, "x_sha256"),
        *[
            (remove(name), "lacks")
            for name in (
                "frames/tau",
                "frames/t",
                "frames",
                "particles/X",
                "particles/mass",
                "parameters",
                "cost",
            )
        ],
        (replace("frames/x", np.zeros((4, 10, 3))), r"frames/x of shape \[4, 10, 3\], not \[4, 11, 3\]"),
        (replace("particles/X", np.zeros((11, 2))), r"particles/X of shape \[11, 2\], not \[any, 3\]"),
    ],
)
def test_a_file_of_other_content(write, change, message):
    path, _ = write()
    Trajectory.open(path).close()
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(SchemaError, match=rf"a\.h5.*{message}"):
        Trajectory.open(path)
    path.unlink()


def refused_by_all(paths):
    """Ends well where every reader refuses every file, of a process whose memory is bounded."""
    resource.setrlimit(resource.RLIMIT_DATA, (2**33, 2**33))
    for path in paths:
        for read in (Trajectory.open, Rollout.open, read_columns):
            with pytest.raises(SchemaError, match="has a heap of texts or names without an end"):
                read(path)


def test_heaps_without_an_end_are_refused_before_hdf5_walks_them(write):
    """An object of no size, in texts of attributes or where a virtual data set names its files; a free place
    that leads to itself. HDF5 walks the first two for ever and fills the memory with the third."""
    paths = [write(f"{name}.h5")[0] for name in ("texts", "virtual", "names")]
    with h5py.File(paths[1], "r+") as file:
        virtual(file)
    for path in paths:
        data = bytearray(path.read_bytes())
        for heap in range(len(data) - 32):
            if path.stem != "names" and data[heap : heap + 4] == b"GCOL":
                data[heap + 16 : heap + 32] = bytes(16)
            if path.stem == "names" and data[heap : heap + 4] == b"HEAP":
                free, segment = np.frombuffer(data[heap + 16 : heap + 32], "<u8").tolist()
                if free != 1:
                    data[segment + free : segment + free + 8] = free.to_bytes(8, "little")
        path.write_bytes(data)
    process = multiprocessing.get_context("fork").Process(target=refused_by_all, args=(paths,))
    process.start()
    process.join(60)
    process.kill()
    assert process.exitcode == 0


def test_a_file_that_claims_terabytes_is_refused_before_any_is_asked_for(tmp_path, constants):
    """24 TB of frames, all of whose constants are in order."""
    path, frames = tmp_path / "a.h5", 10**8
    with started(path, constants, 1) as writer:
        writer.append(**one_frame())
    with h5py.File(path, "r+") as file:
        for name, c in COMPONENTS.items():
            claims(f"frames/{name}", (frames, 11, c))(file)
        replace("frames/t", np.arange(10.0))(file)
    assert path.stat().st_size < 100_000
    with pytest.raises(SchemaError, match="frames/x of shape"):
        Trajectory.open(path)
    with h5py.File(path, "r+") as file:
        del file["frames/t"]
        file["frames"].create_dataset("t", (frames,), "<f8")
    with pytest.raises(SchemaError, match="ends before frames/t does, which is of 800,000,000 bytes"):
        Trajectory.open(path)


def test_a_pipe_is_no_trajectory(tmp_path):
    os.mkfifo(tmp_path / "a.h5")
    with pytest.raises(SchemaError, match=r"a\.h5 is no regular file"):
        Trajectory.open(tmp_path / "a.h5")


@pytest.mark.parametrize(("field", "bad"), [*zip(COMPONENTS, (np.nan, np.inf, -np.inf, np.nan), strict=True)])
def test_frames_are_finite_where_they_are_read(write, field, bad):
    path, _ = write()
    with h5py.File(path, "r+") as file:
        file[f"frames/{field}"][2, 5, 1] = bad
    with Trajectory.open(path) as trajectory:
        assert trajectory.read(field, slice(0, 2)).shape[0] == 2
        for part in ((slice(None),), ([3, 2],), (slice(None), slice(4, 6)), (2, [7, 5])):
            with pytest.raises(SchemaError, match=rf"a\.h5 has non-finite values of {field}, as in frame 2"):
                trajectory.read(field, *part)
        assert np.isfinite(trajectory.read(field, slice(None), [0, 1])).all()


def test_frames_whose_sum_is_not_finite_are_read(write):
    path, _ = write()
    with h5py.File(path, "r+") as file:
        file["frames/x"][...] = 3e38
    with Trajectory.open(path) as trajectory:
        assert (trajectory.read("x") == np.float32(3e38)).all()


def test_a_run_s_trajectory_is_what_the_run_left(write, tmp_path):
    from nsf.runs import Run

    path, _ = write()
    run = Run.open("simulate", "sand", {}, root=tmp_path / "runs")
    with run.record() as record:
        shutil.copy(path, run.path / "trajectory.h5")
        record.output("trajectory.h5")
    own = run.path / "trajectory.h5"
    Trajectory.open(own).close()
    whole = own.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.integers(len(whole), size=20):
        own.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << rng.integers(8)]) + whole[place + 1 :])
        with pytest.raises(SchemaError, match=r"trajectory\.h5 has sha256 .* it was changed after the run"):
            Trajectory.open(own)
    own.write_bytes(whole)
    Trajectory.open(own).close()


# ---- Writing that goes wrong ----------------------------------------------------------------------------


def started(path, constants, frames=2):
    return TrajectoryWriter(path, **constants, parameters={}, dt=1e-4, dx=0.1, frames=frames)


def one_frame(particles=11):
    return {"t": 0.0, "x": np.zeros((particles, 3)), "v": np.zeros((particles, 3)),
            "C": np.zeros((particles, 9)), "tau": np.zeros((particles, 6))}  # fmt: skip


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupt_leaves_no_file(tmp_path, constants, error):
    path = tmp_path / "a.h5"

    def interrupted():
        with started(path, constants) as writer:
            writer.append(**one_frame())
            assert not path.exists()
            raise error

    with pytest.raises(error):
        interrupted()
    assert os.listdir(tmp_path) == []


def test_a_killed_process_leaves_no_file(tmp_path, constants, write):
    path, _ = write()
    before = path.read_bytes()
    if (child := os.fork()) == 0:
        with started(path, constants) as writer:
            writer.append(**one_frame())
            os._exit(9)
    assert os.waitpid(child, 0)[1]
    assert path.read_bytes() == before
    assert list(tmp_path.glob("*.h5")) == [path]


def write_frames(path, constants, frames, *values):
    with started(path, constants, frames) as writer:
        for value in values:
            writer.append(**value)


def test_too_few_and_too_many_frames(tmp_path, constants):
    with pytest.raises(ShapeError, match="got 1 of frames=2"):
        write_frames(tmp_path / "a.h5", constants, 2, one_frame())
    with pytest.raises(ShapeError, match="holds frames=1 already"):
        write_frames(tmp_path / "a.h5", constants, 1, one_frame(), one_frame())
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("field", COMPONENTS)
def test_wrong_values_are_not_written(tmp_path, constants, field):
    with pytest.raises(ShapeError, match=rf"{field} has shape \[10, "):
        write_frames(tmp_path / "a.h5", constants, 1, one_frame() | {field: one_frame(10)[field]})
    values = one_frame()
    values[field][3, 1] = np.inf
    with pytest.raises(InstabilityError, match=f"1 non-finite values of {field}"):
        write_frames(tmp_path / "a.h5", constants, 1, values)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", ["mass", "volume0"])
def test_constants_of_other_particles(tmp_path, constants, name):
    with pytest.raises(ShapeError, match=rf"{name} has shape \[10\] for 11"):
        started(tmp_path / "a.h5", constants | {name: np.zeros(10)})


def test_a_file_larger_than_the_disk_is_refused_before_the_first_frame(tmp_path, constants):
    with pytest.raises(StorageError, match=r"a\.h5.*MiB free.*NSF_RUNS"):
        started(tmp_path / "a.h5", constants, frames=10**15).__enter__()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_fault_in_any_write_of_hdf5_is_raised_and_leaves_no_file(tmp_path, constants, monkeypatch, fault):
    plain_write, calls, fail_at = Sink.write, [], None

    def write(sink, data):
        calls.append(len(data))
        if len(calls) == fail_at:
            sink._fault = fault
        return plain_write(sink, data)

    monkeypatch.setattr(Sink, "write", write)
    write_frames(tmp_path / "whole.h5", constants, 3, *[one_frame()] * 3)
    expected = StorageError if isinstance(fault, OSError) else KeyboardInterrupt
    for fail_at in range(1, len(calls) + 1):  # noqa: B007
        calls.clear()
        with pytest.raises(expected):
            write_frames(tmp_path / "a.h5", constants, 3, *[one_frame()] * 3)
    assert os.listdir(tmp_path) == ["whole.h5"]


def test_frames_go_in_as_many_pieces_as_the_disk_takes(write, monkeypatch):
    plain = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, data, offset: plain(file, data[:100], offset))
    path, values = write()
    with Trajectory.open(path) as trajectory:
        assert np.array_equal(trajectory.read("x"), stacked(values, "x").astype("f4"))


def test_a_disk_that_is_full_at_a_frame_leaves_no_file(tmp_path, constants, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(StorageError, match="No space"):
        write_frames(tmp_path / "a.h5", constants, 1, one_frame())
    assert os.listdir(tmp_path) == []


def test_a_fault_ends_the_simulation_at_the_frame_it_struck(tmp_path, constants):
    went_on = []

    def work():
        with started(tmp_path / "a.h5", constants) as writer:
            writer._sink._fault = OSError(errno.ENOSPC, "No space left on device")
            writer.append(**one_frame())
            went_on.append(True)

    with pytest.raises(StorageError, match="No space"):
        work()
    assert not went_on


def test_a_write_that_ends_early_is_not_taken_for_whole(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with Sink(tmp_path / "a", "w+") as sink:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
            assert sink.write(bytes(1500)) == 1500  # of which the system takes 1000
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        with pytest.raises(OSError, match="File too large"):
            sink.settle()


@pytest.mark.parametrize("kib", [4, 24, 72])
def test_a_really_full_disk(tmp_path, constants, monkeypatch, kib):
    if shutil.which("mount") is None:
        pytest.skip("no mount command")
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "none", disk], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("not allowed to mount")
    try:
        monkeypatch.setattr("nsf.data.trajectory.require_space", lambda path, size: None)
        with pytest.raises(StorageError, match=r"a\.h5: No space left on device; free some space"):
            write_frames(disk / "a.h5", constants, 100, *[one_frame()] * 100)
        assert os.listdir(disk) == []
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_a_file_cut_short_while_it_is_open_is_refused(write):
    path, _ = write()
    with Trajectory.open(path) as trajectory:
        with path.open("r+b") as file:
            file.truncate(0)
        for field in ("x", "v", "C", "tau"):
            with pytest.raises(SchemaError, match=r"was cut short while it was open; simulate again"):
                trajectory.read(field)
