"""A chain as one tracked run: its keys, its losses as it trains, its figures, and its files.

TensorBoard, MLflow and Weights & Biases get one run a chain, named by its evaluate run; the same command goes
on with it. Jobs of a sweep have a parent (MLflow) or a group (Weights & Biases) in common. All write into the
folder of runs, unless their environment variables say otherwise. `tracking=csv` keeps the losses of training
alone, in its folder.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from nsf.errors import first_line
from nsf.extras import optional
from nsf.manifest import CHAIN
from nsf.runs import Run
from nsf.runs.listing import flat
from nsf.storage import locked

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

#: Tools that track a chain, each with the extra that brings it.
EXTRAS = {"tensorboard": "track", "mlflow": "mlflow", "wandb": "wandb"}
TRACKING = ("none", "csv", *EXTRAS)
#: Methods of a logger that Lightning calls.
_LOGGED = ("log_hyperparams", "log_graph", "log_metrics", "save", "finalize", "after_save_checkpoint")


@dataclass(frozen=True)
class Tool:
    """A tracked run of a tool.

    Attributes:
        logger: of Lightning.
        conclude: adds figures, beside the keys; put: adds a file.
        end: closes the run, as "success" or "failed".
        new: whether its keys are to be logged.
    """

    logger: "Logger"
    conclude: Callable[[Mapping, Mapping], object]
    put: Callable[[Path], object]
    end: Callable[[str], object]
    new: bool = True


def check_tracking(tracking: str | None) -> None:
    """Refuse tracking by what is not installed.

    Raises:
        MissingExtraError: names the command.
    """
    if tracking in EXTRAS:
        optional(tracking, EXTRAS[tracking])


class Tracked:
    """The tracked run of a pipeline, which begins with its first use.

    An error of the tool is one line of warning: it then gets the end of the run alone, and the chain goes on.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`; its `group` is a parent.
    """

    def __init__(self, pipeline):
        self._pipeline = pipeline
        self._tool: Tool | None = None
        self._failed = False

    def loggers(self, folder: Path) -> "list[Logger]":
        """Loggers of Lightning for a phase of the training: the csv file in its folder, and the tool's."""
        from pytorch_lightning.loggers.csv_logs import CSVLogger

        kind = self._pipeline.config.tracking
        if kind in (None, "none"):
            return []
        # A resumed phase logs into a new version, for CSVLogger deletes what it finds.
        version = str(len(list((folder / "csv").glob("*"))))
        losses = CSVLogger(folder, name="csv", version=version, flush_logs_every_n_steps=1)
        tool = self._begun() if kind in EXTRAS else None
        return [losses, tool.logger] if tool else [losses]

    def __enter__(self) -> "Tracked":
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        """Add figures and files of what is there, and close the run."""
        if self._pipeline.config.tracking not in EXTRAS or (kind and not self._tool):
            return
        try:
            if kind is None and (tool := self._begun()):
                self._call(tool.conclude, self._keys(), figures(self._pipeline))
                for path in files(self._pipeline):
                    self._call(tool.put, path)
        finally:
            if self._tool:
                self._end(self._tool, "failed" if kind else "success")
            self._tool, self._failed = None, False

    def _begun(self) -> Tool | None:
        """The tool's run; None where it could not begin."""
        if self._tool is None:
            pipeline = self._pipeline
            run = pipeline.evaluation
            start = {"tensorboard": _tensorboard, "mlflow": _mlflow, "wandb": _wandb}[
                pipeline.config.tracking
            ]
            run.root.mkdir(parents=True, exist_ok=True)
            self._tool = self._call(start, run, run.root.resolve(), pipeline.group)
            if self._tool:
                self._open(self._tool)
        return self._tool

    def _open(self, tool: Tool) -> None:
        """Log the keys of a new run; Lightning gets none of the errors of its logger."""
        for name in _LOGGED:
            if method := getattr(tool.logger, name, None):
                setattr(tool.logger, name, partial(self._call, method))
        self._call(getattr, tool.logger, "experiment", None)  # here, for Lightning would raise its errors
        if tool.new:
            tool.logger.log_hyperparams(self._keys())

    def _call(self, function: Callable, *values: Any, **named: Any) -> Any:
        """The result of a function of the tool; None from its first error on."""
        if self._failed:
            return None
        try:
            return function(*values, **named)
        except Exception as error:
            self._warn(error)
            return None

    def _end(self, tool: Tool, status: str) -> None:
        try:
            tool.end(status)
        except Exception as error:
            self._warn(error)

    def _warn(self, error: Exception) -> None:
        if not self._failed:
            kind = self._pipeline.config.tracking
            self._pipeline.say(f"tracking: warning: {kind} failed and gets no more ({first_line(error)})")
        self._failed = True

    def _keys(self) -> dict[str, Any]:
        return as_text(flat(OmegaConf.to_container(self._pipeline.config, resolve=True)))


def as_text(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers, truth values and texts as they are, others as text."""
    return {key: v if isinstance(v, bool | int | float | str) else str(v) for key, v in keys.items()}


def figures(pipeline) -> dict[str, float]:
    """Figures of the evaluate run, and the seconds of each stage, as far as they are there."""
    seconds = {
        f"seconds/{stage}": sum(run.manifest["seconds"] for run in runs)
        for stage in CHAIN
        if (runs := pipeline.runs_of(stage)) and all(run.complete for run in runs)
    }
    metrics = pipeline.evaluation.manifest["metrics"] if pipeline.evaluation.complete else {}
    means = {f"results/{name}": value for name, value in metrics.items() if isinstance(value, int | float)}
    return means | seconds


def files(pipeline) -> list[Path]:
    """The table, the checkpoint, and the pictures of the report, as far as they are there."""
    table = [pipeline.evaluation.file("results.csv")] if pipeline.evaluation.complete else []
    checkpoint = [pipeline.training.file("manifold.pt")] if pipeline.training.complete else []
    page = pipeline.kept_report()
    return [*table, *checkpoint, *(sorted(page.parent.glob("*.png")) if page else [])]


def _tensorboard(run: Run, folder: Path, group: str) -> Tool:
    import numpy as np
    from PIL import Image
    from pytorch_lightning.loggers.tensorboard import TensorBoardLogger

    home = folder / "tensorboard"
    new = not (home / run.scene / run.hash).exists()
    logger = TensorBoardLogger(home, name=run.scene, version=run.hash, default_hp_metric=False)

    def put(path: Path) -> None:
        if path.suffix == ".png":
            picture = np.asarray(Image.open(path).convert("RGB"))
            logger.experiment.add_image(path.stem, picture, dataformats="HWC")
        else:
            text = f"```\n{path.read_text(encoding='utf-8')}\n```" if path.suffix == ".csv" else str(path)
            logger.experiment.add_text(path.name, text)

    # Keys without figures would not be shown.
    return Tool(logger, logger.log_hyperparams, put, logger.finalize, new)


def _mlflow(run: Run, folder: Path, group: str) -> Tool:
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    from mlflow import MlflowClient
    from pytorch_lightning.loggers.mlflow import MLFlowLogger

    server = os.environ.get("MLFLOW_TRACKING_URI")
    uri = server or f"sqlite:///{folder / 'mlflow.db'}"
    # Two processes that make the tables of a data base, or a parent, at once would fail, or make two.
    with locked(folder / ".mlflow.lock", waiting=lambda: None):
        client = MlflowClient(uri)
        place = None if server else (folder / "mlflow").as_uri()
        earlier = client.get_experiment_by_name(run.scene)
        experiment = earlier.experiment_id if earlier else client.create_experiment(run.scene, place)

        def begun(name: str, title: str, **tags: str) -> tuple[str, bool]:
            runs = client.search_runs([experiment], f"tags.nsf = '{name}'", max_results=1)
            made = [] if runs else [client.create_run(experiment, tags={"nsf": name, **tags}, run_name=title)]
            return (runs or made)[0].info.run_id, bool(made)

        of = {}
        if group:
            of["mlflow.parentRunId"], made = begun(group, group)
            if made:
                client.set_terminated(of["mlflow.parentRunId"])  # it has no work of its own
        run_id, new = begun(run.id, run.hash, **of)
    logger = MLFlowLogger(experiment_name=run.scene, tracking_uri=uri, run_id=run_id)
    return Tool(
        logger,
        lambda keys, values: logger.log_metrics(values),
        lambda path: client.log_artifact(run_id, str(path)),
        logger.finalize,
        new,
    )


def _wandb(run: Run, folder: Path, group: str) -> Tool:
    os.environ.setdefault("WANDB_MODE", "offline")  # nothing leaves the machine unasked
    import wandb
    from pytorch_lightning.loggers.wandb import WandbLogger

    options = {"project": "nsf", "id": run.hash, "name": f"{run.scene}/{run.hash}", "resume": "allow"}
    logger = WandbLogger(save_dir=folder, group=group or None, **options)

    def put(path: Path) -> None:
        if path.suffix == ".png":
            logger.experiment.log({path.stem: wandb.Image(str(path))})
        else:
            artifact = wandb.Artifact(f"{run.hash}-{path.stem}", type="result")
            artifact.add_file(str(path))
            logger.experiment.log_artifact(artifact)

    return Tool(
        logger,
        lambda keys, values: logger.log_metrics(values),
        put,
        lambda status: logger.experiment.finish(int(status != "success")),
    )
