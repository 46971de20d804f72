"""Run VTK's readers in a child process.

VTK is fast and reads every dialect, but a damaged file can crash it or make it allocate all memory. The child reads the
file and returns arrays. Where the child dies, the parent reports the file as damaged.
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
from numpy.typing import NDArray

from vstent.children import environment
from vstent.errors import ReadError
from vstent.geometry.image import Image
from vstent.io.files import suffix
from vstent.io.polydata import triangles_of
from vstent.kernels.arrays import Floats, Ints

SECONDS: Final = 8.0
"""CPU time that a child may use, in s; long enough that a sound file is read on a busy machine too."""
SECONDS_PER_BYTE: Final = 1e-6
"""Additional CPU time per byte of the file, in s."""
PATIENCE: Final = 1.0 if sys.platform == "win32" else 10.0
"""Wall time allowed per second of CPU time; Windows limits wall time only."""
MEMORY_BYTES: Final = 2_000_000_000
"""Memory that a child may allocate, in bytes."""
MEMORY_PER_BYTE: Final = 40
"""Additional memory per byte of the file, in bytes."""
DISK_FULL: Final = 28
"""Exit code of a child that could not write its arrays."""
LEAST_USED: Final = 0.9
"""Smallest fraction of the points of a complete OBJ file that belong to triangles.

Points come before triangles, so a truncated file has a smaller fraction.
"""


def read_apart(path: Path) -> tuple[Floats, Ints, str] | None:
    """Read a surface file in a child process.

    Parameters
    ----------
    path : the file.

    Returns
    -------
    tuple or None
        Vertices (n, 3), triangles (m, 3) as vertex numbers, and the frame that the field data state (``RAS``, ``LPS``
        or empty). None where the child died or took too long.
    """
    found = _from_child(path)
    return None if found is None else (found["vertices"], found["faces"], str(found["space"]))


def read_vti(path: Path) -> Image:
    """Read a VTK image (``.vti``); its axes are taken as LPS.

    Raises
    ------
    ReadError
        The file is damaged, or has no point data with one value per voxel.
    """
    found = _from_child(path)
    if found is None:
        raise ReadError(
            f"{path.name} is damaged, or has no point data with one value per voxel. Copy or export it again."
        )
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = found["edges"], found["origin"]
    return Image(found["voxels"], affine)


def _from_child(path: Path) -> dict[str, NDArray[Any]] | None:
    """Return the arrays that a child read from a file; None where it died or took too long."""
    size = path.stat().st_size
    with tempfile.TemporaryDirectory(prefix="vstent-") as folder:
        result = Path(folder) / "surface.npz"
        command = [sys.executable, "-m", "vstent.io.vtk_child", str(path.resolve()), str(result)]
        try:
            subprocess.run(
                command,
                env=environment(),
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
            return dict(arrays)


def _seconds(size: int) -> float:
    """Return the CPU time in s allowed for a file of `size` bytes."""
    return SECONDS + SECONDS_PER_BYTE * size


def _limit(size: int) -> None:
    """Limit memory and CPU time of this process for a file of `size` bytes."""
    with suppress(ImportError):  # Windows has no such limits
        import resource

        memory, seconds = MEMORY_BYTES + MEMORY_PER_BYTE * size, ceil(_seconds(size))
        for what, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):
            with suppress(ValueError, OSError):
                resource.setrlimit(what, (most, most))


def _reader(kind: str) -> Any:
    """Return VTK's reader for a file suffix."""
    from vtkmodules import vtkIOGeometry, vtkIOLegacy, vtkIOPLY, vtkIOXML

    readers = {
        ".vtp": vtkIOXML.vtkXMLPolyDataReader,
        ".vtu": vtkIOXML.vtkXMLUnstructuredGridReader,
        ".vtm": vtkIOXML.vtkXMLMultiBlockDataReader,
        ".vti": vtkIOXML.vtkXMLImageDataReader,
        ".vtk": vtkIOLegacy.vtkGenericDataObjectReader,
        ".ply": vtkIOPLY.vtkPLYReader,
        ".stl": vtkIOGeometry.vtkSTLReader,
        ".obj": vtkIOGeometry.vtkOBJReader,
    }
    return readers[kind]()


def _faults() -> list[str]:
    """Return a list that collects VTK's error messages; after an error VTK returns incomplete data."""
    from vtkmodules.util.misc import calldata_type
    from vtkmodules.vtkCommonCore import VTK_STRING, vtkOutputWindow

    faults: list[str] = []

    @calldata_type(VTK_STRING)
    def note(_: Any, event: str, text: str) -> None:
        if event == "ErrorEvent" or "Error reading" in text:  # truncated binary data raise a warning only
            faults.append(text)

    window: Any = vtkOutputWindow.GetInstance()
    for event in ("ErrorEvent", "WarningEvent"):
        window.AddObserver(event, note)
    return faults


