"""Medial graph of a closed surface: inscribed spheres from a Voronoi diagram, and shortest paths between them.

The vertices of the Voronoi diagram of a dense surface sample that lie inside the surface are, within the accuracy of
the sampling, centres of maximum inscribed spheres (Antiga et al. 2003, IEEE Trans. Med. Imaging 22:674).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import Delaunay, cKDTree

from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.tree import Tree, sees_inside

SHORTER: Final = 0.93
"""Factor by which the steps towards the widest sphere of a section shrink."""
N_STEPS: Final = 128
"""Number of these steps; the last is a ten-thousandth of the first."""


class Medial(NamedTuple):
    """The medial graph as arrays."""

    points: Floats
    """(n, 3) centres of inscribed spheres."""
    radius: Floats
    """(n,) radii of the spheres."""
    edges: Ints
    """(e, 2) pairs of spheres whose Delaunay tetrahedra share a face."""


def voronoi(samples: Floats) -> tuple[Medial, Ints]:
    """Return the Voronoi vertices of surface samples (n, 3), and the four samples (t, 4) equidistant from each."""
    # Exactly cospherical points on a lattice (marching cubes) form flat tetrahedra; a small jitter avoids this.
    scale = float(np.ptp(samples, axis=0).max())
    jitter = np.random.default_rng(0).normal(0.0, 1e-7 * scale, samples.shape)
    points = samples + jitter
    delaunay = Delaunay(points)
    center, radius = _circumspheres(points[delaunay.simplices])
    first = np.repeat(np.arange(len(center)), 4)
    second = delaunay.neighbors.ravel()
    once = second > first
    edges = np.stack([first[once], second[once]], axis=1).astype(np.int32)
    return Medial(center, radius, edges), delaunay.simplices


def _circumspheres(corners: Floats) -> tuple[Floats, Floats]:
    """Return centres and radii of the circumspheres of tetrahedra; the radius of a flat one is inf."""
    a = corners[:, 0]
    edges = corners[:, 1:] - a[:, None]
    right = 0.5 * np.einsum("ijk,ijk->ij", edges, edges)
    determinant = np.linalg.det(edges)
    flat = np.abs(determinant) < 1e-14
    edges = np.where(flat[:, None, None], np.eye(3), edges)
    offset = np.linalg.solve(edges, right[..., None])[..., 0]
    radius = np.where(flat, np.inf, np.linalg.norm(offset, axis=1))
    return a + np.where(flat[:, None], 0.0, offset), radius


def keep(medial: Medial, kept: Bools) -> Medial:
    """Return the part of the graph on the vertices where the mask `kept` (n,) is true."""
    number = np.cumsum(kept) - 1
    edges = medial.edges[kept[medial.edges].all(axis=1)]
    return Medial(medial.points[kept], medial.radius[kept], number[edges].astype(np.int32))


def with_terminals(medial: Medial, terminals: Floats, reach: Floats) -> Medial:
    """Return the graph with terminals appended, each joined to all spheres whose centres lie within its reach.

    Without such a sphere a terminal is joined to the nearest one, if it is within ten times the reach.

    Parameters
    ----------
    terminals : (t, 3); points to append.
    reach : (t,); distance within which each is joined.
    """
    n = len(medial.points)
    tree = cKDTree(medial.points)
    edges = [medial.edges]
    for k, (terminal, limit) in enumerate(zip(terminals, reach, strict=True)):
        near = tree.query_ball_point(terminal, limit) or [int(tree.query(terminal)[1])]
        near = near if np.linalg.norm(medial.points[near[0]] - terminal) < 10 * limit else []
        edges.append(np.stack([np.array(near, dtype=np.int32), np.full(len(near), n + k)], axis=1))
    radius = medial.radius[tree.query(terminals)[1]]
    return Medial(
        np.concatenate([medial.points, terminals]),
        np.concatenate([medial.radius, radius]),
        np.concatenate(edges).astype(np.int32),
    )


def cost_graph(medial: Medial, radius_cap: Floats) -> csr_matrix:
    """Return the symmetric graph whose edges have the cost length / radius (the travel time of Antiga et al. 2003).

    Parameters
    ----------
    radius_cap : (n,); upper limit of the radii.
    """
    radius = np.maximum(np.minimum(medial.radius, radius_cap), 1e-6)
    a, b = medial.edges.T
    length = np.linalg.norm(medial.points[a] - medial.points[b], axis=1)
    cost = np.maximum(length, 1e-12) * 0.5 * (1 / radius[a] + 1 / radius[b])
    n = len(radius)
    return coo_matrix((np.tile(cost, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(n, n)).tocsr()


def path_to(before: Ints, end: int) -> Ints:
    """Return the vertices from the root of a shortest-path tree to `end`.

    Parameters
    ----------
    before : (n,); predecessor of every vertex, negative at the root.
    end : last vertex.
    """
    path = [end]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.int32)


def spheres(samples: Floats, normals: Floats, closed: Tree, ends: Floats) -> Medial:
    """Return the medial graph inside a surface.

    Only the wall is sampled, not its caps, so that the spheres keep the vessel's radius towards an opening. A sphere is
    inside when its centre lies behind the wall at all four samples that it touches. This test is unreliable near the
    openings and for the widest spheres; there the closed surface decides.

    Parameters
    ----------
    samples, normals : (n, 3); points of the wall and outward normals.
    ends : (k, 3); centres of the openings.
    """
    every, touched = voronoi(samples)
    extent = float(np.ptp(samples, axis=0).max())
    offset = every.points[:, None] - samples[touched]
    behind = np.einsum("tkd,tkd->tk", offset, normals[touched]) < 0
    kept = (every.radius < extent) & np.isfinite(every.points).all(axis=1) & behind.all(axis=1)
    if not kept.any():
        return keep(every, kept)
    unsure = kept & (every.radius > 2.0 * np.quantile(every.radius[kept], 0.9))
    if len(ends):
        unsure |= kept & (cKDTree(ends).query(every.points)[0] < 3.0 * every.radius)
    kept[unsure] = sees_inside(closed, every.points[unsure], -offset[unsure, 0])
    return _largest(keep(every, kept))


def within(medial: Medial, closed: Tree) -> Medial:
    """Return the largest connected part of the graph among the spheres whose centres lie inside a closed surface."""
    askew = np.array([0.756, 0.539, 0.371])  # an oblique ray does not graze rows of triangles along an axis
    inside = sees_inside(closed, medial.points, np.broadcast_to(askew, medial.points.shape))
    return _largest(keep(medial, inside))


def _largest(medial: Medial) -> Medial:
    """Return the connected part with most spheres; sampling leaves a few isolated ones."""
    n = len(medial.points)
    if not n:
        return medial
    ones = np.ones(len(medial.edges), dtype=bool)
    graph = coo_matrix((ones, (medial.edges[:, 0], medial.edges[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    return keep(medial, label == np.argmax(np.bincount(label)))


def arms(medial: Medial, roots: Ints, least_cost: float, least_radius: float) -> list[Ints]:
    """Return paths from a tree to distant tips of the graph, the most distant first.

    The tree consists of the paths between `roots`, or of the widest sphere. Each path is added to the tree before the
    next tip is searched.

    Parameters
    ----------
    roots : (r,); vertices of the tree; may be empty.
    least_cost : minimum cost length / radius of a path, that is, its length in radii.
    least_radius : spheres up to this radius may lie between roots but do not form an arm.
    """
    graph = cost_graph(medial, np.full(len(medial.radius), np.inf))
    if len(roots):
        cost, before = shortest_paths(graph, int(roots[0]))
        roots = np.unique(np.concatenate([path_to(before, int(root)) for root in roots if np.isfinite(cost[root])]))
    else:
        roots = np.array([int(np.argmax(medial.radius))], dtype=np.int32)
    wide = medial.radius > least_radius
    wide[roots] = True
    number, original = np.cumsum(wide) - 1, np.flatnonzero(wide)
    graph, roots = graph[wide][:, wide], number[roots]
    found: list[Ints] = []
    while len(path := _farthest(graph, roots, least_cost)):
        found.append(original[path])
        roots = np.union1d(roots, path)
    return found


def _farthest(graph: csr_matrix, roots: Ints, least_cost: float) -> Ints:
    """Return the path from `roots` to the most distant vertex, empty when its cost is less than `least_cost`."""
    cost, before, _ = dijkstra(graph, directed=False, indices=roots, return_predecessors=True, min_only=True)
    cost[~np.isfinite(cost)] = -1.0
    tip = int(np.argmax(cost))
    return path_to(before, tip) if cost[tip] >= least_cost else np.zeros(0, dtype=np.int32)


def shortest_paths(graph: csr_matrix, start: int) -> tuple[Floats, Ints]:
    """Return the cost (n,) from vertex `start` to every vertex, inf where unreachable, and the predecessors (n,)."""
    cost, before, _ = dijkstra(
        graph, directed=False, indices=np.array([start]), return_predecessors=True, min_only=True
    )
    return cost, before


@njit(cache=True)
def widest_in_section(distance: Any, slope: Any, gain: float, first_step: Any) -> Any:
    """Return the shifts (n, 2) within sections that maximise the distance to the nearest of k planes.

    A penalty of `gain` times the shift is subtracted. Each step moves straight away from the nearest plane (subgradient
    method). Without planes ahead, the total shift is fourteen first steps.

    Parameters
    ----------
    distance : (n, k); distances from the planes.
    slope : (n, k, 2); decrease of the distances with the shift.
    gain : weight of the penalty.
    first_step : (n,); length of the first step.

    References
    ----------
    Shor 1985, Minimization Methods, sec. 2.4.
    """
    n, k = distance.shape
    shift = np.zeros((n, 2))
    for i in range(n):
        step = first_step[i]
        for _ in range(N_STEPS):
            least, nearest = np.inf, 0
            for j in range(k):
                gap = distance[i, j] - slope[i, j, 0] * shift[i, 0] - slope[i, j, 1] * shift[i, 1]
                if gap < least:
                    least, nearest = gap, j
            back = gain / max(np.sqrt(shift[i, 0] ** 2 + shift[i, 1] ** 2), 1e-300)
            shift[i, 0] -= step * (slope[i, nearest, 0] + back * shift[i, 0])
            shift[i, 1] -= step * (slope[i, nearest, 1] + back * shift[i, 1])
            step *= SHORTER
    return shift
