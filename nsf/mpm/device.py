"""Warp and its devices by name, and the GPUs of a host."""

import os
from contextlib import suppress
from functools import cache

import warp as wp

from nsf.errors import DeviceError, StorageError
from nsf.gpu import has_driver

wp.config.log_level = wp.LOG_ERROR  # kernels are compiled without a word; errors still show


def _begin_without_gpu() -> None:
    """Start Warp where no GPU can be, without its warning; `nsf doctor` says what is missing."""
    with suppress(OSError), open(os.devnull, "wb") as nowhere:
        stderr = os.dup(2)  # the warning comes from C++, which knows no sys.stderr
        try:
            os.dup2(nowhere.fileno(), 2)
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


if not has_driver():
    _begin_without_gpu()


def warp_device(name: str):
    """The Warp device `cpu`, `cuda` or `cuda:N`; `auto` is the first GPU, or the CPU where there is none.

    Raises:
        DeviceError: the device does not exist.
        StorageError: Warp cannot write its kernels.
    """
    _check_kernel_cache()
    name = str(name)
    if name == "auto":
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    if name.startswith("cuda") and not wp.is_cuda_available():
        raise DeviceError(
            f"device={name} was asked for, but this machine has no usable GPU; use device=cpu or device=auto"
        )
    names = {d.alias for d in wp.get_devices()} | {"cuda"}
    if name not in names:
        raise DeviceError(f"device={name} is unknown; this machine has {', '.join(sorted(names - {'cuda'}))}")
    return wp.get_device(name)


@cache
def _check_kernel_cache() -> None:
    """Refuse a folder of compiled kernels that cannot be written, before Warp does."""
    reason = "it is read-only"
    try:
        # Known, unless a GPU is there, from an earlier try to start Warp.
        if wp.config.kernel_cache_dir is None:
            wp.init()
        os.makedirs(wp.config.kernel_cache_dir, exist_ok=True)
        if os.access(wp.config.kernel_cache_dir, os.W_OK | os.X_OK):
            return
    except OSError as error:
        reason = error.strerror
    raise StorageError(
        f"compiled kernels cannot be kept in {wp.config.kernel_cache_dir}: {reason}; "
        "set WARP_CACHE_PATH to a folder that can be written"
    )


def visible_gpus() -> tuple[str, ...]:
    """The GPUs that this process may use, by the names that CUDA_VISIBLE_DEVICES has for each.

    The first one is this process's `cuda:0`.
    """
    count = len(wp.get_cuda_devices())
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = named.split(",") if named else map(str, range(count))
    return tuple(name.strip() for name in names)[:count]
