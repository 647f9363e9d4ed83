"""Loggers of a training: CSV always, and TensorBoard or MLflow where `tracking` names it."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from nsf.extras import optional
from nsf.scalars import one_of
from nsf.storage import locked, write_text

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger, MLFlowLogger

#: Values of `tracking`, each with the extra that brings it.
EXTRAS = {"tensorboard": "track", "mlflow": "mlflow"}


def check_tracking(tracking: str | None) -> None:
    """Refuse a kind of tracking that is unknown or not installed.

    Raises:
        ConfigError: it is unknown.
        MissingExtraError: it is not installed; names the command.
    """
    if one_of("tracking", tracking, (None, *EXTRAS)) is not None:
        optional(tracking, EXTRAS[tracking])


def loggers(folder: Path, tracking: str | None) -> list[Logger]:
    """The loggers of one phase.

    Args:
        folder: of the phase, in the folder of the training.
        tracking: "tensorboard" writes into `folder`; "mlflow" into `mlflow.db` (SQLite) by the trainings,
            or to MLFLOW_TRACKING_URI. None: the CSV log alone.
    """
    from pytorch_lightning.loggers.csv_logs import CSVLogger

    # A resumed phase logs into a new version, for CSVLogger deletes what it finds.
    version = str(len(list((folder / "csv").glob("*"))))
    writers: list[Logger] = [CSVLogger(folder, name="csv", version=version, flush_logs_every_n_steps=1)]
    if tracking == "tensorboard":
        from pytorch_lightning.loggers.tensorboard import TensorBoardLogger

        writers.append(TensorBoardLogger(folder, name="tensorboard", version=version))
    if tracking == "mlflow":
        writers.append(_mlflow(folder))
    return writers


def _run_id(path: Path) -> str | None:
    """The id of MLflow in a file; None where there is none, or something else."""
    found = path.read_bytes() if path.is_file() else b""
    return found.decode() if re.fullmatch(rb"[0-9a-f]{32}", found) else None


def _mlflow(folder: Path) -> MLFlowLogger:
    """One MLflow run a phase, which a resumed phase goes on with."""
    from pytorch_lightning.loggers.mlflow import MLFlowLogger

    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    trainings, run_file = folder.parent.parent.resolve(), folder / "mlflow_run.txt"
    # Two processes that make the tables of a data base at once would fail.
    with locked(trainings / ".mlflow.lock", waiting=lambda: None):
        logger = MLFlowLogger(
            experiment_name=f"{trainings.parent.name}/{trainings.name}",
            run_name=f"{folder.parent.name}/{folder.name}",
            tracking_uri=os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{trainings / 'mlflow.db'}"),
            artifact_location=(trainings / "mlflow").as_uri(),
            run_id=_run_id(run_file),
        )
        write_text(run_file, str(logger.run_id))
    return logger
