"""The part of a triangle mesh beyond a plane that is connected to a given face: its volume, section and wall."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from vstent.kernels import topology
from vstent.kernels.arrays import Bools, Floats, Ints


class Sheet(NamedTuple):
    """A connected triangle mesh with boundary."""

    vertices: Floats
    """(n, 3) vertices."""
    faces: Ints
    """(m, 3) vertex indices."""
    neighbours: Ints
    """(m, 3) face across each of the edges 01, 12 and 20; -1 at an open edge."""
    terms: Floats
    """(m, 4 + w) of each face: 6 times the volume of its tetrahedron with the origin, its area vector, and w weighted
    areas."""


def sheet(vertices: Floats, faces: Ints, weights: Floats) -> Sheet:
    """Return a mesh, with at most two faces at an edge, and the integrals of its faces with weights (m, w) of areas."""
    edges = topology.edges_of(faces)
    one = edges.starts[edges.n_uses == 2]
    neighbours = np.full((len(faces), 3), -1, dtype=np.int32)
    for use, other in ((one, one + 1), (one + 1, one)):
        neighbours[edges.face[use], edges.side[use]] = edges.face[other]
    a, b, c = vertices[faces].transpose(1, 0, 2)
    vector = 0.5 * np.cross(b - a, c - a)
    tetrahedron = np.einsum("fi,fi->f", a, np.cross(b, c))
    terms = np.column_stack([tetrahedron, vector, np.linalg.norm(vector, axis=1)[:, None] * weights])
    return Sheet(np.array(vertices, order="C"), np.array(faces, dtype=np.int32, order="C"), neighbours, terms)


def beyond(mesh: Sheet, seed: int, points: Floats, normals: Floats) -> tuple[Floats, Bools]:
    """Measure the part of a mesh beyond each of several planes: points (k, 3), unit normals (k, 3) toward the part.

    The part is the wall beyond the plane that is connected to the face `seed`. It includes pouches that hang back
    through the plane and have no boundary of their own, so the section is the area of the other openings.

    Returns
    -------
    measures : (k, 2 + w) volume of the part closed by the plane, area of its section, and its weighted areas.
    is_closed : (k,) whether the part has no open edges of the mesh; otherwise the measures are not complete.
    """
    return _beyond(*mesh, seed, np.ascontiguousarray(points), np.ascontiguousarray(normals))


@njit(cache=True)
def _beyond(
    vertices: Any, faces: Any, neighbours: Any, terms: Any, seed: int, points: Any, normals: Any
) -> tuple[Any, Any]:
    """Return the measures (k, 2 + w) of the part beyond each plane, and whether it has no open edge (k,)."""
    measures, is_closed = np.zeros((len(points), terms.shape[1] - 2)), np.zeros(len(points), dtype=np.bool_)
    height = np.zeros(len(vertices))
    seen, stack, cut = np.zeros((3, len(faces)), dtype=np.int32)
    shares = np.zeros((len(faces), terms.shape[1]))
    ring, total = np.zeros((4, 3)), np.zeros(terms.shape[1])
    for k in range(len(points)):
        p, q = points[k], normals[k]
        level = p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
        for v in range(len(vertices)):
            height[v] = vertices[v, 0] * q[0] + vertices[v, 1] * q[1] + vertices[v, 2] * q[2] - level
        if max(height[faces[seed, 0]], height[faces[seed, 1]], height[faces[seed, 2]]) <= 0.0:
            continue
        # 0: not reached, 1: reached, 2: cut by the plane.
        seen[:] = 0
        total[:] = 0.0
        is_closed[k] = True
        stack[0], n, n_cut = seed, 1, 0
        seen[seed] = 1
        while n > 0 and is_closed[k]:
            n -= 1
            f = stack[n]
            if min(height[faces[f, 0]], height[faces[f, 1]], height[faces[f, 2]]) > 0.0:
                total += terms[f]
            else:
                seen[f] = 2
                cut[n_cut] = f
                n_cut += 1
                _part(vertices, faces[f], height, terms[f], ring, shares[f])
                total += shares[f]
            for i in range(3):
                if max(height[faces[f, i]], height[faces[f, (i + 1) % 3]]) > 0.0:
                    g = neighbours[f, i]
                    if g < 0:
                        is_closed[k] = False
                    elif seen[g] == 0:
                        seen[g] = 1
                        stack[n] = g
                        n += 1
        if is_closed[k]:
            _add_pouches(faces, neighbours, terms, height, seen, stack, cut[:n_cut], shares, total)
        measures[k, 0] = (total[0] - 2.0 * (p[0] * total[1] + p[1] * total[2] + p[2] * total[3])) / 6.0
        measures[k, 1] = q[0] * total[1] + q[1] * total[2] + q[2] * total[3]
        measures[k, 2:] = total[4:]
    return measures, is_closed


@njit(cache=True)
def _part(vertices: Any, face: Any, height: Any, terms: Any, ring: Any, share: Any) -> None:
    """Set `share` to the terms of the part of a face beyond a plane; `ring` is scratch."""
    n = 0
    for i in range(3):
        j = (i + 1) % 3
        high, low = height[face[i]], height[face[j]]
        if high > 0.0:
            ring[n] = vertices[face[i]]
            n += 1
        if (high > 0.0) != (low > 0.0):
            along = high / (high - low)
            for x in range(3):
                ring[n, x] = vertices[face[i], x] + along * (vertices[face[j], x] - vertices[face[i], x])
            n += 1
    share[:] = 0.0
    for i in range(1, n - 1):
        u, v, w = ring[0], ring[i], ring[i + 1]
        for x in range(3):
            y, z = (x + 1) % 3, (x + 2) % 3
            share[0] += u[x] * (v[y] * w[z] - v[z] * w[y])
            share[1 + x] += 0.5 * ((v[y] - u[y]) * (w[z] - u[z]) - (v[z] - u[z]) * (w[y] - u[y]))
    whole = terms[1] ** 2 + terms[2] ** 2 + terms[3] ** 2
    fraction = (share[1] * terms[1] + share[2] * terms[2] + share[3] * terms[3]) / max(whole, 1e-300)
    share[4:] = fraction * terms[4:]


@njit(cache=True)
def _add_pouches(
    faces: Any, neighbours: Any, terms: Any, height: Any, seen: Any, stack: Any, cut: Any, shares: Any, total: Any
) -> None:
    """Add the terms of wall behind the plane that starts at cut faces and has no open edge of the mesh."""
    # 3: visited, 4: visited and cut by the plane, with its other side in the part.
    pouch = np.zeros(terms.shape[1])
    for start in cut:
        if seen[start] == 4:
            continue
        seen[start] = 4
        stack[0], n = start, 1
        pouch[:] = 0.0
        is_open = False
        while n > 0:
            n -= 1
            f = stack[n]
            pouch += terms[f]
            if seen[f] == 4:
                pouch -= shares[f]
            for i in range(3):
                if seen[f] == 4 and min(height[faces[f, i]], height[faces[f, (i + 1) % 3]]) > 0.0:
                    continue
                g = neighbours[f, i]
                if g < 0:
                    is_open = True
                elif seen[g] == 0 or seen[g] == 2:
                    seen[g] = 3 if seen[g] == 0 else 4
                    stack[n] = g
                    n += 1
        if not is_open:
            total += pouch
