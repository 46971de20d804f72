"""Change all diameters of an anatomy, as a lower or higher threshold of the scan would."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Centerline
from vstent.kernels.arrays import Floats


def widened(anatomy: Anatomy, diameter_mm: float) -> Anatomy:
    """Return an anatomy with all walls moved along their normals, by half of the increase of every diameter.

    The lumen and the landing surface move along their own normals. Sac, neck and its plane move with the surfaces on
    which they lie, so that they still meet. The arc lengths at which the neck begins and ends stay the same. Negative
    values shrink the artery.
    """
    half_mm, vessel, parent = 0.5 * diameter_mm, anatomy.vessel, anatomy.parent

    def wider(line: Centerline) -> Centerline:
        return Centerline(line.points_mm, line.inscribed_radius_mm + half_mm)

    lumen, landing = (
        Surface(surface.vertices_mm + half_mm * surface.vertex_normals, surface.faces)
        for surface in (vessel.lumen, parent.landing_surface)
    )
    with_wall = _moved_with((vessel.lumen, lumen), (parent.landing_surface, landing))
    with_tube = _moved_with((parent.landing_surface, landing))
    openings = tuple(
        replace(opening, area_mm2=opening.area_mm2 * (1 + diameter_mm / opening.diameter_mm) ** 2)
        for opening in vessel.openings
    )
    aneurysms = []
    for aneurysm in anatomy.aneurysms:
        plane = aneurysm.plane
        if plane is not None:
            section_mm = with_wall(plane.rim_mm)
            height_mm = section_mm @ plane.normal
            # The section stays plane where the wall leans differently around it.
            flat_mm = section_mm - np.outer(height_mm - height_mm.mean(), plane.normal)
            moved = replace(plane, rim_mm=flat_mm)
            factor = moved.area_mm2 / plane.area_mm2
            low_mm2, high_mm2 = plane.area_band_mm2
            plane = replace(moved, area_band_mm2=(factor * low_mm2, factor * high_mm2))
        sac = Surface(with_wall(aneurysm.sac.vertices_mm), aneurysm.sac.faces)
        neck = Surface(with_tube(aneurysm.neck.vertices_mm), aneurysm.neck.faces)
        rim_mm = with_tube(aneurysm.neck_mm)
        aneurysms.append(replace(aneurysm, sac=sac, neck=neck, neck_mm=rim_mm, plane=plane))
    radius_mm = parent.section_radius_mm + half_mm
    path = replace(parent, axis=wider(parent.axis), section_radius_mm=radius_mm, landing_surface=landing)
    centerlines = tuple(map(wider, vessel.centerlines))
    vessel = replace(vessel, lumen=lumen, openings=openings, centerlines=centerlines)
    return replace(anatomy, vessel=vessel, paths=(path,), aneurysms=tuple(aneurysms))


def _moved_with(*moved: tuple[Surface, Surface]) -> Callable[[Floats], Floats]:
    """Return a function that moves points (n, 3) like the nearest vertex of surfaces, given before and after."""
    before_mm = np.concatenate([old.vertices_mm for old, _ in moved])
    shift_mm, tree = np.concatenate([new.vertices_mm for _, new in moved]) - before_mm, cKDTree(before_mm)
    return lambda points_mm: points_mm + shift_mm[tree.query(points_mm)[1]]
