"""Fits of a recurrence to runs of a law that it can hold exactly."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from nsf.errors import ConfigError, InstabilityError
from nsf.recurrence import Fitting, Runs, Yardstick, fit, standardised
from nsf.recurrence.descent import Descent, ends, windows
from nsf.recurrence.fitting import check_stride
from nsf.recurrence.form import State

SHORT = Fitting(width=16, descents=12, batch=32)


def damped(count=6, steps=40, stride=1):
    """Oscillators under a gravity of their own, whose stress follows their speed with a delay."""
    generator = torch.Generator().manual_seed(0)
    gravity = 0.5 * torch.randn(1, count, 3, generator=generator).double().expand(steps, -1, -1)
    x, d, s = (
        [torch.zeros(count, 2).double()],
        torch.zeros(count, 2).double(),
        [torch.zeros(count, 1).double()],
    )
    for n in range(steps):
        d = d - 0.05 * x[-1] - 0.02 * d - 0.01 * s[-1] + 0.01 * gravity[n, :, :2]
        x.append(x[-1] + d)
        s.append(s[-1] + d[:, :1] - 0.1 * s[-1])
    given = (
        torch.zeros(count, 2).double(),
        torch.ones(count, 1).double(),
        gravity,
        torch.zeros(steps, count, 0),
    )
    return Runs.in_strides(stride, torch.stack(x), torch.stack(s), *given)


def yardstick(runs):
    """Runs whose latents are the places of two particles along one axis."""

    def positions(xhat):
        return torch.stack([xhat, 0.0 * xhat, 0.0 * xhat], -1)

    return Yardstick(runs, positions, positions(runs.xhat))


def fitted(fitting=SHORT, stride=1, seed=0):
    runs = damped(stride=stride)
    form = standardised(runs, fitting, 0.01, stride, True, seed)
    errors = fit(form, runs, yardstick(runs), torch.ones(2), fitting, seed)
    return form, errors


@pytest.mark.parametrize(("stride", "descents"), [pytest.param(1, 150, marks=pytest.mark.slow), (4, 100)])
def test_it_follows_the_runs_that_taught_it(stride, descents):
    form, errors = fitted(replace(SHORT, descents=descents), stride)
    assert min(errors) < 0.75  # a run that does not move is off by 1
    assert float(yardstick(damped(stride=stride)).errors(form).mean()) == min(errors)


def test_the_same_seed_gives_the_same_bits():
    one, other, third = (fitted(seed=seed)[0].state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert any(not torch.equal(one[name], third[name]) for name in one)


def test_members_begin_apart_and_each_is_that_of_its_seed():
    runs = damped()
    both = standardised(runs, replace(SHORT, members=2), 0.01, 1, True, 3)
    alone = standardised(runs, SHORT, 0.01, 1, True, 4)
    weights = both.networks["motion"].weights[0]
    assert not torch.equal(weights[0], weights[1])
    assert torch.equal(weights[1], alone.networks["motion"].weights[0][0])


def test_a_member_that_is_lost_moves_no_other(monkeypatch):
    monkeypatch.setattr("nsf.recurrence.descent._check_members", lambda form, runs: None)
    runs = damped()
    form = standardised(runs, replace(SHORT, members=2), 0.01, 1, True, 0)
    form.networks["motion"].biases[2].data[1] = 1e30
    fit(
        form,
        runs,
        replace(yardstick(runs), positions=lambda x: torch.zeros(len(x), 2, 3)),
        torch.ones(2),
        SHORT,
        0,
    )
    assert bool(torch.isfinite(form.networks["motion"].weights[2][0]).all())


def test_runs_that_are_all_lost_are_an_error():
    runs = damped()
    form = standardised(runs, SHORT, 0.01, 1, True, 0)
    lost = replace(yardstick(runs), positions=lambda xhat: torch.full((len(xhat), 2, 3), torch.nan))
    with pytest.raises(
        InstabilityError, match=r"loses a validation run; raise model\.descents or model\.runs"
    ):
        fit(form, runs, lost, torch.ones(2), SHORT, 0)


def test_members_that_disagree_from_the_first_step_are_an_error(monkeypatch):
    runs = damped()
    form = standardised(runs, replace(SHORT, members=2), 0.01, 1, True, 0)
    form.networks["motion"].biases[2].data[1] = 1e3
    monkeypatch.setattr("nsf.recurrence.descent.windows", lambda strides, descents: [(1, 1)])
    near = replace(yardstick(runs), positions=lambda xhat: torch.zeros(len(xhat), 2, 3).double())
    with pytest.raises(InstabilityError, match=r"the 2 members disagree from the first step.* model\.runs"):
        fit(form, runs, near, torch.ones(2), SHORT, 0)


def test_windows_grow_to_half_a_run():
    assert windows(400, replace(SHORT, descents=1000)) == [(16, 350), (64, 450), (200, 200)]
    assert windows(50, replace(SHORT, descents=100)) == [(16, 35), (48, 45), (48, 20)]
    assert [length for length, _ in windows(2, replace(SHORT, descents=3))] == [1, 1, 1]
    assert windows(400, replace(SHORT, window=30))[1][0] == 30


def test_a_captured_descent_is_that_of_the_host(device):
    if device == "cpu":
        pytest.skip("nothing is captured on a CPU")
    runs, states = damped(), []
    for where in ("cpu", device):
        form = standardised(runs, SHORT, 0.01, 1, True, 0)
        fit(form, runs, yardstick(runs), torch.ones(2), replace(SHORT, descents=6), 0, where)
        states.append(form.state_dict())
    for name, values in states[0].items():
        np.testing.assert_allclose(states[1][name], values, atol=1e-4, err_msg=name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width=0 must be at least 1"),
        ({"members": 0}, "members=0 must be at least 1"),
        ({"noise": -1.0}, "noise=-1.0 must be finite"),
    ],
)
def test_bad_values(options, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        Fitting(**options)


def test_a_stride_divides_the_steps():
    check_stride(5, 250)
    with pytest.raises(ConfigError, match=r"model\.stride=3 does not divide the 250 steps .* one of 1, 2, 5"):
        check_stride(3, 250)


def test_the_loss_of_a_window_is_that_of_the_form_in_units():
    """A window of three strides, written with `Form.step`."""
    runs, fitting, window = damped(), replace(SHORT, members=2, noise=0.0, batch=5), 3
    form = standardised(runs, fitting, 0.01, 1, True, 0)
    for weights in form.parameters():
        weights.data += 0.1 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(1)).double()
    descent = Descent(form, runs, torch.tensor([1.0, 2.0]), fitting, 0, "cpu")
    k, n, *noise = descent._drawn(window)
    c, moves = form.collider_state(runs.features), (torch.tensor([1.0, 2.0]) * form.x_scale).square()
    at = [State(*(v[n + j, k] for v in (runs.xhat, runs.changes, runs.stress))) for j in range(window + 1)]
    state, scales, expected = at[0], (form.x_scale, form.d_scale, form.s_scale), torch.zeros(2).double()
    for j in range(window):
        after = form.step(state, runs.parameters[k], runs.gravity[n + j, k], c[n + j, k])
        if j == 0:
            single = ((after.change - at[1].change) / form.a_scale).square().mean((1, 2))
            single += ((after.stress - at[1].stress) / form.t_scale).square().mean((1, 2))
        pairs = zip(after, at[j + 1], scales, strict=True)
        x, d, s = (8 * torch.tanh((a - b) / scale / 8) for a, b, scale in pairs)
        state = State(*(b + off * scale for b, off, scale in zip(at[j + 1], (x, d, s), scales, strict=True)))
        error = (moves / moves.sum() * x.square()).sum(-1)
        error = error + 0.02 * x.square().mean(-1) + 0.1 * s.square().mean(-1)
        expected += torch.log1p(1000 * error / (1 + j)).mean(1) / window
    torch.testing.assert_close(
        descent._loss(window, k, n, *noise).double(), (expected + 0.3 * single).sum(), rtol=1e-4, atol=0.0
    )


@pytest.mark.parametrize("window", [1, 3, 10, 39])
def test_every_state_of_a_run_counts_alike(window):
    states = 41
    reached = np.zeros(states)
    for first in range(states - window):
        reached[first + 1 : first + window + 1] += 1.0
    counts = reached * ends(states, window).numpy()
    np.testing.assert_allclose(counts[1:], window * (states - window) / (states - 1), rtol=1e-6)


def test_the_end_of_runs_is_followed_as_well_as_their_midst():
    """Of a family, whose last states are in few windows; the members of one seed begin alike."""
    runs, last = damped(), []
    for fitting in (replace(SHORT, descents=60, ends=ends_count) for ends_count in (False, True)):
        form = standardised(runs, fitting, 0.01, 1, False, 0)
        fit(form, runs, yardstick(runs), torch.ones(2), fitting, 0)
        start = form.begin(runs.xhat[0], runs.first, runs.stress[0])
        with torch.no_grad():
            xhat, _ = form.run(start, runs.parameters, runs.gravity, form.collider_state(runs.features))
        last.append(float((xhat[-1].mean(0) - runs.xhat[-1]).square().mean()))
    assert last[1] < last[0]


def test_a_parameter_that_never_varies_has_no_scale():
    runs = replace(damped(count=7), parameters=torch.full((7, 1), 0.1, dtype=torch.float64))
    assert float(standardised(runs, SHORT, 0.01, 1, True, 0).mu_scale) == 1.0
