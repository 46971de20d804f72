"""Read a file with limited memory and time and save its arrays; `vstent.io.apart` starts this module."""

import errno
import faulthandler
import importlib
import json
import struct
import sys
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import VstentError
from vstent.io.files import NIFTI_SUFFIXES, PAIR_SUFFIXES, suffix
from vstent.io.scans import read_scan
from vstent.io.text_headers import META_SUFFIXES, NRRD_SUFFIXES
from vstent.io.vtk_reader import read_mesh

Content = tuple[dict[str, NDArray[Any]], dict[str, Any]]
"""Arrays by name, and everything else, as JSON can hold it."""
BEGUN: Final = "begun"
"""Empty file that is written when the libraries are loaded and reading begins."""
WORDS: Final = "words.json"
"""File with everything that is no array; it is written last."""
LATE: Final = b"Timeout ("
"""What `faulthandler` writes to standard error when it ends a process that has waited too long."""
PATIENCE: Final = 1.0 if sys.platform == "win32" else 10.0
"""Wall time allowed per second of CPU time; Windows limits wall time only."""
FAULTS: Final = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Errors of libraries on content that they do not expect."""


def _scan(path: Path, options: dict[str, Any]) -> Content:
    """Return the content of a scan."""
    image = read_scan(path, **options)
    words = {"modality": image.modality, "notes": image.notes, "is_oriented": image.is_oriented}
    return {"voxels": image.voxels, "affine_mm": image.affine_mm}, words


def _mesh(path: Path, _: dict[str, Any]) -> Content:
    """Return the content of a surface file."""
    mesh = read_mesh(path)
    return {"vertices": mesh.vertices, "faces": mesh.faces}, {"space": mesh.space}


READERS: Final[dict[str, Callable[[Path, dict[str, Any]], Content]]] = {"scan": _scan, "mesh": _mesh}
"""Readers by name."""


def main(what: str, path: Path, options: dict[str, Any], folder: Path, limits: dict[str, float]) -> None:
    """Read a file and save its arrays in a folder, or the error that it ends with.

    `limits` are the largest ``memory`` in bytes and the CPU time in ``seconds``, which counts from here.
    """
    for library in _libraries(what, path):
        importlib.import_module(library)
    is_own = limit(**limits)
    (folder / BEGUN).touch()
    try:
        arrays, words = READERS[what](path, options)
        for name, values in arrays.items():
            _save(folder / f"{name}.npy", values)
    except VstentError as error:
        words = {"error": type(error).__name__, "sentence": str(error)}
    except MemoryError:
        words = {"error": "Limit" if is_own else "MemoryError"}
    except OSError as error:
        words = {"error": "OSError", "errno": error.errno or 0, "file": str(error.filename or path)}
    except (*FAULTS, EOFError, struct.error, zlib.error) as error:
        reason = " ".join(str(error).split())[:120]
        words = {"error": "ReadError", "sentence": f"{path.name} is damaged ({reason}). Copy or export it again."}
    (folder / WORDS).write_text(json.dumps(words), encoding="utf-8")


def _save(path: Path, values: NDArray[Any]) -> None:
    """Save an array; NumPy gives the error of a full disk no number."""
    try:
        np.save(path, values)
    except OSError as error:
        raise OSError(error.errno or errno.ENOSPC, str(error), str(path)) from error


def _libraries(what: str, path: Path) -> tuple[str, ...]:
    """Return the libraries that the reader of a file imports: loading them from a slow disk is no part of reading."""
    if what == "mesh" or suffix(path) in (".vti", ".vtr", ".vtk"):
        return ("vtkmodules.vtkIOGeometry", "vtkmodules.vtkIOLegacy", "vtkmodules.vtkIOPLY", "vtkmodules.vtkIOXML")
    if suffix(path) in (*NIFTI_SUFFIXES, *PAIR_SUFFIXES):
        return ("nibabel.nifti2",)
    return ("SimpleITK",) if suffix(path) in (*NRRD_SUFFIXES, *META_SUFFIXES) else ("pydicom",)


def limit(memory: float, seconds: float) -> bool:
    """Limit memory in bytes and further time in s of this process; return whether that of memory is the lower one."""
    faulthandler.dump_traceback_later(PATIENCE * seconds, exit=True)
    with suppress(ImportError):  # Windows has no such limits
        import resource

        own = {resource.RLIMIT_AS: int(memory), resource.RLIMIT_CPU: ceil(time.process_time() + seconds)}
        given = {what: resource.getrlimit(what)[0] for what in own}
        for what, most in own.items():
            if given[what] == resource.RLIM_INFINITY or given[what] > most:
                with suppress(ValueError, OSError):
                    resource.setrlimit(what, (most, most))
        return resource.getrlimit(resource.RLIMIT_AS)[0] == own[resource.RLIMIT_AS]
    return False


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3]), Path(sys.argv[4]), json.loads(sys.argv[5]))
