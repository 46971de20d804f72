"""Connectivity of triangle meshes: welding, orientation, components, and separation of non-manifold parts."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints

Labels = NDArray[np.int64]


class Edges(NamedTuple):
    """The edges of a mesh, sorted. A *use* is a side of a face; the uses of one edge are consecutive."""

    face: Labels
    """(3 m,) face of every use."""
    side: Labels
    """(3 m,) side of that face: from its corner `side` to the next."""
    is_upward: Bools
    """(3 m,) whether the side goes from the lower vertex number to the higher."""
    starts: Labels
    """(e,) first use of every edge."""
    n_uses: Labels
    """(e,) number of uses: 1 at an open edge, 2 at a regular one, more at a non-manifold one."""


def edges_of(faces: Ints) -> Edges:
    """Return the sorted edges of faces (m, 3)."""
    directed = triangles.directed_edges(faces).astype(np.int64)
    low, high = np.sort(directed, axis=1).T
    code = low * (high.max(initial=0) + 1) + high
    order = np.argsort(code, kind="stable")
    starts, n_uses = np.unique(code[order], return_index=True, return_counts=True)[1:]
    side, face = np.divmod(order, max(len(faces), 1))
    return Edges(face, side, directed[order, 0] < directed[order, 1], starts, n_uses)


def weld(vertices: Floats, faces: Ints, tolerance: float) -> tuple[Floats, Ints]:
    """Merge vertices that are closer than `tolerance`, transitively; the first of each group is kept."""
    kept, same = first_equals(vertices)  # otherwise every pair of many equal points would be listed as near
    label = triangles.joined(cKDTree(vertices[kept]).query_pairs(tolerance, output_type="ndarray"), len(kept))
    _, first = np.unique(label, return_index=True)
    return vertices[kept[first]], label[same[faces]]


CRACK_OF_EDGE: Final = (0.001, 0.003, 0.01, 0.03, 0.1)
"""Widths of cracks that are tried, as fractions of the median length of open edges."""
CLOSED: Final = 0.5
"""Smallest fraction of the open edges that meet once cracks are closed; the edges of real openings stay apart."""


def without_cracks(vertices: Floats, faces: Ints) -> tuple[Ints, float]:
    """Merge the vertices of open edges that miss each other by little, where most open edges meet then.

    The mesh has no equal vertices. Returns faces (m, 3) on the vertices that are kept, and the smallest width at which
    most edges meet; 0 where nothing was merged.
    """
    rims = triangles.open_edges(faces)
    rim, place = np.unique(rims, return_inverse=True)
    if not len(rim):
        return faces, 0.0
    widths = np.array(CRACK_OF_EDGE) * float(
        np.median(np.linalg.norm(vertices[rims[:, 0]] - vertices[rims[:, 1]], axis=1))
    )
    tree = cKDTree(vertices[rim])
    labels = [triangles.joined(tree.query_pairs(width, output_type="ndarray"), len(rim)) for width in widths]
    meeting = []
    for label in labels:
        edges = np.sort(label[place.reshape(-1, 2)].astype(np.int64), axis=1)
        edges = edges[edges[:, 0] != edges[:, 1]]
        count = np.unique(edges[:, 0] * len(rim) + edges[:, 1], return_counts=True)[1]
        meeting.append(int(count[count > 1].sum()))
    best = int(np.argmax(meeting))  # the first of equals
    if meeting[best] < CLOSED * len(rims):
        return faces, 0.0
    _, first, group = np.unique(labels[best], return_index=True, return_inverse=True)
    same = np.arange(len(vertices))
    same[rim] = rim[first[group]]
    return same[faces].astype(np.int32), float(widths[best])


def first_equals(vertices: Floats) -> tuple[Ints, Ints]:
    """Return the first (k,) of each set of equal vertices, in order, and for every vertex (n,) its position there."""
    rows = np.ascontiguousarray(vertices + 0.0, dtype=np.float64).view("V24").ravel()
    _, first, same = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[same.ravel()]


def _components(n: int, a: NDArray[np.integer], b: NDArray[np.integer]) -> Labels:
    """Return the component (n,) of every node of the graph with edges a - b."""
    return triangles.joined(np.stack([a, b], axis=1), n).astype(np.int64)


def sound_faces(faces: Ints) -> Bools:
    """Return for each face (m,) whether it has three different vertices and no earlier face has the same three."""
    ordered = np.sort(faces, axis=1).astype(np.int64)
    distinct = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    n = ordered.max(initial=0) + 1
    pair = ordered[:, 0] * n + ordered[:, 1]
    order = np.lexsort((ordered[:, 2], pair))  # stable: the first face of equals stays first
    repeated = (np.diff(pair[order]) == 0) & (np.diff(ordered[order, 2]) == 0)
    is_first = np.ones(len(faces), dtype=bool)
    is_first[order[1:][repeated]] = False
    return distinct & is_first


def face_components(faces: Ints) -> Labels:
    """Return the component (m,) of every face; faces are connected by shared edges."""
    pairs = face_neighbours(faces)
    return _components(len(faces), pairs[:, 0], pairs[:, 1])


def face_neighbours(faces: Ints) -> Ints:
    """Return pairs (k, 2) of faces that share an edge; more than two faces at an edge are paired in a chain."""
    edges = edges_of(faces)
    later = np.delete(np.arange(len(edges.face)), edges.starts)
    return np.stack([edges.face[later - 1], edges.face[later]], axis=1).astype(np.int32)


def patches(faces: Ints) -> Labels:
    """Return the patch (m,) of every face; patches are bounded by open edges and edges of more than two faces."""
    f, g, _ = _neighbours(faces)
    return _components(len(faces), f, g)


def _neighbours(faces: Ints) -> tuple[Labels, Labels, Bools]:
    """Return pairs of faces (e,), (e,) across the edges of exactly two faces, and whether orientations clash (e,)."""
    edges = edges_of(faces)
    first = edges.starts[edges.n_uses == 2]
    return edges.face[first], edges.face[first + 1], edges.is_upward[first] == edges.is_upward[first + 1]


def oriented(faces: Ints) -> tuple[Ints, Bools]:
    """Return faces turned so that neighbours across regular edges agree, and which were turned (m,).

    The majority of every patch is kept. Each face and its reverse are two nodes of a graph, joined to the neighbour
    with the same orientation. The two components of that graph are the two orientations. A patch with one component
    only (a Moebius strip) has no orientation. There each face follows the majority of its neighbours, and some still
    clash.
    """
    m = len(faces)
    f, g, is_clash = _neighbours(faces)
    shift = np.where(is_clash, m, 0)
    sheet = _components(2 * m, np.concatenate([f, f + m]), np.concatenate([g + shift, (g + m + shift) % (2 * m)]))
    turned = sheet[:m] > sheet[m:]
    component = np.minimum(sheet[:m], sheet[m:])
    many = np.bincount(component[turned], minlength=2 * m) * 2 > np.bincount(component, minlength=2 * m)
    turned ^= many[component]
    degree = np.bincount(f, minlength=m) + np.bincount(g, minlength=m)
    while (sheet[:m] == sheet[m:]).any():
        clash = is_clash ^ turned[f] ^ turned[g]
        wants = 2 * (np.bincount(f[clash], minlength=m) + np.bincount(g[clash], minlength=m)) > degree
        both = wants[f] & wants[g]
        wants[np.maximum(f[both], g[both])] = False
        if not wants.any():
            break
        turned ^= wants
    return np.where(turned[:, None], faces[:, ::-1], faces), turned


def clashing(faces: Ints) -> Bools:
    """Return for each face (m,) whether its orientation clashes with that of a neighbour."""
    f, g, is_clash = _neighbours(faces)
    result = np.zeros(len(faces), dtype=bool)
    result[f[is_clash]] = result[g[is_clash]] = True
    return result


def overused(faces: Ints) -> Bools:
    """Return for each face (m,) whether it shares an edge with two or more others."""
    edges = edges_of(faces)
    result = np.zeros(len(faces), dtype=bool)
    result[edges.face[np.repeat(edges.n_uses > 2, edges.n_uses)]] = True
    return result


def inner_sheets(vertices: Floats, faces: Ints) -> Bools:
    """Return for each face (m,) whether it belongs to a sheet inside the surface, such as a fin or a membrane.

    Where an odd number of patches meets at an edge, one of them is inside. It is the one with the smallest area,
    because a membrane is smaller than the wall that bulges over the same border.
    """
    edges, patch = edges_of(faces), patches(faces)
    area = np.bincount(patch, triangles.areas(vertices[faces]))
    is_inner = np.zeros(len(area), dtype=bool)
    odd = (edges.n_uses > 2) & (edges.n_uses % 2 == 1)
    for start, count in zip(edges.starts[odd], edges.n_uses[odd], strict=True):
        meeting = np.unique(patch[edges.face[start : start + count]])
        if len(meeting) > 1 and not is_inner[meeting].any():
            is_inner[meeting[np.argmin(area[meeting])]] = True
    return is_inner[patch]


def unzipped(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Split vertices so that every fan of faces around a vertex has its own, and the mesh is a manifold with boundary.

    Faces stay joined across edges that exactly two of them share. At an edge of more faces, those that bound the same
    wedge of the inside stay joined and all others are separated. Faces must be oriented.
    """
    m = len(faces)
    edges = edges_of(faces)
    first = edges.starts[edges.n_uses == 2]
    a, b = [first], [first + 1]
    for start, count in zip(edges.starts[edges.n_uses > 2], edges.n_uses[edges.n_uses > 2], strict=True):
        pairs = _wedges(vertices, faces, edges, np.arange(start, start + count))
        a.append(pairs[:, 0])
        b.append(pairs[:, 1])
    use, other = np.concatenate(a), np.concatenate(b)
    # corners are numbered corner * m + face; a neighbour of equal orientation has the edge in opposite direction
    tail, head = edges.side * m + edges.face, (edges.side + 1) % 3 * m + edges.face
    agree = edges.is_upward[use] != edges.is_upward[other]
    use, other = use[agree], other[agree]
    label = _components(3 * m, np.concatenate([tail[use], head[use]]), np.concatenate([head[other], tail[other]]))
    _, where = np.unique(label, return_index=True)
    number = faces.T.ravel()[where].astype(np.int64)  # the first fan keeps the vertex number, others are appended
    order = np.argsort(number, kind="stable")
    is_more = np.concatenate([[False], np.diff(number[order]) == 0])[: len(order)]
    more = order[is_more]
    vertices = np.concatenate([vertices, vertices[number[more]]])
    number[more] = len(vertices) - len(more) + np.arange(len(more))
    return vertices, number[label].reshape(3, m).T.astype(np.int32)


