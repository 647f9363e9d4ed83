"""Operators: what a step is by construction, how a file is read, and what the compiled loop computes."""

import math
import re

import numpy as np
import pytest
import torch
import warp as wp
from angles import angle

from nsf.data import Case
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.setup import first_change
from nsf.engines.operators import (
    Course,
    Operators,
    Sizes,
    StepOperators,
    Taught,
    Teaching,
    Yardstick,
    collider_states,
    principal,
    random_cases,
)
from nsf.engines.operators.descent import _by_accelerations
from nsf.engines.operators.recurrence import Recurrence, make_recurrence, places
from nsf.errors import ConfigError, InstabilityError, MissingRunError, SchemaError
from nsf.mpm import Cuboid, HalfSpace, Motion, precision_of
from nsf.mpm.device import warp_device
from nsf.sampling import SampleSpan

SAMPLES = (SampleSpan(0.0, np.arange(3)), SampleSpan(0.5, np.array([1, 7]), np.array([0.5, 1.5])))
TAUGHT = Taught(
    manifold="aa", scene="bb", sample="cc", dt=0.01, sources="fields", projector="gn", parameters=("angle",),
    ranges=((20.0, 40.0),), gravity=(0.0, 0.0, -10.0), reach=1.0,
)  # fmt: skip
RUNS, STEPS = 3, 12
#: r and width, so that on a GPU weights are in shared memory or not, and columns in registers or not; the
#: last ones are wider than a block.
WIDTHS = [(4, 16), (4, 160), (4, 400), (8, 128), (4, 1100)]
PRECISIONS = [("fp64", 1e-12), ("fp32", 1e-5)]


def operators(states=2, gravity=True, width=16, latents=4, memory=0):
    """Operators of random weights and scales."""
    torch.manual_seed(0)
    sizes = Sizes(latents, 1, 9 * bool(states), states, gravity, width, memory)
    model = StepOperators(sizes, 0.01).double()
    with torch.no_grad():
        model.net[4].weight.normal_(std=0.4 / width**0.5)
        model.net[4].bias.normal_(std=0.1)
    for name, values in model.named_buffers():
        scaled = 0.5 + torch.rand(values.shape).double()
        values.copy_(0.01 * scaled if name in ("d_scale", "a_scale") else scaled)
    if memory:
        model.lag_decay.copy_(torch.linspace(0.5, 0.9, memory))
    return model


def given(model, *lead):
    """x̂, d, μ, g and c."""
    torch.manual_seed(1)
    sizes = model.sizes
    shapes = [sizes.latents, sizes.latents, sizes.parameters, 3, sizes.states]
    x, d, mu, g, c = (torch.randn(*lead, size).double() for size in shapes)
    return x, 0.01 * d, mu, g, c


def by_definition(model, x, d, mu, gravity, c):
    """[N + 1, B, r] of runs by `StepOperators.step` under gravity [N, B, 3] and c [N, B, C]."""
    run, lag = [x], x.new_zeros(len(x), model.sizes.lags)
    with torch.no_grad():
        for g, state in zip(gravity, c, strict=True):
            x, d = model.step(x, d, mu, g, state, lag)
            lag = model.next_lag(lag, d)
            run.append(x)
    return torch.stack(run)


# -- a step ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", [1, 3], ids=["change", "gravity"])
def test_a_step_is_affine(what):
    model = operators()
    one, other = (list(given(model, 5)) for _ in range(2))
    other[what] = other[what] + 3.0 * torch.randn_like(other[what])
    between = list(one)
    between[what] = 0.3 * one[what] + 0.7 * other[what]
    ends = [model.step(*values)[1] for values in (one, other, between)]
    assert (ends[0] - ends[1]).abs().max() > 1e-3
    torch.testing.assert_close(0.3 * ends[0] + 0.7 * ends[1], ends[2], rtol=1e-12, atol=1e-14)


