"""Triangle meshes as arrays: areas, normals, volume, boundary loops, caps, cuts and connected components.

Triangles are arrays of corners (m, 3, 3), or vertices (n, 3) and faces (m, 3).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vstent.kernels.arrays import Floats, Ints


def areas(corners: Floats) -> Floats:
    """Return the areas (m,) of triangles (m, 3, 3)."""
    return 0.5 * np.linalg.norm(_crosses(np.ascontiguousarray(corners, dtype=np.float64)), axis=1)


def normals(corners: Floats) -> Floats:
    """Return the unit normals (m, 3) of triangles (m, 3, 3); zero for degenerate ones."""
    cross = _crosses(np.ascontiguousarray(corners, dtype=np.float64))
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)


@njit(cache=True)
def _crosses(corners: Any) -> Any:
    """Return the cross product (m, 3) of two edges of each triangle."""
    cross = np.zeros((len(corners), 3))
    for f in range(len(corners)):
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            cross[f, k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
    return cross


def volume(corners: Floats) -> float:
    """Return the volume enclosed by a closed surface of triangles (m, 3, 3), by the divergence theorem."""
    local = corners - corners.reshape(-1, 3).mean(axis=0)
    return float(np.einsum("ij,ij->", local[:, 0], np.cross(local[:, 1], local[:, 2])) / 6)


def vertex_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return unit normals (n, 3) weighted by the triangles' angles (Baerentzen and Aanaes 2005, IEEE TVCG 11(3))."""
    corners = np.ascontiguousarray(vertices[faces], dtype=np.float64)
    total = _angle_weighted(corners, np.ascontiguousarray(faces), normals(corners), len(vertices))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


@njit(cache=True)
def _angle_weighted(corners: Any, faces: Any, normal: Any, n_vertices: int) -> Any:
    """Return the sum (n, 3) of face normals at each vertex, weighted by angle."""
    total = np.zeros((n_vertices, 3))
    for f in range(len(faces)):
        for k in range(3):
            o, p, q = corners[f, k], corners[f, (k + 1) % 3], corners[f, (k + 2) % 3]
            a0, a1, a2 = p[0] - o[0], p[1] - o[1], p[2] - o[2]
            b0, b1, b2 = q[0] - o[0], q[1] - o[1], q[2] - o[2]
            c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            angle = np.arctan2(np.sqrt(c0 * c0 + c1 * c1 + c2 * c2), a0 * b0 + a1 * b1 + a2 * b2)
            for axis in range(3):
                total[faces[f, k], axis] += angle * normal[f, axis]
    return total


def smooth_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return unit normals (n, 3) of the smooth surface that a mesh samples (Max 1999, J. Graph. Tools 4(2):1, eq. 2).

    They are exact for vertices on a sphere, and more accurate on a third-order surface than angle-weighted normals.
    """
    total = _max_weighted(np.ascontiguousarray(vertices[faces], dtype=np.float64), faces, len(vertices))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


@njit(cache=True)
def _max_weighted(corners: Any, faces: Any, n_vertices: int) -> Any:
    """Return the sum (n, 3) of face normals at each vertex with the weights of Max 1999."""
    total = np.zeros((n_vertices, 3))
    for f in range(len(faces)):
        for k in range(3):
            a2, b2 = 1e-300, 1e-300
            for i in range(3):
                a2 += (corners[f, (k + 1) % 3, i] - corners[f, k, i]) ** 2
                b2 += (corners[f, (k + 2) % 3, i] - corners[f, k, i]) ** 2
            for i in range(3):
                m, n = (i + 1) % 3, (i + 2) % 3
                a_m, a_n = corners[f, (k + 1) % 3, m] - corners[f, k, m], corners[f, (k + 1) % 3, n] - corners[f, k, n]
                b_m, b_n = corners[f, (k + 2) % 3, m] - corners[f, k, m], corners[f, (k + 2) % 3, n] - corners[f, k, n]
                total[faces[f, k], i] += (a_m * b_n - a_n * b_m) / (a2 * b2)
    return total


def barycentric(corners: Floats, points: Floats) -> Floats:
    """Return barycentric weights (n, 3) of points (n, 3), each in its own triangle (n, 3, 3)."""
    first, second, offset = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb, ra, rb = (
        np.einsum("ij,ij->i", u, v)
        for u, v in ((first, first), (first, second), (second, second), (offset, first), (offset, second))
    )
    area2 = np.maximum(aa * bb - ab * ab, 1e-300)
    v, w = np.clip((bb * ra - ab * rb) / area2, 0.0, 1.0), np.clip((aa * rb - ab * ra) / area2, 0.0, 1.0)
    return np.stack([np.maximum(1.0 - v - w, 0.0), v, w], axis=1)


def directed_edges(faces: Ints) -> Ints:
    """Return all directed edges (3 m, 2): 01 of all faces, then 12 of all, then 20 of all."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def open_edges(faces: Ints) -> Ints:
    """Return the directed edges (k, 2) that belong to a single face."""
    edges = directed_edges(faces)
    low, high = np.sort(edges, axis=1).astype(np.int64).T
    _, inverse, count = np.unique(low * (high.max(initial=0) + 1) + high, return_inverse=True, return_counts=True)
    return edges[count[inverse] == 1]


