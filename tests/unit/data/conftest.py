"""Tiny trajectories of random but reproducible values."""

import numpy as np
import pytest

from nsf.data import TrajectoryWriter

FRAMES, PARTICLES = 4, 11


def frame_values(seed, particles=PARTICLES):
    rng = np.random.default_rng(seed)
    tau = rng.normal(size=(particles, 3, 3)) * 1e5
    return {
        "x": rng.random((particles, 3)),
        "v": rng.normal(size=(particles, 3)),
        "C": rng.normal(size=(particles, 3, 3)),
        "tau": tau + tau.transpose(0, 2, 1),
    }


@pytest.fixture
def constants():
    rng = np.random.default_rng(7)
    return {"X": rng.random((PARTICLES, 3)), "mass": rng.random(PARTICLES), "volume0": rng.random(PARTICLES)}


@pytest.fixture
def write(tmp_path, constants):
    """Write a trajectory and return its path and the frames that went in."""

    def write(name="a.h5", frames=FRAMES, parameters=None, seed=0, dtype="float32", **changes):
        path = tmp_path / name
        parameters = {"friction_angle": 30.0} if parameters is None else parameters
        arguments = {**constants, "dt": 1e-4, "dx": 0.1, **changes}
        values = [frame_values(seed + i, len(arguments["X"])) for i in range(frames)]
        with TrajectoryWriter(path, parameters=parameters, frames=frames, dtype=dtype, **arguments) as writer:
            for i, value in enumerate(values):
                writer.append(t=0.5 * i, **value)
            writer.cost["seconds"] = 1.25
        return path, values

    return write
