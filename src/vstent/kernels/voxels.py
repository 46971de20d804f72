"""Voxels and triangle meshes: the surface at a level of a field, the grid cells inside a mesh, and their numbers."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vstent.kernels.arrays import Bools, Floats, Ints


def fill(corners: Floats, shape: tuple[int, int, int]) -> Bools:
    """Return for every point of the integer grid `shape` whether it is inside closed triangles (m, 3, 3).

    The winding number is found along grid lines of all three axes, and the majority decides. A crack or a doubled face
    of a faulty mesh therefore does not leave a line of wrong cells.
    """
    votes = np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        order = [axis, (axis + 1) % 3, (axis + 2) % 3]
        change = np.zeros([shape[k] for k in order], dtype=np.int8)
        _mark_crossings(np.ascontiguousarray(corners[:, :, order]), change)
        votes += np.moveaxis(np.cumsum(change, axis=0, dtype=np.int8) > 0, [0, 1, 2], order)
    return votes >= 2


@njit(cache=True)
def _is_left(ax: float, ay: float, bx: float, by: float, px: float, py: float) -> bool:
    """Return whether p lies left of a -> b; exactly the opposite for b -> a, so that no line passes between faces."""
    if (bx, by) < (ax, ay):
        return not ((ax - bx) * (py - by) - (ay - by) * (px - bx) > 0.0)
    return (bx - ax) * (py - ay) - (by - ay) * (px - ax) > 0.0


@njit(cache=True, nogil=True)
def _mark_crossings(corners: Any, change: Any) -> None:
    """Add +1 where a grid line along axis 0 enters the mesh and -1 where it leaves, at the next grid point."""
    n0, n1, n2 = change.shape
    for m in range(len(corners)):
        t = corners[m]
        area = (t[1, 1] - t[0, 1]) * (t[2, 2] - t[0, 2]) - (t[1, 2] - t[0, 2]) * (t[2, 1] - t[0, 1])
        if area == 0.0:
            continue
        for u in range(max(0, int(np.ceil(t[:, 1].min()))), min(n1, int(np.floor(t[:, 1].max())) + 1)):
            for v in range(max(0, int(np.ceil(t[:, 2].min()))), min(n2, int(np.floor(t[:, 2].max())) + 1)):
                left = _is_left(t[0, 1], t[0, 2], t[1, 1], t[1, 2], u, v)
                if left != _is_left(t[1, 1], t[1, 2], t[2, 1], t[2, 2], u, v):
                    continue
                if left != _is_left(t[2, 1], t[2, 2], t[0, 1], t[0, 2], u, v):
                    continue
                w1 = ((u - t[0, 1]) * (t[2, 2] - t[0, 2]) - (v - t[0, 2]) * (t[2, 1] - t[0, 1])) / area
                w2 = ((t[1, 1] - t[0, 1]) * (v - t[0, 2]) - (t[1, 2] - t[0, 2]) * (u - t[0, 1])) / area
                depth = t[0, 0] + w1 * (t[1, 0] - t[0, 0]) + w2 * (t[2, 0] - t[0, 0])
                first = max(0, int(np.ceil(depth)))
                if first < n0:
                    change[first, u, v] += 1 if area < 0.0 else -1


def dilate(mask: Bools, offsets: NDArray[Any]) -> Bools:
    """Return all cells of `mask` and their neighbours at the integer `offsets` (k, 3).

    The mask must not touch the border of its grid.
    """
    result = mask.copy()
    for offset in offsets:
        result |= np.roll(mask, tuple(int(o) for o in offset), axis=(0, 1, 2))
    return result


def isosurface(field: NDArray[np.float32], level: float) -> tuple[Floats, Ints]:
    """Return vertices (n, 3) in index units and faces (m, 3), counter-clockwise seen from the low side.

    Vertices lie on grid edges and are found by linear interpolation (flying edges: Schroeder, Maynard and Geveci 2015,
    IEEE LDAV). The surface is open where it meets the border of the grid.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    values = np.ascontiguousarray(field, dtype=np.float32)
    grid = vtkImageData()
    grid.SetDimensions(values.shape[::-1])  # VTK's first index runs fastest: its (x, y, z) are our (k, j, i)
    grid.GetPointData().SetScalars(numpy_to_vtk(values.ravel()))
    contour = vtkFlyingEdges3D()
    contour.SetInputData(grid)
    contour.SetValue(0, level)
    contour.ComputeNormalsOff()
    contour.ComputeGradientsOff()
    contour.ComputeScalarsOff()
    contour.Update()
    mesh = contour.GetOutput()
    if mesh.GetNumberOfCells() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
    vertices = vtk_to_numpy(mesh.GetPoints().GetData())[:, ::-1].astype(np.float64)
    faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)[:, ::-1].astype(np.int32)
    return vertices, faces
