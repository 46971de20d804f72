"""Measure the aneurysm: sac, neck and parent artery in numbers."""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.distance import pdist

from vstent.anatomy.landing_zones import landing_diameters_mm, neck_span_mm
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm, Centerline
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats

Measures = dict[str, float | str]
"""Values by name; names of numbers end in their unit, and a few values are text."""
Morphology = dict[str, float | str | Measures]
"""Measures of the largest sac, with those of each further sac under ``sac_2``, ``sac_3``, ..."""
PARTED: Final = 0.9
"""The section by the neck plane is left out where its largest piece is below this fraction of the neck area: the
artery's wall rises through the plane there."""
FEWEST_AXIS_POINTS: Final = 9
"""Fewest axis points from which curvature and torsion are computed."""
LEAST_UPSTREAM: Final = 0.25
"""Least length of artery before the neck, in its diameters, from which the inflow angle is computed."""
BENT: Final = 0.1
"""An axis is bent, and has a torsion, where its curvature exceeds this value divided by the artery's diameter."""

ON_NECK_MM: Final = 1e-4
"""Distance from the neck, in mm, below which a face of the sac belongs to it: both have the same triangles."""
ON_PLANE_MM: Final = 1e-6
"""A neck within this distance of a plane, in mm, lies in it: the whole sac is beyond."""
ON_PLANE: Final = 1e-6
"""Largest deviation from 1 of the cosine between the neck plane's normal and that of a facet on the plane."""
HALF_SPHERE: Final = float(np.cbrt(18 * np.pi))
"""Wall area of a half sphere over its volume to the power 2/3."""


def morphology(anatomy: Anatomy) -> Morphology:
    """Measure the parent artery and its aneurysms.

    Heights, widths, perimeter, aspect ratio, size ratio, inflow angle and the shape indices refer to the neck plane
    (`vstent.anatomy.restore.plane`). Height, aspect ratio and size ratio follow Dhar et al. 2008. The height is
    perpendicular to the plane. The size ratio uses the longest distance from the center of the section to the dome. The
    neck diameter in the aspect ratio is twice the mean distance from that center to the rim of the section.

    Volume and area of the sac, and the projection and the surface of the neck, are those of the sac as it is closed: by
    the wall of its artery, or by the plane at a fork. Most of the literature cuts every sac by a plane (Raghavan et al.
    2005): the volume beyond the plane and the area of the section are listed too, with the range of areas of the planes
    that separate the sac nearly as well. A neck drawn by hand has the mean plane of its curve. There the area of the
    section is left out where the artery's wall rises through the plane and divides it.

    The shape indices of Raghavan et al. 2005 are those of the sac beyond the neck plane (see `shape_indices`). The
    inflow angle (Baharoglu et al. 2010) lies between the parent axis over one diameter before the neck and the line
    from the center of the neck to the farthest point of the dome. It is 90 degrees for a sac beside a straight artery,
    and 180 degrees for one straight ahead of the flow.

    Curvature and torsion are those of the parent axis (Piccinelli et al. 2009), from a quartic fitted over one diameter
    on both sides. The same length is left out at both ends of the axis.

    Parameters
    ----------
    anatomy : restored parent artery with its aneurysms.

    Returns
    -------
    measures : values by name, for the largest aneurysm; those of further ones under ``sac_2``, ``sac_3`` and so on.

    References
    ----------
    Dhar et al. 2008, Neurosurgery 63:185.

    Raghavan, Ma and Harbaugh 2005, J. Neurosurg. 102:355.

    Baharoglu et al. 2010, Stroke 41:1423.

    Piccinelli et al. 2009, IEEE Trans. Med. Imaging 28:1141.
    """
    result: Morphology = {**_parent(anatomy)}
    if anatomy.vessel.threshold_band_mm > 0:
        result["diameter_threshold_band_mm"] = anatomy.vessel.threshold_band_mm
    result |= _course(anatomy)
    for number, aneurysm in enumerate(anatomy.aneurysms, start=1):
        beside = _parent(replace(anatomy, aneurysms=(aneurysm,)))
        measures = _sac(aneurysm, anatomy.parent.axis, 0.5 * sum(beside.values()))
        result |= measures if number == 1 else {f"sac_{number}": {**beside, **measures}}
    return result


