"""Handle Ctrl-C at the command line."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

UNBEARING: Final = ("numba", "llvmlite", "vtkmodules", "importlib", "_frozen_importlib", "_frozen_importlib_external")
"""Packages whose Python code is called from C code that an exception would corrupt or crash."""
BEARING: Final = "numba.cuda"
"""Part of these packages that may be interrupted: it waits for a GPU most of the time, in Python."""
AGAIN_S: Final = 0.05
"""Delay before a deferred Ctrl-C is raised again, in s."""


@contextmanager
def borne_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt on Ctrl-C only where it is safe: not while a kernel is compiled or a module is loaded.

    Nothing is changed off the main thread, or where Ctrl-C is ignored or has another handler.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or defer it where a frame belongs to a package that must not be interrupted."""
    while frame is not None:
        name = str(frame.f_globals.get("__name__"))
        if name.partition(".")[0] in UNBEARING and not name.startswith(BEARING):
            timer = threading.Timer(AGAIN_S, _again)
            timer.daemon = True
            timer.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _again() -> None:
    """Interrupt the main thread again, unless this handler is no longer installed."""
    main = threading.main_thread().ident
    if signal.getsignal(signal.SIGINT) is not _interrupt:
        return
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)
    else:  # Windows
        signal.raise_signal(signal.SIGINT)
