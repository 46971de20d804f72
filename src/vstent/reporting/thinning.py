"""Reduce triangles, points and frames so that a scene is small enough for a page."""

import itertools

import numpy as np
from scipy.spatial import cKDTree

from vstent.devices.stent import Deployment
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats, Ints


def thin_surface(surface: Surface, n_faces: int) -> tuple[Surface, Ints]:
    """Return a surface decimated to about `n_faces` faces, and the nearest given vertex (n,) of every new vertex.

    A surface that is small enough is returned as it is.
    """
    if len(surface.faces) <= n_faces:
        return surface, np.arange(len(surface.vertices_mm), dtype=np.int32)
    import fast_simplification

    # The library does not change the arrays, but it rejects read-only ones.
    vertices, faces = fast_simplification.simplify(
        surface.vertices_mm.copy(), surface.faces.copy(), target_count=n_faces
    )
    origin = np.asarray(cKDTree(surface.vertices_mm).query(vertices)[1], dtype=np.int32)
    return Surface(vertices, faces), origin


def thin_lines(points: Floats, starts: Ints, values: Floats, n_points: int) -> tuple[Floats, Ints, Floats]:
    """Return polylines with about `n_points` points (p, 3) and values (p,): every k-th and the last of each line."""
    step = max(1, -(-len(points) // n_points))
    kept = [np.append(np.arange(a, b - 1, step), b - 1) for a, b in itertools.pairwise(starts)]
    chosen = np.concatenate([np.zeros(0, dtype=int), *kept])
    new_starts = np.concatenate([[0], np.cumsum([len(k) for k in kept])]).astype(np.int32)
    return points[chosen], new_starts, values[chosen] if len(values) else values


def some_frames(deployment: Deployment, n_frames: int) -> Ints:
    """Return the indices of evenly spaced contours of an expansion, including the first and the last."""
    last = len(deployment.history_mm) - 1
    return np.unique(np.linspace(0, last, min(n_frames, last + 1)).astype(int))


def thin_frames(deployment: Deployment, landing_surface: Surface, n_frames: int) -> tuple[Floats, Floats]:
    """Return contours over the expansion of a device, and their gaps to the wall.

    The gap of an earlier contour is its distance to the wall, reduced by the part of that distance that belongs to the
    device at the deployed node.
    """
    nodes = deployment.stent.nodes_mm.reshape(-1, 3)
    gaps = deployment.wall_gap_mm.ravel()
    history = deployment.history_mm.reshape(len(deployment.history_mm), -1, 3)
    chosen = some_frames(deployment, n_frames)
    frames = np.concatenate([history[chosen[:-1]], nodes[None]])
    kept = landing_surface.closest(nodes)[1] - gaps
    before = [np.maximum(landing_surface.closest(frame)[1] - kept, 0.0) for frame in frames[:-1]]
    return frames, np.stack([*before, gaps])