def _wedges(vertices: Floats, faces: Ints, edges: Edges, uses: Labels) -> Labels:
    """Return pairs (k, 2) of uses of one edge that bound the same wedge of the inside.

    Around the edge, the inside begins at one face and ends at the next one of opposite direction.
    """
    face, side = edges.face[uses], edges.side[uses]
    up = edges.is_upward[uses]
    ends = np.sort([faces[face[0], side[0]], faces[face[0], (side[0] + 1) % 3]])
    along = vertices[ends[1]] - vertices[ends[0]]
    along = along / max(float(np.linalg.norm(along)), 1e-300)
    apex = vertices[faces[face, (side + 2) % 3]] - vertices[ends[0]]
    apex = apex - (apex @ along)[:, None] * along
    e1 = apex[0] / max(float(np.linalg.norm(apex[0])), 1e-300)
    angle = np.arctan2(apex @ np.cross(along, e1), apex @ e1)
    order = np.argsort(angle, kind="stable")
    following = np.roll(order, -1)
    # seen along the edge, angles increase counter-clockwise; the outward normal of an upward face points to larger
    # angles, so that the inside begins at a downward face and ends at the next upward one
    is_wedge = ~up[order] & up[following]
    return np.stack([uses[order[is_wedge]], uses[following[is_wedge]]], axis=1)


