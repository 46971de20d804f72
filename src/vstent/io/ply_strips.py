"""Read the triangle strips of a PLY file, which VTK's reader skips."""

import re
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""NumPy's names of the types of a PLY file."""
_STRIPS: Final = re.compile(r"element\s+tristrips\s+(\d+)\s+property\s+list\s+(\w+)\s+(\w+)")
"""Declaration of the strips in the header."""


def ply_strips(path: Path) -> NDArray[np.int64]:
    """Return the triangles (m, 3) of the strips in a PLY file, which follow its vertices; none where it has none."""
    data = path.read_bytes()
    end = re.search(rb"end_header\r?\n", data)
    head = data[: end.start()].decode("ascii", "replace") if end else ""
    before, _, _ = head.partition("element tristrips")
    strips = _STRIPS.search(head)
    if end is None or strips is None or "property list" in before:
        return np.zeros((0, 3), dtype=np.int64)
    n_vertices = int(re.findall(r"element\s+vertex\s+(\d+)", before)[0])
    columns = [TYPES[kind] for kind in re.findall(r"property\s+(\w+)\s+\w+", before)]
    if "format ascii" in head:
        words = iter(data[end.end() :].split()[n_vertices * len(columns) :])
        rows = [[int(next(words)) for _ in range(int(next(words)))] for _ in range(int(strips[1]))]
        return _triangles([-1, *(corner for row in rows for corner in (*row, -1))])
    order, at = ">" if "big_endian" in head else "<", end.end()
    at += n_vertices * sum(np.dtype(kind).itemsize for kind in columns)
    count, corner = np.dtype(order + TYPES[strips[2]]), np.dtype(order + TYPES[strips[3]])
    corners = [np.array([-1])]
    for _ in range(int(strips[1])):
        n = int(np.frombuffer(data, count, 1, at)[0])
        corners += [np.frombuffer(data, corner, n, at + count.itemsize).astype(np.int64), np.array([-1])]
        at += count.itemsize + n * corner.itemsize
    return _triangles(np.concatenate(corners))


def _triangles(corners: NDArray[np.int64] | list[int]) -> NDArray[np.int64]:
    """Return the triangles (m, 3) of strips separated by -1; every second one of a strip is reversed."""
    corners = np.asarray(corners, dtype=np.int64)
    number = np.arange(len(corners))
    since = number - np.maximum.accumulate(np.where(corners < 0, number, 0)) - 1  # place in its strip
    found = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    found[since[:-2] % 2 == 1] = found[since[:-2] % 2 == 1][:, [1, 0, 2]]
    return found[(found >= 0).all(axis=1)]
