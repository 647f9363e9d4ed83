"""Networks that are averaged: training side by side, and the mean as one network."""

import copy

import pytest
import torch

from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.fields.networks import Committee, FullyConnected, TensorCores
from nsf.kinematics.training.schedules import FastTrainer
from nsf.kinematics.training.train import train

MEMBERS, WIDTHS = 3, (4, 7, 5, 2)


@pytest.fixture
def committee():
    network = Committee(MEMBERS, WIDTHS, "silu")
    network.initialise(torch.Generator().manual_seed(0))
    for bias in network.biases:  # zero biases would hide a wrong one
        torch.nn.init.normal_(bias, generator=torch.Generator().manual_seed(1))
    return network


def alone(committee, member):
    """A member as a network of its own."""
    network = FullyConnected(committee.widths, committee.activation)
    with torch.no_grad():
        for layer, weight, bias in zip(network.layers, committee.weights, committee.biases, strict=True):
            layer.weight.copy_(weight[member])
            layer.bias.copy_(bias[member, 0])
    return network


def test_members_are_networks_apart(committee):
    inputs = torch.randn(MEMBERS, 6, WIDTHS[0], generator=torch.Generator().manual_seed(2))
    outputs = committee(inputs)
    for k in range(MEMBERS):
        torch.testing.assert_close(outputs[k], alone(committee, k)(inputs[k]))
    assert not torch.equal(committee.weights[0][0], committee.weights[0][1])


def test_mean_and_its_tangents(committee):
    inputs = torch.randn(6, WIDTHS[0], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    mean, members = committee.mean(), [alone(committee, k).double() for k in range(MEMBERS)]
    outputs, tangents = mean.forward_and_tangents(inputs, torch.eye(WIDTHS[0], dtype=torch.float64))
    torch.testing.assert_close(outputs, sum(m(inputs) for m in members) / MEMBERS)
    jacobian = torch.func.vmap(torch.func.jacrev(lambda x: sum(m(x) for m in members) / MEMBERS))(inputs)
    torch.testing.assert_close(tangents, jacobian.mT)


def test_raw_units(committee):
    one = torch.ones
    shift, scale = 2.0 * one(WIDTHS[-1]), 3.0 * one(WIDTHS[-1])
    mean, std = 0.5 * one(WIDTHS[0]), 4.0 * one(WIDTHS[0])
    raw = committee.in_raw_units(mean, std, shift, scale, torch.float64, "cpu")
    inputs = torch.randn(6, WIDTHS[0], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(raw(inputs), 2.0 + 3.0 * committee.mean()((inputs - 0.5) / 4.0))


def test_committee_of_one_network_repeated_is_that_network(committee):
    with torch.no_grad():
        for values in (*committee.weights, *committee.biases):
            values.copy_(values[:1].clone().expand_as(values))
    inputs = torch.randn(6, WIDTHS[0], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(committee.mean()(inputs), alone(committee, 0).double()(inputs))


def test_trained_manifold_survives_its_file(snapshots, tmp_path):
    """Members differ after training, and what is deployed is the same from the file."""
    field = BasisField(modes=[9, 7, 8], beta=4, depth=2, members=MEMBERS)
    schedule = FastTrainer(steps=120, learning_rate=1e-2)
    manifold, metrics = train(snapshots, field, schedule, 2, 0, tmp_path / "run", "cpu")
    assert metrics["deformation_loss"] < 0.5
    weights = manifold.fields["stress"].network.weights
    assert (weights[1][0] - weights[1][1]).abs().max() > 1e-2
    manifold.save(tmp_path / "manifold.pt")
    loaded = type(manifold).load(tmp_path / "manifold.pt")
    xhat = manifold.training_latents[3]
    for one, other in zip(
        manifold.restrict().position_and_jacobian(xhat),
        copy.deepcopy(loaded).restrict().position_and_jacobian(xhat),
        strict=True,
    ):
        assert torch.equal(one, other)


@pytest.mark.parametrize(("arithmetic", "smallest", "largest"), [("tf32", 0.0, 1e-2), ("bf16", 1e-5, 3e-2)])
def test_tensor_cores_change_few_digits(arithmetic, smallest, largest):
    """A CPU has no tf32: there the first is fp32."""
    generator = torch.Generator().manual_seed(0)
    network = FullyConnected((9, 64, 64, 64, 6), "elu")
    network.initialise(generator)
    # Raw units: inputs that differ in their last digits alone.
    mean, std = torch.full((9,), 500.0), torch.full((9,), 1e-2)
    exact = network.in_raw_units(mean, std, torch.zeros(6), torch.full((6,), 1e4), torch.float64, "cpu")
    inputs = mean + std * torch.randn(40, 9, dtype=torch.float64, generator=generator)
    expected = exact(inputs)
    before = torch.backends.cuda.matmul.allow_tf32
    found = TensorCores(copy.deepcopy(exact), arithmetic)(inputs)
    assert torch.backends.cuda.matmul.allow_tf32 == before
    assert (found.shape, found.dtype) == (expected.shape, torch.float64)
    assert smallest < (found - expected).norm() / expected.norm() < largest
