"""The only door between torch and Warp: shared memory, shared stream."""

from contextlib import contextmanager, nullcontext

import torch
import warp as wp

from nsf.gpu import without_collection
from nsf.mpm.precision import Precision

TORCH_DTYPES = {"fp32": torch.float32, "fp64": torch.float64}


def torch_dtype(precision: Precision) -> torch.dtype:
    """The torch type of a precision."""
    return TORCH_DTYPES[precision.name]


def as_vectors(tensor: torch.Tensor, precision: Precision) -> wp.array:
    """View a [n, 3] tensor as a Warp array of n vectors, without a copy."""
    return wp.from_torch(tensor, dtype=precision.vec3)


def as_matrices(tensor: torch.Tensor, precision: Precision) -> wp.array:
    """View a [n, 3, 3] tensor as a Warp array of n matrices, without a copy."""
    return wp.from_torch(tensor, dtype=precision.mat33)


def as_scalars(tensor: torch.Tensor) -> wp.array:
    """View a [n] tensor as a Warp array, without a copy."""
    return wp.from_torch(tensor)


def as_tensor(array: wp.array) -> torch.Tensor:
    """View a Warp array as a tensor, without a copy; vectors and matrices are its last axes."""
    return wp.to_torch(array)


def torch_device(device) -> torch.device:
    """The torch device of a Warp device."""
    return torch.device(str(device)) if device.is_cuda else torch.device("cpu")


def on_torch_stream(device):
    """Context in which Warp launches on torch's current stream, so both order their work.

    No events are recorded at entry: the stream may be under capture. Inside another such context it does
    nothing: to leave an inner one would take the stream away from the outer, and Warp would clear arrays
    on the default stream, which a capture does not see.
    """
    if not device.is_cuda:
        return nullcontext()
    stream = torch.cuda.current_stream(torch_device(device))
    if device.stream.cuda_stream == stream.cuda_stream:
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False, sync_exit=False)


class ReadBack:
    """Copies to the host that wait for the work on a device up to `mark`, and for none that follows it.

    Without it a small copy waits for all that was queued before it, as the decoding of a whole run.

    Args:
        device: Warp device of the tensors.
    """

    def __init__(self, device):
        self._event = torch.cuda.Event() if device.is_cuda else None
        self._stream = torch.cuda.Stream(torch_device(device)) if device.is_cuda else None

    def mark(self) -> None:
        """Let copies wait for what torch's current stream has been given by now."""
        if self._event is not None:
            self._event.record(torch.cuda.current_stream(self._stream.device))

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """The values on the host, as they were at `mark`; nothing may write over them until then."""
        if self._event is None:
            return values.cpu()
        self._stream.wait_event(self._event)
        with torch.cuda.stream(self._stream):
            return values.cpu()


@contextmanager
def captured(device):
    """Capture what torch and Warp launch inside into one CUDA graph, which is yielded.

    Garbage is left alone until it is over: Warp does not see a capture of torch, in which its arrays cannot
    be freed.
    """
    graph = torch.cuda.CUDAGraph()
    with without_collection(), torch.cuda.graph(graph), on_torch_stream(device):
        yield graph
