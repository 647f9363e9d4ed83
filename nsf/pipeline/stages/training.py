"""The stage `train`: the manifold of the training trajectories."""

import contextlib

from nsf.data import Snapshots
from nsf.data.schema import TRAJECTORY
from nsf.kinematics.training.train import train as train_field
from nsf.runs import Run


def train(pipeline, run: Run) -> None:
    """Train the manifold of a pipeline's configuration.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its train run.
    """
    c, device = pipeline.config, pipeline.device
    field, trainer = pipeline.field, pipeline.trainer
    paths = [data.file(TRAJECTORY) for data in pipeline.training_data]
    with run.record(device=device, seed=c.seed) as record:
        with contextlib.closing(Snapshots(paths, device, c.data.resident)) as snapshots:
            manifold, metrics = train_field(
                snapshots,
                field,
                trainer,
                c.latent_dim,
                c.seed,
                run.path,
                device,
                pipeline.tracked.loggers,
                pipeline.say,
            )
        manifold.save(run.path / "manifold.pt")
        record.output("manifold.pt")
        record.metrics.update(metrics)
    seconds = metrics["training_seconds"]
    pipeline.say(f"train: field={manifold.field}, r={c.latent_dim} in {seconds:.1f} s → {run.id}")
