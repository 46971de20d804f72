"""Bounding-box tree over triangles: closest point, signed distance, crossings and first hit of a ray.

The triangles of a node are halved at the median along the longest side of their box, down to one triangle per leaf.
The leaves are the last level of a complete binary tree stored as a heap without pointers: the children of node i are
2 i + 1 and 2 i + 2.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numba import njit, prange

from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints

_STACK: Final = 64
"""Size of the stack of nodes to visit."""


@dataclass(frozen=True, eq=False)
class Tree:
    """The tree as arrays."""

    vertices: Floats
    """(n, 3) vertices of the surface."""
    faces: Ints
    """(m, 3) faces of the surface."""
    corners: Floats
    """(m, 3, 3) triangles in tree order."""
    face: Ints
    """(m,) face number in the surface of every triangle in tree order."""
    low: Floats
    """(nodes, 3) lower corner of every node's box."""
    high: Floats
    """(nodes, 3) upper corner of every node's box."""
    rise: Floats | None = None
    """(m, 3) rise (n_b - n_a) (b - a) of the edges 01, 12, 20 of curved triangles, which the boxes contain. An edge
    bulges by t (1 - t) / 2 times its rise. None for flat triangles."""

    @cached_property
    def pseudonormal(self) -> Floats:
        """(m, 7, 3) normals of each triangle's face, edges 01, 12, 20 and corners 0, 1, 2, in tree order.

        Their sign test is exact on closed surfaces (Baerentzen and Aanaes 2005, IEEE TVCG 11(3)).
        """
        normals = triangles.normals(self.vertices[self.faces])
        low, high = np.sort([self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()], axis=0).astype(np.int64)
        edge = np.unique(low * len(self.vertices) + high, return_inverse=True)[1]
        at_edge = np.stack([np.bincount(edge, np.repeat(normals[:, k], 3)) for k in range(3)], axis=1)
        at_corner = triangles.vertex_normals(self.vertices, self.faces)[self.faces]
        return np.concatenate([normals[:, None], at_edge[edge].reshape(-1, 3, 3), at_corner], axis=1)[self.face]


def build(vertices: Floats, faces: Ints) -> Tree:
    """Return the tree over triangles (m, 3) of vertices (n, 3)."""
    corners = vertices[faces]
    order = _median_order(corners.mean(axis=1))
    corners = np.ascontiguousarray(corners[order])
    return Tree(vertices, faces, corners, order, *_boxes(corners, 0.0))


def curved(tree: Tree, normals: Floats) -> Tree:
    """Return the tree with its triangles curved by unit normals (m, 3, 3) at the corners of every face.

    Along an edge the quadratic with the normals of its ends rises by t (1 - t) / 2 times (n_b - n_a) (b - a). Inside a
    triangle the contributions of the edges are added.
    """
    rise = triangles.edge_rises(tree.corners, normals[tree.face])
    low, high = _boxes(tree.corners, np.abs(rise).sum(axis=1, keepdims=True) / 8)
    return replace(tree, low=low, high=high, rise=rise)


@njit(cache=True)
def _median_order(points: Any) -> Any:
    """Return the order (m,) in which each node's triangles are halved along the longest side."""
    n = len(points)
    order = np.arange(n).astype(np.int32)
    block = 1
    while block < n:
        block *= 2
    while block > 1:
        half = block // 2
        for start in range(0, n - half, block):
            end = min(start + block, n)
            axis, longest = 0, -1.0
            for k in range(3):
                low, high = np.inf, -np.inf
                for i in range(start, end):
                    low, high = min(low, points[order[i], k]), max(high, points[order[i], k])
                if high - low > longest:
                    axis, longest = k, high - low
            _part(points[:, axis], order, start, end - 1, start + half)
        block = half
    return order


