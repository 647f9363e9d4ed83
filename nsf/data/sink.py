"""Where HDF5 writes, so that a full disk is an error and not a crash."""

import io
import os
from types import TracebackType
from typing import Any

import numpy as np


class Sink(io.FileIO):
    """A file that keeps its faults from HDF5, which crashes in closing a file it failed to write.

    After a fault (a full disk, an interrupt) writes are dropped; `settle` raises it once HDF5 is done.
    """

    _fault: BaseException | None = None

    def write(self, data: Any) -> int:
        """Write all of `data`, or note why not."""
        rest = memoryview(data).cast("B")
        try:
            while rest and self._fault is None:
                rest = rest[super().write(rest) :]
        except BaseException as fault:
            self._fault = fault
        return len(data)

    def place(self, data: np.ndarray, offset: int) -> None:
        """Write a contiguous array where HDF5 has reserved its place, past HDF5's lock.

        Args:
            data: C-contiguous.
            offset: from the file's beginning [byte].

        Raises:
            OSError: the disk refused it; no call of HDF5 on this file is under way that could be hurt.
        """
        rest = memoryview(data).cast("B")
        while rest:
            written = os.pwrite(self.fileno(), rest, offset)
            rest, offset = rest[written:], offset + written

    def truncate(self, size: int | None = None) -> int:
        """Set the size, or note why not."""
        try:
            return super().truncate(size)
        except BaseException as fault:
            self._fault = self._fault or fault
            return 0

    def settle(
        self,
        kind: type[BaseException] | None = None,
        error: BaseException | None = None,
        trace: TracebackType | None = None,
    ) -> None:
        """Raise what was noted, unless an exception is on its way already."""
        if self._fault is not None and error is None:
            raise self._fault
