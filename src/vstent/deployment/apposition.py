"""Apposition of a deployed device: gaps to the wall, and nodes outside it."""

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.deployment.coverage import quad_areas_mm2
from vstent.deployment.deploy import APPOSED_GAP_MM
from vstent.devices.stent import Deployment, Stent
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats


def apposition(anatomy: Anatomy, deployment: Deployment) -> Measures:
    """Measure the gaps to the patient's own wall, and how far nodes lie outside the landing surface.

    Returns apposed fraction of the nodes, mean and largest gap (mm), volume between device and wall (mm3), and largest
    distance of a node outside the landing surface (mm). Only the last is given where the whole device lies over
    restored wall.
    """
    stent = deployment.stent
    points_mm = stent.nodes_mm.reshape(-1, 3)
    surface = anatomy.parent.landing_surface
    _, distance_mm, face = surface.closest(points_mm)
    is_wall = anatomy.parent.is_patient_face[face]
    middle_mm = np.repeat(stent.nodes_mm.mean(axis=1), stent.nodes_mm.shape[1], axis=0)
    outside_mm = np.where(surface.crosses(middle_mm, points_mm), distance_mm, 0.0)
    gap_mm, area_mm2 = deployment.wall_gap_mm.ravel()[is_wall], _node_areas_mm2(stent).ravel()[is_wall]
    outside: Measures = {"max_outside_mm": float(outside_mm.max())}
    if not is_wall.any():
        return outside
    return {
        "apposed_fraction": float((gap_mm < APPOSED_GAP_MM).mean()),
        "mean_wall_gap_mm": float(gap_mm.mean()),
        "max_wall_gap_mm": float(gap_mm.max()),
        "malapposition_volume_mm3": float((gap_mm * area_mm2).sum()),
    } | outside


def _node_areas_mm2(stent: Stent) -> Floats:
    """Return the area (rows, columns) of the contour that belongs to every node, in mm2."""
    quarter = 0.25 * quad_areas_mm2(stent)
    beside = quarter + np.roll(quarter, 1, axis=1)
    empty = np.zeros((1, beside.shape[1]))
    return np.concatenate([beside, empty]) + np.concatenate([empty, beside])
