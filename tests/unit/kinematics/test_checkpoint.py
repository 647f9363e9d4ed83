"""A checkpoint comes back to the bit or is refused by name."""

import pickle

import pytest
import torch

from nsf.errors import MissingRunError, SchemaError
from nsf.kinematics.manifold import Manifold


@pytest.fixture
def path(manifold, tmp_path):
    manifold.datasets, manifold.split = ["simulate/wave/0a"], {"train": [0.8, 1.1], "test": []}
    manifold.save(tmp_path / "manifold.pt")
    return tmp_path / "manifold.pt"


def test_round_trip(manifold, path):
    loaded = Manifold.load(path)
    assert type(loaded) is type(manifold)
    for name in (
        "latent_dim",
        "x_sha256",
        "parameter_names",
        "hyperparameters",
        "datasets",
        "split",
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
        ({"format_version": 2}, "format_version 2"),
        ({"format": "other"}, "no manifold"),
        ({"field": "os"}, "field 'os'"),
        ({"state": {}}, "do not fit"),
        ({"hyperparameters": {}}, "do not fit"),
        ({"latent_dim": 3}, "do not fit"),
    ],
)
def test_foreign(path, change, message):
    torch.save({**torch.load(path, weights_only=True), **change}, path)
    with pytest.raises(SchemaError, match=message):
        Manifold.load(path)


def test_missing_key(path):
    content = torch.load(path, weights_only=True)
    del content["split"]
    torch.save(content, path)
    with pytest.raises(SchemaError, match="lacks split"):
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
