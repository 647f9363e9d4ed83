"""Deployment: reduced runs over parameter values, driven by Lightning's `Trainer.predict`."""

import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader

from nsf.dynamics.solver import ReducedMPM
from nsf.errors import SchemaError
from nsf.progress import Progress, quiet_lightning
from nsf.storage import writing
from nsf.timing import synchronizer

_VERSION = 1


@dataclass  # not frozen: Lightning moves the fields of what a prediction step returns
class Rollout:
    """One reduced run.

    Attributes:
        parameter: value of the problem parameter.
        t: [N + 1] time [s]; xhat: [N + 1, r] latent vectors.
        residuals: [N, k + 1] projection residuals [m]; stops: [N] stop reasons.
        sample: |S| of the first phase; integration_mean: mean |N|.
        needed_outside: most particles or nodes a step needed outside the superset.
        seconds: wall time of the steps, without set-up.
        diverged: step at which x̂ ceased to be finite or a sample particle left the grid, −1 when neither did.
    """

    parameter: float
    t: np.ndarray
    xhat: np.ndarray
    residuals: np.ndarray
    stops: list[str]
    sample: int
    integration_mean: float
    needed_outside: int
    seconds: float
    diverged: int

    def save(self, path: Path) -> None:
        """Write as HDF5, whole or not at all."""
        # In memory first: HDF5 cannot report a full disk when it closes a file.
        memory = io.BytesIO()
        with h5py.File(memory, "w") as file:
            file.attrs.update({"nsf_rollout": _VERSION, "parameter": self.parameter, "sample": self.sample})
            file.attrs.update(
                {"integration_mean": self.integration_mean, "needed_outside": self.needed_outside}
            )
            file.attrs.update({"seconds": self.seconds, "diverged": self.diverged})
            for name in ("t", "xhat", "residuals"):
                file[name] = getattr(self, name)
            file["stops"] = np.array(self.stops, dtype=h5py.string_dtype())
        with writing(path) as partial:
            partial.write_bytes(memory.getbuffer())

    @classmethod
    def open(cls, path: Path) -> "Rollout":
        """Read a rollout.

        Raises:
            SchemaError: the file is missing, truncated, foreign or newer.
        """
        try:
            with h5py.File(path, "r") as file:
                version = file.attrs.get("nsf_rollout")
                if version != _VERSION:
                    raise SchemaError(
                        f"{path} is not a rollout of version {_VERSION} (found {version}); deploy again"
                    )
                scalars = {k: file.attrs[k].item() for k in ("parameter", "sample", "integration_mean")}
                scalars |= {k: file.attrs[k].item() for k in ("needed_outside", "seconds", "diverged")}
                arrays = {k: file[k][()] for k in ("t", "xhat", "residuals")}
                stops = [s.decode() for s in file["stops"][()]]
        except (OSError, KeyError, RuntimeError) as error:
            raise SchemaError(
                f"{path} is truncated or not a rollout ({error}); delete it and deploy again"
            ) from error
        return cls(**scalars, **arrays, stops=stops)


class Deployment(pl.LightningModule):
    """Lightning module whose prediction step is a reduced run a parameter value.

    Args:
        solver_at: parameter value and device name → a `ReducedMPM` at t = 0.
        progress: told of each run done.
    """

    def __init__(self, solver_at: Callable[[float, str], ReducedMPM], progress: Progress):
        super().__init__()
        self._solver_at, self._progress = solver_at, progress

    def predict_step(self, batch: torch.Tensor, batch_idx: int) -> list[Rollout]:
        """Run each parameter value of a batch [B] from t = 0 to T."""
        runs = []
        for value in batch.tolist():
            runs.append(rollout(self._solver_at(value, str(self.device)), value))
            self._progress.advance()
        return runs


def rollout(solver: ReducedMPM, parameter: float) -> Rollout:
    """Run a reduced solver to the end of its scene."""
    solver.step(1)  # compiles, loads and captures
    wait = synchronizer(solver.device)
    wait()
    started = time.perf_counter()
    solver.step(solver.total_steps - 1)
    wait()
    seconds = (time.perf_counter() - started) * solver.total_steps / max(1, solver.total_steps - 1)
    latent = solver.trajectory()
    diverged = solver.left_grid()
    outside = solver.needed_outside() if diverged < 0 else 0
    return Rollout(
        parameter=float(parameter),
        t=latent.t,
        xhat=latent.xhat,
        residuals=latent.residuals,
        stops=latent.stops,
        sample=solver.sample_size,
        integration_mean=solver.integration_mean,
        needed_outside=outside,
        seconds=seconds,
        diverged=diverged,
    )


def deploy(
    solver_at: Callable[[float, str], ReducedMPM], values: Sequence[float], device: str
) -> list[Rollout]:
    """Reduced runs at every parameter value, with a progress bar.

    Args:
        solver_at: parameter value and device name → solver at t = 0.
        values: parameter values.
        device: `cpu`, `cuda` or `cuda:N`.

    Raises:
        KeyboardInterrupt: passed on; Lightning would exit with code 1.
    """
    loader = DataLoader(torch.tensor(list(values), dtype=torch.float64), batch_size=1, num_workers=0)
    cuda = torch.device(device).type == "cuda"
    with quiet_lightning(), Progress("deploy", len(values), "runs") as progress:
        trainer = pl.Trainer(
            accelerator="gpu" if cuda else "cpu",
            devices=[torch.device(device).index or 0] if cuda else 1,
            logger=False,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=False,
            inference_mode=False,  # torch's inference tensors could not be updated in place between steps
        )
        try:
            batches = trainer.predict(Deployment(solver_at, progress), loader)
        except SystemExit as stop:
            raise KeyboardInterrupt from stop
    return [run for batch in batches for run in batch]
