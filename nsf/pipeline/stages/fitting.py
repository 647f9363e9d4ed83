"""The stage `teach` of models of latent vectors: what they learn from the training runs."""

import time
from typing import Any

import torch

from nsf.data import archives
from nsf.kinematics.manifold import Manifold
from nsf.models.lookup import training_inputs
from nsf.runs import Run
from nsf.storage import writing

#: File of a teach run with what was learned.
FITTED = "model.pt"


def fit(pipeline, run: Run) -> None:
    """Fit the model of a pipeline's configuration.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its teach run.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        started = time.perf_counter()
        with writing(record.path / FITTED) as partial:
            torch.save(fitted(pipeline, manifold), partial)
        record.output(FITTED)
        record.metrics["teach_seconds"] = seconds = time.perf_counter() - started
    pipeline.say(f"teach: model={pipeline.model.name} in {seconds:.1f} s → {run.id}")


def fitted(pipeline, manifold: Manifold) -> Any:
    """The fit of a pipeline's model to the training runs."""
    inputs = training_inputs(manifold, pipeline.scene, pipeline.split.train)
    return pipeline.model.fit(manifold, inputs, int(pipeline.config.seed))


def loaded(run: Run) -> Any:
    """The result of a teach run.

    Raises:
        MissingRunError: it has not run.
        SchemaError: the file was changed after its run, or holds more than tensors in plain containers.
    """
    return archives.tensors(run.require().file(FITTED), "model", "teach")
