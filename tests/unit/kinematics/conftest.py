"""Small snapshots on disk and quickly trained manifolds of every field."""

from functools import cache

import numpy as np
import pytest

from nsf.data import Snapshots, TrajectoryWriter
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.fields.mlp import MlpField
from nsf.kinematics.training.schedules import FastTrainer
from nsf.kinematics.training.train import train

FIELDS = {
    "basis": BasisField(modes=[9, 7, 8], beta=4, depth=2),
    "mlp": MlpField(beta=4, head_parameters=True),
}
QUICK = FastTrainer(steps=150, learning_rate=1e-2, frames_per_batch=6, particles_per_batch=40)
PARTICLES, FRAMES, LATENT = 150, 13, 2


def motion(X, t, speed):
    """Positions, stress [Pa] and C [1/s] of a wave through the unit cube; not of low rank."""
    phase = 2 * np.pi * (X[:, :1] - speed * t)
    x = X + 0.1 * t * np.hstack([np.sin(phase), np.cos(phase + X[:, 1:2]), X[:, 2:] * phase / 6])
    tau = 1e4 * speed * np.hstack([np.tanh(np.sin(phase + k) + t) for k in range(6)])
    C = np.hstack([speed * np.cos(phase + k) for k in range(9)])
    return x, tau, C


@pytest.fixture(scope="session")
def snapshots(tmp_path_factory):
    """Two parameter values of 13 frames of 150 particles."""
    folder = tmp_path_factory.mktemp("trajectories")
    X = np.random.default_rng(0).random((PARTICLES, 3))
    paths = []
    for speed in (0.8, 1.1):
        paths.append(folder / f"{speed}.h5")
        ones = np.ones(PARTICLES)
        about = {"mass": ones, "volume0": ones, "parameters": {"speed": speed}, "dt": 1e-3, "dx": 0.1}
        with TrajectoryWriter(paths[-1], X=X, frames=FRAMES, dtype="float32", **about) as writer:
            for t in np.linspace(0, 1, FRAMES):
                x, tau, C = motion(X, t, speed)
                writer.append(t, x, np.zeros_like(x), C, tau)
    return Snapshots(paths)


@pytest.fixture(scope="session")
def fields():
    """A small field of each kind, by name."""
    return FIELDS


@pytest.fixture(scope="session")
def trained_of(snapshots, tmp_path_factory):
    """(name of a field) → its manifold and metrics."""

    @cache
    def of(name):
        return train(snapshots, FIELDS[name], QUICK, LATENT, 0, tmp_path_factory.mktemp(name), "cpu")

    return of


@pytest.fixture(scope="session", params=FIELDS)
def trained(request, trained_of):
    """(manifold, metrics) of each field."""
    return trained_of(request.param)


@pytest.fixture(scope="session")
def manifold(trained):
    return trained[0]
