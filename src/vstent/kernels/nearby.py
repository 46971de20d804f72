"""Weighted sums over everything within reach of given nodes, with the weight (1 - r^2 / reach^2)^2.

The nodes are sorted into boxes, so that a point meets only the nodes near it.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from vstent.kernels.arrays import Floats, Ints

MOST_BOXES: Final = 64
"""Maximum number of boxes along an axis; the boxes of a long device are wider than the reach."""
_STACK: Final = 64
"""Size of the stack of triangles to quarter: three more for every halving of the edges."""


class _Boxes(NamedTuple):
    """Nodes by box."""

    nodes: Floats
    """(n, 3) nodes, sorted by box."""
    low: Floats
    """(3,) lower corner of the first box."""
    width: float
    """Edge of the boxes."""
    shape: Ints
    """(3,) number of boxes along each axis."""
    start: Ints
    """(boxes + 1,) first node of every box."""


def sums(nodes: Floats, points: Floats, values: Floats, reach: float) -> Floats:
    """Return the sums (n, k) of values (p, k) at points (p, 3) around nodes (n, 3), with weight zero beyond `reach`."""
    boxes, order = _boxed(nodes, reach)
    result = np.zeros((len(order), values.shape[1]))
    result[order] = _sums(boxes, np.array(points), np.array(values), reach)
    return result


def areas(nodes: Floats, corners: Floats, spacing: float, reach: float) -> Floats:
    """Return the weighted area (n,) of triangles (m, 3, 3) around nodes (n, 3), with weight zero beyond `reach`.

    A triangle is quartered until its edges are at most `spacing` long. Each part has the weight of its centroid.
    """
    boxes, order = _boxed(nodes, reach)
    result = np.zeros(len(order))
    result[order] = _areas(boxes, np.array(corners), spacing, reach)
    return result


def _boxed(nodes: Floats, reach: float) -> tuple[_Boxes, Ints]:
    """Return nodes (n, 3) by box, and their numbers (n,) in that order."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    width = max(reach, float((high - low).max()) / MOST_BOXES)
    place = ((nodes - low) / width).astype(np.int64)
    shape = place.max(axis=0) + 1
    box = (place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2]
    order = np.argsort(box, kind="stable")
    start = np.r_[0, np.cumsum(np.bincount(box, minlength=shape.prod()))]
    return _Boxes(nodes[order], low, width, shape, start), order


@njit(cache=True)
def _span(boxes: Any, k: int, x: float, reach: float) -> tuple[int, int]:
    """Return the first box along an axis that an interval meets, and the last plus one."""
    first, last = np.floor((x - reach - boxes.low[k]) / boxes.width), np.floor((x + reach - boxes.low[k]) / boxes.width)
    return int(min(max(first, 0.0), boxes.shape[k])), int(min(max(last + 1.0, 0.0), boxes.shape[k]))


