"""Find and separate arteries that touch, so that the scan shows one lumen where there are two.

Where two walls are closer than the resolution of the scan, its surface joins the two lumens by a window, and a
centerline may pass through it. The course of the path identifies a window. A path through a stenosis is straight, and a
path into a branch follows the branch. A path through a window turns off one artery, crosses, and turns into another,
and both arteries continue as if there were no window. A communicating artery has this shape too, but the arteries that
it joins are farther apart than their radii.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.openings import still_open
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.kernels.medial import Medial
from vstent.units import place

STEP_MM: Final = 0.05
"""Spacing in mm of the points at which a path is examined."""
WAIST: Final = 0.85
"""Largest radius of the inscribed sphere in a window, as a fraction of the radius of the thinner artery."""
SMALL: Final = 0.4
"""The same, where the part beyond the window is connected only through it and has fewer than two openings: blood
reaches that part through a wider window or not at all."""
NEAR: Final = 2.5
"""Largest distance along the path from a window to the axis of either artery, in radii. A path that leaves an axis
tangentially and enters the window at a right angle is a quarter circle of one radius."""
APART: Final = 1.15
"""Largest distance between the two axes, relative to the sum of both radii, at which the walls touch."""
TURN_RAD: Final = np.radians(50.0)
"""Smallest angle, in rad, by which the path turns on both sides of a window."""
AHEAD: Final = 1.5
"""Distance along either axis beyond the window, in radii, at which the artery must continue."""
SAME: Final = 0.75
"""Smallest sphere, in artery radii, and largest distance from the straight line, in artery radii, with which an artery
continues."""
REACH: Final = 1.5
"""Largest extent of the crevice around a window from its center, in radii of the thinner artery."""


class Artery(NamedTuple):
    """An artery beside a window, as a straight cylinder."""

    point_mm: Floats
    """(3,) point on its axis."""
    direction: Floats
    """(3,) unit vector along its axis."""
    radius_mm: float
    """Radius in mm."""

    def height_mm(self, points_mm: Floats) -> Floats:
        """Return the distance (n,) of points (n, 3) to its wall, in mm; negative inside."""
        offset = points_mm - self.point_mm
        along = (offset @ self.direction)[:, None] * self.direction
        return np.asarray(np.linalg.norm(offset - along, axis=1) - self.radius_mm)

    def turns_to(self, across: Floats) -> bool:
        """Return whether a path with the vector (3,) in the window turns there."""
        length = float(np.linalg.norm(self.direction) * np.linalg.norm(across))
        cosine = abs(float(self.direction @ across)) / max(length, 1e-12)
        return bool(np.arccos(min(cosine, 1.0)) > TURN_RAD)

    def goes_on(self, spheres: Medial) -> bool:
        """Return whether it continues beyond the point where the path turns off it."""
        ahead = self.point_mm + AHEAD * self.radius_mm * self.direction
        near = cKDTree(spheres.points).query_ball_point(ahead, SAME * self.radius_mm)
        return bool((spheres.radius[near] > SAME * self.radius_mm).any())


class Contact(NamedTuple):
    """A window between two arteries."""

    center_mm: Floats
    """(3,) center of the window."""
    radius_mm: float
    """Radius of the inscribed sphere in the window."""
    before: Artery
    """Artery from which the path comes."""
    after: Artery
    """Artery into which the path turns."""

    @property
    def artery_mm(self) -> float:
        """Radius of the thinner artery in mm."""
        return min(self.before.radius_mm, self.after.radius_mm)


def find_contact(path_mm: Floats, radius_mm: Floats, spheres: Medial) -> Contact | None:
    """Return the narrowest window between two arteries on a path (n, 3) with inscribed radii (n,), if there is one."""
    place = curves.arc_length(path_mm)
    even = np.arange(0.0, place[-1], STEP_MM)
    points, radius = curves.interpolate(place, path_mm, even), np.interp(even, place, radius_mm)
    inner = np.arange(1, len(even) - 1)
    waists = inner[(radius[inner] <= radius[inner - 1]) & (radius[inner] < radius[inner + 1])]
    for waist in waists[np.argsort(radius[waists])]:
        before, after = (_artery(points[waist::sense], radius[waist::sense]) for sense in (-1, 1))
        if before is None or after is None:
            continue
        contact = Contact(points[waist], float(radius[waist]), before, after)
        half = max(1, round(0.3 * contact.artery_mm / STEP_MM))
        if contact.radius_mm > WAIST * contact.artery_mm or waist < half or waist + half >= len(points):
            continue
        if np.linalg.norm(after.point_mm - before.point_mm) > APART * (before.radius_mm + after.radius_mm):
            continue
        across = points[waist + half] - points[waist - half]
        if all(side.turns_to(across) and side.goes_on(spheres) for side in (before, after)):
            return contact
    return None


def _artery(points: Floats, radius: Floats) -> Artery | None:
    """Return the artery that a path (n, 3) reaches from a waist, directed to the waist; None where there is none."""
    widest = np.maximum.accumulate(radius)
    shrinks = np.flatnonzero(radius < 0.9 * widest)
    end = int(shrinks[0]) if len(shrinks) else len(radius)
    typical = float(widest[end - 1])
    here = int(np.argmax(radius[:end] >= 0.95 * typical))
    there = here + max(1, round(typical / STEP_MM))
    if here * STEP_MM > NEAR * typical or there >= len(points):
        return None
    course = points[here] - points[there]
    return Artery(points[here], course / max(float(np.linalg.norm(course)), 1e-9), typical)


def part(vessel: Vessel, contact: Contact, *, holds_inlet: bool) -> Vessel | None:
    """Separate two arteries by closing the window between them on both sides.

    Where the vessel falls into two parts, the part with the inlet is kept where it `holds_inlet`, otherwise the larger
    part. None if that would leave fewer than two openings, remove an inlet, or remove a part fed through a window that
    is not small, or where the faces around the window form no ring.
    """
    points, lumen = vessel.lumen.vertices_mm, vessel.lumen
    is_after = (contact.before.height_mm(points) > contact.after.height_mm(points))[lumen.faces]
    cut = np.flatnonzero(is_after.any(axis=1) & ~is_after.all(axis=1))
    if not len(cut):
        return None
    distance = np.linalg.norm(lumen.corners_mm[cut].mean(axis=1) - contact.center_mm, axis=1)
    label = triangles.components(lumen.faces[cut], len(points))
    mine = label == label[distance.argmin()]
    if distance[mine].max() > REACH * contact.artery_mm:
        return None
    rest = np.delete(lumen.faces, cut[mine], axis=0)
    at_cut = np.zeros(len(points), dtype=bool)
    at_cut[lumen.faces[cut[mine]]] = True
    lids = [loop for loop in triangles.boundary_loops(points, rest) if at_cut[loop].all()]
    if len(lids) != 2:
        return None
    vertices, faces = triangles.cap(points, rest, lids)
    area, label = triangles.areas(vertices[faces]), triangles.components(faces, len(vertices))
    if holds_inlet:
        to_inlet = np.linalg.norm(vertices[faces].mean(axis=1) - vessel.inlet.center_mm, axis=1)
        kept = label == label[to_inlet.argmin()]
    else:
        kept = label == np.bincount(label, area).argmax()
    share = float(1 - area[kept].sum() / area.sum())
    left = f"; the part connected only through it ({share:.0%} of the wall) was removed" if share > 0 else ""
    note = (
        f"Two touching arteries were separated at {place(contact.center_mm)} (window of "
        f"{2 * contact.radius_mm:.2f} mm){left}."
    )
    whole = Surface(*triangles.compact(vertices, faces[kept]))
    parted = still_open(replace(vessel, lumen=whole, notes=(*vessel.notes, note)))
    if parted is None or len(parted.inlets) < len(vessel.inlets):
        return None
    is_small = kept.all() or contact.radius_mm < SMALL * contact.artery_mm
    return parted if is_small or len(vessel.openings) - len(parted.openings) >= 2 else None
