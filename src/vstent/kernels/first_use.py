"""First use of compiled kernels: report that kernels are being compiled, and compile them in a second process."""

import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from numba.core import event

from vstent.children import environment


class _Listener(event.Listener):
    """Calls a function when a compilation begins."""

    def __init__(self, call: Callable[[], None]) -> None:
        """Store the function."""
        self._call = call

    def on_start(self, event: event.Event) -> None:
        """Call the function."""
        self._call()

    def on_end(self, event: event.Event) -> None:
        """Do nothing."""


class _NotCachedError(Exception):
    """A kernel is missing from numba's cache and would be compiled."""


@contextmanager
def reporting_compilation(report: Callable[[], None], *, helper: Sequence[str] = ()) -> Iterator[None]:
    """Call `report` once when a kernel has to be compiled because numba's cache does not hold it.

    Then also start the command `helper`, a second process that compiles further kernels until this block ends. Threads
    of one process cannot compile at the same time, but this process uses whatever the helper has put in numba's cache.
    """
    calls = [report]
    processes: list[subprocess.Popen[bytes]] = []

    def begin() -> None:
        if not calls:
            return
        calls.pop()()
        if helper:
            silent = subprocess.DEVNULL
            processes.append(subprocess.Popen(helper, env=environment(), stdin=silent, stdout=silent, stderr=silent))

    try:
        with event.install_listener("numba:compile", _Listener(begin)):
            yield
    finally:
        for process in processes:  # the kernels that it has finished stay in the cache
            process.terminate()
            process.wait()


def ensure_cached(call: Callable[[], None], command: Sequence[str]) -> None:
    """Make sure that the kernels which `call` runs are loaded from numba's cache.

    If one is missing, another process compiles it by running `command`. Where the cache cannot be written, this process
    compiles at the next call.
    """
    thread = threading.get_ident()

    def refuse() -> None:
        if threading.get_ident() == thread:
            raise _NotCachedError

    try:
        with event.install_listener("numba:compile", _Listener(refuse)):
            call()
    except _NotCachedError:
        subprocess.run(command, env=environment(), stdin=subprocess.DEVNULL, capture_output=True, check=False)