def least_area(polygon: Floats, is_taken: Bools) -> Ints | None:
    """Return the triangulation (n - 2, 3) of a closed polygon (n, 3) with the smallest area; None if there is none.

    The triangles have the direction of the polygon. No chord joins the pairs of vertices (n, n) that are taken. The
    search is a dynamic programme over the chords (Barequet and Sharir 1995, Comput. Aided Geom. Des. 12:207, sec. 3.2).
    """
    n = len(polygon)
    cost, apex = np.zeros((n, n)), np.zeros((n, n), dtype=np.int32)
    for span in range(2, n):
        for i in range(n - span):
            j, k = i + span, np.arange(i + 1, i + span)
            area = 0.5 * np.linalg.norm(np.cross(polygon[k] - polygon[i], polygon[j] - polygon[i]), axis=1)
            total = cost[i, k] + cost[k, j] + area
            apex[i, j] = k[total.argmin()]
            cost[i, j] = np.inf if is_taken[i, j] and span < n - 1 else total.min()
    if n < 3 or not np.isfinite(cost[0, n - 1]):
        return None
    faces, chords = [], [(0, n - 1)]
    while chords:
        low, high = chords.pop()
        if high - low > 1:
            middle = int(apex[low, high])
            faces.append((low, middle, high))
            chords += [(low, middle), (middle, high)]
    return np.array(faces, dtype=np.int32)