def test_untaught_operators_keep_the_change():
    model = StepOperators(Sizes(4, 1, 0, 0, True, 8), 0.01).double()
    x, d, mu, g, c = given(model, 5)
    assert torch.equal(model.step(x, d, mu, g, c)[1], d)


def test_a_body_at_rest_begins_at_rest_and_a_moving_one_moves():
    torch.manual_seed(0)
    J, d = torch.randn(20, 3, 4).double(), torch.randn(4).double()
    assert torch.equal(first_change(J, torch.zeros(20, 3).double(), 0.1), torch.zeros(4).double())
    torch.testing.assert_close(first_change(J, (J @ d) / 0.1, 0.1), d)


# -- colliders ------------------------------------------------------------------------------------------


def plates():
    """Two that mirror each other, come to a halt and go, and a floor."""

    def motion(way):
        return Motion((0.0, 0.04), ((0.0, 0.0, 0.0), (0.0, 0.0, way)))

    return [
        Cuboid((0.5, 0.5, 0.2), (0.1, 0.1, 0.1), motion=motion(0.1), until=0.06),
        Cuboid((0.5, 0.5, 0.8), (0.1, 0.1, 0.1), motion=motion(-0.1), until=0.06),
        HalfSpace((0.0, 0.0, 0.1), (0.0, 0.0, 1.0)),
    ]


