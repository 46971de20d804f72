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
