"""A latent vector of positions and stress together."""

import pytest
import torch

from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.fields import pod
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.fields.joint import JointField
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.phases import seeded

MODES, LATENT = [9, 7, 8], 3


def built(field, snapshots):
    return field.build(snapshots, field.prepare(snapshots, LATENT), LATENT, seeded("cpu", 0))


@pytest.fixture(scope="module")
def joint(snapshots):
    return built(JointField(modes=MODES, beta=4, depth=2, stress_weight=1.0), snapshots)


@pytest.fixture(scope="module")
def frames(snapshots):
    return [snapshots.slab(name, slice(None)).double() for name in ("x", "tau")]


def deviations(values):
    return (values - values.mean(0)).flatten(1)


def unit(columns):
    return columns / columns.norm(dim=0)


@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_latents_are_the_coefficients_of_joint_snapshots(snapshots, frames, weight):
    x, tau = deviations(frames[0]), frames[1].flatten(1)
    left, _, _ = torch.linalg.svd(torch.cat([x / x.norm(), weight**0.5 * tau / tau.norm()], 1))
    manifold = built(JointField(modes=MODES, stress_weight=weight), snapshots)
    latents = manifold.training_latents
    assert torch.allclose((unit(latents) * left[:, :LATENT]).sum(0).abs(), torch.ones(LATENT).double())
    assert torch.allclose(latents.square().mean(0), torch.ones(LATENT).double())


def test_positions_are_linear_in_them_with_a_closure_of_what_is_left(snapshots, frames):
    """Coefficients are orthogonal, and with as many modes as there are frames nothing is left."""
    prepared = JointField(modes=60, stress_weight=1.0).prepare(snapshots, LATENT)["x"]
    a = prepared["coefficients"]
    gram = unit(a).T @ unit(a)
    assert torch.allclose(gram, torch.eye(len(gram), dtype=gram.dtype), atol=1e-6)
    modes = torch.cat([modes for _, _, modes in pod.modes(snapshots, "x", 3, a)])
    x = frames[0]
    found = x.mean(0) + torch.einsum("mk,nck->mnc", a, modes)
    assert torch.allclose(found, x, atol=1e-6)
    assert prepared["unresolved"] < 1e-9


def test_the_same_shape_under_another_stress_is_another_latent(joint, snapshots, frames):
    x, tau = (values[3:4] for values in frames)
    basis = built(BasisField(modes=MODES), snapshots)
    assert torch.equal(basis.encode(x, tau), basis.encode(x, 0 * tau))
    assert (joint.encode(x, tau) - joint.encode(x, 0 * tau)).norm() > 0.1


def test_a_small_weight_leaves_the_latents_of_positions(snapshots):
    weak = built(JointField(modes=MODES, stress_weight=1e-12), snapshots).training_latents
    plain = built(BasisField(modes=MODES), snapshots).training_latents
    assert torch.allclose((unit(weak) * unit(plain)).sum(0).abs(), torch.ones(LATENT).double())


def test_it_comes_back_from_its_file(joint, frames, tmp_path):
    joint.save(tmp_path / "manifold.pt")
    loaded = Manifold.load(tmp_path / "manifold.pt")
    assert loaded.field == "joint"
    assert torch.equal(loaded.encode(*frames), joint.encode(*frames))
    assert torch.allclose(loaded.encode(*frames), joint.training_latents, atol=1e-4)


@pytest.mark.parametrize("tau", [None, torch.zeros(1, 150, 3)], ids=["none", "shape"])
def test_it_needs_the_stress(joint, frames, tau):
    with pytest.raises(ShapeError, match=r"pass tau \(1, 150, 6\)"):
        joint.encode(frames[0][:1], tau)


@pytest.mark.parametrize("weight", [0.0, -1.0, float("nan")])
def test_refused_weights(weight):
    with pytest.raises(ConfigError, match=rf"field\.stress_weight={weight} must be positive"):
        JointField(stress_weight=weight)


def test_a_field_that_never_changes(snapshots, monkeypatch):
    gram = pod.gram
    monkeypatch.setattr(pod, "gram", lambda s, name, d: (name != "tau") * gram(s, name, d))
    with pytest.raises(ConfigError, match="tau is zero in every snapshot"):
        JointField(modes=MODES).prepare(snapshots, LATENT)
