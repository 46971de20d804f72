"""Triangles of the polygons and strips in VTK's data sets, and of the strips in PLY files, which VTK's reader skips."""

import re
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.kernels.arrays import Floats

TYPES: Final = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""NumPy's names of the types of a PLY file."""
_STRIPS: Final = re.compile(r"element\s+tristrips\s+(\d+)\s+property\s+list\s+(\w+)\s+(\w+)")
"""Declaration of the strips in the header."""


def triangles_of(data: Any) -> tuple[Floats, NDArray[np.int64]]:
    """Return the polygons of vtkPolyData as vertices (n, 3) and triangles (m, 3).

    Lines, vertices and polygons with invalid point numbers are left out. VTK's own filters do not check the output of
    its readers and crash on damaged files, so the arrays are checked here.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if data.GetPoints() is None or data.GetNumberOfPoints() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    vertices = vtk_to_numpy(data.GetPoints().GetData())
    faces = np.concatenate([_polygons(data.GetPolys(), vertices), _strips(*_cells(data.GetStrips()))])
    return vertices, faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)]


def _cells(cells: Any) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return point numbers of all cells, the start of each cell and its length; empty where they are inconsistent."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    connectivity = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    starts = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    count = np.diff(starts)
    if not len(starts) or starts[0] != 0 or starts[-1] > len(connectivity) or (count < 0).any():
        return connectivity[:0], starts[:0], starts[:0]
    return connectivity, starts[:-1], count


def _polygons(cells: Any, vertices: NDArray[Any]) -> NDArray[np.int64]:
    """Return triangles (m, 3): quadrilaterals are cut along the shorter diagonal, larger polygons into fans."""
    connectivity, starts, count = _cells(cells)
    quads = connectivity[starts[count == 4][:, None] + np.arange(4)]
    quads = quads[((quads >= 0) & (quads < len(vertices))).all(axis=1)]
    first, second = (vertices[quads[:, k]] - vertices[quads[:, k + 2]] for k in (0, 1))
    turned = (first**2).sum(axis=1) > (second**2).sum(axis=1)
    quads = np.where(turned[:, None], np.roll(quads, -1, axis=1), quads)
    pieces = [connectivity[starts[count == 3][:, None] + np.arange(3)], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    for k in np.unique(count[count > 4]):
        fan = np.stack([np.zeros(k - 2, dtype=np.int64), np.arange(1, k - 1), np.arange(2, k)], axis=1)
        pieces.append(connectivity[starts[count == k][:, None, None] + fan].reshape(-1, 3))
    return np.concatenate(pieces)


def _strips(connectivity: NDArray[np.int64], starts: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles (m, 3) of triangle strips; every second one is reversed."""
    inner = np.maximum(count - 2, 0)
    step = np.arange(inner.sum()) - np.repeat(np.cumsum(inner) - inner, inner)
    first = np.repeat(starts, inner) + step
    odd = step % 2
    return connectivity[np.stack([first + odd, first + 1 - odd, first + 2], axis=1)]


def ply_strips(path: Path) -> NDArray[np.int64]:
    """Return the triangles (m, 3) of the strips in a PLY file, which follow its vertices; none where it has none."""
    data = path.read_bytes()
    end = re.search(rb"end_header\r?\n", data)
    head = data[: end.start()].decode("ascii", "replace") if end else ""
    before, _, _ = head.partition("element tristrips")
    declared = _STRIPS.search(head)
    if end is None or declared is None or "property list" in before:
        return np.zeros((0, 3), dtype=np.int64)
    n_vertices = int(re.findall(r"element\s+vertex\s+(\d+)", before)[0])
    columns = [TYPES[kind] for kind in re.findall(r"property\s+(\w+)\s+\w+", before)]
    strips = [np.zeros(0, dtype=np.int64)]
    if "format ascii" in head:
        words = data[end.end() :].split()[n_vertices * len(columns) :]
        at = 0
        for _ in range(int(declared[1])):
            at, end_of_strip = at + 1, at + 1 + int(words[at])
            strips.append(np.array([int(word) for word in words[at:end_of_strip]], dtype=np.int64))
            at = end_of_strip
    else:
        order, at = ">" if "big_endian" in head else "<", end.end()
        at += n_vertices * sum(np.dtype(kind).itemsize for kind in columns)
        count, corner = np.dtype(order + TYPES[declared[2]]), np.dtype(order + TYPES[declared[3]])
        for _ in range(int(declared[1])):
            n = int(np.frombuffer(data, count, 1, at)[0])
            strips.append(np.frombuffer(data, corner, n, at + count.itemsize).astype(np.int64))
            at += count.itemsize + n * corner.itemsize
    corners = np.concatenate([part for strip in strips for part in (strip, [-1])])
    ends = np.flatnonzero(corners < 0)  # a strip may also hold several, separated by -1
    starts = np.append(0, ends[:-1] + 1)
    return _strips(corners, starts, ends - starts)
