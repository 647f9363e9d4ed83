"""`StepOperators.step` defines the recurrence; the loop, the page's script and gradients follow it."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from test_operators import by_definition, operators

from nsf.dynamics.latent import LatentRecord
from nsf.engines.operators.recurrence import Recurrence
from nsf.inverse.recurrence import differentiable_run
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device

RUNS, STEPS = 3, 12
PAGE = Path(__file__).parents[1] / "web" / "recurrence.mjs"


def inputs(model, runs=RUNS, steps=STEPS):
    """x̂_0 and d [B, r], μ [B, n], gravity [N, B, 3] and states of the colliders [N, B, f]."""
    generator, sizes = torch.Generator().manual_seed(1), model.sizes
    shapes = (runs, sizes.latents), (runs, sizes.latents), (runs, sizes.parameters)
    shapes += (steps, runs, 3), (steps, runs, sizes.features)
    x, d, mu, g, solids = (torch.randn(shape, generator=generator).double() for shape in shapes)
    return x, 0.01 * d, mu, g, solids


def by_loop(model, x, d, mu, gravity, solids):
    record = LatentRecord(x, len(gravity), 1)
    acting = gravity.transpose(0, 1), solids.transpose(0, 1)
    loop = Recurrence(model, mu, *acting, record, precision_of("fp64"), warp_device("cpu"))
    loop.begin(x, d)
    loop.advance(len(gravity))
    return record.xhat.transpose(0, 1)


def by_page(model, x, d, mu, gravity, solids):
    if (node := shutil.which("node")) is None:
        pytest.skip("node is not installed; apt install nodejs")
    arrays = {}
    for k, (weight, bias) in enumerate(model.raw_layers()):
        arrays |= {f"operators.weight{k}": weight.flatten().tolist(), f"operators.bias{k}": bias.tolist()}
    header = {"latents": model.sizes.latents, "gravity": model.sizes.gravity, "layers": 3}
    names = "xhat", "change", "parameters", "gravity", "states"
    values = (v.tolist() for v in (x, d, mu, gravity.transpose(0, 1), solids.transpose(0, 1)))
    runs = [dict(zip(names, run, strict=True)) for run in zip(*values, strict=True)]
    content = json.dumps({"header": {"operators": header}, "arrays": arrays, "runs": runs})
    done = subprocess.run([node, PAGE], input=content, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    taken = torch.tensor(json.loads(done.stdout), dtype=torch.float64).transpose(0, 1)
    return torch.cat([x[None], taken])


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("states", [0, 2])
@pytest.mark.parametrize("text", [by_loop, by_page, differentiable_run])
def test_steps_are_those_of_the_definition(text, states, gravity):
    model = operators(states, gravity).requires_grad_(False)
    values = inputs(model)
    expected = by_definition(model, *values[:4], model.collider_state(values[4]))
    assert (expected[-1] - expected[0]).abs().max() > 0.05
    found = text(model, *values)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * max(1.0, float(expected.abs().max())))


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("states", [0, 2])
def test_gradients_are_those_of_differences(states, gravity, monkeypatch):
    """In x̂_0, d_0, μ, gravity and solids, forward and backward, of several parts of a run."""
    monkeypatch.setattr("nsf.inverse.recurrence._ROWS", 6)
    model = operators(states, gravity).requires_grad_(False)
    values = [v.requires_grad_() for v in inputs(model, runs=2, steps=7)]

    def run(*values):
        return differentiable_run(model, *values)

    how = {"check_forward_ad": True, "fast_mode": True, "eps": 1e-5, "rtol": 1e-5, "atol": 1e-7}
    assert torch.autograd.gradcheck(run, values, **how)
    shared = [*values[:3], *(v.detach()[:, :1].clone().requires_grad_() for v in values[3:])]
    assert torch.autograd.gradcheck(run, shared, **how)


def test_a_linear_recurrence_has_the_gradient_of_its_powers():
    """With constant B and no force d_n = (I + B)ⁿ d_0, so that ∂x̂_N/∂d_0 = Σ_n (I + B)ⁿ."""
    model = operators(0, False).requires_grad_(False)
    model.net[4].weight.zero_()
    B = model.scaled_layers()[2][1][:16].view(4, 4)
    x, d, mu, g, solids = inputs(model, runs=1)

    def end(change):
        return differentiable_run(model, x, change, mu, g, solids)[-1, 0]

    slope = torch.autograd.functional.jacobian(end, d)[:, 0]
    power, expected = torch.eye(4).double(), torch.zeros(4, 4).double()
    for _ in range(STEPS):
        power = power @ (torch.eye(4).double() + B)
        expected += power
    torch.testing.assert_close(slope, expected, rtol=1e-10, atol=1e-12)
