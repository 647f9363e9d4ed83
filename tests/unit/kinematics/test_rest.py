"""Stress of a body at rest, where training runs begin free of it."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from nsf.data import Snapshots, TrajectoryWriter
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.fields.modal import ModalField
from nsf.kinematics.fields.networks import Committee, FullyConnected, zero_at_rest
from nsf.kinematics.training.phases import seeded

PARTICLES, FRAMES, LATENT, MEMBERS = 80, 11, 2, 3
ROUND_OFF = 1e-13


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


@pytest.fixture(params=[(1, 2), (1, 4), (MEMBERS, 2), (MEMBERS, 3)], ids=str)
def raw(request):
    """A network of members side by side in raw units, with as many hidden layers, and its members."""
    members, depth = request.param
    widths = (LATENT + 1, *[7] * depth, 4)
    net = Committee(members, widths, "silu") if members > 1 else FullyConnected(widths, "silu")
    net.initialise(torch.Generator().manual_seed(0))
    for name, value in net.named_parameters():
        if "bias" in name:  # zero biases would hide a wrong one
            torch.nn.init.normal_(value, generator=torch.Generator().manual_seed(1))
    inputs = torch.tensor([[0.5, 0.2, 3.0], [2.0, 0.3, 4.0]]).double()
    outputs = torch.tensor([[0.0], [5.0]]).double().expand(2, 4)
    return net.in_raw_units(*inputs, *outputs, torch.float64, "cpu"), members


REST, REACH = torch.tensor([0.7, -1.2]).double(), torch.tensor([0.01, 0.03]).double()


def test_a_network_is_zero_at_rest_and_as_before_elsewhere(raw):
    network, members = raw
    freed = zero_at_rest(network, members, REST, REACH)
    draw = torch.Generator().manual_seed(2)
    parameters, along = (torch.randn(6, n, generator=draw).double() for n in (1, LATENT))
    along = F.pad(F.normalize(along, dim=1) * REACH, (0, 1))
    still = torch.cat([REST.expand(6, -1), parameters], 1)
    assert freed(still).abs().max() < ROUND_OFF
    assert (network(still).abs() > 0.1).any(1).all()
    taken = [(freed(at) - network(at)).norm() for at in (still + s * along for s in (0, 0.5, 1, 2))]
    assert taken == sorted(taken, reverse=True)
    away = still + 20 * along
    torch.testing.assert_close(freed(away), network(away), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("members", [1, MEMBERS])
def test_a_body_at_rest_is_free_of_stress_at_every_parameter(loaded, members):
    kind = BasisField(modes=[4, 6, 1], beta=4, depth=2, members=members)
    manifold = kind.build(loaded, kind.prepare(loaded, LATENT), LATENT, seeded("cpu", 0))
    at = manifold.restrict()
    first = loaded.gather("x", torch.tensor([0]), slice(None)).double()
    encoded = manifold.encode(first)[0]
    for stiffness in (1.0, 1.7, 40.0):
        parameters = torch.tensor([stiffness]).double()
        moved = at.stress(manifold.rest_latent + 0.3, parameters).abs().max()
        assert at.stress(manifold.rest_latent, parameters).abs().max() < ROUND_OFF * moved
        # Stored frames are float32.
        assert at.stress(encoded, parameters).abs().max() < 1e-3 * moved
    parts = manifold.factors("stress", torch.arange(3), torch.float64, "cpu")
    assert parts.members == 2 * members
    assert [len(b) for _, b in parts.layers[:-1]] == [2 * members * (24 + 2 * LATENT), 2 * members * (24 + 1)]


@pytest.mark.parametrize("noise", [{}, {"noise": 0.0, "noise_floor": 0.0}], ids=["noise", "none"])
def test_a_fiftieth_of_the_noise_away_stress_is_the_fields(loaded, noise):
    kind = BasisField(modes=[4, 6, 1], beta=4, depth=2, **noise)
    manifold = kind.build(loaded, kind.prepare(loaded, LATENT), LATENT, seeded("cpu", 0))
    deviation = (max(kind.noise, 0.01) ** 2 + manifold.floor.square()).sqrt()
    near, parameters = manifold.rest_latent + torch.diag(deviation) / 50, torch.ones(LATENT, 1).double()
    found = manifold.restrict().stress(near, parameters)
    manifold.hyperparameters["free_at_rest"] = False
    torch.testing.assert_close(found, manifold.restrict().stress(near, parameters), rtol=1e-6, atol=1e-9)


def test_one_hidden_layer_knows_no_rest(loaded):
    kind = BasisField(modes=[4, 6, 1], beta=4, depth=1)
    manifold = kind.build(loaded, kind.prepare(loaded, LATENT), LATENT, seeded("cpu", 0))
    assert not manifold.hyperparameters["free_at_rest"]


def test_coefficients_that_never_change_have_their_size_as_scale():
    field = ModalField(5, 6, 1, 0, LATENT, 4, 2, 1)
    field.calibrate(torch.full((7, 1), -3.0).double())
    assert (field.scale, field.network.output_bias) == (3.0, -1.0)


def test_runs_that_begin_under_stress_keep_it(snapshots):
    """Those of the fixture do: there nothing is known of the stress at rest."""
    kind = BasisField(modes=[9, 7, 8], beta=4, depth=2)
    manifold = kind.build(snapshots, kind.prepare(snapshots, LATENT), LATENT, seeded("cpu", 0))
    assert not manifold.hyperparameters["free_at_rest"]
    stress = manifold.restrict().stress(manifold.rest_latent, torch.tensor([0.9]).double())
    moved = manifold.restrict().stress(manifold.rest_latent + 0.3, torch.tensor([0.9]).double())
    assert stress.abs().max() > 1e-3 * moved.abs().max()
