"""First use: tell that kernels are being compiled, where none are kept from before, and have help with it."""

import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from numba.core import event


@contextmanager
def telling(tell: Callable[[], None], *, helper: Sequence[str] = ()) -> Iterator[None]:
    """Have `tell` called once, when a kernel is about to be compiled for want of a kept one.

    `helper` is the command of a second process that then compiles others, as far as it gets before this ends: numba
    takes from its cache what is there by the time that it is needed, and threads of one process cannot compile at once.
    """
    once = _Once(tell, tuple(helper))
    try:
        with event.install_listener("numba:compile", once):
            yield
    finally:
        once.stop()


def kept(call: Callable[[], None], command: Sequence[str]) -> None:
    """See that the kernels which `call` runs are those of numba's cache: what it lacks another process compiles.

    `command` is that process. Where its work cannot be kept, this process compiles at the next call.
    """
    try:
        with event.install_listener("numba:compile", _Refusal()):
            call()
    except _Unkept:
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)


class _Unkept(Exception):
    """Numba is about to compile."""


class _Refusal(event.Listener):
    """Keeps this thread from compiling."""

    def __init__(self) -> None:
        """Remember the thread."""
        self._thread = threading.get_ident()

    def on_start(self, event: event.Event) -> None:
        """Refuse."""
        if threading.get_ident() == self._thread:
            raise _Unkept

    def on_end(self, event: event.Event) -> None:
        """Say nothing."""


class _Once(event.Listener):
    """Reports the first compilation."""

    def __init__(self, tell: Callable[[], None], command: tuple[str, ...]) -> None:
        """Keep whom to tell, and what to start."""
        self._tell: Callable[[], None] | None = tell
        self._command = command
        self._helper: subprocess.Popen[bytes] | None = None

    def on_start(self, event: event.Event) -> None:
        """Tell, the first time."""
        tell, self._tell = self._tell, None
        if tell is None:
            return
        tell()
        if self._command:
            silent = subprocess.DEVNULL
            self._helper = subprocess.Popen(self._command, stdin=silent, stdout=silent, stderr=silent)

    def on_end(self, event: event.Event) -> None:
        """Say nothing."""

    def stop(self) -> None:
        """End the helper, wherever it is: what it has compiled is kept."""
        if self._helper is not None:
            self._helper.terminate()
            self._helper.wait()
