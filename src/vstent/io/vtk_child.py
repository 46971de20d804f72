"""VTK's readers, in a process of their own.

They are fast and know every dialect, but a damaged file can crash them, and us with them, or make them ask for all the
memory there is. So a child reads the file and hands over bare arrays; when it dies, the file was damaged.
"""

import errno
import os
import subprocess
import sys
import tempfile
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.io.files import suffix
from vstent.io.polydata import triangles_of
from vstent.kernels.arrays import Floats, Ints

SECONDS: Final = 8.0
"""Of the processor: on a machine that has much else to do a sound file must not pass for a damaged one."""
SECONDS_PER_BYTE: Final = 1e-6
PATIENCE: Final = 1.0 if sys.platform == "win32" else 10.0
"""Seconds of the clock for each of them; Windows counts no others."""
MEMORY_BYTES: Final = 2_000_000_000
MEMORY_PER_BYTE: Final = 40
DISK_FULL: Final = 28
"""Exit code where the arrays could not be written."""
LEAST_USED: Final = 0.9
"""Part of the points of an OBJ file that belong to triangles; they come first, so a file that breaks off has more."""


def read_apart(path: Path) -> tuple[Floats, Ints] | None:
    """Read vertices (n, 3) and triangles (m, 3) in a child process; None when that dies or takes too long."""
    size = path.stat().st_size
    with tempfile.TemporaryDirectory(prefix="vstent-") as folder:
        result = Path(folder) / "surface.npz"
        command = [sys.executable, "-m", "vstent.io.vtk_child", str(path.resolve()), str(result)]
        try:
            subprocess.run(
                command,
                env=_environment(),
                timeout=PATIENCE * _seconds(size),
                check=True,
                stdin=subprocess.DEVNULL,
                capture_output=True,
            )
        except subprocess.CalledProcessError as died:
            if died.returncode == DISK_FULL:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), folder) from None
            return None
        except subprocess.TimeoutExpired:
            return None
        with np.load(result) as arrays:
            return arrays["vertices"], arrays["faces"]


def _environment() -> dict[str, str]:
    """Ours, and the folder that this package was found in."""
    root = str(Path(__file__).resolve().parents[2])
    others = os.environ.get("PYTHONPATH", "")
    return {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in (root, others) if p)}


def _seconds(size: int) -> float:
    return SECONDS + SECONDS_PER_BYTE * size


def _limit(size: int) -> None:
    """Bound this process's memory and processor time."""
    with suppress(ImportError):  # Windows has no such limits
        import resource

        memory, seconds = MEMORY_BYTES + MEMORY_PER_BYTE * size, ceil(_seconds(size))
        for what, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):
            with suppress(ValueError, OSError):
                resource.setrlimit(what, (most, most))


def _reader(kind: str) -> Any:
    if kind == ".vtp":
        from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

        return vtkXMLPolyDataReader()
    if kind == ".vtk":
        from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader

        return vtkGenericDataObjectReader()
    if kind == ".ply":
        from vtkmodules.vtkIOPLY import vtkPLYReader

        return vtkPLYReader()
    from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader

    return vtkSTLReader() if kind == ".stl" else vtkOBJReader()


def _faults() -> list[str]:
    """Return a list that fills with whatever VTK complains of: after that it hands over what it has, zeros included."""
    from vtkmodules.util.misc import calldata_type
    from vtkmodules.vtkCommonCore import VTK_STRING, vtkOutputWindow

    faults: list[str] = []

    @calldata_type(VTK_STRING)
    def note(_: Any, event: str, text: str) -> None:
        if event == "ErrorEvent" or "Error reading" in text:  # binary data that end early are only warned of
            faults.append(text)

    window: Any = vtkOutputWindow.GetInstance()
    for event in ("ErrorEvent", "WarningEvent"):
        window.AddObserver(event, note)
    return faults


def _announced(path: Path) -> int:
    """Return how many polygons the header of a PLY file announces; VTK is content with fewer."""
    if suffix(path) != ".ply":
        return 0
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0]
    counts = [line.split()[2] for line in head.splitlines() if line.startswith(b"element face")]
    return int(counts[0]) if counts else 0


def _polygons(data: Any) -> Any:
    """Return polygons as they are, the outer faces of a volume mesh, and None for anything else."""
    if data is None or data.IsA("vtkPolyData"):
        return data
    if not data.IsA("vtkUnstructuredGrid"):
        return None
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    outer = vtkGeometryFilter()
    outer.SetInputData(data)
    outer.Update()
    return outer.GetOutput()


def main(path: Path, result: Path) -> int:
    """Read a file and save its vertices and faces; 1 when there is nothing to save."""
    _limit(path.stat().st_size)
    reader = _reader(suffix(path))
    reader.SetFileName(str(path))
    faults = _faults()
    reader.Update()
    data = _polygons(reader.GetOutput())
    if data is None or faults:
        return 1
    vertices, faces = triangles_of(data)
    if len(faces) < _announced(path):
        return 1
    if suffix(path) == ".obj" and len(np.unique(faces)) < LEAST_USED * len(vertices):
        return 1
    try:
        np.savez(result, vertices=vertices.astype(np.float64), faces=faces.astype(np.int32))
    except OSError:
        return DISK_FULL
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
