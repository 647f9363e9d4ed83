"""A stride by construction, and frames between strides."""

import pytest
import torch
from forms import form, inputs

from nsf.recurrence import Form, Sizes
from nsf.recurrence.engine import between


@pytest.mark.parametrize("what", ["change", "gravity", "stress"])
def test_a_change_is_affine(what):
    made = form()
    x, d, mu, g, solids = inputs(made)
    c, g = made.collider_state(solids[0]), g[0]
    state = made.begin(x, d)
    other = torch.randn(state.stress.shape, generator=torch.Generator().manual_seed(2)).double()

    def step(share):
        s = state._replace(stress=state.stress + share * other * (what == "stress"))
        s = s._replace(change=s.change + share * 0.01 * other[..., :1] * (what == "change"))
        return made.step(s, mu, g + share * other[0] * (what == "gravity"), c).change

    ends = [step(share) for share in (0.0, 1.0, 0.3)]
    assert (ends[0] - ends[1]).abs().max() > 1e-4
    torch.testing.assert_close(0.7 * ends[0] + 0.3 * ends[1], ends[2], rtol=1e-11, atol=1e-14)


def test_an_untaught_recurrence_keeps_change_and_stress():
    made = Form(Sizes(4, 3, 1, 0, 0, True, 8, 2), 0.01).double()
    x, d, s = torch.randn(5, 4).double(), torch.randn(5, 4).double(), torch.randn(5, 3).double()
    after = made.step(made.begin(x, d, s), torch.ones(5, 1).double(), torch.ones(3).double(), x[:, :0])
    torch.testing.assert_close(after.change, d.expand(2, 5, 4), rtol=0, atol=0)
    torch.testing.assert_close(after.stress, s.expand(2, 5, 3), rtol=0, atol=0)


def test_frames_between_strides_lie_on_a_parabola():
    t = torch.arange(-4, 13).double() / 4
    way = torch.stack([1.0 + 2.0 * t - 0.7 * t**2, t], -1)
    nodes, first = way[4::4], way[4] - way[0]
    torch.testing.assert_close(between(nodes, first, 4), way[4:], rtol=0, atol=1e-12)
    assert between(nodes, first, 1) is nodes
