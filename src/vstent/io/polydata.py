"""Convert arrays to VTK data sets and back."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vstent.kernels.arrays import Floats, Ints


def polydata_of(vertices_mm: Floats, faces: Ints) -> Any:
    """Return a surface of vertices (n, 3) and triangles (m, 3) as vtkPolyData."""
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    data = vtkPolyData()
    data.SetPoints(points_of(vertices_mm))
    data.SetPolys(cells_of(faces))
    return data


def points_of(points_mm: Floats) -> Any:
    """Return points (n, 3) as vtkPoints in double precision."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints

    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(points_mm, dtype=np.float64), deep=True))
    return points


def cells_of(cells: Ints) -> Any:
    """Return cells (m, k) of k points each as vtkCellArray."""
    return ragged_cells(cells.ravel(), np.arange(len(cells) + 1) * cells.shape[1])


def ragged_cells(connectivity: Ints, starts: Ints) -> Any:
    """Return cells with different numbers of points as vtkCellArray.

    Shapes: `starts` (m + 1,).
    """
    from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    array = vtkCellArray()
    array.SetData(
        numpy_to_vtkIdTypeArray(np.ascontiguousarray(starts, dtype=np.int64), deep=True),
        numpy_to_vtkIdTypeArray(np.ascontiguousarray(connectivity, dtype=np.int64), deep=True),
    )
    return array


def triangles_of(data: Any) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Return the polygons of vtkPolyData as vertices (n, 3) and triangles (m, 3).

    Lines, vertices and polygons with invalid point numbers are left out. VTK's own filters do not check the output of
    its readers and crash on damaged files, so the arrays are checked here.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if data.GetPoints() is None or data.GetNumberOfPoints() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    vertices_mm = vtk_to_numpy(data.GetPoints().GetData())
    faces = np.concatenate([_polygons(data.GetPolys(), vertices_mm), _strips(data.GetStrips())])
    return vertices_mm, faces[((faces >= 0) & (faces < len(vertices_mm))).all(axis=1)]


def _cells(cells: Any) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return point numbers of all cells, the start of each cell and its length; empty where they are inconsistent."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    connectivity = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    starts = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    count = np.diff(starts)
    if not len(starts) or starts[0] != 0 or starts[-1] > len(connectivity) or (count < 0).any():
        return connectivity[:0], starts[:0], starts[:0]
    return connectivity, starts[:-1], count


def _polygons(cells: Any, vertices_mm: NDArray[Any]) -> NDArray[np.int64]:
    """Return triangles (m, 3): quadrilaterals are cut along the shorter diagonal, larger polygons into fans."""
    connectivity, starts, count = _cells(cells)
    quads = connectivity[starts[count == 4][:, None] + np.arange(4)]
    quads = quads[((quads >= 0) & (quads < len(vertices_mm))).all(axis=1)]
    first, second = (
        vertices_mm[quads[:, 0]] - vertices_mm[quads[:, 2]],
        vertices_mm[quads[:, 1]] - vertices_mm[quads[:, 3]],
    )
    turned = (first**2).sum(axis=1) > (second**2).sum(axis=1)
    quads = np.where(turned[:, None], np.roll(quads, -1, axis=1), quads)
    pieces = [connectivity[starts[count == 3][:, None] + np.arange(3)], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    for k in np.unique(count[count > 4]):
        fan = np.stack([np.zeros(k - 2, dtype=np.int64), np.arange(1, k - 1), np.arange(2, k)], axis=1)
        pieces.append(connectivity[starts[count == k][:, None, None] + fan].reshape(-1, 3))
    return np.concatenate(pieces)


def _strips(cells: Any) -> NDArray[np.int64]:
    """Return the triangles (m, 3) of triangle strips; every second one is reversed."""
    connectivity, starts, count = _cells(cells)
    inner = np.maximum(count - 2, 0)
    step = np.arange(inner.sum()) - np.repeat(np.cumsum(inner) - inner, inner)
    first = np.repeat(starts, inner) + step
    odd = step % 2
    return connectivity[np.stack([first + odd, first + 1 - odd, first + 2], axis=1)]
