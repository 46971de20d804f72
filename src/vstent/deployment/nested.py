"""Keep the wires of a device inside those of devices that are in the artery before it."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from vstent.devices.stent import Stent
from vstent.geometry.surface import Surface
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

ROUNDS: Final = 10
"""Largest number of times that the contour is moved inward."""
REACH_MM: Final = 0.2
"""Largest depth, in mm, at which a wire is recognized on the wrong side of another one."""
SPARE_MM: Final = 0.001
"""Gap that is left between the wires of two devices, in mm."""


def kept_inside(
    stent: Stent, redrawn: Callable[[Floats], Stent], outer: Sequence[Stent], artery: Surface, is_nested: Bools
) -> Stent:
    """Return a device whose contour is moved inward where its wires would touch or pass those of outer devices.

    Nodes outside the artery, which occur in the narrow gap between its wall and a ramp, are put back first. `redrawn`
    returns the device with another contour (rows, columns, 3). Rows that are not in `is_nested` (rows,) are beyond a
    cell of the others or beside them, and only kept off their wires.
    """
    points_mm = stent.nodes_mm.reshape(-1, 3)
    middles_mm = np.repeat(stent.nodes_mm.mean(axis=1), stent.nodes_mm.shape[1], axis=0)
    is_outside = artery.crosses(middles_mm, points_mm) if outer else np.zeros(len(points_mm), dtype=bool)
    if is_outside.any():
        wall_mm, _, face = artery.closest(points_mm)
        inside_mm = wall_mm - stent.design.wall_offset_um * MM_PER_UM * artery.normals[face]
        stent = redrawn(np.where(is_outside[:, None], inside_mm, points_mm).reshape(stent.nodes_mm.shape))
    for done in range(ROUNDS if outer else 0):
        inward = stent.nodes_mm.mean(axis=1, keepdims=True) - stent.nodes_mm  # normals turn over where cells crumple
        inward /= curves.lengths(inward)[..., None]
        move_mm = np.zeros(inward.shape[0] * inward.shape[1])
        for other in outer:
            node, depth_mm = _overlaps(stent, other, inward.reshape(-1, 3), np.repeat(is_nested, inward.shape[1]))
            np.maximum.at(move_mm, node, depth_mm)
        if not move_mm.any():
            break
        move_mm = maximum_filter(move_mm.reshape(inward.shape[:2]), 3, mode=("nearest", "wrap"))
        # Crowns that slide along a strut do not come free by the depth of their overlap alone.
        stent = redrawn(stent.nodes_mm + (1 + done) * move_mm[..., None] * inward)
    return stent


def _overlaps(stent: Stent, other: Stent, inward: Floats, is_nested: Bools) -> tuple[Ints, Floats]:
    """Return nodes (k,) of a device near overlaps with another one, and how far (k,) to move it there, in mm.

    `inward` (n, 3) are unit vectors at its nodes. Wires overlap where they cross as seen along these vectors and that
    of the device is less than both radii further inward; at nodes that are not in `is_nested` (n,), where they touch.
    """
    (a, a_end, radius_a), (b, b_end, radius_b) = stent.pieces_mm, other.pieces_mm
    along_a, along_b = a_end - a, b_end - b
    half_a, half_b = 0.5 * curves.lengths(along_a) + radius_a, 0.5 * curves.lengths(along_b) + radius_b
    middles_a, middles_b = cKDTree(a + 0.5 * along_a), cKDTree(b + 0.5 * along_b)
    within_mm = half_a.max() + half_b.max() + REACH_MM
    pairs = middles_a.sparse_distance_matrix(middles_b, within_mm, output_type="coo_matrix")
    i, j = pairs.row, pairs.col
    node = np.asarray(cKDTree(stent.nodes_mm.reshape(-1, 3)).query(a)[1])[i]
    normal = inward[node]
    between, u, v = a[i] - b[j], along_a[i], along_b[j]
    flat = tuple(vectors - np.einsum("kd,kd->k", vectors, normal)[:, None] * normal for vectors in (between, u, v))
    reach_mm, depth_mm = radius_a[i] + radius_b[j], np.zeros(len(i))
    for is_asked, vectors in ((is_nested[node], flat), (True, (between, u, v))):
        share_a, share_b = _nearest(*vectors)
        apart_mm = between + share_a[:, None] * u - share_b[:, None] * v
        height_mm = np.einsum("kd,kd->k", apart_mm, normal)
        aside_mm2 = np.einsum("kd,kd->k", apart_mm, apart_mm) - height_mm**2
        rise_mm = np.sqrt(np.maximum(reach_mm**2 - aside_mm2, 0.0)) - height_mm
        depth_mm = np.maximum(
            depth_mm, np.where(is_asked & (aside_mm2 < reach_mm**2) & (height_mm > -REACH_MM), rise_mm, 0.0)
        )
    is_over = depth_mm > 0
    return node[is_over], depth_mm[is_over] + SPARE_MM


def _nearest(between: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Return the places (k,), 0 to 1, at which pairs of segments are nearest.

    The segments are u and v (k, 3), and the first begins at `between` (k, 3) from the start of the second.
    """
    uu, uv, vv, uw, vw = (np.einsum("kd,kd->k", p, q) for p, q in ((u, u), (u, v), (v, v), (u, between), (v, between)))
    crossed = uu * vv - uv * uv
    is_parallel = crossed < 1e-9 * uu * vv
    at_u = np.where(is_parallel, 0.5, (uv * vw - vv * uw) / np.where(is_parallel, 1.0, crossed))
    for _ in range(2):
        at_v = np.clip((uv * np.clip(at_u, 0.0, 1.0) + vw) / vv, 0.0, 1.0)
        at_u = np.clip((uv * at_v - uw) / uu, 0.0, 1.0)
    return at_u, at_v
