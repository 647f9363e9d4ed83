"""Devices by name, and the GPUs of a host."""

import os

import warp as wp

from nsf.errors import DeviceError


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