def test_the_state_of_colliders():
    states = collider_states(plates(), 0.01, 8)
    assert states.shape == (8, 27)
    np.testing.assert_allclose(states[:, 2], [0.0, 0.025, 0.05, 0.075, 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(states[:, 11], -states[:, 2])
    np.testing.assert_allclose(states[:, 6], [0.025] * 4 + [0.0] * 4, atol=1e-15)
    np.testing.assert_array_equal(states[:, 8], [1] * 6 + [0] * 2)
    np.testing.assert_array_equal(states[:, 18:26], 0.0)


def test_what_moves_together_is_one_state_and_what_rests_is_none():
    mean, matrix = principal([collider_states(plates(), 0.01, 8)] * 2)
    c = (collider_states(plates(), 0.01, 8) - mean) @ matrix
    assert c.shape == (8, 3)  # way, speed and presence
    np.testing.assert_allclose(c[:, 0].std(), 1.0)
    assert len(np.unique(c.round(9), axis=0)) == 6  # the time itself is not told: what rests is alike
    _, none = principal([collider_states(plates()[2:], 0.01, 8)])
    assert none.shape == (9, 0)


def test_a_constant_speed_is_no_state():
    """The way of each step differs by round-off, which must not be taken for a state of its own."""
    motion = Motion([0.0, 0.6], [[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]])
    grip = Cuboid([0.2, 0.5, 0.5], [0.1, 0.2, 0.2], "sticky", motion=motion)
    states = collider_states([grip], 0.004, 150)
    assert 0.0 < np.ptp(states[:, 4]) < 1e-15
    mean, matrix = principal([states])
    c = (states - mean) @ matrix
    assert c.shape == (150, 1)
    np.testing.assert_allclose(np.diff(c[:, 0], axis=0), c[1, 0] - c[0, 0], rtol=1e-9)


class Stepper:
    """A teacher of two runs with d' = 0.9 d + q d², whose own runs are what they are whatever q is."""

    total_steps, dt, steps, programs, asked = 30, 0.01, 0, False, True
    parameters, gravity = torch.tensor([[0.0], [1.0]]).double(), torch.zeros(30, 2, 3).double()
    start, features = torch.tensor([[0.0, 1.0], [0.5, 0.0]]).double(), torch.zeros(30, 2, 0).double()

    def __init__(self, q):
        self.q = q

    def __len__(self):
        return 2

    def first_change(self):
        return torch.tensor([[0.1, -0.2], [0.2, 0.1]]).double()

    def run(self):
        way = torch.cumsum(0.9 ** torch.arange(31).double(), 0) - 1.0
        return self.start + way[:, None, None] * self.first_change()

    def step_from(self, step, xhat, change, gravity=None):
        return xhat + 0.9 * change + self.q * change**2


def test_how_far_a_step_is_from_affine():
    """An affine step has no second difference; that of q d² is in proportion to q."""

    def broken(q):
        teacher = Stepper(q)
        yardstick = Yardstick(teacher, lambda run: run[:, None], teacher.run()[:, :, None])
        course = Course([teacher], None, yardstick, Teaching(8, rounds=0, steps=90, descent=1, unroll=1), 0)
        course.follow()
        return course.broken_affinity()

    assert broken(0.0) < 1e-12
    assert broken(1.0) > 1e-4
    np.testing.assert_allclose(broken(2.0), 2.0 * broken(1.0), rtol=1e-9)


class Yielding:
    """Runs to learn from, of a spring that knows the way it came: d' = d − 0.04 x − 0.1 e, e a lag."""

    total_steps, dt, steps, programs, asked = 60, 0.01, 0, False, False
    parameters, gravity = torch.zeros(8, 1).double(), torch.zeros(60, 8, 3).double()
    start, features = torch.zeros(8, 1).double(), torch.zeros(60, 8, 0).double()
    decay = math.exp(-0.01 / 0.1)

    def __init__(self):
        self._first = torch.randn(8, 1, generator=torch.Generator().manual_seed(4)).double()

    def __len__(self):
        return 8

    def first_change(self):
        return 0.1 * self._first

    def run(self):
        x, d, e, found = self.start, self.first_change(), torch.zeros(8, 1).double(), [self.start]
        for _ in range(60):
            d = d - 0.04 * x - 0.1 * e
            x, e = x + d, self.decay * (e + d)
            found.append(x)
        return torch.stack(found)


def test_what_depends_on_the_way_takes_a_memory():
    def error(*memory):
        teacher = Yielding()
        yardstick = Yardstick(teacher, lambda run: run[:, None], teacher.run()[:, :, None])
        teaching = Teaching(16, rounds=0, descent=300, unroll=16, noise=0.0, memory=memory)
        course = Course([teacher], None, yardstick, teaching, 0)
        course.follow()
        return course.errors[0]

    remembered = error(0.1)
    assert remembered < 0.15
    assert remembered < 0.5 * error()


def test_a_round_that_ends_in_nan_is_not_kept(monkeypatch):
    def lost(descent):
        descent._model.net[4].weight.data.fill_(math.nan)

    monkeypatch.setattr("nsf.engines.operators.teach.Descent.run", lost)
    teacher = Stepper(0.0)
    yardstick = Yardstick(teacher, lambda run: run[:, None], teacher.run()[:, :, None])
    course = Course([teacher], None, yardstick, Teaching(8, rounds=1, steps=90, descent=1, unroll=1), 0)
    with pytest.raises(InstabilityError, match="no round of teaching gave operators whose runs stay finite"):
        course.follow()


def test_a_window_that_is_lost_moves_no_weight_to_nan():
    """Unrolled over all steps in fp32, so steep a network ends beyond all numbers."""
    teacher = Yielding()
    yardstick = Yardstick(teacher, lambda run: run[:, None], teacher.run()[:, :, None])
    teaching = Teaching(8, rounds=0, descent=4, unroll=59, memory=(0.1,))
    course = Course([teacher], None, yardstick, teaching, 0)
    generator = torch.Generator().manual_seed(0)
    course._begin(generator)
    course.model.net[4].weight.data.fill_(1e30)
    course._descend(0, generator)
    assert all(bool(torch.isfinite(weights).all()) for weights in course.model.parameters())


def test_how_far_particles_move_with_a_coordinate():
    """Of linear modes it is their RMS over particles; what moves nothing counts as 1/1000 of the most."""
    modes = torch.tensor(
        [[[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]], [[0.0, 0.0, 0.3], [0.0, 0.4, 0.0]], 2 * [[0.0] * 3]]
    )
    yardstick = Yardstick(Stepper(0.0), lambda run: torch.einsum("nr,rsi->nsi", run, modes), torch.zeros(1))
    found = yardstick.moves(torch.tensor([0.3, -1.0, 2.0]), torch.tensor([0.5, 2.0, 1.0]))
    np.testing.assert_allclose(found, [2.0, 0.125**0.5, 0.002], rtol=1e-6)


def test_windows_weigh_coordinates_whatever_their_unit():
    """In another unit of x̂ the loss is the same; an error that moves particles further counts for more."""
    model, moves = operators(), torch.tensor([1.0, 0.3, 0.1, 0.03]).double()
    off, unit = (
        1e-3 * torch.randn(5, 4, generator=torch.Generator().manual_seed(0)).double(),
        torch.tensor(7.0),
    )
    before = _by_accelerations(off, 3, model, moves)
    far = [
        _by_accelerations(0.01 * model.a_scale[i] * torch.eye(4)[i].double(), 0, model, moves) for i in (0, 3)
    ]
    model.a_scale[1] *= unit
    scaled = torch.tensor([1.0, 7.0, 1.0, 1.0]).double()
    np.testing.assert_allclose(_by_accelerations(scaled * off, 3, model, moves / scaled), before, rtol=1e-12)
    assert far[0] > 10.0 * far[1] > 0.0


@pytest.mark.gpu
def test_captured_steps_of_the_descent_are_those_of_the_host():
    """Graphs replay what eager steps do; warming up leaves neither network nor generator changed.

    Muon multiplies in bfloat16, which rounds otherwise on each device: on an H200 weights differ by 0.0011. A
    schedule of one step less makes more.
    """
    close = 2e-3

    def taught(device, descent=9):
        teacher = Stepper(0.3)
        yardstick = Yardstick(teacher, lambda run: run[:, None], teacher.run()[:, :, None])
        teaching = Teaching(width=8, rounds=0, steps=90, descent=descent, unroll=4)
        return Course([teacher, Stepper(0.3)], None, yardstick, teaching, 0, device).follow().state_dict()

    there, here, before = taught("cuda"), taught("cpu"), taught("cpu", 8)
    for name, values in here.items():
        assert values.device == there[name].device
        np.testing.assert_allclose(there[name], values, rtol=0.0, atol=close, err_msg=name)
    assert float((here["net.4.bias"] - before["net.4.bias"]).abs().max()) > 2.0 * close
    assert float(here["net.4.weight"].abs().max()) > 1e-2  # nine steps have moved it from zero


# -- the file -------------------------------------------------------------------------------------------


def test_a_file_gives_what_was_saved(tmp_path):
    model = operators()
    model.save(tmp_path / "operators.pt", TAUGHT, SAMPLES)
    found, taught, samples = StepOperators.load(tmp_path / "operators.pt")
    assert taught == TAUGHT
    for one, known in zip(samples, SAMPLES, strict=True):
        assert one.start == known.start
        np.testing.assert_array_equal(one.particles, known.particles)
        np.testing.assert_array_equal(one.weights, known.weights)
    assert (found.sizes, found.dt) == (model.sizes, model.dt)
    values = given(model, 5)
    assert torch.equal(found.step(*values)[0], model.step(*values)[0])
    assert not any(weight.requires_grad for weight in found.parameters())


class Evil:
    def __reduce__(self):
        return (print, ("code ran",))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda content: content | {"format": "other"}, "no operators of nsf"),
        (lambda content: content | {"format_version": 9}, "has format_version 9, this nsf reads 3"),
        (lambda content: content | {"samples": [{"start": 0.0}]}, "do not fit each other"),
        (
            lambda content: content | {"samples": [content["samples"][1] | {"weights": torch.zeros(2)}]},
            "2 sample particles must be as many positive numbers",
        ),
        (lambda content: content | {"taught": {}}, "do not say what they were taught on"),
        (lambda content: content | {"sizes": content["sizes"] | {"width": 10**9}}, "do not fit each other"),
        (lambda content: content | {"sizes": content["sizes"] | {"latents": "4"}}, "do not fit each other"),
        (
            lambda content: content | {"state": content["state"] | {"x_mean": torch.full((4,), torch.nan)}},
            "a value is not finite",
        ),
        (lambda content: content | {"more": Evil()}, "calls "),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused(tmp_path, capsys, spoil, message):
    path = tmp_path / "operators.pt"
    operators().save(path, TAUGHT, SAMPLES)
    torch.save(spoil(torch.load(path, weights_only=True)), path)
    with pytest.raises(SchemaError, match=re.escape(message)):
        Operators.load(path)
    assert "code ran" not in capsys.readouterr().out


def test_a_file_that_is_cut_short_or_missing(tmp_path):
    path = tmp_path / "operators.pt"
    with pytest.raises(MissingRunError, match="run `nsf teach` first"):
        Operators.load(path)
    operators().save(path, TAUGHT, SAMPLES)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SchemaError, match="truncated"):
        Operators.load(path)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"manifold": "dd"}, "another manifold: aa, not dd"),
        ({"scene": "dd"}, "another scene: bb, not dd"),
        ({"sample": "dd"}, "another sample: cc, not dd"),
        ({"dt": 0.02}, "another Δt [s]: 0.01, not 0.02"),
        ({"sources": "pic"}, "another sources: fields, not pic"),
        ({"projector": "taylor"}, "another projector: gn, not taylor"),
        ({"ranges": ((20.0, 50.0),)}, "other ranges: ((20.0, 40.0),), not ((20.0, 50.0),)"),
        ({}, ""),
    ],
)
def test_what_operators_were_taught_on_is_compared(changed, message):
    other = Taught(**(vars(TAUGHT) | changed))
    assert TAUGHT.differing(other) == message


