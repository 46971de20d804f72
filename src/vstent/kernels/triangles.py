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
    return 0.5 * np.linalg.norm(_crosses(corners), axis=1)


def normals(corners: Floats) -> Floats:
    """Return the unit normals (m, 3) of triangles (m, 3, 3); zero for degenerate ones."""
    cross = _crosses(corners)
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)


def _crosses(corners: Floats) -> Floats:
    """Return the cross product (m, 3) of two edges of each triangle."""
    return _cross_all(np.ascontiguousarray(corners, dtype=np.float64))


@njit(cache=True)
def _cross_all(corners: Any) -> Any:
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
    """Return unit normals (n, 3) at the vertices, weighted by the angles of the triangles.

    References
    ----------
    Baerentzen and Aanaes 2005, IEEE TVCG 11(3), eq. 5.
    """
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
    """Return unit normals (n, 3) of the smooth surface that a mesh samples.

    They are exact for vertices on a sphere, and more accurate on a third-order surface than angle-weighted normals.

    References
    ----------
    Max 1999, J. Graph. Tools 4(2):1, eq. 2.
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
    """Return the part of a mesh where `level` is negative; faces are cut along level 0.

    Parameters
    ----------
    vertices, faces : (n, 3), (m, 3); the mesh.
    level : (n,); value at every vertex, linear along edges.

    Returns
    -------
    vertices : (k, 3); Vertices; faces next to each other share those of the cut.
    faces : (j, 3); faces.
    level : (k,); level at these vertices.
    """
    level = np.where(np.abs(level) < 1e-12, 1e-12, level)
    inside = level < 0
    count = inside[faces].sum(axis=1)
    whole = faces[count == 3]
    pieces = [whole]
    cut_edges: list[Ints] = []
    for n_inside in (1, 2):
        part = faces[count == n_inside]
        odd = inside[part] if n_inside == 1 else ~inside[part]
        rolled = np.take_along_axis(part, (odd.argmax(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
        a, b, c = rolled.T
        cut_edges.append(np.stack([np.stack([a, b], 1), np.stack([a, c], 1)], axis=1))
        pieces.append(rolled)
    ends = np.concatenate([edges.reshape(-1, 2) for edges in cut_edges])
    unique, inverse = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    number = (len(vertices) + inverse.ravel()).astype(np.int32).reshape(-1, 2)
    u, v = unique.T
    t = (level[u] / (level[u] - level[v]))[:, None] if len(unique) else np.zeros((0, 1))
    points = np.concatenate([vertices, vertices[u] + t * (vertices[v] - vertices[u])])
    levels = np.concatenate([level, np.zeros(len(unique))])
    n_single = len(pieces[1])
    single, double = number[:n_single], number[n_single:]
    corner = np.stack([pieces[1][:, 0], single[:, 0], single[:, 1]], axis=1)
    _, b, c = pieces[2].T
    quad = [np.stack([double[:, 0], b, c], axis=1), np.stack([double[:, 0], c, double[:, 1]], axis=1)]
    kept = np.concatenate([whole, corner, *quad]).astype(np.int32)
    used, renumbered = np.unique(kept, return_inverse=True)
    return points[used], renumbered.reshape(kept.shape).astype(np.int32), levels[used]


def components(faces: Ints, n_vertices: int) -> Ints:
    """Return the number (m,) of each face's connected component; faces are connected by shared vertices."""
    return joined(directed_edges(faces), n_vertices)[faces[:, 0]]


def joined(pairs: Ints, n: int) -> Ints:
    """Return the number (n,) of each item's connected component, given connected pairs (k, 2) of n items."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int32)


def face_neighbours(faces: Ints) -> Ints:
    """Return pairs (k, 2) of faces that share an edge; more than two faces at an edge are paired in a chain."""
    edges = np.sort(directed_edges(faces), axis=1).astype(np.int64)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    owner = np.tile(np.arange(len(faces)), 3)[order]
    return np.stack([owner[:-1][same], owner[1:][same]], axis=1).astype(np.int32)


def sample(vertices: Floats, faces: Ints, most: int = 30_000, coarsest: float = 0.4) -> tuple[Floats, Floats]:
    """Return evenly spaced points (k, 3) on a surface and its normals (k, 3) there.

    Every point is a vertex or lies on a face; one is kept per cube of the spacing.

    Parameters
    ----------
    vertices, faces : (n, 3), (m, 3); the surface.
    most : approximate maximum number of points; it limits how small the spacing is.
    coarsest : spacing wanted; limited to between one and two times the spacing at which there are `most` points.
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
