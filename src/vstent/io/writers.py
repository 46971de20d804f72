"""Write VTP, VTU, STL, JSON and text files. A file is complete or does not exist."""

import errno
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline
from vstent.io.files import atomic, silenced
from vstent.io.polydata import cells_of, points_of, polydata_of, ragged_cells
from vstent.kernels.arrays import Floats, Ints

Arrays = Mapping[str, NDArray[Any]]

"""Arrays by name."""
NOTHING: Final[Arrays] = {}
"""No arrays."""
SIGNIFICANT_DIGITS: Final = 7
"""Significant digits of numbers in JSON and CSV files."""
SPACE: Final = "LPS"
"""Frame of every file written, stated as in 3D Slicer: ``SPACE=LPS``."""


def write_surface(path: Path, surface: Surface, point_data: Arrays = NOTHING, cell_data: Arrays = NOTHING) -> None:
    """Write a surface in mm as VTP.

    Parameters
    ----------
    path : the file.
    surface : the surface.
    point_data : arrays (n, ...) on its vertices.
    cell_data : arrays (m, ...) on its faces.
    """
    data = polydata_of(surface.vertices_mm, surface.faces)
    _attach(data.GetPointData(), point_data, len(surface.vertices_mm))
    _attach(data.GetCellData(), cell_data, len(surface.faces))
    _write_xml(path, data)


def write_lines(
    path: Path, points_mm: Floats, starts: Ints, point_data: Arrays = NOTHING, cell_data: Arrays = NOTHING
) -> None:
    """Write polylines in mm as VTP.

    Parameters
    ----------
    path : the file.
    points_mm : (p, 3) points of all lines, one after another.
    starts : (w + 1,) first point of every line, and p at the end.
    point_data, cell_data : arrays (p, ...) on the points and (w, ...) on the lines.
    """
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    data = vtkPolyData()
    data.SetPoints(points_of(points_mm))
    data.SetLines(ragged_cells(np.arange(len(points_mm), dtype=np.int32), np.asarray(starts)))
    _attach(data.GetPointData(), point_data, len(points_mm))
    _attach(data.GetCellData(), cell_data, len(starts) - 1)
    _write_xml(path, data)


def write_centerlines(path: Path, centerlines: Sequence[Centerline]) -> None:
    """Write centerlines as VTP with the array names of VMTK.

    Parameters
    ----------
    path : the file.
    centerlines : points in mm, inscribed radii and frames.
    """
    lengths = [len(line.points_mm) for line in centerlines]
    frames = np.concatenate([line.frames for line in centerlines])
    write_lines(
        path,
        np.concatenate([line.points_mm for line in centerlines]),
        np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32),
        {
            "MaximumInscribedSphereRadius": np.concatenate([line.inscribed_radius_mm for line in centerlines]),
            "Abscissas": np.concatenate([line.abscissa_mm for line in centerlines]),
            "FrenetTangent": frames[:, 0],
            "ParallelTransportNormals": frames[:, 1],
        },
        {"CenterlineIds": np.arange(len(centerlines), dtype=np.int32)},
    )


def write_cells(
    path: Path, centers_mm: Floats, sizes_mm: Floats, cell_data: Arrays, point_data: Arrays = NOTHING
) -> None:
    """Write cells of one or more regular grids as VTU: hexahedra with shared corners.

    Parameters
    ----------
    path : the file.
    centers_mm : (c, 3) centers of the cells, on grids aligned with the axes and with each other.
    sizes_mm : (c,) edges of the cells, multiples of the smallest.
    cell_data : arrays (c, ...).
    point_data : arrays (p, ...) on the corners in the order of `grid_corners`.
    """
    from vtkmodules.vtkCommonDataModel import VTK_HEXAHEDRON, vtkUnstructuredGrid

    corners_mm, cells = grid_corners(centers_mm, sizes_mm)
    data = vtkUnstructuredGrid()
    data.SetPoints(points_of(corners_mm))
    data.SetCells(VTK_HEXAHEDRON, cells_of(cells))
    _attach(data.GetCellData(), cell_data, len(cells))
    _attach(data.GetPointData(), point_data, len(corners_mm))
    _write_xml(path, data)


_CORNERS: Final = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
"""Corners of a unit cube in VTK's order of a hexahedron."""


