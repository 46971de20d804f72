"""Arrays of a GPU read back to the host: through pinned memory, on a stream of their own."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray


class ReadBack:
    """Copies of some arrays of a GPU, through buffers on the host that are allocated at the first use."""

    def __init__(self, arrays: Sequence[Any]) -> None:
        """Keep the arrays of the GPU."""
        self._arrays = tuple(arrays)
        self._buffers: tuple[NDArray[Any], ...] = ()
        self._stream, self._written = cuda.stream(), cuda.event()
        self._read = [cuda.event() for _ in arrays]

    def after(self, stream: Any) -> Iterator[NDArray[Any]]:
        """Yield each array as it is after what a stream has queued; later arrays are on their way meanwhile."""
        self._buffers = self._buffers or tuple(_pinned(array) for array in self._arrays)
        self._written.record(stream)
        self._written.wait(self._stream)
        for array, buffer, read in zip(self._arrays, self._buffers, self._read, strict=True):
            array.copy_to_host(buffer, stream=self._stream)
            read.record(self._stream)
        for buffer, read in zip(self._buffers, self._read, strict=True):
            read.synchronize()
            yield buffer.copy()


def _pinned(array: Any) -> NDArray[Any]:
    """Return a buffer on the host for an array of the GPU; ordinary memory where the system pins no more."""
    try:
        return np.asarray(cuda.pinned_array(array.shape, array.dtype))
    except Exception:  # noqa: BLE001 drivers and packages each have their own exception classes
        return np.zeros(array.shape, array.dtype)
