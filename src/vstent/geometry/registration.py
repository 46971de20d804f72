"""Rigid registration of points to a surface, whichever way they are turned."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats

FIRST_POINTS, FIRST_STEPS, STEPS = 300, 20, 60
"""Points and steps for every first direction, and steps from the best one."""
SHARE = 0.8
"""Share of the points that counts, the nearest ones: others may have no counterpart."""


class Pose(NamedTuple):
    """A rigid motion, and how well it fits."""

    turn: Floats
    """(3, 3) rotation."""
    shift_mm: Floats
    """(3,) shift after it."""
    residual_mm: float
    """Root mean square distance of the points that count."""

    def of(self, points_mm: Floats) -> Floats:
        """Return points (n, 3) after the motion."""
        return points_mm @ self.turn.T + self.shift_mm


def registered(points_mm: Floats, surface: Surface) -> Pose:
    """Return the motion that brings points (n, 3) onto a surface, the best from 24 directions.

    Distances are measured along the surface's normals, as in Chen and Medioni 1992, Image Vis. Comput. 10:145.
    """
    few_mm = points_mm[:: max(1, len(points_mm) // FIRST_POINTS)]
    centers_mm = points_mm.mean(axis=0), surface.vertices_mm.mean(axis=0)
    starts = [Pose(np.eye(3), np.zeros(3), 0.0)]
    starts += [Pose(turn, centers_mm[1] - turn @ centers_mm[0], 0.0) for turn in Rotation.create_group("O").as_matrix()]
    best = min((settled(few_mm, surface, start, FIRST_STEPS) for start in starts), key=lambda one: one.residual_mm)
    return settled(points_mm, surface, best)


def settled(points_mm: Floats, surface: Surface, pose: Pose, steps: int = STEPS) -> Pose:
    """Return the motion after steps of the iteration from another one."""
    for _ in range(steps):
        here_mm = pose.of(points_mm)
        foot_mm, distance_mm, face = surface.closest(here_mm)
        near = np.argsort(distance_mm)[: round(SHARE * len(points_mm))]
        normal, middle_mm = surface.normals[face[near]], here_mm[near].mean(axis=0)
        slopes = np.concatenate([np.cross(here_mm[near] - middle_mm, normal), normal], axis=1)
        off_mm = np.einsum("nk,nk->n", foot_mm[near] - here_mm[near], normal)
        move = np.linalg.lstsq(slopes, off_mm, rcond=1e-6)[0]
        turn = Rotation.from_rotvec(move[:3]).as_matrix()
        shift_mm = turn @ (pose.shift_mm - middle_mm) + middle_mm + move[3:]
        pose = Pose(turn @ pose.turn, shift_mm, float(np.sqrt((distance_mm[near] ** 2).mean())))
        if np.linalg.norm(move[3:]) < 1e-5 and np.linalg.norm(move[:3]) < 1e-6:
            break
    return pose
