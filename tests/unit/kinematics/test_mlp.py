"""The paper's networks: principal axes of the latent space, waves, noise and the term on the tangent."""

import copy
from dataclasses import replace

import pytest
import torch

from nsf.errors import ConfigError, SchemaError
from nsf.kinematics.fields.mlp import MlpField
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.descent import Descent
from nsf.kinematics.training.phases import seeded
from nsf.kinematics.training.schedules import FastTrainer, PaperTrainer
from nsf.kinematics.training.train import train

FIELD = MlpField(beta=4)
QUICK = FastTrainer(steps=[250, 1, 1], frames_per_batch=13, particles_per_batch=40)
LATENT = 3


@pytest.fixture(scope="module")
def untrained(snapshots):
    """A manifold with latents of its untrained encoder."""
    manifold = FIELD.build(snapshots, FIELD.prepare(snapshots, LATENT), LATENT, seeded("cpu", 0))
    manifold.encode_training(snapshots)
    return manifold.requires_grad_(False)


def covariance_and_metric(manifold):
    """Of the training latents; mean of JᵀJ over particles and snapshots [m²]."""
    xhat = manifold.training_latents
    J = manifold.restrict().position_and_jacobian(xhat)[1]
    metric = torch.einsum("fncj,fnck->jk", J, J) / (J.shape[0] * J.shape[1])
    return torch.cov(xhat.T, correction=0), metric


@pytest.mark.parametrize("floor", [0.0, 0.3])
def test_turned_coordinates_are_principal_axes_of_displacement(untrained, snapshots, floor):
    manifold = copy.deepcopy(untrained)
    before = manifold.restrict().position(manifold.training_latents)
    share = manifold.turn(floor)
    manifold.encode_training(snapshots)
    after = manifold.restrict().position(manifold.training_latents)
    assert (after - before).abs().max() < 1e-5 * (before - manifold.X).abs().max()
    covariance, metric = covariance_and_metric(manifold)
    unit = metric.diagonal().sqrt()  # [m] of displacement by one unit of a coordinate
    sigma = unit * covariance.diagonal().sqrt()
    for matrix, scale in ((metric, unit), (covariance, covariance.diagonal().sqrt())):
        off = matrix / scale / scale[:, None] - torch.eye(LATENT)
        assert off.abs().max() < 1e-3
    assert (torch.diff(sigma) < 0).all()
    torch.testing.assert_close(unit, (sigma**2 + (floor * sigma[0]) ** 2).sqrt(), rtol=1e-3, atol=0)
    torch.testing.assert_close(share, sigma / unit, rtol=1e-3, atol=0)
    again = copy.deepcopy(manifold)
    again.turn(floor)
    torch.testing.assert_close(again.encoder.linear[-1].weight, manifold.encoder.linear[-1].weight)


def test_the_tangent_is_learned_beside_positions(snapshots, tmp_path):
    off = []
    for tangent in (0.0, 1.0):
        field = replace(FIELD, tangent=tangent)
        manifold, _ = train(snapshots, field, QUICK, LATENT, 0, tmp_path / str(tangent), "cpu")
        found = manifold.restrict().position(manifold.training_latents).unflatten(0, (2, -1))
        true = snapshots.slab("x", slice(None)).double().unflatten(0, (2, -1))
        moved, truly = torch.diff(found, dim=1), torch.diff(true, dim=1)
        off.append(float((moved - truly).square().sum() / truly.square().sum()))
    without, with_term = off
    assert with_term < 0.8 * without


def test_stress_and_affine_see_waves_and_the_deformation_does_not(untrained):
    X = untrained.X[:7]
    assert untrained.inputs("deformation", X) is X
    for phase in ("stress", "affine"):
        waves = untrained.inputs(phase, X)
        torch.testing.assert_close(waves[:, :3], X)
        sines, cosines = waves[:, 3:].chunk(2, 1)
        torch.testing.assert_close(sines**2 + cosines**2, torch.ones_like(sines))
        # Each octave has twice the frequency of the one before.
        torch.testing.assert_close(sines[:, 3:6], 2 * sines[:, :3] * cosines[:, :3])
        assert untrained.decoders[phase].layers[0].in_features == 3 + 6 * 4 + LATENT + 1


def test_noise_of_the_heads_is_that_of_the_coordinates(snapshots):
    """A head sees a coordinate at the floor with as much noise as it varies, whatever `noise` is."""
    field = replace(FIELD, noise=0.0, noise_floor=100.0)  # the floor is far above every coordinate
    prepared = field.prepare(snapshots, LATENT)
    manifold = field.build(snapshots, prepared, LATENT, seeded("cpu", 0))
    _, stress, _ = field.fits(manifold, snapshots, prepared)
    seen = []
    stress.network.register_forward_pre_hook(lambda network, given: seen.append(given[0]))
    stress.loss(torch.arange(26), torch.arange(2), seeded("cpu", 1))
    noise = seen[0][:, 0, 3 + 24 : 3 + 24 + LATENT].double() - manifold.training_latents
    assert 0.5 < float(noise.std()) < 1.5
    assert float(manifold.training_latents.std()) < 0.05


@pytest.mark.parametrize(
    ("schedule", "names"), [(PaperTrainer(), ["Adam"]), (FastTrainer(steps=1), ["Muon", "Adam"])]
)
def test_muon_moves_the_matrices_but_in_the_paper_s_schedule(snapshots, schedule, names):
    prepared = FIELD.prepare(snapshots, LATENT)
    manifold = FIELD.build(snapshots, prepared, LATENT, seeded("cpu", 0))
    fit = next(FIELD.fits(manifold, snapshots, prepared))
    descent = Descent(fit, schedule, snapshots.M, snapshots.P, True, 0, torch.device("cpu"))
    optimizers = descent.optimizers()
    assert [type(optimizer).__name__ for optimizer in optimizers] == names
    moved = [w for optimizer in optimizers for group in optimizer.param_groups for w in group["params"]]
    assert {id(w) for w in moved} == {id(w) for w in fit.network.parameters()}
    assert len(moved) == len(list(fit.network.parameters()))
    assert descent.rate_at(0, 10) == (5 if "Muon" in names else 1) * schedule.rate_at(0, 10)


def test_a_checkpoint_from_before_is_refused(untrained, tmp_path):
    old = copy.deepcopy(untrained)
    del old.hyperparameters["octaves"]
    old.save(tmp_path / "manifold.pt")
    with pytest.raises(SchemaError, match=r"octaves.*train again"):
        Manifold.load(tmp_path / "manifold.pt")


@pytest.mark.parametrize(
    ("key", "value"),
    [("octaves", -1), ("octaves", 13), ("noise", -0.1), ("noise_floor", -1), ("tangent", -1)],
)
def test_refusals(key, value):
    with pytest.raises(ConfigError, match=f"{key}={value}"):
        MlpField(**{key: value})
