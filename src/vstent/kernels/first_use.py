"""First use of compiled kernels: report that kernels are being compiled, and compile them in a second process."""

import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from numba.core import event

from vstent.children import environment


@contextmanager
def telling(tell: Callable[[], None], *, helper: Sequence[str] = ()) -> Iterator[None]:
    """Call `tell` once when a kernel has to be compiled because numba's cache does not hold it.

    Parameters
    ----------
    tell : called at the first compilation.
    helper : command of a second process that compiles further kernels until this block ends. Threads of one process
        cannot compile at the same time, but this process uses whatever the helper has put in numba's cache by then.
    """
    once = _Once(tell, tuple(helper))
    try:
        with event.install_listener("numba:compile", once):
            yield
    finally:
        once.stop()


def kept(call: Callable[[], None], command: Sequence[str]) -> None:
    """Make sure that the kernels which `call` runs are loaded from numba's cache.

    If one is missing, another process compiles it. Where the cache cannot be written, this process compiles at the next
    call.

    Parameters
    ----------
    call : runs the kernels.
    command : command of a process that compiles them.
    """
    try:
        with event.install_listener("numba:compile", _Refusal()):
            call()
    except _Unkept:
        subprocess.run(command, env=environment(), stdin=subprocess.DEVNULL, capture_output=True, check=False)


class _Unkept(Exception):
    """A kernel is missing from numba's cache and would be compiled."""


class _Refusal(event.Listener):
    """Prevents compilation in this thread."""

    def __init__(self) -> None:
        """Store the present thread."""
        self._thread = threading.get_ident()

    def on_start(self, event: event.Event) -> None:
        """Raise `_Unkept` in this thread."""
        if threading.get_ident() == self._thread:
            raise _Unkept

    def on_end(self, event: event.Event) -> None:
        """Do nothing."""


class _Once(event.Listener):
    """Reports the first compilation and starts the helper process."""

    def __init__(self, tell: Callable[[], None], command: tuple[str, ...]) -> None:
        """Store the callback and the command."""
        self._tell: Callable[[], None] | None = tell
        self._command = command
        self._helper: subprocess.Popen[bytes] | None = None

    def on_start(self, event: event.Event) -> None:
        """Call the callback and start the helper, the first time."""
        tell, self._tell = self._tell, None
        if tell is None:
            return
        tell()
        if self._command:
            silent = subprocess.DEVNULL
            self._helper = subprocess.Popen(
                self._command, env=environment(), stdin=silent, stdout=silent, stderr=silent
            )

    def on_end(self, event: event.Event) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Stop the helper; the kernels that it has finished stay in the cache."""
        if self._helper is not None:
            self._helper.terminate()
            self._helper.wait()