def boundary_loops(vertices: Floats, faces: Ints) -> tuple[Ints, ...]:
    """Return the closed loops of vertex numbers along open edges, longest perimeter first.

    Each loop has the direction of the faces next to it, opposite to that of a cap. Loops that touch at a vertex are
    separated there.
    """
    following: dict[int, list[int]] = {}
    for a, b in open_edges(faces).tolist():
        following.setdefault(a, []).append(b)
    loops: list[list[int]] = []
    while following:
        loops.extend(_walk(following))
    found = [np.array(loop, dtype=np.int32) for loop in loops if len(loop) >= 3]
    return tuple(sorted(found, key=lambda loop: -perimeter(vertices[loop])))


def _walk(following: dict[int, list[int]]) -> list[list[int]]:
    """Return the loops on one walk along open edges, which are removed from `following`."""
    path = [next(iter(following))]
    closed: list[list[int]] = []
    while path and path[-1] in following:
        ends = following[path[-1]]
        vertex = ends.pop()
        if not ends:
            del following[path[-1]]
        if vertex in path:
            start = path.index(vertex)
            closed.append(path[start:])
            del path[start + 1 :]
        else:
            path.append(vertex)
    return closed


def perimeter(points: Floats) -> float:
    """Return the length of the closed polygon through points (n, 3)."""
    return float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())


def polygon_area_vector(points: Floats) -> Floats:
    """Return the area vector (3,) of a closed polygon (n, 3), by Newell's method; its length is the area if flat."""
    local = points - points.mean(axis=0)
    return 0.5 * np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)


def polygon_centroid(points: Floats) -> Floats:
    """Return the area centroid (3,) of a nearly flat closed polygon (n, 3)."""
    mean = points.mean(axis=0)
    local = points - mean
    unit = polygon_area_vector(points)
    unit = unit / max(float(np.linalg.norm(unit)), 1e-300)
    weight = np.cross(local, np.roll(local, -1, axis=0)) @ unit
    total = weight.sum()
    if abs(total) < 1e-300:
        return mean
    return mean + ((local + np.roll(local, -1, axis=0)) * weight[:, None]).sum(axis=0) / (3 * total)


def cap(vertices: Floats, faces: Ints, loops: Sequence[Ints]) -> tuple[Floats, Ints]:
    """Return vertices and faces of a mesh whose `loops` are closed by fans around their centroids."""
    new_vertices, new_faces = [vertices], [faces]
    for k, loop in enumerate(loops):
        center = len(vertices) + k
        new_vertices.append(polygon_centroid(vertices[loop])[None])
        new_faces.append(np.stack([np.roll(loop, -1), loop, np.full_like(loop, center)], axis=1).astype(np.int32))
    return np.concatenate(new_vertices), np.concatenate(new_faces).astype(np.int32)


