"""File kinds by suffix, and writing that leaves no half-written files."""

import os
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from vstent.errors import ReadError

SURFACE_SUFFIXES: Final = (".stl", ".vtp", ".vtk", ".vtu", ".vtm", ".obj", ".ply")
"""Suffixes of surface files."""
NIFTI_SUFFIXES: Final = (".nii", ".nii.gz")
"""Suffixes of NIfTI files."""
RAW_SUFFIXES: Final = (".raw", ".raw.gz")
"""Suffixes of voxels without a header; their number and spacing must be given."""
IMAGE_SUFFIXES: Final = (*NIFTI_SUFFIXES, ".nrrd", ".nhdr", ".mha", ".mhd", ".vti", *RAW_SUFFIXES, ".dcm")
"""Suffixes of scans."""
PARTIAL: Final = ".partial-"
"""Prefix of the name of a file that is being written; the process number follows."""
_ONE_AT_A_TIME: Final = threading.RLock()
"""Lock of `silenced`."""


def is_surface_file(path: Path) -> bool:
    """Return whether a path has the suffix of a surface file."""
    return suffix(path) in SURFACE_SUFFIXES


def suffix(path: Path) -> str:
    """Return the suffix of a path in lower case; ``.gz`` includes the suffix before it."""
    suffixes = [s.lower() for s in Path(path).suffixes]
    return "".join(suffixes[-2:]) if suffixes[-1:] == [".gz"] else "".join(suffixes[-1:])


def existing(path: Path) -> Path:
    """Return the path of a file or folder that exists.

    Raises
    ------
    ReadError
        The path does not exist.
    """
    path = Path(path)
    if not path.exists():
        raise ReadError(f"{path} does not exist: check the path.")
    return path


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; it is renamed to `path` on success and removed on failure."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    name = path.parent / f"{PARTIAL}{os.getpid()}-{secrets.token_hex(8)}{path.suffix}"
    name.touch(exist_ok=False)
    try:
        yield name
        os.replace(name, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(name)


def sweep(folder: Path) -> None:
    """Remove half-written files of killed processes from a folder and two levels below it."""
    for depth in ("", "*/", "*/*/"):
        for partial in folder.glob(f"{depth}{PARTIAL}*"):
            if partial.is_file() and not _is_running(partial.name[len(PARTIAL) :].partition("-")[0]):
                partial.unlink(missing_ok=True)


def _is_running(process: str) -> bool:
    """Return whether the process with this number is running."""
    if not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


@contextmanager
def silenced() -> Iterator[None]:
    """Discard what C and C++ libraries write to standard error; vstent reports its own errors.

    Standard error belongs to the whole process, so only one thread at a time may discard it.
    """
    with _ONE_AT_A_TIME:
        saved = os.dup(2)
        sink = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(sink, 2)
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            os.close(sink)