@njit(cache=True)
def _part(key: Any, order: Any, first: int, last: int, middle: int) -> None:
    """Reorder so that triangles of smaller key come before `middle` (Hoare 1961, Algorithm 65: FIND)."""
    while first < last:
        pivot = key[order[(first + last) // 2]]
        i, j = first, last
        while i <= j:
            while key[order[i]] < pivot:
                i += 1
            while key[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if j < middle:
            first = i
        if i > middle:
            last = j


def _boxes(corners: Floats, margin: Floats | float) -> tuple[Floats, Floats]:
    """Return the lower and upper corner (nodes, 3) of each node's box, with a margin (m, 1) around the triangles.

    Boxes of nodes without triangles are at infinity.
    """
    n_leaves = 1 << int(np.ceil(np.log2(max(1, len(corners)))))
    low, high = np.full((2 * n_leaves - 1, 3), np.inf), np.full((2 * n_leaves - 1, 3), -np.inf)
    leaves = slice(n_leaves - 1, n_leaves - 1 + len(corners))
    low[leaves], high[leaves] = corners.min(axis=1) - margin, corners.max(axis=1) + margin
    while n_leaves > 1:
        n_leaves //= 2
        nodes, children = slice(n_leaves - 1, 2 * n_leaves - 1), slice(2 * n_leaves - 1, 4 * n_leaves - 1)
        low[nodes] = low[children].reshape(-1, 2, 3).min(axis=1)
        high[nodes] = high[children].reshape(-1, 2, 3).max(axis=1)
    high[low == np.inf] = np.inf  # every ray would enter a box from inf to -inf
    return low, high


def _plain(points: Floats) -> Floats:
    """Return points as a writable array: numba compiles separate code for read-only arrays."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    return points if points.flags.writeable else points.copy()


def closest_points(tree: Tree, points: Floats) -> tuple[Floats, Floats, Ints]:
    """Return the closest point (n, 3) of the surface, its distance (n,) and its face (n,) for points (n, 3)."""
    closest, distance, triangle, _ = _closest_all(tree.corners, tree.low, tree.high, _plain(points))
    return closest, distance, tree.face[triangle]


def inscribed_radii(tree: Tree, points: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3) inside a wall to its curved triangles, at least 0."""
    return _inscribed_all(tree.corners, tree.rise, tree.low, tree.high, _plain(points))


def signed_distances(tree: Tree, points: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3) to a closed surface, negative inside."""
    closest, distance, triangle, feature = _closest_all(tree.corners, tree.low, tree.high, _plain(points))
    side = np.einsum("ij,ij->i", points - closest, tree.pseudonormal[triangle, feature])
    return np.where(side < 0, -distance, distance)


def segments_cross(tree: Tree, starts: Floats, ends: Floats) -> Bools:
    """Return for each segment, from starts (n, 3) to ends (n, 3), whether it meets a triangle."""
    return _first_hit_all(tree.corners, tree.low, tree.high, _plain(starts), ends - starts, 1.0)[0] <= 1.0


def first_hits(tree: Tree, origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
    """Return the distance (n,) to the first triangle along unit rays (n, 3), inf where there is none, and its face."""
    distance, triangle = _first_hit_all(tree.corners, tree.low, tree.high, _plain(origins), _plain(directions), np.inf)
    return distance, tree.face[triangle]


def sees_inside(tree: Tree, origins: Floats, directions: Floats) -> Bools:
    """Return whether rays from origins (n, 3) along directions (n, 3) hit a closed surface from within.

    This is true for every ray of a point inside. Where all walls are about equally near, it is much faster than a
    search for the closest point.
    """
    distance, face = first_hits(tree, origins, directions)
    normals = triangles.normals(tree.vertices[tree.faces[face]])
    return np.isfinite(distance) & (np.einsum("ij,ij->i", normals, directions) > 0)


@njit(cache=True)
def _dot(a0: float, a1: float, a2: float, b0: float, b1: float, b2: float) -> float:
    """Return the scalar product of two vectors given by components."""
    return a0 * b0 + a1 * b1 + a2 * b2


@njit(cache=True)
def _closest_on_longest_edge(t: Any, p: Any, ab_ab: float, ac_ac: float) -> tuple[float, float, int]:
    """Return the result of `_closest_on_triangle` for a triangle whose corners lie on one line."""
    bc_bc = 0.0
    for k in range(3):
        bc_bc += (t[2, k] - t[1, k]) ** 2
    first, last = (1, 2) if bc_bc >= max(ab_ab, ac_ac) else (0, 1) if ab_ab >= ac_ac else (0, 2)
    reach, length2 = 0.0, 0.0
    for k in range(3):
        reach += (t[last, k] - t[first, k]) * (p[k] - t[first, k])
        length2 += (t[last, k] - t[first, k]) ** 2
    share = min(max(reach / max(length2, 1e-300), 0.0), 1.0)
    if first == 1:
        return 1.0 - share, share, 2
    return (share, 0.0, 1) if last == 1 else (0.0, share, 3)


@njit(cache=True)
def _closest_on_triangle(p: Any, t: Any) -> tuple[float, float, int]:
    """Return barycentric weights (v, w) of the closest point a + v ab + w ac, and the feature on which it lies.

    Features are 0 for the face, 1, 2, 3 for the edges ab, bc, ca, and 4, 5, 6 for the corners a, b, c (Ericson 2005,
    Real-Time Collision Detection, sec. 5.1.5).
    """
    ab0, ab1, ab2 = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    ac0, ac1, ac2 = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    ap0, ap1, ap2 = p[0] - t[0, 0], p[1] - t[0, 1], p[2] - t[0, 2]
    d1 = _dot(ab0, ab1, ab2, ap0, ap1, ap2)
    d2 = _dot(ac0, ac1, ac2, ap0, ap1, ap2)
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0, 4
    bp0, bp1, bp2 = p[0] - t[1, 0], p[1] - t[1, 1], p[2] - t[1, 2]
    d3 = _dot(ab0, ab1, ab2, bp0, bp1, bp2)
    d4 = _dot(ac0, ac1, ac2, bp0, bp1, bp2)
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0, 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 > d3:  # d1 = d3: a and b coincide, the other edges decide
        return d1 / (d1 - d3), 0.0, 1
    cp0, cp1, cp2 = p[0] - t[2, 0], p[1] - t[2, 1], p[2] - t[2, 2]
    d5 = _dot(ab0, ab1, ab2, cp0, cp1, cp2)
    d6 = _dot(ac0, ac1, ac2, cp0, cp1, cp2)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0, 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 > d6:
        return 0.0, d2 / (d2 - d6), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0 and d4 - d3 + d5 - d6 > 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w, 2
    total = va + vb + vc
    ab_ab, ac_ac = _dot(ab0, ab1, ab2, ab0, ab1, ab2), _dot(ac0, ac1, ac2, ac0, ac1, ac2)
    if total <= 1e-13 * max(ab_ab, ac_ac) ** 2:  # the area is zero within rounding: use the longest edge
        return _closest_on_longest_edge(t, p, ab_ab, ac_ac)
    return vb / total, vc / total, 0


@njit(cache=True)
def ray_meets_triangle(o: Any, d: Any, t: Any) -> float:
    """Return the parameter s at which the ray o + s d hits a triangle, inf where it misses (Moeller, Trumbore 1997)."""
    e0, e1, e2 = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    f0, f1, f2 = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    h0, h1, h2 = d[1] * f2 - d[2] * f1, d[2] * f0 - d[0] * f2, d[0] * f1 - d[1] * f0
    det = e0 * h0 + e1 * h1 + e2 * h2
    if abs(det) < 1e-300:
        return np.inf
    s0, s1, s2 = o[0] - t[0, 0], o[1] - t[0, 1], o[2] - t[0, 2]
    u = (s0 * h0 + s1 * h1 + s2 * h2) / det
    q0, q1, q2 = s1 * e2 - s2 * e1, s2 * e0 - s0 * e2, s0 * e1 - s1 * e0
    v = (d[0] * q0 + d[1] * q1 + d[2] * q2) / det
    # The tolerance closes the seams between triangles: a ray through a shared edge must hit one of them.
    if u < -1e-12 or v < -1e-12 or u + v > 1.0 + 1e-12:
        return np.inf
    s = (f0 * q0 + f1 * q1 + f2 * q2) / det
    return s if s >= 0.0 else np.inf


@njit(cache=True)
def _away2(point: Any, low: Any, high: Any) -> float:
    """Return the squared distance of a point from a box."""
    total = 0.0
    for k in range(3):
        gap = max(low[k] - point[k], 0.0, point[k] - high[k])
        total += gap * gap
    return total


@njit(cache=True)
def _closest_one(corners: Any, low: Any, high: Any, p: Any, best: Any) -> tuple[float, int, int]:
    """Write the closest point into `best`; return its squared distance, triangle and feature."""
    first_leaf = low.shape[0] // 2
    stack, bound = np.zeros(_STACK, dtype=np.int32), np.zeros(_STACK)
    size, best2, best_triangle, best_feature = min(1, len(corners)), np.inf, 0, 0
    while size > 0:
        size -= 1
        node = stack[size]
        if bound[size] >= best2:
            continue
        if node < first_leaf:
            first, second = 2 * node + 1, 2 * node + 2
            left, right = _away2(p, low[first], high[first]), _away2(p, low[second], high[second])
            if left < right:
                first, second, left, right = second, first, right, left
            if left < best2:
                stack[size], bound[size] = first, left
                size += 1
            if right < best2:
                stack[size], bound[size] = second, right
                size += 1
            continue
        t = corners[node - first_leaf]
        v, w, feature = _closest_on_triangle(p, t)
        c0 = t[0, 0] + v * (t[1, 0] - t[0, 0]) + w * (t[2, 0] - t[0, 0])
        c1 = t[0, 1] + v * (t[1, 1] - t[0, 1]) + w * (t[2, 1] - t[0, 1])
        c2 = t[0, 2] + v * (t[1, 2] - t[0, 2]) + w * (t[2, 2] - t[0, 2])
        d2 = (p[0] - c0) ** 2 + (p[1] - c1) ** 2 + (p[2] - c2) ** 2
        if d2 < best2:
            best2, best_triangle, best_feature = d2, node - first_leaf, feature
            best[0], best[1], best[2] = c0, c1, c2
    return best2, best_triangle, best_feature


@njit(cache=True, parallel=True, nogil=True)
def _closest_all(corners: Any, low: Any, high: Any, points: Any) -> tuple[Any, Any, Any, Any]:
    """Return closest point, distance, triangle and feature for every point."""
    n = points.shape[0]
    closest = np.zeros((n, 3))
    distance = np.zeros(n)
    triangle = np.zeros(n, dtype=np.int32)
    feature = np.zeros(n, dtype=np.int32)
    for i in prange(n):
        d2, t, f = _closest_one(corners, low, high, points[i], closest[i])
        distance[i], triangle[i], feature[i] = np.sqrt(d2), t, f
    return closest, distance, triangle, feature


@njit(cache=True)
def _inscribed_one(corners: Any, rise: Any, low: Any, high: Any, p: Any) -> float:
    """Return the distance of a point from the curved triangles."""
    first_leaf = low.shape[0] // 2
    stack, bound = np.zeros(_STACK, dtype=np.int32), np.zeros(_STACK)
    size, best = min(1, len(corners)), np.inf
    while size > 0:
        size -= 1
        node = stack[size]
        if bound[size] >= best:
            continue
        if node < first_leaf:
            first, second = 2 * node + 1, 2 * node + 2
            left, right = _away2(p, low[first], high[first]), _away2(p, low[second], high[second])
            left, right = np.sqrt(left), np.sqrt(right)
            if left < right:
                first, second, left, right = second, first, right, left
            if left < best:
                stack[size], bound[size] = first, left
                size += 1
            if right < best:
                stack[size], bound[size] = second, right
                size += 1
            continue
        i = node - first_leaf
        t = corners[i]
        v, w, _ = _closest_on_triangle(p, t)
        u, d2 = 1.0 - v - w, 0.0
        for k in range(3):
            d2 += (p[k] - u * t[0, k] - v * t[1, k] - w * t[2, k]) ** 2
        bulge = 0.5 * (u * v * rise[i, 0] + v * w * rise[i, 1] + w * u * rise[i, 2])
        best = min(best, np.sqrt(d2) + bulge)
    return best


@njit(cache=True, parallel=True)
def _inscribed_all(corners: Any, rise: Any, low: Any, high: Any, points: Any) -> Any:
    """Return the distance (n,) of every point from the curved triangles, at least 0."""
    radius = np.zeros(points.shape[0])
    for i in prange(points.shape[0]):
        radius[i] = max(_inscribed_one(corners, rise, low, high, points[i]), 0.0)
    return radius


@njit(cache=True)
def _entry(origin: Any, inverse: Any, low: Any, high: Any, node: int) -> float:
    """Return the distance at which a ray enters a node's box, 0 from inside, inf where it misses."""
    near, far = 0.0, np.inf
    for k in range(3):
        t0 = (low[node, k] - origin[k]) * inverse[k]
        t1 = (high[node, k] - origin[k]) * inverse[k]
        if t0 > t1:
            t0, t1 = t1, t0
        if t0 > near:
            near = t0
        if t1 < far:
            far = t1
    return near if near <= far * (1.0 + 1e-12) + 1e-12 else np.inf


@njit(cache=True)
def _first_hit_one(corners: Any, low: Any, high: Any, origin: Any, direction: Any, limit: float) -> tuple[float, int]:
    """Return the parameter of a ray's first hit, inf where there is none, and the triangle."""
    first_leaf = low.shape[0] // 2
    inverse = np.zeros(3)
    for k in range(3):
        inverse[k] = 1.0 / direction[k] if abs(direction[k]) > 1e-200 else 1e200
    stack, bound = np.zeros(_STACK, dtype=np.int32), np.zeros(_STACK)
    size, best, hit = min(1, len(corners)), np.inf, 0
    while size > 0:
        size -= 1
        node = stack[size]
        # A hit at the face of a box must not be lost by rounding: boxes count as slightly nearer.
        if bound[size] > min(best, limit) * (1.0 + 1e-12) + 1e-12:
            continue
        if node < first_leaf:
            first, second = 2 * node + 1, 2 * node + 2
            left, right = _entry(origin, inverse, low, high, first), _entry(origin, inverse, low, high, second)
            if left < right:
                first, second, left, right = second, first, right, left
            if left < np.inf:
                stack[size], bound[size] = first, left
                size += 1
            if right < np.inf:
                stack[size], bound[size] = second, right
                size += 1
            continue
        s = ray_meets_triangle(origin, direction, corners[node - first_leaf])
        if s < best:
            best, hit = s, node - first_leaf
    return best, hit


@njit(cache=True, parallel=True, nogil=True)
def _first_hit_all(corners: Any, low: Any, high: Any, origins: Any, directions: Any, limit: float) -> tuple[Any, Any]:
    """Return the parameter of every ray's first hit, inf where there is none, and the triangle."""
    n = origins.shape[0]
    hit = np.full(n, np.inf)
    triangle = np.zeros(n, dtype=np.int32)
    for i in prange(n):
        hit[i], triangle[i] = _first_hit_one(corners, low, high, origins[i], directions[i], limit)
    return hit, triangle
