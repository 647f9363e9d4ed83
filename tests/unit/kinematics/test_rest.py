"""Stress of a body at rest, where training runs begin free of it."""

import numpy as np
import pytest
import torch

from nsf.data import Snapshots, TrajectoryWriter
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.fields.joint import JointField
from nsf.kinematics.fields.networks import Committee, FromRest, FullyConnected
from nsf.kinematics.training.phases import seeded

PARTICLES, FRAMES, LATENT, MEMBERS = 80, 11, 2, 3
ROUND_OFF = 1e-13
WIDTHS = (LATENT + 1, 7, 5, 4)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A body at rest that moves and is loaded ever more, by two parameter values."""
    folder, rng = tmp_path_factory.mktemp("loaded"), np.random.default_rng(1)
    X, push, load = (rng.normal(size=(PARTICLES, n)) for n in (3, 3, 6))
    paths = []
    for stiffness in (1.0, 2.5):
        paths.append(folder / f"{stiffness}.h5")
        ones = np.ones(PARTICLES)
        about = {"mass": ones, "volume0": ones, "parameters": {"stiffness": stiffness}, "dt": 0.1, "dx": 0.1}
        with TrajectoryWriter(paths[-1], X=X, frames=FRAMES, dtype="float64", **about) as writer:
            for t in np.linspace(0, 1, FRAMES):
                x = X + 0.1 * t * push + 0.02 * np.sin(5 * t) * X
                tau = 1e5 * stiffness * (t * load + np.sin(4 * t) * np.roll(load, 1, 0))
                writer.append(t, x, 0 * x, np.zeros((PARTICLES, 9)), tau)
    return Snapshots(paths)


@pytest.fixture(params=[1, MEMBERS])
def network(request):
    several = request.param > 1
    net = FromRest(Committee(MEMBERS, WIDTHS, "silu") if several else FullyConnected(WIDTHS, "silu"), LATENT)
    net.initialise(torch.Generator().manual_seed(0))
    for name, value in net.named_parameters():
        if "bias" in name:  # zero biases would hide a wrong one
            torch.nn.init.normal_(value, generator=torch.Generator().manual_seed(1))
    net.rest.copy_(torch.tensor([0.7, -1.2]))
    return net


def test_deployed_network_is_the_difference(network):
    mean, std = torch.tensor([0.5, 0.2, 3.0]).double(), torch.tensor([2.0, 0.3, 4.0]).double()
    shift, scale = torch.full((WIDTHS[-1],), 2.0).double(), torch.full((WIDTHS[-1],), 5.0).double()
    raw = network.in_raw_units(mean, std, shift, scale, torch.float64, "cpu")
    inputs = torch.randn(6, WIDTHS[0], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rows = ((inputs - mean) / std).expand(MEMBERS, -1, -1)
    expected = network.double()(rows)
    expected = expected.mean(0) if expected.ndim == 3 and len(expected) == MEMBERS else expected
    torch.testing.assert_close(raw(inputs), shift + scale * expected.reshape(-1, 6, WIDTHS[-1])[0])
    inputs[:, :LATENT] = network.rest * std[:LATENT] + mean[:LATENT]
    assert (raw(inputs) - shift).abs().max() < ROUND_OFF


@pytest.mark.parametrize("field", [BasisField, JointField])
@pytest.mark.parametrize("members", [1, MEMBERS])
def test_a_body_at_rest_is_free_of_stress_at_every_parameter(loaded, field, members):
    kind = field(modes=[4, 6, 1], beta=4, depth=2, members=members)
    manifold = kind.build(loaded, kind.prepare(loaded, LATENT), LATENT, seeded("cpu", 0))
    at = manifold.restrict()
    first = loaded.gather("x", torch.tensor([0]), slice(None)).double()
    encoded = manifold.encode(first, torch.zeros(1, PARTICLES, 6))[0]
    for stiffness in (1.0, 1.7, 40.0):
        parameters = torch.tensor([stiffness]).double()
        moved = at.stress(manifold.rest_latent + 0.3, parameters).abs().max()
        assert at.stress(manifold.rest_latent, parameters).abs().max() < ROUND_OFF * moved
        # Stored frames are float32.
        assert at.stress(encoded, parameters).abs().max() < 1e-5 * moved
    parts = manifold.factors("stress", torch.arange(3), torch.float64, "cpu")
    assert parts.members == 2 * members
    assert [len(b) for _, b in parts.layers[:-1]] == [2 * members * 24] * 2


def test_runs_that_begin_under_stress_keep_it(snapshots):
    """Those of the fixture do: there nothing is known of the stress at rest."""
    kind = BasisField(modes=[9, 7, 8], beta=4, depth=2)
    manifold = kind.build(snapshots, kind.prepare(snapshots, LATENT), LATENT, seeded("cpu", 0))
    assert not manifold.hyperparameters["free_at_rest"]
    stress = manifold.restrict().stress(manifold.rest_latent, torch.tensor([0.9]).double())
    assert stress.abs().max() > 0
