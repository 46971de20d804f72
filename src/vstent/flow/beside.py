"""Work of the processor while a GPU computes: preparing what the GPU needs next, and finishing what it has computed."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from types import TracebackType
from typing import Final, Self, TypeVar

import numba

from vstent.flow.settings import Numerics

Result = TypeVar("Result")
SAFE_LAYERS: Final = ("omp", "tbb")
"""Threading layers of numba that allow parallel kernels in two threads at once."""


class Beside:
    """One thread for work beside a flow on a GPU. A flow on the processor has none, and all work is done in place.

    Leaving the context waits for the work, so that nothing that was finished is lost.

    Parameters
    ----------
    numerics : Numerics or None
        Numerical settings of the flow; None: no flow is computed.
    """

    def __init__(self, numerics: Numerics | None) -> None:
        self._is_on_gpu = numerics is not None and numerics.device_gpu
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        """Return this."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for the work."""
        if self._pool is not None:
            self._pool.shutdown()

    def do(self, work: Callable[[], Result]) -> Callable[[], Result]:
        """Begin work and return a function that waits for its result, or raises its error.

        Work is done in the order in which it is begun. In place its error is raised here.
        """
        if self._is_on_gpu and self._pool is None and _is_layer_safe():
            self._pool = ThreadPoolExecutor(1, "beside", numba.set_num_threads, (numba.get_num_threads(),))
        if self._pool is not None:
            return self._pool.submit(work).result
        result = work()
        return lambda: result


def _is_layer_safe() -> bool:
    """Return whether parallel kernels may run in two threads at once; False before the first of them has run."""
    with suppress(ValueError):
        return numba.threading_layer() in SAFE_LAYERS
    return False
