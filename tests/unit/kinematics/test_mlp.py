"""The paper's networks: principal axes of the latent space, waves, noise and the term on the tangent."""

import copy
from dataclasses import replace

import pytest
import torch

from nsf.errors import ConfigError, SchemaError
from nsf.kinematics.fields.mlp import MlpField
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.lightning import FieldTraining
from nsf.kinematics.training.phases import seeded
from nsf.kinematics.training.schedules import FastTrainer, PaperTrainer
from nsf.kinematics.training.train import train

FIELD = MlpField(beta=4)
QUICK = FastTrainer(steps=[200, 1, 1], frames_per_batch=13, particles_per_batch=40)
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
        standard = (X - untrained.X.mean(0)) / untrained.X.std(0, correction=0)
        torch.testing.assert_close(sines[:, :3], torch.sin(1.5 * standard), rtol=1e-5, atol=1e-5)
        # Each octave has twice the frequency of the one before.
        torch.testing.assert_close(sines[:, 3:6], 2 * sines[:, :3] * cosines[:, :3])
        assert untrained.decoders[phase].layers[0].in_features == 3 + 6 * 4 + LATENT + 1


def seen_by(network, loss, *batch):
    """The latent part [F, r] of what a network is given, at its first particle, in each call."""
    given, first = [], network.layers[0].in_features
    hook = network.register_forward_pre_hook(lambda network, inputs: given.append(inputs[0].detach()))
    loss(*batch)
    hook.remove()
    places = 3 if network.layers[-1].out_features == 3 else 27
    assert {values.shape[-1] for values in given} == {first}
    return [values[:, 0, places : places + LATENT].double() for values in given]


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_noise_of_g_is_in_deviations_of_the_batch_s_latents(snapshots, noise):
    field = replace(FIELD, noise=noise)
    manifold = field.build(snapshots, field.prepare(snapshots, LATENT), LATENT, seeded("cpu", 0))
    manifold.encode_training(snapshots)
    fit = next(field.fits(manifold, snapshots, field.prepare(snapshots, LATENT)))
    rows = torch.arange(26)
    off = []
    for draw in range(40):
        batch = rows, torch.arange(2), seeded("cpu", draw)
        now, then = seen_by(manifold.decoders["deformation"], fit.loss, *batch)
        off.append(now - manifold.training_latents)
        # The same noise on a frame and on the next one, or their difference would be its own.
        steps = torch.diff(manifold.training_latents, dim=0)[:12]
        torch.testing.assert_close((then - now)[:12], steps, rtol=0, atol=1e-6)
    expected = noise * manifold.training_latents.std(0, correction=0)
    torch.testing.assert_close(torch.cat(off).std(0), expected, rtol=0.1, atol=1e-6)


@pytest.mark.parametrize(("noise", "floor"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.5), (0.3, 0.5)])
def test_noise_of_the_heads_is_that_of_the_coordinates(snapshots, noise, floor):
    """√(noise² σ_k² + (ε σ_1)²) of coordinate k, as displacement."""
    field = replace(FIELD, noise=noise, noise_floor=floor)
    prepared = field.prepare(snapshots, LATENT)
    manifold = field.build(snapshots, prepared, LATENT, seeded("cpu", 0))
    _, stress, _ = field.fits(manifold, snapshots, prepared)
    off = torch.cat(
        [
            seen_by(stress.network, stress.loss, torch.arange(26), torch.arange(2), seeded("cpu", draw))[0]
            - manifold.training_latents
            for draw in range(40)
        ]
    )
    _, metric = covariance_and_metric(manifold)
    unit = metric.detach().diagonal().sqrt()
    sigma = unit * manifold.training_latents.std(0, correction=0)
    expected = (noise**2 * sigma**2 + (floor * sigma[0]) ** 2).sqrt()
    torch.testing.assert_close(off.std(0) * unit, expected, rtol=0.1, atol=float(1e-6 * sigma[0]))


