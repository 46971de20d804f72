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
from vstent.kernels.arrays import Bools, Floats, Ints
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
    """Find the narrowest window between two arteries on a path.

    Shapes: `path_mm` (n, 3), `radius_mm` (n,).
    """
    place = curves.arc_length(path_mm)
    even = np.arange(0.0, place[-1], STEP_MM)
    points, radius = curves.interpolate(place, path_mm, even), np.interp(even, place, radius_mm)
    inner = np.arange(1, len(even) - 1)
    waists = inner[(radius[inner] <= radius[inner - 1]) & (radius[inner] < radius[inner + 1])]
    found = (_contact_at(points, radius, int(i), spheres) for i in waists[np.argsort(radius[waists])])
    return next((contact for contact in found if contact is not None), None)


def _contact_at(points: Floats, radius: Floats, waist: int, spheres: Medial) -> Contact | None:
    """Return the window at a waist of the path; None for a stenosis, a branch or a communicating artery."""
    before, after = (_artery(points[waist::sense], radius[waist::sense]) for sense in (-1, 1))
    if before is None or after is None:
        return None
    contact = Contact(points[waist], float(radius[waist]), before, after)
    half = max(1, round(0.3 * contact.artery_mm / STEP_MM))
    if contact.radius_mm > WAIST * contact.artery_mm or waist < half or waist + half >= len(points):
        return None
    if np.linalg.norm(after.point_mm - before.point_mm) > APART * (before.radius_mm + after.radius_mm):
        return None
    across = points[waist + half] - points[waist - half]
    is_window = all(_angle(side.direction, across) > TURN_RAD and _goes_on(spheres, side) for side in (before, after))
    return contact if is_window else None


def _goes_on(spheres: Medial, artery: Artery) -> bool:
    """Return whether an artery continues beyond the point where the path turns off it."""
    ahead = artery.point_mm + AHEAD * artery.radius_mm * artery.direction
    near = cKDTree(spheres.points).query_ball_point(ahead, SAME * artery.radius_mm)
    return bool((spheres.radius[near] > SAME * artery.radius_mm).any())


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


def _angle(one: Floats, other: Floats) -> float:
    """Return the angle between two lines along vectors (3,), in rad, from 0 to a right angle."""
    cosine = abs(float(one @ other)) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12)
    return float(np.arccos(min(cosine, 1.0)))


def part(vessel: Vessel, contact: Contact, *, holds_inlet: bool) -> Vessel | None:
    """Separate two arteries by closing the window between them on both sides.

    Parameters
    ----------
    vessel : lumen and openings.
    contact : window between the arteries.
    holds_inlet : where the vessel falls into two parts, keep the part with the inlet; otherwise keep the larger part.

    Returns leave fewer than two openings, remove an inlet, or remove a part fed through a window that is not small.
    """
    lumen = vessel.lumen
    ring = _ring(lumen, contact)
    if ring is None:
        return None
    rest = lumen.faces[~ring]
    at_cut = np.zeros(len(lumen.vertices_mm), dtype=bool)
    at_cut[lumen.faces[ring]] = True
    lids = [loop for loop in triangles.boundary_loops(lumen.vertices_mm, rest) if at_cut[loop].all()]
    if len(lids) != 2:
        return None
    vertices, faces = triangles.cap(lumen.vertices_mm, rest, lids)
    kept = _kept(vertices, faces, vessel.inlet.center_mm if holds_inlet else None)
    whole = replace(vessel, lumen=Surface(*triangles.compact(vertices, faces[kept])))
    share = float(1 - triangles.areas(vertices[faces[kept]]).sum() / triangles.areas(vertices[faces]).sum())
    parted = still_open(replace(whole, notes=(*vessel.notes, _note(contact, share))))
    if parted is None or len(parted.inlets) < len(vessel.inlets):
        return None
    if kept.all() or contact.radius_mm < SMALL * contact.artery_mm:
        return parted
    return parted if len(vessel.openings) - len(parted.openings) >= 2 else None


def _ring(lumen: Surface, contact: Contact) -> Bools | None:
    """Return whether each face (m,) is in the crevice around the window; None where these faces form no ring."""
    points = lumen.vertices_mm
    nearer = contact.before.height_mm(points) > contact.after.height_mm(points)
    is_after = nearer[lumen.faces]
    cut = np.flatnonzero(is_after.any(axis=1) & ~is_after.all(axis=1))
    if not len(cut):
        return None
    faces = lumen.faces[cut]
    distance = np.linalg.norm(lumen.corners_mm[cut].mean(axis=1) - contact.center_mm, axis=1)
    label = triangles.components(faces, len(points))
    mine = label == label[distance.argmin()]
    if distance[mine].max() > REACH * contact.artery_mm:
        return None
    ring = np.zeros(len(lumen.faces), dtype=bool)
    ring[cut[mine]] = True
    return ring


def _kept(vertices: Floats, faces: Ints, inlet_mm: Floats | None) -> Bools:
    """Return whether each face (m,) is in the part at the inlet (3,), or in the part of largest area."""
    label = triangles.components(faces, len(vertices))
    if inlet_mm is not None:
        return np.asarray(label == label[np.linalg.norm(vertices[faces].mean(axis=1) - inlet_mm, axis=1).argmin()])
    return np.asarray(label == np.bincount(label, triangles.areas(vertices[faces])).argmax())


def _note(contact: Contact, lost: float) -> str:
    """Return the note on two separated arteries."""
    left = f"; the part connected only through it ({lost:.0%} of the wall) was removed" if lost > 0 else ""
    return (
        f"Two touching arteries were separated at {place(contact.center_mm)} (window of "
        f"{2 * contact.radius_mm:.2f} mm){left}."
    )
