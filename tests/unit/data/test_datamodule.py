"""The data module under a real trainer, whole and resumed."""

import pytest
import pytorch_lightning as lightning
import torch
from pytorch_lightning.callbacks import ModelCheckpoint

from nsf.data import SnapshotDataModule
from nsf.errors import SchemaError

pytestmark = pytest.mark.filterwarnings("ignore")
STEPS = 7


class Recorder(lightning.LightningModule):
    """Fits one number to batches drawn by (seed, step), two optimiser steps a training step."""

    def __init__(self, fail_at=None):
        super().__init__()
        self.automatic_optimization = False
        self.weight = torch.nn.Parameter(torch.zeros(3))
        self.fail_at, self.seen = fail_at, []

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=0.1)

    def training_step(self, step, batch_idx):
        if step == self.fail_at:
            raise KeyboardInterrupt
        assert step == batch_idx
        self.seen.append(step)
        snaps, optimizer = self.trainer.datamodule.snapshots, self.optimizers()
        generator = torch.Generator().manual_seed(1000 + step)
        for _ in range(2):
            rows = torch.randint(snaps.M, (3,), generator=generator)
            loss = (snaps.gather("x", rows, slice(0, 5)) - self.weight).square().mean()
            optimizer.zero_grad()
            self.manual_backward(loss)
            optimizer.step()


def fit(paths, folder, resume=None, fail_at=None):
    keep = ModelCheckpoint(folder, filename="{step}", every_n_train_steps=2, save_top_k=-1, save_last=True)
    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=1, logger=False, enable_progress_bar=False, enable_model_summary=False,
        callbacks=[keep], default_root_dir=folder,
    )  # fmt: skip
    module = Recorder(fail_at)
    data = SnapshotDataModule(paths, steps=STEPS)
    try:
        trainer.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    except (KeyboardInterrupt, SystemExit):
        assert fail_at is not None
    return module, data


@pytest.fixture
def paths(write):
    return [write(f"{i}.h5", seed=10 * i)[0] for i in range(2)]


def test_every_step_once_and_the_snapshots_outlive_the_training(paths, tmp_path):
    module, data = fit(paths, tmp_path)
    assert module.seen == list(range(STEPS))
    assert data.snapshots.M == 8
    assert data.snapshots.slab("v", slice(None)).shape == (8, 11, 3)


@pytest.mark.parametrize("fail_at", [3, 4, 6])
def test_an_interrupted_training_resumes_bitwise(paths, tmp_path, fail_at):
    whole, _ = fit(paths, tmp_path / "whole")
    broken, _ = fit(paths, tmp_path / "broken", fail_at=fail_at)
    assert broken.seen == list(range(fail_at))
    checkpoints = sorted((tmp_path / "broken").glob("step=*.ckpt"))
    assert checkpoints
    for checkpoint in checkpoints:
        done = int(checkpoint.stem.split("=")[1]) // 2
        resumed, _ = fit(paths, tmp_path / f"resumed{done}", resume=checkpoint)
        assert resumed.seen == list(range(done, STEPS))
        assert torch.equal(resumed.weight, whole.weight)


def test_without_a_trainer(paths):
    data = SnapshotDataModule([str(path) for path in paths], steps=3, resident=False)
    data.setup()
    first = data.snapshots
    data.setup("fit")
    assert data.snapshots is first
    assert not first.resident
    assert list(data.train_dataloader()) == [0, 1, 2]


def test_a_bad_file_is_named(paths):
    paths[1].write_bytes(b"")
    with pytest.raises(SchemaError, match=r"1\.h5"):
        SnapshotDataModule(paths, steps=3).setup()
