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
from vstent.io.files import atomic, silenced, write_bytes
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
    """Write a surface in mm as VTP, with arrays (n, ...) on its vertices and (m, ...) on its faces."""
    _write_xml(path, polydata_of(surface.vertices_mm, surface.faces), point_data, cell_data)


def write_lines(
    path: Path, points_mm: Floats, starts: Ints, point_data: Arrays = NOTHING, cell_data: Arrays = NOTHING
) -> None:
    """Write polylines in mm as VTP, with arrays (p, ...) on the points and (w, ...) on the lines.

    The points (p, 3) of all lines follow one another; `starts` (w + 1,) are the first point of every line, and p.
    """
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    data = vtkPolyData()
    data.SetPoints(_points(points_mm))
    data.SetLines(_cells(np.arange(len(points_mm)), starts))
    _write_xml(path, data, point_data, cell_data)


def write_centerlines(path: Path, centerlines: Sequence[Centerline]) -> None:
    """Write centerlines as VTP with the array names of VMTK."""
    lengths = [len(line.points_mm) for line in centerlines]
    frames = np.concatenate([line.frames for line in centerlines])
    write_lines(
        path,
        np.concatenate([line.points_mm for line in centerlines]),
        np.cumsum([0, *lengths]),
        {
            "MaximumInscribedSphereRadius": np.concatenate([line.inscribed_radius_mm for line in centerlines]),
            "Abscissas": np.concatenate([line.abscissa_mm for line in centerlines]),
            "FrenetTangent": frames[:, 0],
            "ParallelTransportNormals": frames[:, 1],
        },
        {"CenterlineIds": np.arange(len(centerlines), dtype=np.int32)},
    )


def write_cells(path: Path, centers_mm: Floats, sizes_mm: Floats, cell_data: Arrays) -> None:
    """Write cells of one or more regular grids as VTU: hexahedra with shared corners.

    Their centers (c, 3) are on grids aligned with the axes and with each other; their edges (c,) are multiples of the
    smallest. There are arrays (c, ...) on the cells.
    """
    from vtkmodules.vtkCommonDataModel import VTK_HEXAHEDRON, vtkUnstructuredGrid

    corners_mm, cells = grid_corners(centers_mm, sizes_mm)
    data = vtkUnstructuredGrid()
    data.SetPoints(_points(corners_mm))
    data.SetCells(VTK_HEXAHEDRON, _cells(cells.ravel(), np.arange(len(cells) + 1) * 8))
    _write_xml(path, data, NOTHING, cell_data)


def polydata_of(vertices_mm: Floats, faces: Ints) -> Any:
    """Return a surface of vertices (n, 3) and triangles (m, 3) as vtkPolyData."""
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    data = vtkPolyData()
    data.SetPoints(_points(vertices_mm))
    data.SetPolys(_cells(faces.ravel(), np.arange(len(faces) + 1) * 3))
    return data


def _points(points_mm: Floats) -> Any:
    """Return points (n, 3) as vtkPoints in double precision."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints

    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(points_mm, dtype=np.float64), deep=True))
    return points


def _cells(connectivity: Ints, starts: Ints) -> Any:
    """Return m cells, whose points begin at `starts` (m + 1,), as vtkCellArray."""
    from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    cells = vtkCellArray()
    parts = (numpy_to_vtkIdTypeArray(np.asarray(ids, dtype=np.int64), deep=True) for ids in (starts, connectivity))
    cells.SetData(*parts)
    return cells


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


def _write_xml(path: Path, data: Any, point_data: Arrays, cell_data: Arrays) -> None:
    """Write a VTK data set as VTP or VTU, with its arrays and its frame."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    for attributes, arrays, length in (
        (data.GetPointData(), point_data, data.GetNumberOfPoints()),
        (data.GetCellData(), cell_data, data.GetNumberOfCells()),
    ):
        for name, values in arrays.items():
            array = np.asarray(values)
            if len(array) != length:
                raise ValueError(f"{name} has {len(array)} rows where {length} are needed")
            array = array.astype(np.uint8) if array.dtype.kind == "b" else array
            rows = numpy_to_vtk(np.ascontiguousarray(array.reshape(length, -1) if array.ndim > 1 else array), deep=True)
            rows.SetName(name)
            attributes.AddArray(rows)
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
    write_bytes(path, header + faces.tobytes())


def write_json(path: Path, content: Any, *, is_exact: bool = False) -> None:
    """Write numbers, strings, lists, mappings and arrays as JSON with sorted keys.

    Floats have seven digits unless `is_exact`. ValueError is raised where a number is not finite, or an object is of
    another type; nothing is written then.
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
    write_bytes(path, text.encode())