@pytest.mark.parametrize(
    ("angle", "gravity", "off", "text"),
    [
        (30.0, [0.0, 0.0, -10.0], 0.0, ""),
        (40.0, [0.0, 0.0, -10.0], 1.0, ""),
        (45.0, [0.0, 0.0, -10.0], 1.5, "angle=45 is outside of 20 … 40"),
        (30.0, [0.0, 0.5, -10.0], 0.5, ""),
        (30.0, [2.0, 0.0, -10.0], 2.0, "gravity is 2 m/s² from that which was taught, 1 m/s² at most"),
    ],
)
def test_how_far_an_input_lies_outside(angle, gravity, off, text):
    assert TAUGHT.outside({"angle": angle}, gravity) == (pytest.approx(off), text)


# -- the compiled loop ----------------------------------------------------------------------------------


def of_each_step(g):
    """Gravity [R, 3] that varies in the course of the runs: [R, STEPS, 3]."""
    return g[:, None] * (1.0 + 0.1 * torch.sin(torch.arange(STEPS).double()))[:, None]


def recurrence(model, device, name="fp64", push=None, rows=slice(None)):
    """Runs of the loop at their start, and the same by torch; `rows` are those of as many runs."""
    precision, (x, d, mu, g, _) = precision_of(name), given(model, RUNS)
    features = torch.randn(RUNS, STEPS, model.sizes.features, generator=torch.Generator().manual_seed(2))
    features = features.double()
    c = model.collider_state(features).transpose(0, 1)
    g = of_each_step(g)
    expected = by_definition(model, x, d, mu, g.transpose(0, 1), c)[:, rows]
    x, d, mu, g, features = (values[rows] for values in (x, d, mu, g, features))
    record = LatentRecord(x.to(device, {"fp32": torch.float32, "fp64": torch.float64}[name]), STEPS, 1)
    found = Recurrence(model, mu, g, features, record, precision, warp_device(device), push)
    found.begin(x, d)
    return found, record, expected