def _parent(anatomy: Anatomy) -> dict[str, float]:
    """Return the diameters of the parent artery on both sides of the largest aneurysm's neck."""
    proximal_mm, distal_mm = landing_diameters_mm(anatomy)
    return {"parent_proximal_diameter_mm": proximal_mm, "parent_distal_diameter_mm": distal_mm}


def _course(anatomy: Anatomy) -> Measures:
    """Return curvature and torsion of the parent axis; empty for an axis of few points."""
    axis = anatomy.parent.axis
    diameter_mm = 2 * float(np.median(anatomy.parent.section_radius_mm))
    first_mm, last_mm = anatomy.parent.own_mm
    inner = (axis.abscissa_mm >= first_mm + diameter_mm) & (axis.abscissa_mm <= last_mm - diameter_mm)
    if inner.sum() < FEWEST_AXIS_POINTS:
        return {}
    even_mm = curves.resample_evenly(axis.points_mm, len(axis.points_mm))
    curvature, torsion = curves.curvature_and_torsion(even_mm, diameter_mm)
    is_bent = inner & (curvature * diameter_mm > BENT)
    measures: Measures = {
        "parent_mean_curvature_per_mm": float(curvature[inner].mean()),
        "parent_max_curvature_per_mm": float(curvature[inner].max()),
        "parent_mean_torsion_per_mm": float(np.abs(torsion[is_bent]).mean()) if is_bent.any() else 0.0,
    }
    if anatomy.aneurysms:
        proximal_mm, distal_mm = neck_span_mm(anatomy)
        at_neck = np.interp(np.linspace(proximal_mm, distal_mm, 51), axis.abscissa_mm, curvature)
        measures["neck_mean_curvature_per_mm"] = float(at_neck.mean())
    return measures


def _sac(aneurysm: Aneurysm, axis: Centerline, parent_diameter_mm: float) -> Measures:
    """Return the measures of a sac and its neck."""
    plane, dome_mm = aneurysm.plane or aneurysm.mean_plane, aneurysm.sac.vertices_mm
    center_mm, normal = plane.center_mm, plane.normal
    height_mm = float(((dome_mm - center_mm) @ normal).max())
    reaches_mm = np.linalg.norm(dome_mm - center_mm, axis=1)
    reach_mm = float(reaches_mm.max())
    neck_mean_mm = float(2 * np.linalg.norm(plane.rim_mm - center_mm, axis=1).mean())
    outermost = np.unique((dome_mm @ curves.directions(600).T).argmax(axis=0))
    first = curves.any_perpendicular(normal)
    angle = np.pi * np.arange(180) / 180
    across = np.outer(first, np.cos(angle)) + np.outer(np.cross(normal, first), np.sin(angle))
    width_mm = np.ptp(plane.rim_mm @ across, axis=0)
    beyond = beyond_plane(aneurysm, center_mm, normal)
    measures: Measures = {
        "sac_volume_mm3": abs(aneurysm.sac.volume_mm3),
        "sac_area_mm2": aneurysm.sac.area_mm2 - aneurysm.neck.area_mm2,
        "sac_height_mm": height_mm,
        "sac_max_height_mm": reach_mm,
        "sac_max_diameter_mm": float(pdist(dome_mm[outermost]).max()),
        "sac_plane_volume_mm3": beyond.volume_mm3,
        "neck_area_mm2": float(np.linalg.norm(triangles.polygon_area_vector(aneurysm.neck_mm))),
        "neck_surface_area_mm2": aneurysm.neck.area_mm2,
        "neck_perimeter_mm": triangles.perimeter(plane.rim_mm),
        "neck_min_diameter_mm": float(width_mm.min()),
        "neck_max_diameter_mm": float(width_mm.max()),
        "aspect_ratio": height_mm / neck_mean_mm,
        "size_ratio": reach_mm / parent_diameter_mm,
        **shape_indices(beyond, normal),
    }
    neck_mm = float(np.clip(axis.nearest_abscissa_mm(aneurysm.neck_mm).min(), 0.0, axis.length_mm))
    if neck_mm >= LEAST_UPSTREAM * parent_diameter_mm:
        before_mm, here_mm = axis.at(np.array([max(neck_mm - parent_diameter_mm, 0.0), neck_mm]))
        longest_mm, upstream_mm = dome_mm[reaches_mm.argmax()] - center_mm, before_mm - here_mm
        cosine = longest_mm @ upstream_mm / np.linalg.norm(longest_mm) / np.linalg.norm(upstream_mm)
        measures["inflow_angle_rad"] = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if aneurysm.plane is not None:
        low_mm2, high_mm2 = plane.area_band_mm2
        measures |= {"neck_plane_area_mm2": plane.area_mm2}
        measures |= {"neck_plane_area_low_mm2": low_mm2, "neck_plane_area_high_mm2": high_mm2}
    elif beyond.section_mm2 > PARTED * plane.area_mm2:
        measures["neck_plane_area_mm2"] = beyond.section_mm2
    return measures


