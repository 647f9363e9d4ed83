"""Modes of snapshots whose rank is known."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from nsf.data import Snapshots, snapshots
from nsf.errors import ConfigError
from nsf.kinematics.fields import pod
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.training import schedules
from nsf.kinematics.training.lightning import FieldTraining
from nsf.kinematics.training.schedules import FastTrainer
from nsf.kinematics.training.train import train

M, P, RANK = 30, 120, 4


class LowRank(SimpleNamespace):
    """Snapshots of rank 4 in x and 3 in tau, and none in C; the methods of `nsf.data.Snapshots`."""

    slabs = Snapshots.slabs

    def slab(self, name, particles):
        return self.data[name][:, particles]

    def gather(self, name, rows, particles):
        return self.data[name][rows][:, particles]


@pytest.fixture
def low_rank():
    generator = torch.Generator().manual_seed(1)
    X = torch.rand(P, 3, generator=generator, dtype=torch.float64)
    weights = torch.randn(M, RANK, generator=generator) * torch.tensor([1.0, 0.5, 0.2, 0.1])
    shapes = torch.randn(RANK, P * 6, generator=generator)
    data = {
        "x": X.float() + (weights @ shapes[:, : 3 * P]).view(M, P, 3),
        "tau": (5e3 + 1e3 * weights[:, :3] @ shapes[:3]).view(M, P, 6),
        "C": torch.zeros(M, P, 9),
    }
    rows = torch.arange(M)
    return LowRank(
        M=M,
        P=P,
        resident=True,
        X=X,
        x_sha256="0" * 64,
        parameter_names=(),
        parameters=torch.zeros(M, 0),
        t=rows.float(),
        frame=rows,
        data=data,
    )


def test_exact_and_orthonormal(low_rank, monkeypatch):
    monkeypatch.setattr(snapshots, "SLAB_ENTRIES", 7 * 3 * M)  # several slabs, the last one shorter
    coefficients = pod.decompose(low_rank, "x", 20)
    assert coefficients.shape == (M, RANK)
    _, mean, modes = zip(*pod.modes(low_rank, "x", coefficients), strict=True)
    mean, modes = torch.cat(mean), torch.cat(modes)
    x = mean + torch.einsum("mk,nck->mnc", coefficients, modes)
    torch.testing.assert_close(x, low_rank.data["x"].double(), rtol=0, atol=1e-5)
    flat = modes.flatten(0, 1)
    torch.testing.assert_close(flat.T @ flat, torch.eye(RANK, dtype=torch.float64), rtol=0, atol=1e-6)


@pytest.fixture
def many(low_rank):
    """Full-rank snapshots whose singular values fall by a factor of 1.25 each."""
    generator = torch.Generator().manual_seed(2)
    left, right = (
        torch.linalg.qr(torch.randn(n, M, generator=generator, dtype=torch.float64)).Q for n in (M, 3 * P)
    )
    sizes = 1.25 ** -torch.arange(M, dtype=torch.float64)
    low_rank.data["x"] = (low_rank.X + (left * sizes @ right.T).view(M, P, 3)).float()
    return low_rank


def test_many_snapshots_have_the_same_modes_without_their_gram_matrix(many, monkeypatch):
    exact = pod.decompose(many, "x", 5)
    monkeypatch.setattr(pod, "MOST_SOLVED", M - 1)
    monkeypatch.setattr(pod, "_MORE", 8)
    monkeypatch.setattr(pod, "_gram", None)
    found = pod.decompose(many, "x", 5)
    signs = (found * exact).sum(0).sign()
    torch.testing.assert_close(found * signs, exact, rtol=0, atol=1e-3 * float(exact.abs().max()))
    modes = torch.cat([values for *_, values in pod.modes(many, "x", found)]).flatten(0, 1)
    torch.testing.assert_close(modes.T @ modes, torch.eye(5, dtype=torch.float64), rtol=0, atol=1e-9)


def test_of_many_snapshots_a_step_sees_some(low_rank, monkeypatch):
    monkeypatch.setattr(schedules, "MOST_AT_ONCE", M - 1)
    monkeypatch.setattr(schedules, "DRAWN", 7)
    seen = []
    fit = next(BasisField().fits(*_built(low_rank)))
    loss = fit.loss
    kept = replace(fit, loss=lambda rows, *rest: seen.append(rows) or loss(rows, *rest))
    module = FieldTraining(kept, FastTrainer(steps=3), low_rank, 0)
    module.begin(module.configure_optimizers())
    module.take(0, 3)
    assert [len(rows) for rows in seen] == [7, 7, 7]
    assert len({tuple(rows.tolist()) for rows in seen}) == 3
    assert max(int(rows.max()) for rows in seen) < M


def _built(snapshots):
    field = BasisField()
    prepared = field.prepare(snapshots, 2)
    return field.build(snapshots, prepared, 2, torch.Generator().manual_seed(0)), snapshots, prepared


def test_latents_of_full_rank_need_no_network(low_rank, tmp_path):
    manifold, metrics = train(low_rank, BasisField(), FastTrainer(steps=20), RANK, 0, tmp_path, "cpu")
    assert "deformation_steps" not in metrics
    assert "affine_steps" not in metrics
    at, xhat = manifold.restrict(), manifold.training_latents
    torch.testing.assert_close(at.position(xhat), low_rank.data["x"].double(), rtol=0, atol=1e-5)
    torch.testing.assert_close(xhat.std(0, correction=0), torch.ones(RANK, dtype=torch.float64))
    assert at.affine(xhat[0], torch.zeros(0)).abs().max() == 0
    x, jacobian = at.position_and_jacobian(xhat[3])
    torch.testing.assert_close(at.position(xhat[3] + jacobian.new_tensor([1, 0, 0, 0])), x + jacobian[..., 0])


@pytest.mark.parametrize(
    ("latent_dim", "message"), [(5, "rank 4"), (49, "48 displacement modes"), (0, "latent_dim=0")]
)
def test_impossible_latent_dimension(low_rank, tmp_path, latent_dim, message):
    with pytest.raises(ConfigError, match=message):
        train(low_rank, BasisField(), FastTrainer(steps=20), latent_dim, 0, tmp_path, "cpu")
