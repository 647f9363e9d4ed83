"""The stage `train`: the manifold of the training trajectories."""

import contextlib
from functools import partial

from nsf.data import Snapshots
from nsf.data.schema import TRAJECTORY
from nsf.kinematics.training.train import train as train_alone
from nsf.runs import Run


def train(pipeline, run: Run) -> None:
    """Train the manifold of a pipeline's configuration.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its train run.
    """
    pipeline.check_devices()
    c, trainer, device = pipeline.config, pipeline.trainer, pipeline.device
    paths = [data.file(TRAJECTORY) for data in pipeline.training_data]
    own = {"field": pipeline.field, "latent_dim": c.latent_dim, "seed": c.seed, "tracking": c.tracking}
    one = partial(train_alone, folder=run.path, **own)
    with run.record(device=device, seed=c.seed) as record:
        if trainer.devices > 1:
            from nsf.kinematics.training.ranks import train_together

            manifold, metrics = train_together(paths, one, trainer, device, c.data.resident)
        else:
            with contextlib.closing(Snapshots(paths, device, c.data.resident)) as snapshots:
                manifold, metrics = one(snapshots, trainer=trainer, device=device)
        manifold.datasets = [data.id for data in pipeline.training_data]
        manifold.split = {
            part: [list(case.numbers) for case in getattr(pipeline.split, part)] for part in ("train", "test")
        }
        manifold.save(run.path / "manifold.pt")
        record.output("manifold.pt")
        record.metrics.update(metrics)
    seconds = metrics["training_seconds"]
    pipeline.say(f"train: field={manifold.field}, r={c.latent_dim} in {seconds:.1f} s → {run.id}")