def assert_is_torch(model, device, name, tolerance):
    found, record, expected = recurrence(model, device, name)
    found.advance(STEPS)
    assert (expected[-1] - expected[0]).abs().max() > 0.05
    tolerance *= max(1.0, float(expected.abs().max()))
    xhat, now, before = (values.cpu().double() for values in (record.xhat, record.now, record.before))
    torch.testing.assert_close(xhat.transpose(0, 1), expected, rtol=0, atol=tolerance)
    torch.testing.assert_close(now, expected[-1], rtol=0, atol=tolerance)
    torch.testing.assert_close(before, expected[-2], rtol=0, atol=tolerance)
    assert record.row.tolist() == [STEPS] * RUNS


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("states", [0, 2])
@pytest.mark.parametrize(("name", "tolerance"), PRECISIONS)
def test_the_loop_is_torch(device, name, tolerance, states, gravity):
    assert_is_torch(operators(states, gravity), device, name, tolerance)


@pytest.mark.parametrize("states", [0, 2])
@pytest.mark.parametrize(("name", "tolerance"), PRECISIONS)
def test_the_loop_with_a_memory_is_torch(device, name, tolerance, states):
    model = operators(states, memory=2)
    assert_is_torch(model, device, name, tolerance)
    remembered = recurrence(model, device)[2]
    model.lag_decay.zero_()
    assert (recurrence(model, device)[2] - remembered).abs().max() > 1e-3  # it matters


