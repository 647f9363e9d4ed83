"""`field.affine=rate`: C where one shape is passed at different speeds."""

import numpy as np
import pytest
import torch

from nsf.data import Snapshots, TrajectoryWriter
from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.training.schedules import FastTrainer
from nsf.kinematics.training.train import train

PARTICLES, FRAMES, DT = 60, 41, 0.01
LONG = FastTrainer(steps=500, learning_rate=1e-2, frames_per_batch=40, particles_per_batch=60)


@pytest.fixture(scope="module")
def swinging(tmp_path_factory):
    """Two modes that go round a circle, to and fro and faster and slower: x does not tell C."""
    folder, rng = tmp_path_factory.mktemp("swinging"), np.random.default_rng(3)
    X = rng.random((PARTICLES, 3))
    shapes, slopes = rng.normal(size=(2, PARTICLES, 3)), rng.normal(size=(2, PARTICLES, 9))
    paths = []
    for run, speed in enumerate((2.0, -3.0, 5.0)):
        paths.append(folder / f"{run}.h5")
        ones = np.ones(PARTICLES)
        about = {"mass": ones, "volume0": ones, "parameters": {"number": float(run)}, "dt": DT, "dx": 0.1}
        t = DT * np.arange(FRAMES)
        phase = speed * t + np.sin(9 * t)
        q = 0.1 * np.stack([np.cos(phase), np.sin(phase)], 1)
        # The rate of the step that ends at a frame; the first is that of the initial velocity.
        before = -DT * speed + np.sin(-9 * DT)
        rates = np.diff(q, axis=0, prepend=0.1 * np.array([[np.cos(before), np.sin(before)]])) / DT
        with TrajectoryWriter(paths[-1], X=X, frames=FRAMES, dtype="float64", **about) as writer:
            for time, place, rate in zip(t, q, rates, strict=True):
                x, v = X + np.tensordot(place, shapes, 1), np.tensordot(rate, shapes, 1)
                writer.append(time, x, v, np.tensordot(rate, slopes, 1), np.zeros((PARTICLES, 6)))
    return Snapshots(paths)


def manifold_of(snapshots, folder, **options):
    field = BasisField(modes=[2, 2, 2], beta=2, depth=2, **options)
    return train(snapshots, field, LONG, 2, 0, folder, "cpu")[0]


def error(manifold, snapshots, rates):
    C = snapshots.slab("C", slice(None)).double()
    at = manifold.restrict()
    found = at.affine(manifold.training_latents, manifold.training_parameters, rates).flatten(-2)
    return float((found - C).norm() / C.norm())


@pytest.fixture(scope="module")
def rated(swinging, tmp_path_factory):
    return manifold_of(swinging, tmp_path_factory.mktemp("rate"), affine="rate", rate_noise=0.01)


def test_the_rate_tells_what_the_shape_cannot(swinging, rated, tmp_path):
    plain = manifold_of(swinging, tmp_path)
    assert error(rated, swinging, rated.training_rates) < 0.05
    assert error(plain, swinging, None) > 0.3


def test_c_is_affine_in_the_rate(rated):
    at, generator = rated.restrict(), torch.Generator().manual_seed(0)
    xhat, (one, other) = rated.training_latents[7], torch.randn(2, 2, generator=generator).double()
    C = lambda rate: at.affine(xhat, rated.training_parameters[7], rate)  # noqa: E731
    at_rest = C(torch.zeros_like(one))
    torch.testing.assert_close(C(one + other) - at_rest, C(one) + C(other) - 2 * at_rest)
    assert (C(one) - at_rest).abs().max() > 1e-3


def test_training_rates_are_backward_differences(rated):
    latents = rated.training_latents.unflatten(0, (3, FRAMES))
    rates = rated.training_rates.unflatten(0, (3, FRAMES))
    # They follow from velocities, and positions are read in float32.
    torch.testing.assert_close(rates[:, 1:], torch.diff(latents, dim=1) / DT, rtol=1e-3, atol=1e-4)
    # Before the first frame a body came with its velocity: one more step of the same motion.
    assert (rates[:, 0] - rates[:, 1]).abs().max() < 0.2 * rates[:, 1].abs().max()


def test_noise_on_the_rate_leaves_c_to_the_shape_where_it_tells(swinging, tmp_path):
    much = manifold_of(swinging, tmp_path, affine="rate", rate_noise=100.0)
    at, xhat = much.restrict(), much.training_latents[7]
    C = [at.affine(xhat, much.training_parameters[7], rate) for rate in torch.eye(2).double()]
    assert (C[0] - C[1]).abs().max() < 0.05 * C[0].abs().max() + 0.05


def test_a_rate_that_is_missing_is_named(rated):
    with pytest.raises(ShapeError, match=r"field\.affine=rate.*pass rate="):
        rated.restrict().affine(rated.training_latents[0], rated.training_parameters[0])


def test_an_unknown_affine_is_named():
    with pytest.raises(ConfigError, match=r"field\.affine=speed is unknown; choose latent or rate"):
        BasisField(affine="speed")
