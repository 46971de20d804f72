"""Case folder: a lock that admits one process at a time, and removal of incomplete files."""

import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import IO, Concatenate, Final, ParamSpec, TypeVar

from vstent.errors import FolderError
from vstent.io.files import sweep

CACHE: Final = ".vstent"
"""Name of the folder inside the case folder that contains finished stages and the lock."""

Given = ParamSpec("Given")
Found = TypeVar("Found")
Study = Callable[Concatenate[Path, Path, Given], Found]
"""A function of an input path, a case folder and further arguments."""


def claiming(study: Study[Given, Found]) -> Study[Given, Found]:
    """Return the function with its case folder (second argument) locked while it runs."""

    @wraps(study)
    def alone(path: Path, out: Path, /, *args: Given.args, **given: Given.kwargs) -> Found:
        with claimed(Path(out)):
            return study(Path(path), Path(out), *args, **given)

    return alone


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Lock a case folder while the context is active.

    The folder is created where needed, and removed at the end if it is still empty. Incomplete files of a killed
    process are deleted.

    Raises
    ------
    FolderError
        Another process uses the folder, or it cannot be written to.
    """
    cache = out / CACHE
    made = [folder for folder in (cache, out, *out.parents) if not folder.exists()]
    try:
        cache.mkdir(parents=True, exist_ok=True)
        lock = _locked(cache / "lock")
    except OSError as error:
        _drop(made)
        raise FolderError(f"{out} cannot be written to ({error.strerror}): choose another folder (--out).") from None
    try:
        sweep(out)
        yield
    finally:
        (cache / "lock").unlink(missing_ok=True)
        lock.close()
        _drop([cache, *made[1:]])


def _drop(folders: list[Path]) -> None:
    """Delete folders, innermost first, up to the first that is not empty."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def _locked(path: Path) -> IO[str]:
    """Return the locked and opened file; the lock ends when it is closed or the process ends."""
    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            _lock(file, path)
            is_there = path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())
        except BaseException:
            file.close()
            raise
        if is_there:  # otherwise a process that has just ended deleted it
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}")
            file.flush()
            return file
        file.close()


def _lock(file: IO[str], path: Path) -> None:
    """Lock a file; raise FolderError where another process holds the lock."""
    try:
        import fcntl
    except ImportError:  # Windows: no lock there
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        who = file.read().strip() or "another process"
        raise FolderError(
            f"{path.parent.parent} is in use by {who}: wait until that run ends, or choose another folder (--out)."
        ) from None
