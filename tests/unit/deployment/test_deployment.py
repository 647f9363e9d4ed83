"""Rollouts: through Lightning's `Trainer.predict`, and on disk."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from angles import angle, rollout

import nsf
from nsf.deployment import Rollout, deploy
from nsf.dynamics import Taylor
from nsf.errors import MissingRunError, SchemaError


@pytest.fixture(scope="module")
def solver_at(chain, tiny_manifold):
    def build(case, device="cpu"):
        return nsf.reduced(chain.scene, tiny_manifold, case, 20, device=device)

    return build


@pytest.fixture(scope="module")
def made(solver_at, tiny_trust) -> Rollout:
    return rollout(solver_at(angle(26.0)), angle(26.0), tiny_trust)


def same_values(one, other) -> bool:
    one, other = map(np.asarray, (one, other))
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def same(one: Rollout, other: Rollout, timing: bool = True) -> bool:
    a, b = ({**vars(run), **vars(run.verdict)} for run in (one, other))
    a.pop("verdict"), b.pop("verdict")
    if not timing:
        a.pop("seconds"), b.pop("seconds")
    return a.keys() == b.keys() and all(same_values(a[k], b[k]) for k in a)


def test_a_rollout_is_the_whole_run(made, solver_at):
    solver = solver_at(angle(26.0))
    solver.step(24)
    latent = solver.trajectory()
    assert (made.case, made.sample, made.diverged, made.needed_outside) == (angle(26.0), 20, -1, 0)
    assert np.array_equal(made.xhat, latent.xhat)
    assert np.array_equal(made.t, latent.t)
    assert made.stops == latent.stops
    assert made.integration_mean == solver.integration_mean
    assert made.seconds > 0


class Thrown:
    """A projector that throws the material off the grid at its fifth step, by latents that stay finite."""

    iterations, tolerance, calls = 1, 0.0, 0

    start = Taylor.start

    def solve(self, at, target, xhat, weights=None):
        self.calls += 1
        result = Taylor().solve(at, target, xhat, weights)
        return replace(result, xhat=result.xhat + (1e4 if self.calls == 5 else 0.0))


def test_a_run_that_leaves_the_grid_has_diverged(chain, tiny_manifold, tiny_trust):
    solver = nsf.reduced(chain.scene, tiny_manifold, angle(26.0), 20, device="cpu", projector=Thrown())
    made = rollout(solver, angle(26.0), tiny_trust)
    assert np.isfinite(made.xhat).all()
    assert made.diverged == 5


def test_batches_are_cases(made, batch_at, tiny_trust):
    cases = (angle(26.0), angle(33.5))
    runs = deploy(batch_at, cases, "cpu", tiny_trust)
    assert tuple(run.case for run in runs) == cases
    assert same(runs[0], made, timing=False)
    assert not np.array_equal(runs[0].xhat, runs[1].xhat)


@pytest.fixture(scope="module")
def batch_at(chain, tiny_manifold):
    def build(cases, device="cpu"):
        taken.append(len(cases))
        return nsf.reduced_batch(chain.scene, tiny_manifold, cases, 20, device=device)

    taken = build.taken = []
    return build


def test_cases_that_take_their_steps_together(solver_at, batch_at, tiny_trust):
    """The last has no other beside it."""
    cases = list(map(angle, (26.0, 8.0, 33.5, 30.0, 22.5)))
    batch_at.taken.clear()
    made = deploy(batch_at, cases, "cpu", tiny_trust, 2)
    assert batch_at.taken == [2, 2, 1]
    assert [run.case for run in made] == cases
    assert made[0].seconds == made[1].seconds > 0
    for run in made:
        assert same(run, rollout(solver_at(run.case), run.case, tiny_trust), timing=False)


def test_round_trip(made, tmp_path):
    made.save(tmp_path / "rollout.h5")
    assert same(Rollout.open(tmp_path / "rollout.h5"), made)
    assert [p.name for p in tmp_path.iterdir()] == ["rollout.h5"]


def test_a_single_step_is_a_run(chain, tiny_manifold, tiny_trust):
    solver = nsf.reduced(
        chain.scene, tiny_manifold, {"friction_angle": 26.0}, 20, device="cpu", dt_multiplier=24
    )
    assert rollout(solver, angle(26.0), tiny_trust).xhat.shape == (2, 4)


@pytest.mark.parametrize("keep", [0, 8, 100, 0.5, -64])
def test_truncated(made, tmp_path, keep):
    path = tmp_path / "rollout.h5"
    made.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole)) if isinstance(keep, float) else keep])
    with pytest.raises(SchemaError, match=r"rollout\.h5 is .*(deploy again|delete)"):
        Rollout.open(path)


def test_missing(tmp_path):
    with pytest.raises(MissingRunError, match=r"no rollout at .*rollout\.h5; run `nsf deploy` first"):
        Rollout.open(tmp_path / "rollout.h5")


def test_foreign(tmp_path, chain):
    with pytest.raises(SchemaError, match="is not a rollout of version 5"):
        Rollout.open(chain.trajectory(26.0))
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["x"] = np.zeros(3)
    with pytest.raises(SchemaError, match="is not a rollout of version 5"):
        Rollout.open(other)
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(SchemaError, match="not HDF5"):
        Rollout.open(tmp_path / "text.h5")


def test_newer(made, tmp_path):
    path = tmp_path / "rollout.h5"
    made.save(path)
    with h5py.File(path, "a") as file:
        file.attrs["nsf_rollout"] = 6
    with pytest.raises(SchemaError, match=r"found 6"):
        Rollout.open(path)


@pytest.mark.parametrize("lost", ["xhat", "stops", "signal", "bound"])
def test_a_part_is_missing(made, tmp_path, lost):
    path = tmp_path / "rollout.h5"
    made.save(path)
    with h5py.File(path, "a") as file:
        del file[lost]
    with pytest.raises(SchemaError, match="deploy again"):
        Rollout.open(path)


def spoiled(made, path, change):
    made.save(path)
    with h5py.File(path, "a") as file:
        change(file)


def attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def replaced(name, value, **how):
    def change(file):
        del file[name]
        file.create_dataset(name, data=value, **how)

    return change


def at(name, index, value):
    return lambda file: file[name].__setitem__(index, value)


def external(file):
    del file["xhat"]
    file.create_dataset("xhat", (25, 4), "f8", external=[(__file__, 0, h5py.h5f.UNLIMITED)])


ODD = [
    (at("xhat", (7, 1), np.nan), "non-finite values of xhat"),
    (at("residuals", (3, 0), np.nan), "non-finite values of residuals"),
    (at("signal", 3, np.nan), "signal, displacement or limit that is negative or no number"),
    (at("bound", 3, -1.0), "errors that are negative"),
    (attribute("by", "magic"), "by='magic', which is no model"),
    (at("t", 3, 0.0), "t that does not increase"),
    (at("stops", 3, "bored"), "stops='bored', which is no reason to stop"),
    (at("stops", 3, "x" * 100_000), "stops with a text of 100000 bytes"),
    (attribute("seconds", [1.0, 2.0]), "attribute seconds, which is no single float"),
    (replaced("case", [np.inf]), "non-finite values of case"),
    (replaced("case", [1.0, 2.0]), r"case_names of shape \[1\], not \[2\]"),
    (attribute("sample", 20.5), "attribute sample, which is no single int"),
    (attribute("diverged", 25), "diverged=25, in 24 steps"),
    (attribute("nsf_rollout", [2, 2]), "not a rollout of version 5"),
    (lambda file: file.attrs.__delitem__("sample"), "lacks a part of a rollout"),
    (replaced("xhat", np.zeros((25, 5))), r"xhat of shape \[25, 5\], not \[25, 4\]"),
    (replaced("xhat", np.zeros((25, 4)), chunks=(1, 4)), "xhat in chunks"),
    (replaced("xhat", None, shape=(25, 4), dtype="f8"), "ends before xhat does"),
    (replaced("t", None, shape=(3 * 10**12,), dtype="f8"), "ends before t does, which is of 24,000,"),
    (replaced("stops", np.zeros(24)), "stops of <f8, not text"),
    (external, "xhat in chunks or outside the file"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "told"), ODD)
def test_what_no_run_leaves(made, tmp_path, change, told):
    spoiled(made, tmp_path / "rollout.h5", change)
    with pytest.raises(SchemaError, match=rf"rollout\.h5 .*{told}.*; deploy again"):
        Rollout.open(tmp_path / "rollout.h5", latent_dim=4)


@pytest.mark.parametrize(
    "link", [h5py.ExternalLink("other.h5", "/x"), h5py.SoftLink("/t")], ids=["other", "own"]
)
def test_links_are_not_followed(made, tmp_path, link):
    def change(file):
        del file["signal"]
        file["signal"] = link

    spoiled(made, tmp_path / "rollout.h5", change)
    with pytest.raises(SchemaError, match="a link in the place of signal"):
        Rollout.open(tmp_path / "rollout.h5")


def test_a_run_that_diverged_may_end_in_anything(made, tmp_path):
    xhat, residuals, signal = made.xhat.copy(), made.residuals.copy(), made.signal.copy()
    xhat[9:], residuals[8:], signal[9:] = np.nan, np.nan, np.inf
    lost = replace(made, xhat=xhat, residuals=residuals, signal=signal, diverged=9)
    lost.save(tmp_path / "rollout.h5")
    assert np.isnan(Rollout.open(tmp_path / "rollout.h5").xhat[9:]).all()
    replace(lost, diverged=10).save(tmp_path / "rollout.h5")
    with pytest.raises(SchemaError, match="non-finite values of xhat"):
        Rollout.open(tmp_path / "rollout.h5")
