"""Workers: the same work on many items, in this process or in several at once; answers come in the items' order.

Processes and not threads: compiled kernels that run in parallel themselves do not bear being called from two threads.
"""

import multiprocessing
import pickle
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeVar

from vstent.errors import VstentError

Item = TypeVar("Item")
Answer = TypeVar("Answer")

_SHARED: Final[dict[str, Any]] = {}
"""What a worker process keeps between items: what it was started with."""


def spread(
    work: Callable[[Any, Item], Answer], common: Any, items: Sequence[Item], *, jobs: int = 1
) -> Iterator[Answer]:
    """Yield ``work(common, item)`` for every item, in their order.

    Parameters
    ----------
    work : a function at the top of a module.
    common : what all items need; it is sent to every process once.
    items : what to work on.
    jobs : processes; 1 works in this one.

    Raises
    ------
    VstentError
        When a process dies.
    """
    if jobs <= 1 or len(items) <= 1:
        yield from (work(common, item) for item in items)
        return
    # Spawned, not forked: a fork copies locks that other threads hold.
    context = multiprocessing.get_context("spawn")
    with TemporaryDirectory() as folder:
        # In a file: what is too long for a pipe blocks this process for ever where a new one dies before it reads it.
        path = Path(folder) / "common.pickle"
        path.write_bytes(pickle.dumps((work, common)))
        pool = ProcessPoolExecutor(min(jobs, len(items)), context, _start, (path,))
        try:
            yield from pool.map(_answer, items)
        except BrokenProcessPool as error:
            raise VstentError(
                "a worker process ended (killed, or out of memory): give the same command again with fewer jobs"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _start(path: Path) -> None:
    import numba

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the first process's to answer
    numba.set_num_threads(1)
    work, common = pickle.loads(path.read_bytes())
    _SHARED.update(work=work, common=common)


def _answer(item: Any) -> Any:
    return _SHARED["work"](_SHARED["common"], item)