class Beyond(NamedTuple):
    """The part of a sac beyond its neck plane."""

    section_mm2: float
    """Area of the largest piece of the section by the plane, in mm2."""
    volume_mm3: float
    """Volume, in mm3."""
    wall_mm2: float
    """Area of the wall without the section and without the neck, in mm2."""
    points_mm: Floats
    """(n, 3) points of the wall, those on the plane included, in mm."""


def beyond_plane(aneurysm: Aneurysm, center_mm: Floats, normal: Floats) -> Beyond:
    """Cut a sac by a plane, with center and normal (3,), and measure the part beyond."""
    sac = aneurysm.sac
    if np.abs((aneurysm.neck.corners_mm - center_mm) @ normal).max() < ON_PLANE_MM:
        neck_mm2 = aneurysm.neck.area_mm2
        return Beyond(neck_mm2, sac.volume_mm3, sac.area_mm2 - neck_mm2, sac.vertices_mm)
    below_mm = -(sac.vertices_mm - center_mm) @ normal
    vertices, faces, _ = triangles.clip(sac.vertices_mm, sac.faces, below_mm)
    loops = triangles.boundary_loops(vertices, faces)
    capped, closed = triangles.cap(vertices, faces, loops)
    sections = [float(np.linalg.norm(triangles.polygon_area_vector(vertices[loop]))) for loop in loops]
    is_wall = aneurysm.neck.closest(vertices[faces].mean(axis=1))[1] > ON_NECK_MM
    wall_mm2 = Surface(vertices, faces[is_wall]).area_mm2
    points_mm = vertices[np.unique(faces)]
    return Beyond(max(sections, default=0.0), triangles.volume(capped[closed]), wall_mm2, points_mm)


def shape_indices(beyond: Beyond, normal: Floats) -> dict[str, float]:
    """Compute the shape indices of Raghavan, Ma and Harbaugh 2005.

    With volume V and wall area S of the sac beyond the neck plane, and those of its convex hull, V_h and S_h:

    - undulation index 1 - V / V_h,
    - ellipticity index 1 - (18 pi)^(1/3) V_h^(2/3) / S_h,
    - nonsphericity index 1 - (18 pi)^(1/3) V^(2/3) / S.

    The areas are without the neck plane, whose unit normal (3,) points toward the dome. All three are 0 for a half
    sphere. Empty if no wall lies beyond the plane.
    """
    from scipy.spatial import ConvexHull

    if beyond.wall_mm2 == 0:
        return {}
    hull = ConvexHull(beyond.points_mm)
    corners = beyond.points_mm[hull.simplices]
    is_dome = hull.equations[:, :3] @ normal > ON_PLANE - 1
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[is_dome]
    hull_mm2 = 0.5 * float(np.linalg.norm(crosses, axis=1).sum())
    return {
        "undulation_index": 1 - beyond.volume_mm3 / float(hull.volume),
        "ellipticity_index": 1 - HALF_SPHERE * float(hull.volume) ** (2 / 3) / hull_mm2,
        "nonsphericity_index": 1 - HALF_SPHERE * beyond.volume_mm3 ** (2 / 3) / beyond.wall_mm2,
    }
