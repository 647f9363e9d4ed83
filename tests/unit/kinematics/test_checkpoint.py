"""A checkpoint comes back to the bit or is refused by name."""

import copy
import importlib
import itertools
import os
import pickle
import random
import re
import shutil
import zipfile

import pytest
import torch

from nsf.errors import MissingRunError, SchemaError
from nsf.kinematics import checkpoint
from nsf.kinematics.manifold import Manifold
from nsf.runs import Run

FIELDS = ["basis", "mlp"]
of_each_field = pytest.mark.parametrize("path", FIELDS, indirect=True)


@pytest.fixture
def path(request, trained_of, tmp_path):
    """A checkpoint of the field `basis`, or of the one that a test asks for."""
    manifold, _ = trained_of(getattr(request, "param", "basis"))
    manifold.save(tmp_path / "manifold.pt")
    return tmp_path / "manifold.pt"


@pytest.mark.parametrize("field", FIELDS)
def test_round_trip(trained_of, tmp_path, field):
    manifold, _ = trained_of(field)
    manifold.save(tmp_path / "manifold.pt")
    loaded = Manifold.load(tmp_path / "manifold.pt")
    assert type(loaded) is type(manifold)
    for name in (
        "latent_dim",
        "x_sha256",
        "parameter_names",
        "hyperparameters",
        "field",
    ):
        assert getattr(loaded, name) == getattr(manifold, name)
    state, expected = loaded.state_dict(), manifold.state_dict()
    assert state.keys() == expected.keys()
    assert all(
        torch.equal(state[key], expected[key]) and state[key].dtype == expected[key].dtype for key in state
    )
    xhat, parameters = manifold.training_latents[4], manifold.training_parameters[4]
    for method in ("stress", "affine"):
        value, reference = (getattr(m.restrict(), method)(xhat, parameters) for m in (loaded, manifold))
        assert torch.equal(value, reference)
    assert torch.equal(loaded.restrict().position(xhat), manifold.restrict().position(xhat))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
def test_truncated(path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(SchemaError, match=r"manifold\.pt.*nsf train"):
        Manifold.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 4}, "format_version 4"),
        ({"format_version": 2}, r"format_version 2, this nsf reads 3; train again with `nsf train`"),
        ({"format": "other"}, "no manifold"),
        ({"state": {}}, "other tensors than its field"),
        ({"hyperparameters": {}}, "hyperparameters lacks particles"),
        ({"latent_dim": 3}, r"has training_latents of float64\[26, 2\], not float64\[26, 3\]"),
        ({"latent_dim": "2"}, "latent_dim='2' must be a whole number of at least 1"),
        ({"latent_dim": True}, "latent_dim=True must be a whole number of at least 1"),
        ({"latent_dim": 0}, "latent_dim=0 must be a whole number of at least 1"),
        ({"x_sha256": 5}, "x_sha256=5 must be text"),
        ({"x_sha256": "0" * 64}, "has an X of other particles"),
        ({"parameter_names": [1]}, r"parameter_names\[0\]=1 must be text"),
        ({"parameter_names": "speed"}, "parameter_names='speed' must be a list"),
        ({"hyperparameters": {"noise": float("nan")}}, "holds nan beside its tensors"),
        ({"hyperparameters": {"noise": torch.zeros(1)}}, r"holds tensor\(\[0\.\]\) beside its tensors"),
    ],
)
def test_foreign(path, change, message):
    torch.save({**torch.load(path, weights_only=True), **change}, path)
    with pytest.raises(SchemaError, match=rf"manifold\.pt .*{message}"):
        Manifold.load(path)


@of_each_field
def test_hyperparameters_that_no_field_has(path):
    content = torch.load(path, weights_only=True)
    for key in content["hyperparameters"]:
        for odd in ("abc", None, -1, [{}], {"a": 1}):
            forged = {**content["hyperparameters"], key: odd}
            torch.save({**content, "hyperparameters": forged}, path)
            with pytest.raises(SchemaError, match=rf"manifold\.pt .*hyperparameters\.{key}"):
                Manifold.load(path)