@njit(cache=True)
def _distance2(nodes: Any, n: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a node from a point."""
    return (nodes[n, 0] - x) ** 2 + (nodes[n, 1] - y) ** 2 + (nodes[n, 2] - z) ** 2


@njit(cache=True)
def _sums(boxes: Any, points: Any, values: Any, reach: float) -> Any:
    """Return the weighted sums (n, k) of values (p, k) around the nodes in the order of their boxes."""
    nodes, start = boxes.nodes, boxes.start
    result = np.zeros((len(nodes), values.shape[1]))
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        i0, i1 = _span(boxes, 0, x, reach)
        j0, j1 = _span(boxes, 1, y, reach)
        k0, k1 = _span(boxes, 2, z, reach)
        for i in range(i0, i1):
            for j in range(j0, j1):
                row = (i * boxes.shape[1] + j) * boxes.shape[2]
                for n in range(start[row + k0], start[row + k1]):
                    left = 1.0 - _distance2(nodes, n, x, y, z) / (reach * reach)
                    if left > 0.0:
                        for k in range(values.shape[1]):
                            result[n, k] += left * left * values[p, k]
    return result


@njit(cache=True)
def _areas(boxes: Any, corners: Any, spacing: float, reach: float) -> Any:
    """Return the weighted area (n,) of triangles (m, 3, 3) around the nodes in the order of their boxes."""
    result = np.zeros(len(boxes.nodes))
    number = np.zeros(len(boxes.nodes), np.int64)
    near = np.zeros((3, len(boxes.nodes)))
    stack, per_reach2 = np.zeros((_STACK, 3, 3)), 1 / (reach * reach)
    own = np.zeros(len(boxes.nodes))
    for f in range(len(corners)):
        size = _near(boxes, corners[f], reach, near, number)
        own[:size] = 0.0
        stack[0] = corners[f]
        depth = 1
        while depth > 0:
            depth -= 1
            t, longest2, cross2 = stack[depth], 0.0, 0.0
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                longest2 = max(longest2, (t[k, 0] - t[i, 0]) ** 2 + (t[k, 1] - t[i, 1]) ** 2 + (t[k, 2] - t[i, 2]) ** 2)
                cross2 += ((t[1, i] - t[0, i]) * (t[2, j] - t[0, j]) - (t[1, j] - t[0, j]) * (t[2, i] - t[0, i])) ** 2
            if np.sqrt(longest2) > spacing:
                _quarter(stack, depth)
                depth += 4
                continue
            area = 0.5 * np.sqrt(cross2)
            x, y, z = _middle(t)
            for m in range(size):
                away2 = (near[0, m] - x) ** 2 + (near[1, m] - y) ** 2 + (near[2, m] - z) ** 2
                left = max(1.0 - away2 * per_reach2, 0.0)
                own[m] += area * left * left
        for m in range(size):
            result[number[m]] += own[m]
    return result


@njit(cache=True)
def _near(boxes: Any, t: Any, reach: float, near: Any, number: Any) -> int:
    """Write the nodes that may be within reach of a triangle, (3, n) and (n,); return how many they are."""
    x, y, z = _middle(t)
    radius2, size = 0.0, 0
    for i in range(3):
        radius2 = max(radius2, _distance2(t, i, x, y, z))
    far = reach + np.sqrt(radius2)
    i0, i1 = _span(boxes, 0, x, far)
    j0, j1 = _span(boxes, 1, y, far)
    k0, k1 = _span(boxes, 2, z, far)
    for i in range(i0, i1):
        for j in range(j0, j1):
            row = (i * boxes.shape[1] + j) * boxes.shape[2]
            for n in range(boxes.start[row + k0], boxes.start[row + k1]):
                if _distance2(boxes.nodes, n, x, y, z) < far * far:
                    for k in range(3):
                        near[k, size] = boxes.nodes[n, k]
                    number[size] = n
                    size += 1
    return size


@njit(cache=True)
def _middle(t: Any) -> tuple[float, float, float]:
    """Return the centroid of a triangle."""
    return ((t[0, 0] + t[1, 0] + t[2, 0]) / 3, (t[0, 1] + t[1, 1] + t[2, 1]) / 3, (t[0, 2] + t[1, 2] + t[2, 2]) / 3)


@njit(cache=True)
def _quarter(stack: Any, at: int) -> None:
    """Replace the triangle at a place of the stack by its four parts, cut at the midpoints of its edges."""
    for k in range(3):
        a, b, c = stack[at, 0, k], stack[at, 1, k], stack[at, 2, k]
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        stack[at, 0, k], stack[at, 1, k], stack[at, 2, k] = a, ab, ca
        stack[at + 1, 0, k], stack[at + 1, 1, k], stack[at + 1, 2, k] = ab, b, bc
        stack[at + 2, 0, k], stack[at + 2, 1, k], stack[at + 2, 2, k] = ca, bc, c
        stack[at + 3, 0, k], stack[at + 3, 1, k], stack[at + 3, 2, k] = ab, bc, ca
