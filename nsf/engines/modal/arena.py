"""Arrays and packed kernel launches on one device, shared by torch and Warp."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import warp as wp

from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.mpm import Precision

_ENTRIES = 2**19  # values of modes taken at once: what is held beside those of a solver is a few MiB


class Arena:
    """Allocates the arrays of packed launches, keeps them alive, and counts their bytes.

    Args:
        precision: of the floating-point arrays that are of the model.
        device: Warp device.

    Attributes:
        mode_bytes: of the modes that launches read.
    """

    def __init__(self, precision: Precision, device):
        self.precision, self.device = precision, device
        self.real, self._torch = torch_dtype(precision), torch_device(device)
        self.mode_bytes = 0
        self._buffers: list[torch.Tensor] = []
        self._tables: list[torch.Tensor] = []  # of others
        self._sides = [wp.Stream(device) for _ in range(3)] if device.is_cuda else []

    @contextmanager
    def concurrently(self, side: int) -> Iterator[None]:
        """Let launches inside run beside those that come after the block, until `meet` of that side."""
        if not self._sides:
            yield
            return
        self._sides[side].wait_stream(self.device.stream)
        with wp.ScopedStream(self._sides[side], sync_enter=False, sync_exit=False):
            yield

    def meet(self, side: int) -> None:
        """Wait, on the device, for what was launched beside."""
        if self._sides:
            self.device.stream.wait_stream(self._sides[side])

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(a.nbytes for a in self._buffers)

    def hold(self, values, dtype: torch.dtype) -> torch.Tensor:
        """The values as a contiguous array of this device."""
        tensor = torch.as_tensor(values).to(self._torch, dtype).contiguous()
        self._buffers.append(tensor)
        return tensor

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Zeros."""
        return self.hold(torch.zeros(shape, device=self._torch), dtype)

    def placed(self, table: torch.Tensor, rows: torch.Tensor, half: bool = True) -> dict[str, torch.Tensor]:
        """Modes of particles, their lengths and rows: arguments of the kernels with `make_combination`.

        A CPU reads those of the table where they are, which all solvers of a manifold share. A GPU takes them
        as of `modes`.

        Args:
            table: [P, c, K]; rows: [n] of the particles.
            half: whether a GPU has them as of `halved`.
        """
        none = self.zeros(1, dtype=self.real)  # modes over no lengths
        if self.device.is_cuda:
            modes, lengths = self.halved(table, rows) if half else (self.modes(table, rows), none)
            return {"modes": modes, "lengths": lengths, "rows": self.zeros(1, dtype=torch.int32)}
        stored = table.to(self._torch, torch.float32).contiguous()
        self.mode_bytes += len(rows) * stored[0].nbytes
        (self._tables if stored.data_ptr() == table.data_ptr() else self._buffers).append(stored)
        return {"modes": stored.flatten(), "lengths": none, "rows": self.hold(rows, torch.int32)}

    def modes(
        self,
        table: torch.Tensor,
        rows: torch.Tensor,
        dtype: torch.dtype = torch.float32,
        lengths: torch.Tensor | float = 1.0,
    ) -> torch.Tensor:
        """Modes of particles in vectors of four, in the order that the device reads best, flat.

        A GPU has the vectors of neighbouring particles side by side, [c, K/4, n, 4]; a CPU those of one
        particle, [n, c, K/4, 4]. They are taken part by part, so that nothing else of their size is held.

        Args:
            table: [P, c, K].
            rows: [n] of the particles.
            dtype: of what is held.
            lengths: [K], of which the modes are multiples then.
        """
        n, (c, K) = len(rows), table.shape[1:]
        four = -(-K // 4)
        shape = (c, four, n, 4) if self.device.is_cuda else (n, c, four, 4)
        stored = self.hold(torch.zeros(shape, dtype=dtype, device=self._torch), dtype)
        self.mode_bytes += stored.nbytes
        by_particle = stored.permute(2, 0, 1, 3) if self.device.is_cuda else stored
        for part in self._parts(table, rows):
            values = table[rows[part]].to(self._torch) / lengths
            by_particle[part] = torch.nn.functional.pad(values, (0, -K % 4)).unflatten(2, (four, 4)).to(dtype)
        return stored.flatten()

    def halved(self, table: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As `modes`, in half precision, each over the length [K] that is given beside them.

        A GPU reads them faster than anything else in a step; no entry exceeds 1, so that none is lost.
        """
        largest = [table[rows[part]].abs().amax((0, 1)) for part in self._parts(table, rows)]
        lengths = torch.stack(largest).amax(0).clamp_min(torch.finfo(table.dtype).tiny)
        lengths = self.hold(lengths, self.real)
        return self.modes(table, rows, torch.float16, lengths), lengths

    @staticmethod
    def _parts(table: torch.Tensor, rows: torch.Tensor) -> list[slice]:
        """Parts of the rows that are taken at once."""
        n, size = len(rows), max(1, _ENTRIES // max(1, table[0].numel()))
        return [slice(start, min(start + size, n)) for start in range(0, n, size)]

    def lanes(self, count: int) -> int:
        """Threads that work on one result: `count` of a GPU, one of a CPU."""
        return count if self.device.is_cuda else 1

    def whole_blocks(self, threads: int, block: int = 128) -> int:
        """At least so many threads, those of whole blocks on a GPU: none of them leaves before it begins."""
        lanes = self.lanes(block)
        return -(-threads // lanes) * lanes

    def pack(self, kernel, dim: int, block: int = 128, **arguments) -> wp.Launch:
        """A launch whose arguments are packed once; tensors among them are shown to Warp as they are.

        Args:
            kernel, dim, block: as for `wp.launch`; a block of a CPU is one thread.
            arguments: of the kernel by name, those of a struct as a dictionary.
        """
        kinds = kernel.func.__annotations__
        if kinds.keys() != arguments.keys():
            raise TypeError(f"{kernel.key} takes {', '.join(kinds)}, not {', '.join(arguments)}")
        inputs = [_shown(kind, arguments[name]) for name, kind in kinds.items()]
        return wp.launch(
            kernel, dim=dim, inputs=inputs, device=self.device, block_dim=self.lanes(block), record_cmd=True
        )


def _shown(kind, value):
    """A kernel's argument: a tensor as Warp's array, a dictionary as the struct of its kind."""
    if isinstance(value, torch.Tensor):
        return wp.from_torch(value)
    if not isinstance(value, dict):
        return value
    filled = kind()
    for name, part in value.items():
        setattr(filled, name, _shown(None, part))
    return filled