def grid_corners(centers_mm: Floats, sizes_mm: Floats) -> tuple[Floats, Ints]:
    """Return the corners of grid cells, each once, and the corners of every cell.

    Shapes: `centers_mm` (c, 3), `sizes_mm` (c,).
    """
    if not len(centers_mm):
        return np.zeros((0, 3)), np.zeros((0, 8), dtype=np.int32)
    size_mm = sizes_mm.min()
    first_mm = centers_mm - 0.5 * (sizes_mm - size_mm)[:, None]  # centers of the smallest cells at the lowest corners
    origin = first_mm.min(axis=0)
    index = np.round((first_mm - origin) / size_mm).astype(np.int64)
    width = np.round(sizes_mm / size_mm).astype(np.int64)
    n = (index + width[:, None]).max(axis=0) + 1
    stride = np.array([n[1] * n[2], n[2], 1])
    code, cells = np.unique((index @ stride)[:, None] + np.outer(width, _CORNERS @ stride), return_inverse=True)
    lattice = np.stack([code // stride[0], code // stride[1] % n[1], code % n[2]], axis=-1)
    return origin + (lattice - 0.5) * size_mm, cells.reshape(-1, 8).astype(np.int32)


def _attach(attributes: Any, arrays: Arrays, length: int) -> None:
    """Add arrays of `length` rows to the attributes of a VTK data set."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    for name, values in arrays.items():
        array = np.asarray(values)
        if len(array) != length:
            raise ValueError(f"{name} has {len(array)} rows where {length} are needed")
        if array.dtype.kind == "b":
            array = array.astype(np.uint8)
        data = numpy_to_vtk(np.ascontiguousarray(array.reshape(length, -1) if array.ndim > 1 else array), deep=True)
        data.SetName(name)
        attributes.AddArray(data)


def _write_xml(path: Path, data: Any) -> None:
    """Write a VTK data set as VTP or VTU, with its frame."""
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    frame = vtkStringArray()
    frame.SetName("SPACE")
    frame.InsertNextValue(SPACE)
    data.GetFieldData().AddArray(frame)
    writer = (vtkXMLPolyDataWriter if data.IsA("vtkPolyData") else vtkXMLUnstructuredGridWriter)()
    writer.SetInputData(data)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToZLib()
    writer.SetCompressionLevel(1)
    with atomic(path) as partial:
        writer.SetFileName(str(partial))
        with silenced():
            is_written = writer.Write() == 1
        if not is_written or partial.stat().st_size == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


_STL_FACE: Final = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""Layout of a triangle in a binary STL file."""


def write_stl(path: Path, surface: Surface) -> None:
    """Write a surface in mm as binary STL; the header states the unit and the frame."""
    faces = np.zeros(len(surface.faces), dtype=_STL_FACE)
    faces["normal"], faces["corners"] = surface.normals, surface.corners_mm
    header = f"vstent, mm, SPACE={SPACE}".encode().ljust(80) + len(faces).to_bytes(4, "little")
    with atomic(path) as partial:
        partial.write_bytes(header + faces.tobytes())


def write_json(path: Path, content: Any, *, is_exact: bool = False) -> None:
    """Write numbers, strings, lists, mappings and arrays as JSON with sorted keys.

    Parameters
    ----------
    path : the file.
    content : what is written.
    is_exact : whether floats are written without rounding; otherwise they have seven digits.

    Raises
    ------
    ValueError
        A number is not finite, or an object is of another type; nothing is written.
    """
    plain = _plain(content, "", is_exact)
    write_text(path, json.dumps(plain, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n")


def _plain(value: Any, where: str, is_exact: bool) -> Any:
    """Return a value as JSON types; `where` is its place for error messages."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}", is_exact) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{where}[{i}]", is_exact) for i, item in enumerate(value)]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist(), where, is_exact)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where.lstrip('.')} is {value}, which JSON cannot hold")
        return value if is_exact else float(f"{value:.{SIGNIFICANT_DIGITS}g}")
    if value is None or isinstance(value, (str, int, bool)):
        return value
    if isinstance(value, Path):
        return str(value)
    raise ValueError(f"{where.lstrip('.')} is a {type(value).__name__}, which JSON cannot hold")


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8."""
    with atomic(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