@pytest.mark.parametrize("phase", [1, 2])
def test_a_frame_counts_for_less_by_its_own_size(snapshots, phase):
    """The loss of each frame alone, with the same untrained network, over that without weights."""
    losses = []
    for evenness in (0.0, 2.0):
        field = replace(FIELD, noise=0.0, noise_floor=0.0, evenness=evenness)
        prepared = field.prepare(snapshots, LATENT)
        manifold = field.build(snapshots, prepared, LATENT, seeded("cpu", 0))
        fit = list(field.fits(manifold, snapshots, prepared))[phase]
        rows = torch.arange(26).split(1)
        losses.append(torch.stack([fit.loss(row, slice(None), seeded("cpu", 0)) for row in rows]).detach())
    name = ("tau", "C")[phase - 1]
    squares = manifold.standard[name](snapshots.slab(name, slice(None))).square().mean((1, 2))
    expected = 1.0 / (1.0 + 2.0 * squares / squares.mean())
    torch.testing.assert_close(losses[1] / losses[0], expected / expected.mean(), rtol=1e-4, atol=0)
    assert expected.max() > 1.5 * expected.min()


def test_a_metre_counts_as_much_along_each_axis(snapshots):
    mean, std = FIELD.prepare(snapshots, LATENT)["x"]
    u = snapshots.slab("x", slice(None)) - snapshots.X.float()
    torch.testing.assert_close(std, u.std((0, 1), correction=0).square().mean().sqrt().expand(3))
    torch.testing.assert_close(mean, u.mean((0, 1)))


@pytest.mark.parametrize("field", [FIELD, MlpField(beta=4, octaves=0, head_parameters=False)])
def test_deployed_fields_are_those_that_were_trained(snapshots, field):
    prepared = field.prepare(snapshots, LATENT)
    manifold = field.build(snapshots, prepared, LATENT, seeded("cpu", 0))
    manifold.encode_training(snapshots)
    rows, particles = torch.tensor([4, 20]), torch.arange(150)
    mu, xhat = manifold.training_parameters[rows], manifold.training_latents[rows]
    at = manifold.restrict()
    found = {"tau": at.stress(xhat, mu), "C": at.affine(xhat, mu).flatten(-2)}
    for fit, name in zip(list(replace_noise(field, manifold, snapshots, prepared))[1:], found, strict=True):
        values = snapshots.gather(name, rows, particles)
        off = (found[name] - values) / prepared[name][1]
        torch.testing.assert_close(
            off.square().mean().float(), fit.loss(rows, particles, None).detach(), rtol=1e-4, atol=0
        )


def replace_noise(field, manifold, snapshots, prepared):
    """The fits of a field without noise and weights, whose latent space is left as it is."""
    manifold.turn = lambda floor: torch.ones(LATENT, dtype=torch.float64)
    return replace(field, noise=0.0, evenness=0.0).fits(manifold, snapshots, prepared)


@pytest.mark.parametrize(
    ("schedule", "names"), [(PaperTrainer(), ["Adam"]), (FastTrainer(steps=1), ["Muon", "Adam"])]
)
def test_muon_moves_the_matrices_but_in_the_paper_s_schedule(snapshots, schedule, names):
    prepared = FIELD.prepare(snapshots, LATENT)
    manifold = FIELD.build(snapshots, prepared, LATENT, seeded("cpu", 0))
    fit = next(FIELD.fits(manifold, snapshots, prepared))
    module = FieldTraining(fit, schedule, snapshots, 0)
    optimizers = module.configure_optimizers()
    assert [type(optimizer).__name__ for optimizer in optimizers] == names
    moved = [w for optimizer in optimizers for group in optimizer.param_groups for w in group["params"]]
    assert {id(w) for w in moved} == {id(w) for w in fit.network.parameters()}
    assert len(moved) == len(list(fit.network.parameters()))
    assert module.rate_at(0) == (5 if "Muon" in names else 1) * schedule.rate_at(0, 1)


def test_a_checkpoint_from_before_is_refused(untrained, tmp_path):
    old = copy.deepcopy(untrained)
    del old.hyperparameters["octaves"]
    old.save(tmp_path / "manifold.pt")
    with pytest.raises(SchemaError, match=r"octaves.*train again"):
        Manifold.load(tmp_path / "manifold.pt")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("octaves", -1),
        ("octaves", 8),
        ("octaves", 2.5),
        ("noise", -0.1),
        ("noise_floor", -1),
        ("tangent", -1),
    ],
)
def test_refusals(key, value):
    with pytest.raises(ConfigError, match=f"{key}={value}"):
        MlpField(**{key: value})


def test_steps_may_be_more_than_units_of_a_layer():
    steps = FastTrainer(steps=[5, 40_000])
    assert [steps.steps_of(phase, 26) for phase in ("deformation", "affine")] == [5, 40_000]
    with pytest.raises(ConfigError, match=r"beta=40000 is not .* from 1 to 16384"):
        MlpField(beta=40_000)
