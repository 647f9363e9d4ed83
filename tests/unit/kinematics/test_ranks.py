"""Training in two processes: what they exchange, resumption, and what is refused."""

import os
import signal
from dataclasses import replace
from functools import cache, partial

import pytest
import torch

from nsf.data import Snapshots
from nsf.errors import ConfigError, LaunchError, StorageError
from nsf.kinematics.fields.mlp import MlpManifold
from nsf.kinematics.training import blocks, descent
from nsf.kinematics.training import train as training
from nsf.kinematics.training.optimisers import muon_and_adam
from nsf.kinematics.training.phases import PHASES, seeded
from nsf.kinematics.training.rank import SEED_STREAM, Rank
from nsf.kinematics.training.ranks import train_together
from nsf.kinematics.training.schedules import FastTrainer, PaperTrainer
from nsf.kinematics.training.train import WEIGHTS_STREAM, train

LATENT, SEED = 2, 3
TOGETHER = FastTrainer(steps=[20, 12, 12], frames_per_batch=6, particles_per_batch=16, devices=2)
pytestmark = pytest.mark.skipif(os.cpu_count() == 1, reason="two processes want two cores")


@pytest.fixture(scope="module")
def files(snapshots):
    return [trajectory.path for trajectory in snapshots.trajectories]


@pytest.fixture(scope="module")
def training_in(fields):
    """(folder, until) → the training of field=mlp, for `train_together`."""

    def make(folder, until=None):
        own = {"field": fields["mlp"], "latent_dim": LATENT, "seed": SEED, "folder": folder}
        return partial(in_short_blocks, until, **own)

    return make


def in_short_blocks(until, **arguments):
    """Train in blocks of five steps, and keep each rank's outcome; the first stops before a (phase, step)."""
    blocks.SHORTEST_BLOCK = 5
    take, phase = descent.Steps._take, training._phase

    def kept(descent, folder, tracking):
        outcome = phase(descent, folder, tracking)
        torch.save(outcome, folder / f"{descent.fit.name}_of_{descent.rank.number}.pt")
        return outcome

    def stopping(self, step):
        if (self.descent.fit.name, step) == until and self.descent.rank.first:
            if until[0] == "affine":
                os.kill(os.getpid(), signal.SIGKILL)
            raise StorageError("the disk is full")
        return take(self, step)

    descent.Steps._take, training._phase = stopping, kept
    return train(**arguments)


@pytest.fixture
def turned_once(monkeypatch):
    """The manifold of several fits is turned by the first of them alone."""
    monkeypatch.setattr(MlpManifold, "turn", cache(MlpManifold.turn))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("ranks")


@pytest.fixture(scope="module")
def together(files, training_in, folder):
    """(manifold, metrics) of two ranks, in a folder."""
    return train_together(files, training_in(folder), TOGETHER, "cpu")


def alike(folder):
    """Whether both ranks ended every phase with the same weights and the same loss."""
    for phase in PHASES:
        one, other = (torch.load(folder / f"{phase}_of_{number}.pt") for number in range(2))
        same = all(torch.equal(one["state"][name], other["state"][name]) for name in one["state"])
        if not same or one["loss"] != other["loss"]:
            return False
    return True


def equal(one, other):
    return all(
        torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    )


@pytest.mark.slow
def test_the_weights_of_all_ranks_agree(together, folder):
    assert alike(folder)
    assert [together[1][f"{phase}_steps"] for phase in PHASES] == [20, 12, 12]


@pytest.mark.slow
def test_a_step_is_that_of_the_mean_gradient(together, files, fields, turned_once):
    """The same training in one process, which adds the gradients of both shards."""
    field, whole, share = fields["mlp"], Snapshots(files), TOGETHER.share()
    assert share.frames_per_batch == 3
    prepared = field.prepare(whole, LATENT)
    manifold = field.build(whole, prepared, LATENT, seeded("cpu", SEED, WEIGHTS_STREAM))
    shards = [Snapshots(files, shard=(number, 2)) for number in range(2)]
    for fits in zip(*(field.fits(manifold, shard, prepared) for shard in shards), strict=True):
        optimizers = muon_and_adam(fits[0].network, 1.0)
        steps = share.steps_of(fits[0].name, shards[0].M)
        for step in range(steps):
            fits[0].network.zero_grad()
            for number, (fit, shard) in enumerate(zip(fits, shards, strict=True)):
                seed = Rank(number, 2).seed(SEED)
                generator = seeded("cpu", seed, PHASES.index(fit.name), step)
                rows, particles = share.batch(step, fit, shard.M, shard.P, seed, generator)
                (fit.loss(rows, particles, generator) / 2).backward()
            for optimizer in optimizers:
                for group in optimizer.param_groups:
                    group["lr"] = descent.MUON * share.rate_at(step, steps)
                optimizer.step()
    found = together[0]
    for name, value in manifold.state_dict().items():
        torch.testing.assert_close(found.state_dict()[name], value, rtol=1e-4, atol=1e-6, msg=name)


