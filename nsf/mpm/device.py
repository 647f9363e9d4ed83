"""Devices by name, and the sharing of a host's GPUs among processes."""

import itertools
import os
from contextlib import ExitStack
from functools import cache
from pathlib import Path

import warp as wp

from nsf.errors import DeviceError
from nsf.storage import locked

_held = ExitStack()  # the lock of this process's GPU, which the operating system frees when the process ends


def warp_device(name: str):
    """The Warp device `cpu`, `cuda` or `cuda:N`; `auto` is the first GPU, or the CPU where there is none.

    Raises:
        DeviceError: the device does not exist.
    """
    name = str(name)
    if name == "auto":
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    if name.startswith("cuda") and not wp.is_cuda_available():
        raise DeviceError(
            f"device={name} was asked for, but this machine has no usable GPU; use device=cpu or device=auto"
        )
    known = {d.alias for d in wp.get_devices()} | {"cuda"}
    if name not in known:
        raise DeviceError(f"device={name} is unknown; this machine has {', '.join(sorted(known - {'cuda'}))}")
    return wp.get_device(name)


def visible_gpus() -> tuple[str, ...]:
    """The GPUs that this process may use, by the names that CUDA_VISIBLE_DEVICES has for each.

    The first one is this process's `cuda:0`.
    """
    count = len(wp.get_cuda_devices())
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = named.split(",") if named else map(str, range(count))
    return tuple(name.strip() for name in names)[:count]


@cache
def take_gpu(gpus: tuple[str, ...], folder: Path) -> None:
    """Make this process see one GPU alone, as `cuda:0`. Call it before CUDA is used.

    Processes that call it take the GPUs in turn. The GPU of a process is free again once the process has
    ended.

    Args:
        gpus: names from `visible_gpus`.
        folder: holds the locks that the processes share.

    Raises:
        StorageError: the folder cannot be written.
    """
    for turn in itertools.count():
        if _held.enter_context(locked(folder / f".gpu_{turn}.lock")):
            os.environ["CUDA_VISIBLE_DEVICES"] = gpus[turn % len(gpus)]
            return