def _announced(path: Path) -> int:
    """Return the number of polygons that the header of a PLY file states; VTK accepts files with fewer."""
    if suffix(path) != ".ply":
        return 0
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0]
    counts = [line.split()[2] for line in head.splitlines() if line.startswith(b"element face")]
    return int(counts[0]) if counts else 0


def _polygons(data: Any) -> Any:
    """Return polygons, the outer faces of a grid, or the joined surfaces of blocks; None for anything else."""
    if data is None or data.IsA("vtkPolyData"):
        return data
    if data.IsA("vtkMultiBlockDataSet"):
        return _joined([one for one in map(_polygons, _blocks(data)) if one is not None])
    if not data.IsA("vtkUnstructuredGrid"):
        return None
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    outer = vtkGeometryFilter()
    outer.SetInputData(data)
    outer.Update()
    return outer.GetOutput()


def _blocks(data: Any) -> list[Any]:
    """Return all data sets of a multi-block data set, also those of nested blocks."""
    children = [data.GetBlock(number) for number in range(data.GetNumberOfBlocks())]
    return [one for child in children if child is not None for one in (_blocks(child) if _is_multi(child) else [child])]


def _is_multi(data: Any) -> bool:
    """Return whether a data set is a multi-block data set."""
    return bool(data.IsA("vtkMultiBlockDataSet"))


def _joined(surfaces: list[Any]) -> Any:
    """Return surfaces as one; None where there is none."""
    from vtkmodules.vtkFiltersCore import vtkAppendPolyData

    if not surfaces:
        return None
    appended = vtkAppendPolyData()
    for surface in surfaces:
        appended.AddInputData(surface)
    appended.Update()
    return appended.GetOutput()


def _space(data: Any) -> str:
    """Return the frame that the field data of a data set, or of one of its blocks, state under the name SPACE."""
    for one in _blocks(data) if data is not None and _is_multi(data) else [data]:
        array = None if one is None else one.GetFieldData().GetAbstractArray("SPACE")
        if array is not None and array.GetNumberOfValues():
            return str(array.GetVariantValue(0).ToString()).strip().upper()
    return ""


def _voxels(data: Any) -> dict[str, NDArray[Any]] | None:
    """Return voxels (i, j, k), edges (3, 3) and origin (3,) of a VTK image; None without single values at points."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    scalars = data.GetPointData().GetScalars() or data.GetPointData().GetArray(0)
    if scalars is None or scalars.GetNumberOfComponents() != 1:
        return None
    shape, extent = data.GetDimensions(), data.GetExtent()
    matrix = data.GetDirectionMatrix()
    direction = np.array([[matrix.GetElement(row, column) for column in range(3)] for row in range(3)])
    edges = direction * np.array(data.GetSpacing())
    origin = np.array(data.GetOrigin()) + edges @ np.array(extent[::2], dtype=np.float64)
    return {"voxels": vtk_to_numpy(scalars).reshape(shape, order="F"), "edges": edges, "origin": origin}


def _triangles(data: Any, path: Path) -> dict[str, NDArray[Any]] | None:
    """Return vertices, triangles and stated frame; None where polygons are missing."""
    polygons = _polygons(data)
    if polygons is None:
        return None
    vertices, faces = triangles_of(polygons)
    if len(faces) < _announced(path):
        return None
    if suffix(path) == ".obj" and len(np.unique(faces)) < LEAST_USED * len(vertices):
        return None
    return {
        "vertices": vertices.astype(np.float64),
        "faces": faces.astype(np.int32),
        "space": np.array(_space(data)),
    }


def main(path: Path, result: Path) -> int:
    """Read a file and save its arrays.

    Parameters
    ----------
    path : the file.
    result : the .npz file to write.

    Returns
    -------
    int
        Exit code: 0 done, 1 where there is nothing to save, `DISK_FULL` where it could not be saved.
    """
    _limit(path.stat().st_size)
    reader = _reader(suffix(path))
    reader.SetFileName(str(path))
    faults = _faults()
    reader.Update()
    data = reader.GetOutputDataObject(0)
    if data is None or faults:
        return 1
    arrays = _voxels(data) if suffix(path) == ".vti" else _triangles(data, path)
    if arrays is None:
        return 1
    try:
        np.savez(result, **arrays)  # type: ignore[arg-type]
    except OSError:
        return DISK_FULL
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