@pytest.mark.parametrize(
    "name",
    [
        "os.system",
        "os",
        "nsf.workers.Worker",
        "nsf.kinematics.manifold.Manifold",
        "nsf.kinematics.fields.basis.BasisField",
        "nsf.kinematics.fields.basis.Manifold",  # imported there, and not its own
        "nsf.kinematics.fields.modal.ModalRestriction",
        "nsf.kinematics.fields.basis.BasisManifold.load",
        "nsf.kinematics.fields.nothing.Here",
        "nsf.kinematics.fields..basis.BasisManifold",
        "nsf.kinematics.fields._hidden.Manifold",
        "nsf.kinematics.fields.basis.__builtins__",
        "nsf.kinematics.fields.basis/../../../os.system",
        "",
        None,
        5,
        ["nsf.kinematics.fields.basis.BasisManifold"],
        "x" * 10_000,
    ],
)
def test_a_class_that_no_file_may_name(path, name, monkeypatch):
    imported = []
    plain = importlib.import_module
    monkeypatch.setattr(importlib, "import_module", lambda name: imported.append(name) or plain(name))
    torch.save(torch.load(path, weights_only=True) | {"manifold": name}, path)
    with pytest.raises(
        SchemaError, match=r"manifold\.pt names the manifold .*, which is no Manifold of a module of"
    ):
        Manifold.load(path)
    assert not [module for module in imported if not module.startswith("nsf.kinematics.fields.")]


def test_a_class_of_elsewhere_cannot_be_saved(trained_of, tmp_path):
    manifold = copy.copy(trained_of("basis")[0])

    class Elsewhere(type(manifold)):
        pass

    manifold.__class__ = Elsewhere
    with pytest.raises(SchemaError, match=r"names the manifold '.*Elsewhere'"):
        manifold.save(tmp_path / "manifold.pt")
    assert not list(tmp_path.iterdir())


def state_of(path, change):
    """Write the checkpoint with other tensors."""
    content = torch.load(path, weights_only=True)
    change(content["state"])
    torch.save(content, path)


def test_every_tensor_must_be_finite(path):
    whole = path.read_bytes()
    state = torch.load(path, weights_only=True)["state"]
    names = [name for name, tensor in state.items() if tensor.numel() and tensor.is_floating_point()]
    for name, bad in zip(names, itertools.cycle([float("nan"), float("inf"), -float("inf")])):
        state_of(path, lambda state: state[name].view(-1)[-1:].fill_(bad))  # noqa: B023
        with pytest.raises(
            SchemaError, match=rf"manifold\.pt has non-finite values of {re.escape(name)}; train"
        ):
            Manifold.load(path)
        path.write_bytes(whole)
    Manifold.load(path)


def test_a_sum_that_overflows_is_of_finite_values(path):
    state_of(path, lambda state: state["training_times"].fill_(1.7e308))
    assert Manifold.load(path).training_times[0] == 1.7e308


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.update(X=s["X"].float()), r"X of float32\[150, 3\], not float64"),
        (lambda s: s.update(X=s["X"].T), r"X of float64\[3, 150\]"),
        (lambda s: s.update(X=s["X"].flip(0)), "has an X of other particles"),
        (lambda s: s.update(X=s["X"].to_sparse()), "calls 'torch._utils _rebuild_sparse_tensor'"),
        (lambda s: s.update(X=[1, 2]), "'X' among its tensors"),
        (lambda s: s.update(X=torch.zeros(1, 1).expand(10**9, 3)), "is larger than the file"),
        (lambda s: s.pop("training_latents"), r"other tensors than its field \(training_latents\)"),
        (lambda s: s.update(more=torch.zeros(1)), r"other tensors than its field \(more\)"),
        (lambda s: s.update({5: torch.zeros(1)}), "has 5 among its tensors"),
        (
            lambda s: s["standard_parameters.std"].fill_(0.0),
            r"standard_parameters\.std that are not positive",
        ),
        (
            lambda s: s["standard_parameters.std"].fill_(-1.0),
            r"standard_parameters\.std that are not positive",
        ),
    ],
)
def test_odd_tensors(path, change, message):
    state_of(path, change)
    with pytest.raises(SchemaError, match=rf"manifold\.pt .*{message}.*; train again"):
        Manifold.load(path)


