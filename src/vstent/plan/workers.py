"""Apply one function to many items, in this process or in several; results keep the order of the items.

Processes are used instead of threads because compiled kernels that run in parallel must not be called from two threads.
"""

import multiprocessing
import os
import pickle
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Final, TypeVar

from vstent.children import spawning
from vstent.errors import VstentError

Item = TypeVar("Item")
Answer = TypeVar("Answer")

_SHARED: Final[dict[str, Any]] = {}
"""Function and common data that a worker process keeps between items."""


def spread(
    work: Callable[[Any, Item], Answer], common: Any, items: Sequence[Item], *, jobs: int = 1, niceness: int = 0
) -> Iterator[Answer]:
    """Yield ``work(common, item)`` for every item, in order; `work` is a function at the top level of a module.

    The data that all items need, `common`, are sent to each of the `jobs` processes once. With one job the work is done
    in this process. Other processes yield to more urgent ones by their `niceness`. A VstentError says that a process
    ended unexpectedly.
    """
    if jobs <= 1 or len(items) <= 1:
        yield from (work(common, item) for item in items)
        return
    # Processes are spawned because a fork copies locks that other threads hold.
    context = multiprocessing.get_context("spawn")
    # A TemporaryDirectory would warn where this generator is collected before its end.
    folder = Path(tempfile.mkdtemp(prefix="vstent-"))
    try:
        # Passed in a file: data too long for a pipe would block this process forever if a worker died
        # before reading them.
        path = folder / "common.pickle"
        path.write_bytes(pickle.dumps((work, common)))
        with spawning():
            pool = ProcessPoolExecutor(min(jobs, len(items)), context, _start, (path, niceness))
            answers = pool.map(_answer, items)
        try:
            yield from answers
        except BrokenProcessPool as error:
            raise VstentError(
                "a worker process ended (killed, or out of memory): give the same command again with fewer jobs"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _start(path: Path, niceness: int) -> None:
    """Store the function and the common data in a new worker process."""
    import numba

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C
    numba.set_num_threads(1)
    if hasattr(os, "nice"):  # not on Windows
        os.nice(niceness)
    work, common = pickle.loads(path.read_bytes())
    _SHARED.update(work=work, common=common)


def _answer(item: Any) -> Any:
    """Return the result for one item."""
    return _SHARED["work"](_SHARED["common"], item)
