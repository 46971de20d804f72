"""Ctrl-C at the command line."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

UNBEARING: Final = ("numba", "llvmlite", "vtkmodules", "importlib", "_frozen_importlib", "_frozen_importlib_external")
"""Packages whose Python code is called by C code that an exception leaves in disorder, or crashes."""
BEARING: Final = "numba.cuda"
"""What of them waits for a GPU most of the time, in Python."""
AGAIN_S: Final = 0.05
"""Time until an interrupt that could not be borne comes back."""


@contextmanager
def borne_interrupts() -> Iterator[None]:
    """Have Ctrl-C raise KeyboardInterrupt only where that can be borne: not while a kernel or a module is loaded.

    Where Ctrl-C is ignored or answered by another, and off the main thread, nothing is changed.
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
    if not _is_borne(frame):
        again = threading.Timer(AGAIN_S, _again)
        again.daemon = True
        again.start()
        return
    raise KeyboardInterrupt


def _is_borne(frame: FrameType | None) -> bool:
    """Tell whether neither a frame nor any that called it is of a package that does not bear exceptions."""
    while frame is not None:
        name = str(frame.f_globals.get("__name__"))
        if name.partition(".")[0] in UNBEARING and not name.startswith(BEARING):
            return False
        frame = frame.f_back
    return True


def _again() -> None:
    """Interrupt the main thread, wherever it waits, unless what was to be interrupted is over."""
    if signal.getsignal(signal.SIGINT) is not _interrupt:
        return
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)
    else:  # Windows
        signal.raise_signal(signal.SIGINT)
