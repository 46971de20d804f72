"""Receive uploaded files: check names and sizes, unpack archives, and remove patient data.

A complete file is moved to the subfolder ``input`` of the case folder. DICOM slices are rewritten without patient data
and numbered, because their names may be a patient's too. Archives are unpacked up to a size limit; the paths in them
are not used.
"""

import gzip
import shutil
import zipfile
import zlib
from pathlib import Path
from typing import Final

from vstent.errors import ReadError
from vstent.io.dicom import is_dicom
from vstent.io.dicom_strip import strip_dicom
from vstent.io.files import IMAGE_SUFFIXES, SURFACE_SUFFIXES, suffix

FOLDER: Final = "input"
"""Subfolder of the case folder for uploaded files."""
SERIES: Final = "series"
"""Subfolder of it for DICOM slices."""
UNPACKED_LIMIT: Final = 4 << 30
"""Largest unpacked size of an archive or compressed file, in bytes."""
MOST_FILES: Final = 5000
"""Largest number of slices of a case, and of files in an archive."""
LONGEST_NAME: Final = 120
"""Largest number of characters of a file name."""
_BLOCK: Final = 1 << 20
"""Number of bytes read at a time."""
_TOO_MUCH: Final = (
    f"The archive holds more than {UNPACKED_LIMIT >> 30} GB or {MOST_FILES} files, which is too much. Drop a "
    "smaller one."
)
"""Message for an archive that is too large."""


def checked_name(name: str) -> str:
    """Return the name of an upload if it is a plain name of a file that can be read.

    Raises ReadError: the name is a path, hidden, too long, or of an unsupported kind.
    """
    is_plain = name and not any(mark in name for mark in ("/", "\\", "\0")) and not name.startswith(".")
    if not is_plain or len(name) > LONGEST_NAME or not name.isprintable():
        raise ReadError("This file name cannot be used. Rename the file and drop it again.")
    kind = suffix(Path(name))
    has_kind = kind in (*SURFACE_SUFFIXES, *IMAGE_SUFFIXES, ".zip", ".ima", "")
    if not has_kind and kind.lstrip(".").isalpha():
        known = ", ".join((*SURFACE_SUFFIXES, *IMAGE_SUFFIXES, ".zip"))
        raise ReadError(f"{name} is neither a scan nor a surface. Drop a DICOM folder or one of {known}.")
    return name


def take(partial: Path, name: str, case_folder: Path) -> None:
    """Move a complete upload, with its name on the user's machine, into the case folder; `partial` is removed.

    Raises ReadError: the file is damaged, unpacks to too many bytes, or there are too many files.
    """
    folder = case_folder / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    try:
        if is_dicom(partial):
            _take_slice(partial, folder)
        elif zipfile.is_zipfile(partial):
            _take_archive(partial, folder)
        else:
            _take_file(partial, name, folder)
    finally:
        partial.unlink(missing_ok=True)


def found(case_folder: Path) -> str:
    """Return the path of the uploaded scan or surface, relative to the case folder.

    Raises ReadError: there is no scan or surface, or more than one.
    """
    from vstent.io.images import files_of  # imported late so that the first page appears sooner

    folder = case_folder / FOLDER
    files = sorted(path for path in folder.glob("*") if path.is_file() and not path.name.startswith("."))
    known = [path for path in files if suffix(path) in (*SURFACE_SUFFIXES, *IMAGE_SUFFIXES)]
    voxels = {file for path in known for file in files_of(path)[1:]}  # voxel files with a separate header
    scans = [path for path in known if path not in voxels]
    if (folder / SERIES).is_dir():
        scans.append(folder / SERIES)
    if not scans:
        raise ReadError("None of the files is a scan or a surface. Drop a DICOM folder, a volume or a surface.")
    if len(scans) > 1:
        names = " and ".join(path.name for path in scans[:2])
        raise ReadError(f"There is more than one scan or surface ({names}). Drop one; make another case for the other.")
    return f"{FOLDER}/{scans[0].name}"


def _take_slice(path: Path, folder: Path) -> None:
    """Write a DICOM slice without patient data into the case."""
    series = folder / SERIES
    series.mkdir(exist_ok=True)
    count = sum(1 for _ in series.iterdir())
    if count >= MOST_FILES:
        raise ReadError(f"More than {MOST_FILES} slices. Drop one series.")
    strip_dicom(path, series / f"slice-{count + 1:05}.dcm")


def _take_archive(path: Path, folder: Path) -> None:
    """Unpack the supported files of an archive; the paths in it are not used."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            if len(entries) > MOST_FILES or sum(entry.file_size for entry in entries) > UNPACKED_LIMIT:
                raise ReadError(_TOO_MUCH)
            left = UNPACKED_LIMIT
            for number, entry in enumerate(entries):
                left = _take_entry(archive, entry, folder / f".entry-{number}", folder, left)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError):
        raise ReadError("The archive is damaged or locked. Unpack it and drop the folder.") from None


def _take_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, partial: Path, folder: Path, left: int) -> int:
    """Unpack one file of an archive and keep it if it is supported; return the number of bytes left of the limit."""
    try:
        with archive.open(entry) as packed, partial.open("wb") as out:
            for block in iter(lambda: packed.read(_BLOCK), b""):
                left -= len(block)
                if left < 0:  # the sizes that an archive states may be wrong
                    raise ReadError(_unpacks_to_too_much("The archive"))
                out.write(block)
        name = entry.filename.replace("\\", "/").rpartition("/")[2]
        if is_dicom(partial):
            _take_slice(partial, folder)
        elif suffix(Path(name)) in (*SURFACE_SUFFIXES, *IMAGE_SUFFIXES):
            _take_file(partial, name, folder)
    finally:
        partial.unlink(missing_ok=True)
    return left


def _take_file(path: Path, name: str, folder: Path) -> None:
    """Move a file into the case, unless it is compressed and unpacks to more than the limit."""
    if suffix(Path(name)).endswith(".gz"):
        total = 0
        try:
            with gzip.open(path) as stream:
                while total <= UNPACKED_LIMIT and (block := stream.read(_BLOCK)):
                    total += len(block)
        except (OSError, EOFError, zlib.error):
            raise ReadError("The compressed file is damaged. Copy it again from its source.") from None
        if total > UNPACKED_LIMIT:
            raise ReadError(_unpacks_to_too_much(name))
    shutil.move(path, folder / checked_name(name))


def _unpacks_to_too_much(name: str) -> str:
    """Return the message for a file that unpacks to more than the limit."""
    return f"{name} unpacks to more than {UNPACKED_LIMIT >> 30} GB, which is too much. Drop a smaller one."
