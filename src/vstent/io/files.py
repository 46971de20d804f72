"""File kinds, folders of files, and writing that leaves no half-written files."""

import gzip
import os
import re
import secrets
import shutil
import tempfile
import threading
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedIOBase
from pathlib import Path, PureWindowsPath
from typing import Final

from vstent.errors import ReadError

SURFACE_SUFFIXES: Final = (".stl", ".vtp", ".vtk", ".vtu", ".vtm", ".obj", ".ply")
"""Suffixes of surface files."""
NIFTI_SUFFIXES: Final = (".nii", ".nii.gz")
"""Suffixes of NIfTI files."""
RAW_SUFFIXES: Final = (".raw", ".raw.gz")
"""Suffixes of voxels without a header; their number and spacing must be given."""
PAIR_SUFFIXES: Final = (".hdr", ".img")
"""Suffixes of the header and of the voxels of a NIfTI or Analyze image of two files."""
IMAGE_SUFFIXES: Final = (
    *(*NIFTI_SUFFIXES, *PAIR_SUFFIXES, ".nrrd", ".nhdr", ".mha", ".mhd"),
    *(".vti", ".vtr", *RAW_SUFFIXES, ".dcm"),
)
"""Suffixes of scans."""
CACHE: Final = ".vstent"
"""Subfolder by which a folder of results is recognized; it holds the store of finished stages, and the lock."""
_VTK_IMAGE: Final = re.compile(rb"^\s*DATASET\s+(STRUCTURED_POINTS|RECTILINEAR_GRID)", re.I | re.M)
"""Line of a legacy VTK file that holds an image."""
PARTIAL: Final = ".partial-"
"""Prefix of the name of a file that is being written; the process number follows."""
DAMAGE: Final = (OSError, EOFError, zlib.error)
"""Exceptions that reading a damaged gzip file raises."""
_ONE_AT_A_TIME: Final = threading.RLock()
"""Lock of `silenced`."""


def is_surface_file(path: Path) -> bool:
    """Return whether a path has the suffix of a surface file, and is no image in legacy VTK format."""
    return suffix(path) in SURFACE_SUFFIXES and not is_vtk_image(path)


def is_vtk_image(path: Path) -> bool:
    """Return whether a file is an image in legacy VTK format (``.vtk``), which may hold a surface too."""
    if suffix(path) != ".vtk" or not path.is_file():
        return False
    with path.open("rb") as file:
        return _VTK_IMAGE.search(file.read(4096)) is not None


def suffix(path: Path) -> str:
    """Return the suffix of a path in lower case; ``.gz`` includes the suffix before it."""
    suffixes = [s.lower() for s in Path(path).suffixes]
    return "".join(suffixes[-2:]) if suffixes[-1:] == [".gz"] else "".join(suffixes[-1:])


def existing(path: Path) -> Path:
    """Return the path of a file or folder that exists.

    ReadError is raised where it does not, where its name is not text, and for something else, such as a named pipe, on
    which reading would wait forever.
    """
    path = Path(path)
    if not path.exists():
        raise ReadError(f"{path} does not exist: check the path.")
    if any("\udc80" <= letter <= "\udcff" for letter in str(path)):
        raise ReadError(f"{path} has a name that is not text in this system's encoding. Rename it.")
    if not (path.is_file() or path.is_dir()):
        raise ReadError(f"{path} is neither a file nor a folder. Give a scan or a surface.")
    return path


def beside(path: Path, name: str, what: str = "file") -> Path:
    """Return the path of a file that another one names; ReadError is raised where it is not beside that or below."""
    # PureWindowsPath knows the separators and roots of all systems.
    if PureWindowsPath(name).anchor or ".." in PureWindowsPath(name).parts:
        raise ReadError(f"{path.name} names the {what} {name[:80]}. Only files beside it or below are read.")
    return path.parent / name


def files_in(folder: Path) -> list[Path]:
    """Return the files below a folder, sorted, without hidden ones and without those of folders of results."""
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name[0] != "." and not Path(place, name, CACHE).is_dir()]
        found += [Path(place, name) for name in names if name[0] != "."]
    return sorted(found)


@contextmanager
def unpacked(path: Path) -> Iterator[BufferedIOBase]:
    """Open a file for reading; where it begins like a gzip file, its unpacked content is read, whatever its name."""
    with path.open("rb") as file:
        is_packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        with gzip.open(file) if is_packed else file as content:
            yield content


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


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, which is complete or does not exist."""
    with atomic(path) as partial:
        partial.write_bytes(content)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `folder` on success and is removed on failure."""
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield building
        building.chmod(0o755)
        shutil.rmtree(folder, ignore_errors=True)
        building.replace(folder)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def sweep(folder: Path) -> None:
    """Remove half-written files of killed processes from a folder and four levels below it."""
    for depth in range(5):
        for partial in folder.glob(f"{'*/' * depth}{PARTIAL}*"):
            try:
                os.kill(int(partial.name[len(PARTIAL) :].partition("-")[0]), 0)
            except (ProcessLookupError, ValueError):
                if partial.is_file():
                    partial.unlink(missing_ok=True)
            except OSError:
                continue  # the process is running, for another user


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


# -- sizes and dates of files, by which unchanged files are recognized without reading them ----------------------------

State = list[int] | None
"""Size in bytes and date of the last change in ns; None: there is no such file."""


def state_of(file: Path) -> State:
    """Return the state of a file."""
    with suppress(OSError):
        state = file.stat()
        return [state.st_size, state.st_mtime_ns]
    return None


def states_of(folder: Path, names: Iterable[str]) -> dict[str, State]:
    """Return the states of files of a folder by name."""
    return {name: state_of(folder / name) for name in names}


def program_states() -> dict[str, State]:
    """Return the states of the program's own files, by their path in the package."""
    root = Path(__file__).parents[1]
    files = sorted(root.rglob("*.py")) + sorted(root.rglob("*.toml"))
    return states_of(root, (str(file.relative_to(root)) for file in files))
