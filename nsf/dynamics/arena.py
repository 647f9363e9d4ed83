"""Arrays and packed kernel launches on one device, shared by torch and Warp."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
import warp as wp

from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.mpm import Precision


class Arena:
    """Holds what packed launches point to, and counts it.

    Args:
        precision: of the floating-point arrays that are of the model.
        device: Warp device.
    """

    def __init__(self, precision: Precision, device):
        self.precision, self.device = precision, device
        self.real, self._torch = torch_dtype(precision), torch_device(device)
        self._held: list[torch.Tensor] = []
        self._side = wp.Stream(device) if device.is_cuda else None

    @contextmanager
    def beside(self) -> Iterator[None]:
        """What is launched inside may run beside what is launched after it, until `meet`."""
        if self._side is None:
            yield
            return
        self._side.wait_stream(self.device.stream)
        with wp.ScopedStream(self._side, sync_enter=False, sync_exit=False):
            yield

    def meet(self) -> None:
        """Wait, on the device, for what was launched beside."""
        if self._side is not None:
            self.device.stream.wait_stream(self._side)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(a.nbytes for a in self._held)

    def hold(self, values, dtype: torch.dtype) -> torch.Tensor:
        """The values as a contiguous array of this device."""
        tensor = torch.as_tensor(values).to(self._torch, dtype).contiguous()
        self._held.append(tensor)
        return tensor

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Zeros."""
        return self.hold(torch.zeros(shape, device=self._torch), dtype)

    def modes(self, modes: torch.Tensor, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """Modes [n, c, K] in vectors of four, in the order that the device reads best, flat.

        A GPU has the vectors of neighbouring particles side by side, [c, K/4, n, 4]; a CPU those of one
        particle, [n, c, K/4, 4].
        """
        modes = torch.nn.functional.pad(modes, (0, -modes.shape[2] % 4)).unflatten(2, (-1, 4))
        if self.device.is_cuda:
            modes = modes.permute(1, 2, 0, 3)
        return self.hold(modes, dtype).flatten()

    def halved(self, modes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As `modes`, on a GPU in half precision, each over the length [K] that is given beside them.

        A GPU reads them faster than anything else in a step; no entry exceeds 1, so that none is lost.
        """
        if not self.device.is_cuda:
            return self.modes(modes), modes.new_ones(modes.shape[2])
        lengths = modes.abs().amax((0, 1)).clamp_min(torch.finfo(modes.dtype).tiny)
        return self.modes(modes / lengths, torch.float16), lengths

    def lanes(self, count: int) -> int:
        """Threads that work on one result: `count` of a GPU, one of a CPU."""
        return count if self.device.is_cuda else 1

    def whole_blocks(self, threads: int, block: int = 128) -> int:
        """At least so many threads, those of whole blocks on a GPU: none of them leaves before it begins."""
        lanes = self.lanes(block)
        return -(-threads // lanes) * lanes

    def pack(self, kernel, dim: int | tuple[int, ...], arguments: Sequence, block: int = 128) -> wp.Launch:
        """A launch whose arguments are packed once; tensors among them are shown to Warp as they are."""
        inputs = [wp.from_torch(a) if isinstance(a, torch.Tensor) else a for a in arguments]
        return wp.launch(
            kernel, dim=dim, inputs=inputs, device=self.device, block_dim=self.lanes(block), record_cmd=True
        )
