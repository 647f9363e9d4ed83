"""Standardising."""

import pytest
import torch

from nsf.data import Snapshots, Standardizer, snapshots
from nsf.errors import ShapeError


def test_of_snapshots_is_that_of_all_values_at_once(write, monkeypatch):
    snaps = Snapshots([write("a.h5")[0], write("b.h5", seed=50)[0]], resident=False)
    values = snaps.slab("tau", slice(None)).double().reshape(-1, 6)
    monkeypatch.setattr(snapshots, "SLAB_ENTRIES", 6 * snaps.M * 2)  # two particles a block
    scale = Standardizer.of(snaps, "tau")
    assert torch.allclose(scale.mean.double(), values.mean(0), rtol=1e-6)
    assert torch.allclose(scale.std.double(), values.std(0, unbiased=False), rtol=1e-6)
    standard = scale(snaps.slab("tau", slice(None)))
    assert standard.dtype == torch.float32
    assert torch.allclose(standard.reshape(-1, 6).mean(0), torch.zeros(6), atol=1e-5)
    assert torch.allclose(standard.reshape(-1, 6).std(0, unbiased=False), torch.ones(6), atol=1e-5)


def test_sums_are_float64_and_a_large_mean_does_not_cancel():
    noise = torch.rand(2000, 100, 1, generator=torch.Generator().manual_seed(0))
    scale = Standardizer.fit(noise)
    assert scale.mean.item() == pytest.approx(noise.double().mean().item(), rel=1e-7)
    assert scale.std.item() == pytest.approx(noise.double().std(unbiased=False).item(), rel=1e-7)
    far = 1e8 + 1e4 * noise.double()
    assert Standardizer.fit(far).std.item() == pytest.approx(far.std(unbiased=False).item(), rel=1e-7)


def test_round_off_of_a_constant_is_no_spread():
    values = 1e8 + torch.rand(1000, 1, dtype=torch.float64)
    assert Standardizer.fit([values]).std.item() == 1.0


def test_a_constant_component_is_only_centred():
    values = torch.tensor([[1.0, 0.0, 7e6], [3.0, 0.0, 7e6]])
    scale = Standardizer.fit([values])
    assert scale.mean.tolist() == [2, 0, 7e6]
    assert scale.std.tolist() == [1, 1, 1]
    assert torch.equal(scale(values), torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]))


def test_a_small_component_beside_a_large_one_is_scaled_by_itself():
    values = torch.tensor([[1e-9, 1e9], [3e-9, 3e9]])
    assert torch.allclose(Standardizer.fit([values])(values), torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))


@pytest.mark.parametrize(
    ("mean", "std"), [([0.0], [0.0]), ([0.0], [-1.0]), ([float("nan")], [1.0]), ([0.0, 0.0], [1.0])]
)
def test_bad_scales(mean, std):
    with pytest.raises(ShapeError):
        Standardizer(torch.tensor(mean), torch.tensor(std))


def test_a_scene_without_parameters():
    assert Standardizer.fit([torch.zeros(5, 0)])(torch.zeros(2, 0)).shape == (2, 0)


def test_no_value():
    with pytest.raises(ShapeError, match="at least one"):
        Standardizer.fit([torch.zeros(0, 3)])
