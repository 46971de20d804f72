"""Start child processes that run no code from the user's current folder, whatever its files are called."""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Final

SAFE: Final = {"PYTHONSAFEPATH": "1"}
"""Variable with which Python does not search the current folder for modules."""
_ONE_AT_A_TIME: Final = threading.Lock()
"""Lock of `spawning`, which changes the state of the whole process."""


def environment() -> dict[str, str]:
    """Return the environment of a child process: without the current folder, with the folder of this package."""
    package = Path(__file__).resolve().parents[1]
    # Folders of PYTHONPATH precede the standard library, which installed packages may not do.
    own = () if package.name.endswith("-packages") else (str(package),)
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)  # an empty entry is the current folder
    return {**os.environ, **SAFE, "PYTHONPATH": os.pathsep.join(place for place in (*own, *given) if place)}


@contextmanager
def spawning() -> Iterator[None]:
    """Let `multiprocessing` start processes that skip the current folder and the script that this process runs.

    The functions and data that they get must not be defined in that script. It needs no ``if __name__ == "__main__"``.
    """
    with _ONE_AT_A_TIME:
        before, script = dict(os.environ), sys.modules["__main__"]
        os.environ.update(environment())
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name in (*SAFE, "PYTHONPATH"):
                os.environ.pop(name) if name not in before else os.environ.update({name: before[name]})
