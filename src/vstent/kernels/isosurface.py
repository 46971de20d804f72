"""Iso-surfaces of a sampled field."""

import numpy as np
from numpy.typing import NDArray

from vstent.kernels.arrays import Floats, Ints


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
