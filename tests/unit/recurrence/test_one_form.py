"""`Form.step` defines the recurrence; the compiled loop, the page's script and gradients follow it."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
import warp as wp
from forms import form, inputs

from nsf.dynamics.latent import LatentRecord
from nsf.inverse.recurrence import differentiable_run
from nsf.live.publish import recurrence_arrays, recurrence_header
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device
from nsf.recurrence import Loop
from nsf.recurrence.descent import of_strides
from nsf.recurrence.engine import between
from nsf.recurrence.loop import make_recurrence

PAGE = Path(__file__).parents[1] / "web" / "recurrence.mjs"
#: Coordinates of stress, states of solids, gravity, members and stride.
KINDS = [(0, 0, False, 1, 1), (0, 2, True, 1, 1), (3, 0, True, 2, 1), (3, 2, True, 2, 3), (5, 2, False, 1, 2)]
kinds = pytest.mark.parametrize("kind", KINDS, ids=str)


def by_definition(made, x, d, mu, gravity, solids):
    """x̂ [N + 1, M, B, r] and ŝ of runs."""
    gravity, solids = (of_strides(values, made.stride) for values in (gravity, solids))
    return made.run(made.begin(x, d), mu, gravity, made.collider_state(solids))


def looped(made, x, d, mu, gravity, solids, precision="fp64", device="cpu", parts=(12,)):
    acting = (of_strides(values, made.stride).transpose(0, 1) for values in (gravity, solids))
    loop = Loop(made, mu, *acting, precision_of(precision), warp_device(device))
    loop.begin(made.begin(x, d))
    first = 0
    for strides in parts:
        loop.advance(first, strides)
        first += strides
    return loop


def by_loop(made, *values):
    loop = looped(made, *values)
    return loop.xhat.permute(2, 0, 1, 3), loop.stress.permute(2, 0, 1, 3)


def by_page(made, xhat, d, mu, gravity, solids):
    if (node := shutil.which("node")) is None:
        pytest.skip("node is not installed; apt install nodejs")
    arrays = {name: values.flatten().tolist() for name, values in recurrence_arrays(made).items()}
    acting = (of_strides(values, made.stride).transpose(0, 1) for values in (gravity, solids))
    names = "xhat", "change", "parameters", "gravity", "states"
    values = (v.tolist() for v in (xhat, d, mu, *acting))
    runs = [dict(zip(names, run, strict=True)) for run in zip(*values, strict=True)]
    content = {"header": {"recurrence": recurrence_header(made)}, "arrays": arrays, "runs": runs}
    done = subprocess.run(
        [node, PAGE], input=json.dumps(content), capture_output=True, text=True, timeout=60, check=True
    )
    taken = json.loads(done.stdout)  # of each run, stride and member: x̂ and ŝ
    x, s = (
        torch.tensor([[[own[k] for own in n] for n in run] for run in taken], dtype=torch.float64)
        for k in (0, 1)
    )
    start = made.begin(xhat, d)
    return tuple(
        torch.cat([first[None], later.permute(1, 2, 0, 3)])
        for first, later in ((start.xhat, x), (start.stress, s))
    )


@kinds
@pytest.mark.parametrize("text", [by_loop, by_page])
def test_strides_are_those_of_the_definition(text, kind):
    stress, states, gravity, members, stride = kind
    made = form(stress, states, gravity, members, stride)
    values = inputs(made)
    for found, expected in zip(text(made, *values), by_definition(made, *values), strict=True):
        if expected.numel():
            assert (expected[-1] - expected[0]).abs().max() > 0.01
        # Weights of a page are in single precision.
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-11 if text is by_loop else 1e-6)


@kinds
def test_a_differentiable_run_is_that_of_the_definition(kind):
    stress, states, gravity, members, stride = kind
    made = form(stress, states, gravity, members, stride)
    _, d, *rest = values = inputs(made)
    nodes = by_definition(made, *values)[0].mean(1).movedim(0, -2)
    expected = between(nodes, d, stride).movedim(-2, 0)
    assert len(expected) == len(rest[1]) + 1
    torch.testing.assert_close(differentiable_run(made, *values), expected, rtol=0, atol=1e-11)


@kinds
def test_gradients_are_those_of_differences(kind, monkeypatch):
    """In x̂_0, d_0, μ, gravity and solids, forward and backward, of several parts of a run."""
    monkeypatch.setattr("nsf.inverse.recurrence._ROWS", 6)
    stress, states, gravity, members, stride = kind
    made = form(stress, states, gravity, members, stride)
    values = [v.requires_grad_() for v in inputs(made, runs=2, strides=5)]

    def run(*values):
        return differentiable_run(made, *values)

    how = {"check_forward_ad": True, "fast_mode": True, "eps": 1e-5, "rtol": 1e-5, "atol": 1e-7}
    assert torch.autograd.gradcheck(run, values, **how)
    if kind != KINDS[3]:
        return
    shared = [*values[:3], *(v.detach()[:, :1].clone().requires_grad_() for v in values[3:])]
    assert torch.autograd.gradcheck(run, shared, **how)


@kinds
def test_a_record_is_the_mean_of_members_between_strides(kind):
    made = form(*kind)
    values = inputs(made, runs=2, strides=12)
    loop, d, k = looped(made, *values), values[1], kind[4]
    record = LatentRecord(values[0], 12 * k, 1)
    record.stress = torch.zeros(2, 12 * k + 1, kind[0], dtype=torch.float64)
    write = loop.recorder(d, record)
    for begin, end in ((0, 1), (1, 5), (5, 12 * k)):
        write(begin, end)
    xhat, stress = between(loop.xhat.mean(0), d, k), loop.stress.mean(0)
    torch.testing.assert_close(record.xhat, xhat)
    torch.testing.assert_close((record.before, record.now), (xhat[:, -2], xhat[:, -1]))
    assert record.row.tolist() == [12 * k] * 2
    torch.testing.assert_close(record.stress[:, k::k], stress[:, 1:])
    if k > 1:
        line = torch.lerp(stress[:, :-1], stress[:, 1:], 1 / k)
        torch.testing.assert_close(record.stress[:, 1::k], line)


def test_a_linear_recurrence_has_the_gradient_of_its_powers():
    """With constant B and no force d_n = (I + B)ⁿ d_0, so that ∂x̂_N/∂d_0 = Σ_n (I + B)ⁿ."""
    made = form(stress=0, states=0, gravity=False, members=1)
    made.networks["motion"].weights[2].zero_()
    B = made.in_raw_units()["motion"][2][1].view(4, 5)[:, :4]
    x, d, *rest = inputs(made, runs=1)

    def end(change):
        return differentiable_run(made, x, change, *rest)[-1, 0]

    slope = torch.autograd.functional.jacobian(end, d)[:, 0]
    power, expected = torch.eye(4).double(), torch.zeros(4, 4).double()
    for _ in range(12):
        power = power @ (torch.eye(4).double() + B)
        expected += power
    torch.testing.assert_close(slope, expected, rtol=1e-10, atol=1e-12)


# -- the loop -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [16, 600])
@pytest.mark.parametrize(("precision", "tolerance"), [("fp64", 1e-11), ("fp32", 2e-5)])
def test_the_loop_on_a_device(device, precision, tolerance, width):
    made = form(width=width)
    values = inputs(made)
    loop, expected = looped(made, *values, precision, device), by_definition(made, *values)
    for found, wanted in zip((loop.xhat, loop.stress), expected, strict=True):
        torch.testing.assert_close(
            found.permute(2, 0, 1, 3).cpu().double(),
            wanted,
            rtol=0,
            atol=tolerance * float(wanted.abs().max()),
        )


def test_strides_taken_at_once_and_in_parts_are_the_same_bits(device):
    made = form()
    values = inputs(made)
    once, parts = looped(made, *values, device=device), looped(made, *values, device=device, parts=(1, 4, 7))
    assert torch.equal(once.xhat, parts.xhat)
    assert torch.equal(once.state.stress, parts.state.stress)


def test_a_batch_is_its_runs():
    made = form()
    x, d, mu, g, solids = inputs(made)
    batch = looped(made, x, d, mu, g, solids)
    for run in range(len(x)):
        rows = slice(run, run + 1)
        alone = looped(made, x[rows], d[rows], mu[rows], g[:, rows], solids[:, rows])
        assert torch.equal(alone.xhat[:, 0], batch.xhat[:, run])


@pytest.mark.skipif(90 not in wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize(("name", "stress"), [("fp32", 0), ("fp64", 32)])
def test_the_loop_compiles_for_a_gpu(name, stress, tmp_path):
    kernel = make_recurrence(precision_of(name), form(stress=stress, width=96, latents=16).sizes)
    wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert list(tmp_path.glob("*.ptx"))
