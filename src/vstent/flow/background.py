"""Work of the processor while a GPU computes: preparing what the GPU needs next, and finishing what it has computed."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import TypeVar

import numba

from vstent.flow.settings import Numerics

Result = TypeVar("Result")


class BackgroundWork(ExitStack):
    """One thread for work while a GPU computes a flow. A flow on the processor has none: all work is done in place.

    Without numerical settings no flow is computed. Leaving the context waits for the work, so that nothing that was
    finished is lost.
    """

    def __init__(self, numerics: Numerics | None) -> None:
        super().__init__()
        self._is_on_gpu = numerics is not None and numerics.device_gpu
        self._pool: ThreadPoolExecutor | None = None

    def begin(self, work: Callable[[], Result]) -> Callable[[], Result]:
        """Begin work and return a function that waits for its result, or raises its error.

        Work is done in the order in which it is begun. In place its error is raised here.
        """
        with suppress(ValueError):  # raised before the first parallel kernel has run
            # These layers allow parallel kernels in two threads at once.
            if self._is_on_gpu and self._pool is None and numba.threading_layer() in ("omp", "tbb"):
                threads = numba.get_num_threads()
                pool = ThreadPoolExecutor(1, "background", numba.set_num_threads, (threads,))
                self._pool = self.enter_context(pool)
        if self._pool is not None:
            return self._pool.submit(work).result
        result = work()
        return lambda: result
