"""Training of a manifold, phase by phase (paper section 4.5): g with e, then h, then l."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch

from nsf.data import Snapshots
from nsf.data.archives import keep, kept, taken_up
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.phases import CHECKPOINT, Fit, seeded
from nsf.kinematics.training.schedules import Trainer
from nsf.scalars import number
from nsf.storage import refusals

WEIGHTS_STREAM = 1 << 30  # apart from the phases' streams


class Field(Protocol):
    """A field of `conf/field/`, as training needs it."""

    def prepare(self, snapshots: Snapshots, latent_dim: int) -> dict[str, Any]:
        """Plain containers and host tensors that follow from the snapshots before any network is trained."""

    def build(
        self, snapshots: Snapshots, prepared: dict[str, Any], latent_dim: int, generator: torch.Generator
    ) -> Manifold:
        """A manifold with untrained networks."""

    def fits(self, manifold: Manifold, snapshots: Snapshots, prepared: dict[str, Any]) -> Iterator[Fit]:
        """The phases, one by one; the next one follows once the one before is trained."""


def train(
    snapshots: Snapshots,
    field: Field,
    trainer: Trainer,
    latent_dim: int,
    seed: int,
    folder: Path,
    device: str | torch.device,
    loggers: Callable[[Path], Sequence[Any]] = lambda folder: (),
    say: Callable[[str], object] = print,
) -> tuple[Manifold, dict[str, float]]:
    """Train encoder and fields on the snapshots.

    An interrupted training called again with the same arguments goes on where it stood (finished phases are
    not repeated) and ends with the same bits as one that was never interrupted.

    Args:
        snapshots: of the training cases, on `device`.
        field, trainer: a field and a schedule of `conf/field/`, `conf/trainer/`.
        latent_dim: r.
        seed: of the initial weights, batches and noise.
        folder: keeps logs, checkpoints and finished phases; one training a folder.
        device: "cpu", "cuda", "cuda:1".
        loggers: the loggers of Lightning for a phase, whose folder they are called with.
        say: called with a line for each file of an interrupted training that was damaged, whose part is done
            again.

    Returns:
        The manifold on the host, and for each phase its steps, last loss (mean squared error over the
        variance of the field, and what a field adds) and seconds; `training_seconds` adds those, the
        preparation's and the building's. Time before an interrupt counts, work that an interrupt undid does
        not.

    Raises:
        ConfigError: a value is out of range.
        InstabilityError: a loss is not finite.
        SchemaError: somebody made the files of an interrupted training.
        StorageError: the disk refused a file.
        KeyboardInterrupt: on an interrupt, after which a second call goes on.

    Source: Zong et al. 2023, section 4.5.
    """
    number("latent_dim", latent_dim, 1, whole=True)
    device, folder = torch.device(device), Path(folder)
    resumed = any(folder.rglob("*.pt"))
    fits = taken_up(folder, "train") if resumed else contextlib.nullcontext()
    with refusals(folder), _deterministic(), fits:
        prepare = partial(_timed, partial(field.prepare, snapshots, latent_dim))
        begun = _once(folder / "prepared.pt", say, prepare)
        prepared, weights = begun["value"], seeded("cpu", seed, WEIGHTS_STREAM)
        built = _timed(lambda: field.build(snapshots, prepared, latent_dim, weights).to(device))
        manifold = built["value"]
        # Of a large scene, building reads all data once more; as all seconds, those of the first call count.
        total = begun["seconds"] + _once(folder / "built.pt", say, lambda: built["seconds"])
        metrics: dict[str, float] = {}
        for fit in field.fits(manifold, snapshots, prepared):
            phase = partial(_descend, fit, trainer, snapshots, seed, folder / fit.name, loggers, say)
            outcome = _once(folder / f"{fit.name}.pt", say, phase)
            fit.network.load_state_dict(outcome["state"])
            fit.network.to(device)  # Lightning leaves it on the host
            (folder / fit.name / CHECKPOINT).unlink(missing_ok=True)
            metrics |= {f"{fit.name}_{key}": outcome[key] for key in ("steps", "loss", "seconds")}
            total += outcome["seconds"]
    metrics["training_seconds"] = total
    return manifold.cpu().requires_grad_(False).eval(), metrics


def _descend(*phase: Any) -> dict[str, Any]:
    from nsf.kinematics.training.lightning import descend

    return descend(*phase)


def _timed(compute: Callable[[], Any]) -> dict[str, Any]:
    """A value, and the seconds that it took."""
    started = time.perf_counter()
    return {"value": compute(), "seconds": time.perf_counter() - started}


def _once(path: Path, say: Callable[[str], object], compute: Callable[[], Any]) -> Any:
    """The value kept in `path`; computed and kept there where there is none, or a damaged one."""
    value = kept(path, say)
    if value is None:
        keep(path, compute())
        value = kept(path, say)
    return value


@contextlib.contextmanager
def _deterministic() -> Iterator[None]:
    """torch's deterministic algorithms, for the time of the training only."""
    before = torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # a debugging aid that writes everything once
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
        torch.utils.deterministic.fill_uninitialized_memory = fill