def test_a_shard_has_the_losses_of_its_rows(files, fields, turned_once):
    whole, shard = Snapshots(files), Snapshots(files, shard=(1, 2))
    field = replace(fields["mlp"], noise=0.0, noise_floor=0.0, tangent=0.0, evenness=0.0)
    prepared = field.prepare(whole, LATENT)
    manifold = field.build(whole, prepared, LATENT, seeded("cpu", 0))
    rows, particles = torch.tensor([0, 7]), torch.tensor([3, 140, 5])
    for of_all, of_shard in zip(*(field.fits(manifold, s, prepared) for s in (whole, shard)), strict=True):
        loss = of_shard.loss(rows, particles, None)
        assert loss == of_all.loss(shard.rows[rows], particles, None)
        assert loss != of_all.loss(rows, particles, None)


@pytest.mark.slow
def test_resumed_training_has_the_same_bits(together, files, training_in, tmp_path):
    with pytest.raises(StorageError, match="the disk is full"):
        train_together(files, training_in(tmp_path, ("stress", 7)), TOGETHER, "cpu")
    assert (tmp_path / "deformation.pt").is_file()
    assert (tmp_path / "stress" / descent.CHECKPOINT).is_file()
    resumed, metrics = train_together(files, training_in(tmp_path), TOGETHER, "cpu")
    assert equal(resumed, together[0])
    assert all(metrics[f"{phase}_loss"] == together[1][f"{phase}_loss"] for phase in PHASES)
    assert len(list(tmp_path.glob("stress/csv/*/metrics.csv"))) == 2  # the first rank alone keeps logs


@pytest.mark.slow
def test_a_rank_that_dies(files, training_in, tmp_path):
    with pytest.raises(LaunchError, match=r"training: process 0 .* SIGKILL; .*trainer\.devices=2$"):
        train_together(files, training_in(tmp_path, ("affine", 7)), TOGETHER, "cpu")


def test_seeds_of_ranks():
    assert Rank().seed(5) == 5
    seeds = {Rank(number, 3).seed(seed) for number in range(3) for seed in (0, 1, SEED_STREAM)}
    assert len(seeds) == 9


def test_the_paper_sees_every_frame_of_each_shard_once_an_epoch(files):
    paper = PaperTrainer([1e-3], 1, 1, 1, frames_per_batch=8, devices=2)
    shard, share = Snapshots(files, shard=(1, 2)), paper.share()
    steps = share.steps_of("stress", shard.M)
    assert steps == paper.steps_of("stress", 26) == 4
    fit = descent.Fit("stress", torch.nn.Identity(), lambda *_: None, pointwise=True)
    batches = [share.batch(step, fit, shard.M, 9, 0, seeded("cpu", step))[0] for step in range(steps)]
    assert sorted(torch.cat(batches).tolist()) == list(range(13))


def test_what_is_refused(snapshots, fields, tmp_path):
    with pytest.raises(ConfigError, match=r"frames_per_batch=32 cannot be shared .* devices=3; .*=30$"):
        FastTrainer(steps=5, devices=3)
    with pytest.raises(ConfigError, match="devices=0 is below"):
        PaperTrainer(devices=0)
    with pytest.raises(ConfigError, match=r"trainer\.devices=2, but processes that train: 1"):
        training.train(snapshots, fields["mlp"], TOGETHER, LATENT, 0, tmp_path, "cpu")


@pytest.mark.gpu(2)
def test_on_two_gpus(files, training_in, tmp_path):
    one, _ = train_together(files, training_in(tmp_path / "run"), TOGETHER, "cuda:0")
    assert alike(tmp_path / "run")
    resumed = tmp_path / "resumed"
    with pytest.raises(StorageError):
        train_together(files, training_in(resumed, ("stress", 7)), TOGETHER, "cuda:0")
    assert equal(train_together(files, training_in(resumed), TOGETHER, "cuda:0")[0], one)
