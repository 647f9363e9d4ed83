"""Training of one field in several processes: each has a device, and a shard of the snapshots on it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from multiprocessing.process import BaseProcess
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from tempfile import TemporaryDirectory

from lightning_fabric import Fabric
from lightning_fabric.plugins.environments import LightningEnvironment
from lightning_fabric.strategies import DDPStrategy
from torch import distributed
from torch.multiprocessing import ProcessExitedException, ProcessRaisedException
from typing_extensions import override

from nsf.data import Snapshots
from nsf.errors import LaunchError, NSFError
from nsf.kinematics.manifold import Manifold
from nsf.kinematics.training.rank import Rank
from nsf.kinematics.training.schedules import Trainer
from nsf.progress import quiet_lightning

_GRACE = 10.0  # [s] for a process that is stopped to leave nothing half-written
_TIMEOUT = timedelta(hours=6)  # rank 0 reads all snapshots once, while the others wait


class _QuietDDP(DDPStrategy):
    """Lightning's strategy, which tells nothing as its processes find each other."""

    @override
    def setup_environment(self) -> None:
        with quiet_lightning():
            super().setup_environment()


def train_together(
    trajectories: Sequence[Path],
    train: Callable[..., tuple[Manifold, dict[str, float]]],
    trainer: Trainer,
    device: str,
    resident: bool | str = "auto",
) -> tuple[Manifold, dict[str, float]]:
    """Train in `trainer.devices` processes under Lightning's DDP, on the first GPUs or on the CPU.

    The processes are spawned: a script that calls this guards its main part by `if __name__ == "__main__"`.
    Resumed after an interrupt, the training ends with the same bits on up to two devices; on more, the steps
    that are left add gradients in another order.

    Args:
        trajectories: files of the training cases.
        train: `nsf.kinematics.training.train.train` with all arguments but `snapshots`, `trainer`, `device`
            and `rank`; it is pickled.
        trainer: the schedule of all processes together.
        device: "cpu" or "cuda:0".
        resident: as for `Snapshots`, of each process's shard.

    Returns:
        As `train`, from the first process.

    Raises:
        NSFError: of every kind that `train` raises, in whichever process.
        LaunchError: a process died.
    """
    # Not the environment of a cluster: Slurm starts one process a job, and that one starts these.
    alone = LightningEnvironment()
    strategy = _QuietDDP(start_method="spawn", timeout=_TIMEOUT, cluster_environment=alone)
    kind = "gpu" if device.startswith("cuda") else "cpu"
    errors = multiprocessing.get_context("spawn").SimpleQueue()
    with TemporaryDirectory() as folder, quiet_lightning(), _spawning():
        # Tensors do not come back through Lightning's queue: its sender has ended by then.
        kept = Path(folder) / "manifold.pt"
        one = partial(run_rank, errors, kept, trajectories, train, trainer, resident)
        try:
            metrics = Fabric(accelerator=kind, strategy=strategy, devices=trainer.devices).launch(one)
        except (ProcessExitedException, ProcessRaisedException) as error:
            if not errors.empty():
                raise errors.get() from error
            if isinstance(error, ProcessRaisedException):
                raise
            raise LaunchError(
                f"training: {error}; see that there is memory for trainer.devices={trainer.devices}"
            ) from error
        return Manifold.load(kept), metrics


@contextmanager
def _spawning() -> Iterator[None]:
    """Processes that the block starts are fresh interpreters, and none outlives it."""
    method, others = multiprocessing.get_start_method(allow_none=True), multiprocessing.active_children()
    multiprocessing.set_start_method("spawn", force=True)  # joblib's own is told on, and unknown to them
    try:
        yield
    finally:
        multiprocessing.set_start_method(method, force=True)
        os.environ.pop("MASTER_PORT", None)  # Lightning keeps it; the next training takes a free one
        _stop(set(multiprocessing.active_children()).difference(others))


def _stop(processes: Set[BaseProcess]) -> None:
    """Interrupt processes, and wait until they have ended."""
    for process in processes:
        if process.is_alive():  # SIGTERM would have Lightning tell the other ranks, which may be gone
            os.kill(process.pid, signal.SIGINT)
    for process in processes:
        process.join(_GRACE)
        process.kill()
        process.join()


def run_rank(
    errors: SimpleQueue, kept: Path, trajectories, train, trainer: Trainer, resident, fabric: Fabric
) -> dict[str, float]:
    """Train as one of several processes; see `train_together`.

    Args:
        errors: gets the error that is raised, if it is the package's own.
        kept: file of the manifold, which the first process writes.
        trajectories, train, trainer, resident: as there.
        fabric: which of the processes this is, and its device.
    """
    os.setsid()  # Ctrl-C is for the process that started this one, which then stops it
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    rank = Rank(fabric.global_rank, fabric.world_size)
    try:
        with quiet_lightning():
            snapshots = Snapshots(trajectories, fabric.device, resident, rank.shard)
            manifold, metrics = train(snapshots=snapshots, trainer=trainer, device=fabric.device, rank=rank)
        if rank.first:
            manifold.save(kept)
    except KeyboardInterrupt:
        sys.exit(130)  # torch takes an interrupt for success
    except NSFError as error:
        errors.put(error)
        raise
    # Not after an error: it could wait for ranks that will not come.
    distributed.destroy_process_group()
    return metrics