def test_a_memory_goes_on_from_a_record(device):
    model = operators(memory=2)
    whole, record, _ = recurrence(model, device)
    whole.advance(STEPS)
    again, other, _ = recurrence(model, device)
    again.advance(5)
    again.begin(other.now, other.now - other.before, model.lags_after(other.xhat[:, :6]))
    again.advance(STEPS - 5)
    torch.testing.assert_close(other.xhat, record.xhat, rtol=0, atol=1e-12)


def test_lags_of_a_steady_change():
    """e_n = d a (1 − aⁿ)/(1 − a), with a = exp(−Δt/T), which tends to T dx̂/dt for short steps."""
    model = operators(memory=2)
    change = torch.tensor([0.01, -0.02, 0.0, 0.03]).double()
    lags = model.lags_along(change.expand(50, 3, 4)).unflatten(-1, (2, 4))
    for k, a in enumerate(model.lag_decay.tolist()):
        for n in (0, 1, 7, 50):
            expected = change * a * (1 - a**n) / (1 - a)
            torch.testing.assert_close(lags[n, 1, k], expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("latents", "width"), WIDTHS)
@pytest.mark.parametrize(("name", "tolerance"), PRECISIONS)
def test_the_loop_of_a_width_is_torch(device, name, tolerance, latents, width):
    assert_is_torch(operators(width=width, latents=latents), device, name, tolerance)


def test_weights_are_wherever_they_can_be():
    """The widths tried have both in shared memory and registers, either alone, and neither."""
    sizes = [Sizes(latents, 1, 9, 2, True, width) for latents, width in WIDTHS]
    found = {places(precision_of(name), size) for name, _ in PRECISIONS for size in sizes}
    assert found == {(kept, column) for kept in (True, False) for column in (True, False)}


@pytest.mark.parametrize("name", ["fp64", "fp32"])
def test_steps_taken_at_once_and_one_by_one_are_the_same_bits(device, name):
    once, record, _ = recurrence(operators(), device, name)
    once.advance(STEPS)
    single, other, _ = recurrence(operators(), device, name)
    for n in (1, 4, STEPS - 5):
        single.advance(n)
    assert torch.equal(record.xhat, other.xhat)
    assert torch.equal(record.before, other.before)


def test_a_batch_is_its_runs(device):
    batch, record, _ = recurrence(operators(), device)
    batch.advance(STEPS)
    for run in range(RUNS):
        alone, own, _ = recurrence(operators(), device, rows=slice(run, run + 1))
        alone.advance(STEPS)
        assert torch.equal(own.xhat[0], record.xhat[run])


