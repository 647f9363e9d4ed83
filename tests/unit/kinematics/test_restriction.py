"""Shapes and derivatives of both fields, at particles and between them."""

import pytest
import torch

from nsf.errors import SchemaError, ShapeError

STEP = 1e-6


def differences(function, at):
    """Central differences along the last axis of `at`, last in the result; `at` may be [n, 3] points."""
    shifts = STEP * torch.eye(at.shape[-1], dtype=torch.float64)
    return torch.stack([(function(at + s) - function(at - s)) / (2 * STEP) for s in shifts], -1)


def close(value, reference, relative=1e-6):
    return (value - reference).abs().max() <= relative * reference.abs().max()


@pytest.fixture
def points():
    return 0.1 + 0.8 * torch.rand(20, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (4,)])
def test_shapes(manifold, batch):
    at = manifold.restrict(particles=torch.arange(10))
    xhat, parameters = torch.zeros(*batch, 2, dtype=torch.float64), torch.ones(*batch, 1, dtype=torch.float64)
    x, jacobian = at.position_and_jacobian(xhat)
    assert at.position(xhat).shape == x.shape == (*batch, 10, 3)
    assert jacobian.shape == (*batch, 10, 3, 2)
    assert at.stress(xhat, parameters).shape == (*batch, 10, 6)
    assert at.affine(xhat, parameters[..., :]).shape == (*batch, 10, 3, 3)
    assert at.deformation_gradient(xhat).shape == (*batch, 10, 3, 3)
    assert at.stress(xhat, torch.ones(1, dtype=torch.float64)).shape == (*batch, 10, 6)


def test_batch_is_rows(manifold):
    at = manifold.restrict()
    xhat, parameters = manifold.training_latents[3:6], manifold.training_parameters[3:6]
    for i in range(3):
        for values, value in [
            (at.position(xhat), at.position(xhat[i])),
            (at.position_and_jacobian(xhat)[1], at.position_and_jacobian(xhat[i])[1]),
            (at.stress(xhat, parameters), at.stress(xhat[i], parameters[i])),
            (at.affine(xhat, parameters), at.affine(xhat[i], parameters[i])),
            (at.deformation_gradient(xhat), at.deformation_gradient(xhat[i])),
        ]:
            torch.testing.assert_close(values[i], value)


def test_jacobian(manifold):
    at, xhat = manifold.restrict(), manifold.training_latents[7]
    x, jacobian = at.position_and_jacobian(xhat)
    torch.testing.assert_close(x, at.position(xhat))
    assert close(jacobian, differences(at.position, xhat))


def test_deformation_gradient(manifold, points):
    xhat = manifold.training_latents[7]
    F = manifold.restrict(X=points).deformation_gradient(xhat)
    assert close(F, differences(lambda X: manifold.restrict(X=X).position(xhat), points))


def test_deformation_gradient_at_particles(manifold):
    rows = torch.tensor([5, 60, 120])
    xhat = manifold.training_latents[7]
    F = manifold.restrict(particles=rows).deformation_gradient(xhat)
    assert close(F, differences(lambda X: manifold.restrict(X=X).position(xhat), manifold.X[rows]), 1e-5)


def test_points_are_particles(manifold):
    rows = torch.tensor([5, 60, 120])
    xhat, parameters = manifold.training_latents[7], manifold.training_parameters[7]
    stored, between = manifold.restrict(particles=rows), manifold.restrict(X=manifold.X[rows])
    for one, other in [
        (stored.position(xhat), between.position(xhat)),
        (stored.stress(xhat, parameters), between.stress(xhat, parameters)),
        (stored.affine(xhat, parameters), between.affine(xhat, parameters)),
    ]:
        assert close(one, other)


def test_parameters_matter(manifold):
    at, xhat = manifold.restrict(), manifold.training_latents[7]
    low, high = torch.tensor([[0.8], [1.1]], dtype=torch.float64)
    assert not torch.allclose(at.stress(xhat, low), at.stress(xhat, high))


def test_subset_shares_memory(manifold):
    at = manifold.restrict()
    few = at.subset(slice(0, 6))
    xhat, parameters = manifold.training_latents[7], manifold.training_parameters[7]
    assert few.points == 6
    torch.testing.assert_close(few.position(xhat), at.position(xhat)[:6])
    torch.testing.assert_close(few.position_and_jacobian(xhat)[1], at.position_and_jacobian(xhat)[1][:6])
    torch.testing.assert_close(few.stress(xhat, parameters), at.stress(xhat, parameters)[:6])
    torch.testing.assert_close(few.deformation_gradient(xhat), at.deformation_gradient(xhat)[:6])
    held = {v.data_ptr() for v in _tensors(at)}
    assert {v.data_ptr() for v in _tensors(few)} <= held


@pytest.mark.parametrize("trained", ["basis"], indirect=True)
def test_positions_need_no_network_of_stress(manifold, monkeypatch):
    made, deployed = [], type(manifold)._deployed

    def counted(self, phase, like):
        made.append(phase)
        return deployed(self, phase, like)

    monkeypatch.setattr(type(manifold), "_deployed", counted)
    manifold.restrict().position(manifold.training_latents[7])
    assert made == ["deformation"]


def _tensors(restriction):
    if hasattr(restriction, "X"):
        return [restriction.X, *restriction.decoders["stress"].parameters()]
    return [t for field in restriction.fields.values() for t in (field.mean, field.modes)]


def test_dtype(manifold):
    at = manifold.restrict(dtype=torch.float32)
    xhat, parameters = manifold.training_latents[7], manifold.training_parameters[7]
    assert at.stress(xhat, parameters).dtype == at.position(xhat).dtype == torch.float32
    reference = manifold.restrict()
    assert close(at.stress(xhat, parameters).double(), reference.stress(xhat, parameters), 1e-4)
    assert close(at.position(xhat).double(), reference.position(xhat), 1e-5)


def test_encode(manifold, snapshots):
    xhat = manifold.encode(snapshots.slab("x", slice(None)))
    assert xhat.dtype == torch.float64
    torch.testing.assert_close(xhat, manifold.training_latents, rtol=1e-5, atol=1e-5)
    with pytest.raises(ShapeError, match=r"\(1, 7, 3\).*150"):
        manifold.encode(torch.zeros(1, 7, 3))


def test_refusals(manifold):
    manifold.check_particles(manifold.x_sha256)
    with pytest.raises(SchemaError, match="other particles"):
        manifold.check_particles("0" * 64)
    with pytest.raises(ShapeError, match="not both"):
        manifold.restrict(particles=torch.arange(2), X=torch.zeros(2, 3))
