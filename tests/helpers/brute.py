"""The plain implementation of the wall: every point and every segment against every triangle."""

import numpy as np

from vstent.deployment.wall import AbstractWall, Contact


class BruteWall(AbstractWall):
    """Every point against every triangle."""

    def __init__(self, surface):
        self.surface = surface

    def contact(self, points_mm):
        corners, normals = self.surface.corners_mm, self.surface.normals
        every = np.arange(len(corners))
        found = []
        for p in points_mm:
            candidates = [_on_edge(corners[:, k], corners[:, (k + 1) % 3], p) for k in range(3)]
            height = np.einsum("ij,ij->i", p - corners[:, 0], normals)
            foot = p - height[:, None] * normals
            candidates.append(np.where(_is_in_triangle(corners, normals, foot)[:, None], foot, corners[:, 0]))
            candidates = np.array(candidates)
            distance = np.linalg.norm(candidates - p, axis=2)
            which = distance.argmin(axis=0)
            best = distance[which, every].argmin()
            found.append((candidates[which[best], best], distance[which[best], best], normals[best], best))
        return Contact(*(np.array(part) for part in zip(*found, strict=True)))

    def crosses(self, starts_mm, ends_mm):
        """Signed volumes of tetrahedra: start and end on two sides, and the line inside the triangle."""
        a, b, c = self.surface.corners_mm.transpose(1, 0, 2)

        def volume(p, q, r, s):
            return np.einsum("...i,...i->...", np.cross(q - p, r - p), s - p)

        hits = []
        for p, q in zip(starts_mm, ends_mm, strict=True):
            sides = volume(a, b, c, p) * volume(a, b, c, q) <= 0
            u, v, w = volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)
            same = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
            hits.append(bool((sides & same).any()))
        return np.array(hits)


def _on_edge(a, b, p):
    t = np.einsum("ij,ij->i", p - a, b - a) / np.einsum("ij,ij->i", b - a, b - a)
    return a + np.clip(t, 0, 1)[:, None] * (b - a)


def _is_in_triangle(corners, normals, foot):
    turns = [np.cross(np.roll(corners, -k - 1, axis=1)[:, 0] - corners[:, k], foot - corners[:, k]) for k in range(3)]
    return np.all([np.einsum("ij,ij->i", turn, normals) >= 0 for turn in turns], axis=0)


def least_gap_mm(first, second):
    """The smallest gap between the wires of two devices, of all pairs of their pieces; negative where wires overlap."""
    a, a_end, a_half = first.pieces_mm
    b, b_end, b_half = second.pieces_mm
    middle, reach = 0.5 * (b + b_end), 0.5 * np.linalg.norm(b_end - b, axis=1) + b_half
    least = np.inf
    for k in range(len(a)):
        bound = np.linalg.norm(0.5 * (a[k] + a_end[k]) - middle, axis=1) - 0.5 * np.linalg.norm(a_end[k] - a[k]) - reach
        near = np.flatnonzero(bound - a_half[k] < min(least, 0.1))  # the others are farther apart than that
        if len(near):
            apart = _apart(a[k], a_end[k], b[near], b_end[near]) - a_half[k] - b_half[near]
            least = min(least, float(apart.min()))
    return least


def _apart(a, a_end, b, b_end):
    """Distances of a segment from segments (n, 3): the least of their ends, and of lines where they cross."""

    def to_segment(point, start, end):
        along = end - start
        t = np.sum((point - start) * along, axis=-1) / np.sum(along * along, axis=-1)
        return np.linalg.norm(point - start - np.clip(t, 0, 1)[..., None] * along, axis=-1)

    ends = [to_segment(p, b, b_end) for p in (a, a_end)] + [to_segment(p, a, a_end) for p in (b, b_end)]
    across = np.cross(a_end - a, b_end - b)
    size = np.sum(across * across, axis=1)
    is_crossed = size > 1e-20
    size = np.where(is_crossed, size, 1.0)
    s = np.sum(np.cross(b - a, b_end - b) * across, axis=1) / size
    t = np.sum(np.cross(b - a, a_end - a) * across, axis=1) / size
    is_within = is_crossed & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    lines = np.where(is_within, np.abs(np.sum((b - a) * across, axis=1)) / np.sqrt(size), np.inf)
    return np.min([*ends, lines], axis=0)
