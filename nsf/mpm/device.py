"""Devices by name."""

import warp as wp

from nsf.errors import DeviceError


def warp_device(name: str):
    """The Warp device `cpu`, `cuda` or `cuda:N`; `auto` is the GPU where there is one.

    Raises:
        DeviceError: a GPU was asked for where there is none.
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
