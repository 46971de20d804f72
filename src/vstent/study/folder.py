"""Reserve a case folder for one process, and leave no half-written files in it."""

import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final

from vstent.errors import FolderError, ReadError
from vstent.io.files import CACHE as CACHE, sweep
from vstent.study.store import UNREADABLE

RUN: Final = "run.json"
"""File of the case folder with the provenance of the run."""
INPUT: Final = "input.json"
"""File in the cache folder with the path of the input; not for sharing, because the path may name the patient."""
METRICS: Final = "metrics.json"
"""File of the case folder with all metrics."""
LAYOUT: Final = 3
"""Number of the layout of case folders, as stated by the files `RUN` and `INPUT`."""
LOCK: Final = "lock"
"""File in that folder while a process uses the case folder, or has been killed."""

TREATMENTS: Final = "treatments"
"""Subfolder of the case folder with a folder for every treatment."""


def implant_folder(out: Path, treatment: str, implant: str) -> Path:
    """Return the folder of a deployed implant in a case folder."""
    return out / TREATMENTS / treatment / "implants" / implant


def straightened_folder(out: Path, treatment: str) -> Path:
    """Return the folder of the artery that has yielded to a treatment in a case folder."""
    return out / TREATMENTS / treatment / "straightened"


def flow_folder(out: Path, treatment: str) -> Path:
    """Return the folder of the flow with a treatment in a case folder."""
    return out / TREATMENTS / treatment / "flow"


def refuse_older(out: Path, remedy: str = "Give another --out, or delete that folder.") -> None:
    """Raise ReadError where a folder is a case folder of another layout."""
    for path in (out / CACHE / INPUT, out / RUN):
        with suppress(*UNREADABLE):
            if json.loads(path.read_text(encoding="utf-8")).get("layout") != LAYOUT:
                raise ReadError(f"{out} was written by an older version of vstent. {remedy}")


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Reserve a case folder for this process.

    Files that a killed process left half-written there are removed. Folders created here are removed at the end if they
    are empty. FolderError is raised where another process uses the folder or it cannot be written, and ReadError where
    it is a case folder of an older version.
    """
    refuse_older(out)
    cache = out / CACHE
    made = [folder for folder in (cache, out, *out.parents) if not folder.exists()]
    try:
        cache.mkdir(parents=True, exist_ok=True)
        lock = _locked(cache / LOCK)
    except OSError as error:
        _drop(made)
        raise FolderError(f"{out} cannot be written ({error.strerror}): give another --out") from None
    try:
        sweep(out)
        yield
        if os.fstat(lock.fileno()).st_nlink == 0:
            raise FolderError(f"{out} was removed while this run wrote to it, and is not complete: run it again")
    finally:
        (cache / LOCK).unlink(missing_ok=True)
        lock.close()
        _drop([cache, *made[1:]])


def _drop(folders: list[Path]) -> None:
    """Remove folders, the innermost first, until one is not empty."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def _locked(path: Path) -> IO[str]:
    """Return a file that is locked until it is closed or the process ends for any reason."""
    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            with suppress(ImportError):  # Windows has no such locks, so two processes may use the folder at once
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                file.truncate(0)
                file.write(f"process {os.getpid()} on {platform.node()}")
                file.flush()
                return file
        except BlockingIOError:
            file.seek(0)
            who = file.read().strip() or "another process"
            file.close()
            raise FolderError(
                f"{path.parent.parent} is in use by {who}: wait until that run ends, or give another --out"
            ) from None
        except BaseException:
            file.close()
            raise
        file.close()  # a process that ended has removed the file, perhaps between opening and locking