def test_what_is_added_to_each_change(device):
    model = operators()
    push = 1e-3 * torch.randn(RUNS, STEPS, 4, generator=torch.Generator().manual_seed(3)).double()
    found, record, _ = recurrence(model, device, push=push)
    found.advance(STEPS)
    x, d, mu, g, _ = given(model, RUNS)
    features = torch.randn(RUNS, STEPS, 9, generator=torch.Generator().manual_seed(2)).double()
    with torch.no_grad():
        for n, c in enumerate(model.collider_state(features).unbind(1)):
            d = model.step(x, d, mu, of_each_step(g)[:, n], c)[1] + push[:, n]
            x = x + d
            torch.testing.assert_close(record.xhat[:, n + 1].cpu(), x, rtol=0, atol=1e-12)


@pytest.mark.skipif(90 not in wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize(("latents", "width"), WIDTHS)
@pytest.mark.parametrize("name", ["fp32", "fp64"])
def test_the_loop_compiles_for_a_gpu(name, latents, width, tmp_path):
    for gravity, pushed, memory in ((True, False, 2), (False, True, 0)):
        sizes = Sizes(latents, 1, 9, 2, gravity, width, memory)
        kernel = make_recurrence(precision_of(name), sizes, pushed)
        wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 2


# -- teaching -------------------------------------------------------------------------------------------


def test_values_between_are_none_that_is_taken():
    box, known = np.array([[20.0, 40.0]]), [angle(20.0)]
    cases = random_cases(box, 5, 0, known)
    assert cases == sorted(cases) == random_cases(box, 5, 0, known)
    fifths = [int((case["friction_angle"] - 20.0) // 4.0) for case in cases]
    assert fifths == list(range(5))  # shaken, each in its own
    assert random_cases(box, 5, 0, [*known, cases[2]]) == cases[:2] + cases[3:]
    assert random_cases(box, 5, 1, known) != cases


def test_cases_between_fill_a_box_of_two_parameters():
    known = Case(("E", "friction"), (0.0, 0.0))
    cases = random_cases(np.array([[0.0, 1.0], [-2.0, 2.0]]), 16, 0, [known])
    numbers = np.array([case.numbers for case in cases])
    assert numbers.shape == (16, 2)
    halves = (numbers[:, 0] >= 0.5) + 2 * (numbers[:, 1] >= 0.0)
    assert np.bincount(halves, minlength=4).min() >= 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width=0 must be at least 1"),
        ({"noise": -1.0}, "noise=-1.0 must be finite"),
        ({"memory": [0.1, 0.0]}, "memory=[0.1, 0.0] must be times in seconds"),
        ({"memory": [math.nan]}, "memory=[nan] must be times in seconds"),
        ({"memory": [0.1] * 17}, "memory has 17 times; 16 at most"),
    ],
)
def test_bad_teaching(options, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        Teaching(**options)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:900] + b"\0\0\0\0" + data[904:], lambda data: data[:99]]
)
def test_a_damaged_round_of_an_interrupted_teaching_is_done_again(tmp_path, damage):
    def taught(folder, warn=print):
        teacher = Stepper(0.0)
        yardstick = Yardstick(teacher, lambda run: run[:, None], teacher.run()[:, :, None])
        teaching = Teaching(8, rounds=1, steps=90, descent=3, unroll=2)
        return Course([teacher], None, yardstick, teaching, 0, folder=folder, warn=warn).follow()

    expected, lines = taught(tmp_path).state_dict(), []
    path = tmp_path / "round_0.pt"
    path.write_bytes(damage(path.read_bytes()))
    again = taught(tmp_path, lines.append).state_dict()
    assert all(torch.equal(again[name], value) for name, value in expected.items())
    assert len(lines) == 1
    assert str(path) in lines[0]
