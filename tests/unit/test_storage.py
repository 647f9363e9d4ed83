"""Files that appear whole or not at all."""

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nsf.errors import StorageError
from nsf.storage import locked, refusals, require_folder, require_space, write_json, writing


@pytest.fixture
def tiny_disk(tmp_path):
    """A folder on a file system of 64 KiB; skipped where mounting is not allowed."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True)
    except FileNotFoundError:
        pytest.skip("no mount command")
    if done.returncode:
        pytest.skip("not allowed to mount")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_writing_replaces_the_file_and_keeps_its_suffix(tmp_path):
    target = tmp_path / "new" / "frames.npz"
    for text in ("first", "second"):
        with writing(target) as partial:
            assert partial.suffix == ".npz"
            partial.write_text(text)
            inode = partial.stat().st_ino
        assert target.read_text() == text
        assert target.stat().st_ino == inode  # renamed, not copied: no reader sees a part
    assert os.listdir(target.parent) == ["frames.npz"]


def test_a_folder_that_goes_as_it_is_written(tmp_path):
    target = tmp_path / "new" / "a.txt"
    gone = pytest.raises(StorageError, match=r"cannot write .*a\.txt: its folder was deleted or moved")
    with gone, writing(target) as partial:
        partial.write_text("half")
        shutil.rmtree(target.parent)
    assert not target.parent.exists()


def test_a_folder_that_goes_as_it_is_locked(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "mkdir", lambda *arguments, **options: None)
    gone = pytest.raises(StorageError, match=r"\.lock: its folder was deleted .*run the same command again")
    with gone, locked(tmp_path / "new" / ".lock"):
        pass


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space"), OSError(errno.EIO, "broken")])
def test_whose_fault_a_refusal_is(tmp_path, error):
    kind = StorageError if error.errno == errno.ENOSPC else OSError
    with pytest.raises(kind) as found, refusals(tmp_path):
        raise error
    assert (str(tmp_path) in str(found.value)) == (kind is StorageError)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
def test_a_failed_block_leaves_the_earlier_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "a.txt"
    target.write_text("whole")

    def half():
        with writing(target) as partial:
            partial.write_text("half")
            assert target.read_text() == "whole"
            raise error

    with pytest.raises(error):
        half()
    assert target.read_text() == "whole"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EFBIG])
def test_storage_faults_name_the_file_and_the_remedy(tmp_path, number):
    target = tmp_path / "a.txt"
    errors = [
        OSError(number, os.strerror(number)),
        OSError(f"Can't write data (errno = {number}, error message = '{os.strerror(number)}')"),
        RuntimeError(f"Can't decrement id ref count (error message = '{os.strerror(number)}')"),
    ]
    for error in errors:
        with pytest.raises(StorageError, match=r"a\.txt.*(NSF_RUNS|ulimit)") as caught, writing(target):
            raise error
        assert os.strerror(number) in str(caught.value)
        assert caught.value.__cause__ is error
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "error", [OSError("odd"), RuntimeError("odd"), FileNotFoundError(errno.ENOENT, "gone")]
)
def test_other_faults_pass_unchanged(tmp_path, error):
    with pytest.raises(type(error)) as caught, writing(tmp_path / "a"):
        raise error
    assert caught.value is error


def test_a_fault_of_another_file_is_not_blamed_on_this_one(tmp_path):
    with pytest.raises(PermissionError), writing(tmp_path / "a"):
        raise PermissionError(errno.EACCES, "Permission denied", "/elsewhere/input.yaml")


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "runs").write_text("")
    with pytest.raises(StorageError, match="runs"), writing(tmp_path / "runs" / "a"):
        pass


def test_a_file_over_the_size_limit(tmp_path):
    code = (
        "import resource, signal, sys\n"
        "from nsf.storage import writing\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "with writing(sys.argv[1]) as partial:\n"
        "    partial.write_bytes(b'0' * 5000)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a"], capture_output=True, text=True)
    assert "nsf.errors.StorageError" in done.stderr
    assert "ulimit -f" in done.stderr
    assert os.listdir(tmp_path) == []


def test_require_space(tmp_path):
    require_space(tmp_path / "a", 1)
    with pytest.raises(StorageError, match="MiB free"):
        require_space(tmp_path / "a", 2**62)


def test_a_folder_is_made_or_refused(tmp_path):
    require_folder(tmp_path / "a/b")
    assert list(tmp_path.rglob("*")) == [tmp_path / "a", tmp_path / "a/b"]
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"file: File exists; .* write elsewhere"):
        require_folder(tmp_path / "file")


def test_write_json_refuses_what_json_cannot_hold(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"loss": float("nan")})
    assert os.listdir(tmp_path) == []
