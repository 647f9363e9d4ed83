"""The file of a recurrence, and what taught it."""

import re

import numpy as np
import pytest
import torch
from forms import form, inputs

from nsf.errors import MissingRunError, SchemaError
from nsf.recurrence import RecurrenceEngine, Taught
from nsf.recurrence.stream import Encoded
from nsf.recurrence.taught import load, save
from nsf.storage import intact

TAUGHT = Taught(
    manifold="aa", scene="bb", dt=0.01, parameters=("angle",), ranges=((20.0, 40.0),),
    gravity=(0.0, 0.0, -10.0), reach=1.0,
)  # fmt: skip


def test_a_file_gives_what_was_saved(tmp_path):
    made = form(stride=3)
    save(made, TAUGHT, tmp_path / "recurrence.pt")
    found, taught = load(tmp_path / "recurrence.pt")
    assert (taught, found.sizes, found.dt, found.stride) == (TAUGHT, made.sizes, made.dt, 3)
    x, d, mu, g, solids = inputs(made)
    c = made.collider_state(solids[0])
    one, other = (own.step(own.begin(x, d), mu, g[0], c) for own in (made, found))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    assert not any(weight.requires_grad for weight in found.parameters())


class Evil:
    def __reduce__(self):
        return (print, ("code ran",))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda content: content | {"format": "other"}, "no recurrence of nsf"),
        (lambda content: content | {"format": "nsf-operators"}, "no recurrence of nsf"),
        (lambda content: content | {"format_version": 9}, "has format_version 9, this nsf reads 1"),
        (lambda content: content | {"taught": {}}, "does not say what taught it"),
        (lambda content: content | {"stride": 0}, "a stride of 0 steps"),
        (lambda content: content | {"sizes": content["sizes"] | {"width": 10**9}}, "do not fit each other"),
        (lambda content: content | {"sizes": content["sizes"] | {"latents": "4"}}, "do not fit each other"),
        (
            lambda content: content | {"state": content["state"] | {"x_mean": torch.full((4,), torch.nan)}},
            "a value is not finite",
        ),
        (lambda content: content | {"more": Evil()}, "and no data do"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused(tmp_path, capsys, spoil, message):
    path = tmp_path / "recurrence.pt"
    save(form(), TAUGHT, path)
    torch.save(spoil(torch.load(path, weights_only=True)), path)
    with pytest.raises(SchemaError, match=re.escape(message)):
        RecurrenceEngine.load(path)
    assert "code ran" not in capsys.readouterr().out


def test_a_file_that_is_cut_short_or_missing(tmp_path):
    path = tmp_path / "recurrence.pt"
    with pytest.raises(MissingRunError, match="run `nsf teach` first"):
        load(path)
    save(form(), TAUGHT, path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SchemaError, match="truncated"):
        load(path)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"manifold": "dd"}, "another manifold: aa, not dd"),
        ({"scene": "dd"}, "another scene: bb, not dd"),
        ({"dt": 0.02}, "another Δt [s]: 0.01, not 0.02"),
        ({"ranges": ((20.0, 50.0),)}, "other ranges: ((20.0, 40.0),), not ((20.0, 50.0),)"),
        ({}, ""),
    ],
)
def test_identities_are_compared(changed, message):
    assert TAUGHT.differing(Taught(**(vars(TAUGHT) | changed))) == message


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
    assert TAUGHT.outside({"angle": angle}, np.array(gravity)) == (pytest.approx(off), text)


def test_an_encoded_run_is_read_again_until_it_is_damaged(tmp_path):
    path, lines = tmp_path / "encoded_0.npz", []
    run = Encoded(np.ones((3, 2), np.float32), np.zeros((3, 0), np.float32), 1.5)
    run.save(path)
    assert intact(path, lines.append)
    np.testing.assert_array_equal(Encoded.open(path).xhat, run.xhat)
    data = bytearray(path.read_bytes())
    data[60] ^= 1
    path.write_bytes(data)
    assert not intact(path, lines.append)
    assert "encoded_0.npz" in lines[0]
    assert not path.exists()
