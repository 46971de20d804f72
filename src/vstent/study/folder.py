"""The case folder: one process at a time works in it, and it is never left half-made."""

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
"""Folder inside the case folder that holds finished stages, and the lock."""

Given = ParamSpec("Given")
Found = TypeVar("Found")
Study = Callable[Concatenate[Path, Path, Given], Found]
"""Takes an input and a case folder, and more."""


def claiming(study: Study[Given, Found]) -> Study[Given, Found]:
    """Let a study have its case folder (the second argument) for itself while it runs."""

    @wraps(study)
    def alone(path: Path, out: Path, /, *args: Given.args, **given: Given.kwargs) -> Found:
        with claimed(Path(out)):
            return study(Path(path), Path(out), *args, **given)

    return alone


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Keep other processes out of a case folder; folders that were made for it go again if they stay empty.

    What a process that was killed has left half-written there is taken away.

    Raises
    ------
    FolderError
        Another process works there, or the folder cannot be written to.
    """
    cache = out / CACHE
    made = [folder for folder in (cache, out, *out.parents) if not folder.exists()]
    try:
        cache.mkdir(parents=True, exist_ok=True)
        lock = _locked(cache / "lock")
    except OSError as error:
        _drop(made)
        raise FolderError(f"{out} cannot be written ({error.strerror}): give another --out") from None
    try:
        sweep(out)
        yield
    finally:
        (cache / "lock").unlink(missing_ok=True)
        lock.close()
        _drop([cache, *made[1:]])


def _drop(folders: list[Path]) -> None:
    """Remove folders, innermost first, as far as they are empty."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def _locked(path: Path) -> IO[str]:
    """Lock a file until it is closed or the process dies, however it dies."""
    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            _lock(file, path)
            is_there = path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())
        except BaseException:
            file.close()
            raise
        if is_there:  # and not taken away by a process that ended just now
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}")
            file.flush()
            return file
        file.close()


def _lock(file: IO[str], path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: two processes are not kept apart there
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        who = file.read().strip() or "another process"
        raise FolderError(
            f"{path.parent.parent} is in use by {who}: wait until that run ends, or give another --out"
        ) from None