def compact(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Return vertices and faces without the vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(faces.shape).astype(np.int32)


def clip(vertices: Floats, faces: Ints, level: Floats) -> tuple[Floats, Ints, Floats]:
    """Return the part of a mesh where `level` (n,) is negative, with its level; faces are cut along level 0.

    The level is linear along edges, and faces next to each other share the vertices of the cut.
    """
    level = np.where(np.abs(level) < 1e-12, 1e-12, level)
    inside = level[faces] < 0
    count = inside.sum(axis=1)
    single, double = faces[count == 1], faces[count == 2]
    a = _rotated(single, inside[count == 1].argmax(axis=1))
    b = _rotated(double, inside[count == 2].argmin(axis=1))
    points, crossing = _crossings(
        vertices, np.concatenate([a[:, [0, 1]], a[:, [0, 2]], b[:, [0, 1]], b[:, [0, 2]]]), level
    )
    n, m = len(a), len(b)
    a1, a2, b1, b2 = np.split(crossing, [n, 2 * n, 2 * n + m])
    corners = np.stack([a[:, 0], a1, a2], axis=1)
    quads = [np.stack([b1, b[:, 1], b[:, 2]], axis=1), np.stack([b1, b[:, 2], b2], axis=1)]
    kept = np.concatenate([faces[count == 3], corners, *quads]).astype(np.int32)
    used, renumbered = np.unique(kept, return_inverse=True)
    levels = np.concatenate([level, np.zeros(len(points) - len(level))])
    return points[used], renumbered.reshape(kept.shape).astype(np.int32), levels[used]


def cut(vertices: Floats, faces: Ints, value: Floats) -> tuple[Floats, Ints]:
    """Return the part of a mesh where a value (n,), linear on every face, is at most 0.

    Faces share the vertices of the cut. Vertices that no face uses any more stay in the list.
    """
    positive = value[faces] > 0
    count = positive.sum(axis=1)
    one, two = faces[count == 1], faces[(count == 2) & (value[faces].min(axis=1) < 0)]
    a = _rotated(one, np.argmax(value[one] > 0, axis=1))
    b = _rotated(two, np.argmin(value[two] > 0, axis=1))
    vertices, crossing = _crossings(
        vertices, np.concatenate([a[:, [0, 1]], a[:, [0, 2]], b[:, [0, 1]], b[:, [0, 2]]]), value
    )
    a1, a2, b1, b2 = np.split(crossing, [len(a), 2 * len(a), 2 * len(a) + len(b)])
    quads = [np.stack([a[:, 1], a[:, 2], a2], axis=1), np.stack([a[:, 1], a2, a1], axis=1)]
    made = np.concatenate([*quads, np.stack([b[:, 0], b1, b2], axis=1)])
    sound = (made[:, 0] != made[:, 1]) & (made[:, 1] != made[:, 2]) & (made[:, 2] != made[:, 0])
    return vertices, np.concatenate([faces[count == 0], made[sound]]).astype(np.int32)


def section(vertices: Floats, faces: Ints, value: Floats) -> Floats:
    """Return the segments (s, 2, 3) along which a mesh meets the zero of `value` (n,), linear on every face."""
    is_positive = value[faces] > 0
    count = is_positive.sum(axis=1)
    one = _rotated(faces[count == 1], np.argmax(is_positive[count == 1], axis=1))
    lone = np.concatenate([one, _rotated(faces[count == 2], np.argmin(is_positive[count == 2], axis=1))])
    a, b = lone[:, :1], lone[:, 1:]
    share = (value[a] / (value[a] - value[b]))[..., None]
    return np.asarray(vertices[a] + share * (vertices[b] - vertices[a]))


def _rotated(faces: Ints, start: Ints) -> Ints:
    """Return every face rotated so that its corner number `start` comes first."""
    return np.take_along_axis(faces, (start[:, None] + np.arange(3)) % 3, axis=1)


def _crossings(vertices: Floats, edges: Ints, value: Floats) -> tuple[Floats, Ints]:
    """Return vertices with one more per edge whose ends differ in sign, and its number for every edge (k,).

    For an edge with an end at zero, the number is that of this end.
    """
    low, high = edges.min(axis=1), edges.max(axis=1)
    on_zero = (value[low] == 0) | (value[high] == 0)
    code, inverse = np.unique(low.astype(np.int64) * len(vertices) + high, return_inverse=True)
    a, b = code // len(vertices), code % len(vertices)
    span = np.where(value[a] == value[b], 1.0, value[a] - value[b])
    t = np.clip(value[a] / span, 0.0, 1.0)[:, None]
    created = vertices[a] + t * (vertices[b] - vertices[a])
    answer = np.where(on_zero, np.where(value[low] == 0, low, high), len(vertices) + inverse)
    return np.concatenate([vertices, created]), answer.astype(np.int32)


def components(faces: Ints, n_vertices: int) -> Ints:
    """Return the number (m,) of each face's connected component; faces are connected by shared vertices."""
    return joined(directed_edges(faces), n_vertices)[faces[:, 0]]


def joined(pairs: Ints, n: int) -> Ints:
    """Return the number (n,) of each item's connected component, given connected pairs (k, 2) of n items."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int32)


def sample(vertices: Floats, faces: Ints, most: int = 30_000, coarsest: float = 0.4) -> tuple[Floats, Floats]:
    """Return evenly spaced points (k, 3) on a surface and its normals (k, 3) there.

    Every point is a vertex or lies on a face; one is kept per cube of the spacing. The spacing is `coarsest`, limited
    to between one and two times that at which there are `most` points.
    """
    corners = vertices[faces]
    even = float(np.sqrt(areas(corners).sum() / most))
    spacing = float(np.clip(coarsest, even, 2.0 * even))
    points, directions = [vertices], [vertex_normals(vertices, faces)]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    level = np.clip(np.ceil(longest / spacing), 1, 64).astype(int)
    for n in np.unique(level[level > 1]):
        v, w = (grid.ravel() / n for grid in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        inside = v + w <= 1 + 1e-9
        weights = np.stack([1 - v - w, v, w], axis=1)[inside]
        points.append(np.einsum("pk,fkd->fpd", weights, corners[level == n]).reshape(-1, 3))
        directions.append(np.repeat(normals(corners[level == n]), len(weights), axis=0))
    every = np.concatenate(points)
    cube = np.floor((every - every.min(axis=0)) / spacing).astype(np.int64)
    _, first = np.unique(cube @ np.array([1, 2**20, 2**40]), return_index=True)
    first = np.sort(first)
    return every[first], np.concatenate(directions)[first]


def part_at(vertices: Floats, faces: Ints, point: Floats) -> tuple[Floats, Ints]:
    """Return vertices and faces of the connected part with the face nearest to `point` (3,)."""
    return compact(vertices, faces_at(vertices, faces, point))


def faces_at(vertices: Floats, faces: Ints, point: Floats) -> Ints:
    """Return the faces (k, 3) of the connected part with the face nearest to `point` (3,)."""
    nearest = np.argmin(np.linalg.norm(vertices[faces].mean(axis=1) - point, axis=1))
    label = components(faces, len(vertices))
    return faces[label == label[nearest]]


def largest_part(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Return vertices and faces of the connected part with the largest area."""
    label = components(faces, len(vertices))
    area = np.bincount(label, areas(vertices[faces]))
    return compact(vertices, faces[label == np.argmax(area)])


def edge_rises(corners: Floats, normals: Floats) -> Floats:
    """Return the rise (m, 3) of the edges 01, 12, 20 of triangles (m, 3, 3) with unit normals at their corners.

    From a to b it is (n_b - n_a) (b - a). At fraction t the edge of the smooth surface bulges by t (1 - t) / 2 times
    the rise.
    """
    ahead = [1, 2, 0]
    return np.ascontiguousarray(np.einsum("fkd,fkd->fk", normals[:, ahead] - normals, corners[:, ahead] - corners))