@of_each_field
def test_sizes_that_no_file_could_fill(path):
    content = torch.load(path, weights_only=True)
    sizes = {"particles", "frames", "depth", "members"} & content["hyperparameters"].keys()
    for key, huge in itertools.product(sizes, (10**6, 2**63, -(10**12))):
        torch.save(content | {"hyperparameters": content["hyperparameters"] | {key: huge}}, path)
        with pytest.raises(SchemaError, match=r"asks for .* entries, with"):
            Manifold.load(path)


def test_more_layers_than_the_file_has_tensors(path):
    content = torch.load(path, weights_only=True)
    torch.save(content | {"hyperparameters": content["hyperparameters"] | {"depth": 50_000}}, path)
    with pytest.raises(SchemaError, match=r"depth=50000 must be a whole number from 1 to 256"):
        Manifold.load(path)


def test_a_list_that_is_endless_to_go_through(path):
    bomb = [0.0]
    for _ in range(30):
        bomb = [bomb] * 10
    torch.save(torch.load(path, weights_only=True) | {"hyperparameters": {"modes": bomb}}, path)
    assert path.stat().st_size < 10**6
    with pytest.raises(SchemaError, match="more than plain data"):
        Manifold.load(path)


def test_a_file_that_unpacks_to_more_than_it_is(path, tmp_path):
    packed = tmp_path / "packed.pt"
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for member in whole.namelist():
            archive.writestr(member, whole.read(member))
    with pytest.raises(SchemaError, match=r"packed\.pt has a part that is compressed, or counts twice"):
        Manifold.load(packed)


def test_a_run_s_manifold_is_what_the_run_left(path, tmp_path):
    run = Run.open("train", "sand", {}, root=tmp_path / "runs")
    with run.record() as record:
        shutil.copy(path, run.path / "manifold.pt")
        record.output("manifold.pt")
    own = run.path / "manifold.pt"
    Manifold.load(own)
    whole, rng = own.read_bytes(), random.Random(0)
    for _ in range(20):
        place = rng.randrange(len(whole))
        own.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << rng.randrange(8)]) + whole[place + 1 :])
        with pytest.raises(SchemaError, match=r"manifold\.pt has sha256 .* it was changed after the run"):
            Manifold.load(own)


def test_damaged_bytes_never_give_another_error(path):
    whole, rng, refused = path.read_bytes(), random.Random(0), 0
    for _ in range(60):
        place = rng.randrange(len(whole))
        path.write_bytes(whole[:place] + rng.randbytes(rng.randint(1, 64)) + whole[place + 64 :])
        try:
            Manifold.load(path)
        except SchemaError:
            refused += 1
    assert refused > 10


def test_a_pipe_is_no_checkpoint(tmp_path):
    os.mkfifo(tmp_path / "manifold.pt")
    with pytest.raises(SchemaError, match=r"manifold\.pt is no regular file"):
        Manifold.load(tmp_path / "manifold.pt")


def test_missing_key(path):
    content = torch.load(path, weights_only=True)
    del content["state"]
    torch.save(content, path)
    with pytest.raises(SchemaError, match="lacks state"):
        Manifold.load(path)


class Bomb:
    """Unpickling it would write a file."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return open, (str(self.target), "w")


@pytest.mark.parametrize("save", [torch.save, lambda bomb, path: path.write_bytes(pickle.dumps(bomb))])
def test_pickle_bomb(tmp_path, save):
    save({"format": Bomb(tmp_path / "exploded")}, tmp_path / "bomb.pt")
    with pytest.raises(SchemaError, match=r"bomb\.pt"):
        Manifold.load(tmp_path / "bomb.pt")
    assert not (tmp_path / "exploded").exists()


def test_missing(tmp_path):
    with pytest.raises(MissingRunError, match="nsf train"):
        Manifold.load(tmp_path / "none.pt")


def test_a_tensor_that_is_a_plain_attribute_is_named():
    module = torch.nn.Module()
    with torch.device("meta"):
        module.own = torch.zeros(3)
    with pytest.raises(SchemaError, match=r"no tensor 'own' of Module.*register_buffer"):
        checkpoint.check_filled(module)
    module.own = torch.zeros(3)
    checkpoint.check_filled(module)
