"""Medial graph of a closed surface: inscribed spheres from a Voronoi diagram, and shortest paths between them.

The vertices of the Voronoi diagram of a dense surface sample that lie inside the surface are, within the accuracy of
the sampling, centres of maximum inscribed spheres (Antiga et al. 2003, IEEE Trans. Med. Imaging 22:674).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import Delaunay, cKDTree

from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.tree import Tree, sees_inside
from vstent.kernels.triangles import joined

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

    def where(self, mask: Bools) -> "Medial":
        """Return the part of the graph on the vertices where a mask (n,) is true."""
        number = np.cumsum(mask) - 1
        edges = self.edges[mask[self.edges].all(axis=1)]
        return Medial(self.points[mask], self.radius[mask], number[edges].astype(np.int32))

    def largest(self) -> "Medial":
        """Return the connected part with most spheres; sampling leaves a few isolated ones."""
        if not len(self.points):
            return self
        label = joined(self.edges, len(self.points))
        return self.where(label == np.argmax(np.bincount(label)))


def with_terminals(medial: Medial, terminals: Floats, reach: Floats) -> Medial:
    """Return the graph with terminals (t, 3) appended, each joined to all spheres whose centres are within reach (t,).

    Without such a sphere a terminal is joined to the nearest one, if it is within ten times the reach.
    """
    n = len(medial.points)
    tree = cKDTree(medial.points)
    edges = [medial.edges]
    for k, (terminal, limit) in enumerate(zip(terminals, reach, strict=True)):
        near = tree.query_ball_point(terminal, limit) or [int(tree.query(terminal)[1])]
        near = near if np.linalg.norm(medial.points[near[0]] - terminal) < 10 * limit else []
        edges.append(np.stack([np.array(near, dtype=np.int32), np.full(len(near), n + k)], axis=1))
    points, radius = np.concatenate([medial.points, terminals]), medial.radius[tree.query(terminals)[1]]
    return Medial(points, np.concatenate([medial.radius, radius]), np.concatenate(edges).astype(np.int32))


def cost_graph(medial: Medial, radius_cap: Floats | float = np.inf) -> csr_matrix:
    """Return the symmetric graph whose edges cost length / radius (Antiga et al. 2003), with the radii (n,) capped."""
    radius = np.maximum(np.minimum(medial.radius, radius_cap), 1e-6)
    a, b = medial.edges.T
    length = np.linalg.norm(medial.points[a] - medial.points[b], axis=1)
    cost = np.maximum(length, 1e-12) * 0.5 * (1 / radius[a] + 1 / radius[b])
    n = len(radius)
    return coo_matrix((np.tile(cost, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(n, n)).tocsr()


def path_to(before: Ints, end: int) -> Ints:
    """Return the vertices to `end` from the root of a shortest-path tree of predecessors (n,), negative at the root."""
    path = [end]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.int32)


def spheres(samples: Floats, normals: Floats, closed: Tree, ends: Floats) -> Medial:
    """Return the medial graph inside a surface, from points (n, 3) of its wall with outward normals (n, 3).

    Only the wall is sampled, not its caps, so that the spheres keep the vessel's radius towards an opening. A sphere is
    inside when its centre lies behind the wall at all four samples that it touches. This test is unreliable near the
    openings, centered at ends (k, 3), and for the widest spheres; there the closed surface decides.
    """
    # Exactly cospherical points on a lattice (marching cubes) form flat tetrahedra; a small jitter avoids this.
    extent = float(np.ptp(samples, axis=0).max())
    points = samples + np.random.default_rng(0).normal(0.0, 1e-7 * extent, samples.shape)
    delaunay = Delaunay(points)
    corners = points[delaunay.simplices]
    sides = corners[:, 1:] - corners[:, :1]
    right = 0.5 * np.einsum("ijk,ijk->ij", sides, sides)
    is_flat = np.abs(np.linalg.det(sides)) < 1e-14
    from_corner = np.linalg.solve(np.where(is_flat[:, None, None], np.eye(3), sides), right[..., None])[..., 0]
    radius = np.where(is_flat, np.inf, np.linalg.norm(from_corner, axis=1))
    center = corners[:, 0] + np.where(is_flat[:, None], 0.0, from_corner)
    first, second = np.repeat(np.arange(len(center)), 4), delaunay.neighbors.ravel()
    edges = np.stack([first, second], axis=1)[second > first].astype(np.int32)
    every = Medial(center, radius, edges)
    offset = center[:, None] - samples[delaunay.simplices]
    behind = np.einsum("tkd,tkd->tk", offset, normals[delaunay.simplices]) < 0
    is_inside = (radius < extent) & np.isfinite(center).all(axis=1) & behind.all(axis=1)
    if not is_inside.any():
        return every.where(is_inside)
    unsure = is_inside & (radius > 2.0 * np.quantile(radius[is_inside], 0.9))
    if len(ends):
        unsure |= is_inside & (cKDTree(ends).query(center)[0] < 3.0 * radius)
    is_inside[unsure] = sees_inside(closed, center[unsure], -offset[unsure, 0])
    return every.where(is_inside).largest()


def within(medial: Medial, closed: Tree) -> Medial:
    """Return the largest connected part of the graph among the spheres whose centres lie inside a closed surface."""
    askew = np.array([0.756, 0.539, 0.371])  # an oblique ray does not graze rows of triangles along an axis
    inside = sees_inside(closed, medial.points, np.broadcast_to(askew, medial.points.shape))
    return medial.where(inside).largest()


def arms(medial: Medial, roots: Ints, least_cost: float, least_radius: float) -> list[Ints]:
    """Return paths from a tree to distant tips of the graph, the most distant first.

    The tree consists of the paths between roots (r,), or of the widest sphere without them. Each path is added to the
    tree before the next tip is searched. A path has at least the cost length / radius, that is, the length in radii;
    spheres up to the least radius may lie between roots but do not form an arm.
    """
    graph = cost_graph(medial)
    if len(roots):
        cost, before = shortest_paths(graph, int(roots[0]))
        roots = np.unique(np.concatenate([path_to(before, int(root)) for root in roots if np.isfinite(cost[root])]))
    else:
        roots = np.array([int(np.argmax(medial.radius))], dtype=np.int32)
    wide = medial.radius > least_radius
    wide[roots] = True
    number, original = np.cumsum(wide) - 1, np.flatnonzero(wide)
    graph, roots = graph[wide][:, wide], number[roots]
    paths: list[Ints] = []
    while True:
        cost, before = shortest_paths(graph, roots)
        cost[~np.isfinite(cost)] = -1.0
        tip = int(np.argmax(cost))
        if cost[tip] < least_cost:
            return paths
        path = path_to(before, tip)
        paths.append(original[path])
        roots = np.union1d(roots, path)


def shortest_paths(graph: csr_matrix, start: Ints | int) -> tuple[Floats, Ints]:
    """Return the cost (n,) from the nearest start to every vertex, inf where unreachable, and its predecessor (n,)."""
    starts = np.atleast_1d(start)
    cost, before, _ = dijkstra(graph, directed=False, indices=starts, return_predecessors=True, min_only=True)
    return cost, before


@njit(cache=True)
def widest_in_section(distance: Any, slope: Any, gain: float, first_step: Any) -> Any:
    """Return the shifts (n, 2) within sections that maximise the distance (n, k) to the nearest of k planes.

    The distances decrease with the shift by a slope (n, k, 2), and a penalty of `gain` times the shift is subtracted.
    Each step, the first of length `first_step` (n,), moves straight away from the nearest plane (subgradient method,
    Shor 1985, Minimization Methods, sec. 2.4). Without planes ahead, the total shift is fourteen first steps.
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
