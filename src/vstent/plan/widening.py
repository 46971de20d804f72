"""Change all diameters of an anatomy, as a lower or higher threshold of the scan would."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm, Centerline
from vstent.kernels.arrays import Floats


def widened(anatomy: Anatomy, diameter_mm: float) -> Anatomy:
    """Return an anatomy with all walls moved along their normals.

    The lumen and the landing surface move along their own normals. Sac and neck move with the surfaces on which they
    lie, so that they still meet. The arc lengths at which the neck begins and ends stay the same.

    Parameters
    ----------
    diameter_mm : increase of every diameter, in mm; negative values shrink the artery.

    Returns the wider artery.
    """
    half_mm, vessel = 0.5 * diameter_mm, anatomy.vessel
    lumen, landing = (_moved_out(surface, half_mm) for surface in (vessel.lumen, anatomy.parent.landing_surface))
    wall = _Shift.of((vessel.lumen, lumen), (anatomy.parent.landing_surface, landing))
    tube = _Shift.of((anatomy.parent.landing_surface, landing))
    openings = tuple(
        replace(opening, area_mm2=opening.area_mm2 * (1 + diameter_mm / opening.diameter_mm) ** 2)
        for opening in vessel.openings
    )
    lines = tuple(_line(line, half_mm) for line in vessel.centerlines)
    parent = replace(
        anatomy.parent,
        axis=_line(anatomy.parent.axis, half_mm),
        section_radius_mm=anatomy.parent.section_radius_mm + half_mm,
        landing_surface=landing,
    )
    return replace(
        anatomy,
        vessel=replace(vessel, lumen=lumen, openings=openings, centerlines=lines),
        paths=(parent,),
        aneurysms=tuple(_sac(aneurysm, wall, tube) for aneurysm in anatomy.aneurysms),
    )


class _Shift:
    """Displacement of the wall at the vertex nearest to a point."""

    def __init__(self, before_mm: Floats, shift_mm: Floats) -> None:
        self.tree, self.shift_mm = cKDTree(before_mm), shift_mm

    @staticmethod
    def of(*moved: tuple[Surface, Surface]) -> "_Shift":
        """Return the displacements of all vertices from pairs of surfaces before and after the move."""
        before = np.concatenate([old.vertices_mm for old, _ in moved])
        return _Shift(before, np.concatenate([new.vertices_mm - old.vertices_mm for old, new in moved]))

    def __call__(self, points_mm: Floats) -> Floats:
        """Return points (n, 3) moved like the nearest vertex of the wall, in mm."""
        return points_mm + self.shift_mm[self.tree.query(points_mm)[1]]


def _moved_out(surface: Surface, by_mm: float) -> Surface:
    """Return a surface moved by `by_mm` along its normals, in mm."""
    return Surface(surface.vertices_mm + by_mm * surface.vertex_normals, surface.faces)


def _line(line: Centerline, half_mm: float) -> Centerline:
    """Return a centerline with its inscribed radii increased by `half_mm`, in mm."""
    return Centerline(line.points_mm, line.inscribed_radius_mm + half_mm)


def _sac(aneurysm: Aneurysm, wall: _Shift, tube: _Shift) -> Aneurysm:
    """Return an aneurysm moved with the wall (sac, section by the neck plane) and the landing surface (neck)."""
    plane = aneurysm.plane
    if plane is not None:
        rim_mm = wall(plane.rim_mm)
        height_mm = rim_mm @ plane.normal
        # The section stays plane where the wall leans differently around it.
        moved = replace(plane, rim_mm=rim_mm - np.outer(height_mm - height_mm.mean(), plane.normal))
        factor = moved.area_mm2 / plane.area_mm2
        low_mm2, high_mm2 = plane.area_band_mm2
        plane = replace(moved, area_band_mm2=(factor * low_mm2, factor * high_mm2))
    return replace(
        aneurysm,
        sac=Surface(wall(aneurysm.sac.vertices_mm), aneurysm.sac.faces),
        neck=Surface(tube(aneurysm.neck.vertices_mm), aneurysm.neck.faces),
        neck_mm=tube(aneurysm.neck_mm),
        plane=plane,
    )
