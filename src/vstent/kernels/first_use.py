"""First use: tell that kernels are being compiled, where none are kept from before."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event


@contextmanager
def telling(tell: Callable[[], None]) -> Iterator[None]:
    """Have `tell` called once, when a kernel is about to be compiled for want of a kept one."""
    with event.install_listener("numba:compile", _Once(tell)):
        yield


class _Once(event.Listener):
    """Tells of the first compilation."""

    def __init__(self, tell: Callable[[], None]) -> None:
        """Keep whom to tell."""
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: event.Event) -> None:
        """Tell, the first time."""
        tell, self._tell = self._tell, None
        if tell is not None:
            tell()

    def on_end(self, event: event.Event) -> None:
        """Say nothing."""
