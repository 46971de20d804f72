"""Contacts: arteries that touch, so that a scan shows one lumen where there are two.

Where two walls come nearer to each other than the scan resolves, its surface joins the lumens by a window, and a
centerline may slip through it. A way through a stenosis goes straight on, and one into a branch follows the branch; a
way through a window turns off one artery, crosses, and turns into another, and both arteries go on beside it as if it
were not there. A communicating artery has that shape too, but the arteries it joins lie further apart than their radii.
Where no centerline slips through, a window still makes a ring of the lumen: rings are walked round in search of it. A
sac may touch an artery too.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.spatial import cKDTree

from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.medial import Medial, meetings, ring_through
from vstent.openings import still_open
from vstent.surface import Surface
from vstent.vessel import Vessel

STEP_MM: Final = 0.1
"""Paths are looked at in steps of this length."""
THROAT_MM: Final = 0.5
"""A window is narrower than all that lies nearer than half of this on the way."""
WAIST: Final = 0.85
"""The inscribed sphere of a window is narrower than this fraction of those of both arteries..."""
SMALL: Final = 0.4
"""... and than this one where what is beyond it hangs on it alone and has less than two openings of its own: blood
comes to it through a wider window, or not at all."""
NEAR: Final = 2.5
"""A window lies within this many radii of both arteries' axes along the way: one that leaves an axis tangentially and
enters the window at a right angle is a quarter of a circle of one radius..."""
APART: Final = 1.15
"""... and the axes are no further apart than this many times the sum of both radii: the walls touch..."""
TOGETHER: Final = 0.5
"""... and no nearer than this many times: within one artery a way passes its own noise."""
TURN_RAD: Final = np.radians(50.0)
"""On both sides of a window the way turns by more than this."""
AHEAD: Final = (1.25, 1.75)
"""So many radii further along either axis the artery goes on..."""
SAME: Final = 0.75
"""... as a sphere of at least this many of its radii..."""
ONWARD_RAD: Final = np.radians(70.0)
"""... less than this off the way's direction, which turns before it leaves the artery's axis..."""
ASIDE_RAD: Final = np.radians(50.0)
"""... and more than this off the direction to the window."""
REACH: Final = 1.5
"""The crevice around a window reaches no further from its middle than this many radii of the thinner artery."""
ROUND: Final = 4.0
"""Ways that meet and were parted by a wall when each had so many radii to go have come round a ring."""


class Artery(NamedTuple):
    """An artery beside a window, as straight and round as it is there."""

    point_mm: Floats
    """(3,) on its axis."""
    direction: Floats
    """(3,) unit vector along it; 0 for a sac, which is round."""
    radius_mm: float
    """Its radius."""

    def height_mm(self, points_mm: Floats) -> Floats:
        """Distance (n,) of points (n, 3) to its wall, negative inside."""
        offset = points_mm - self.point_mm
        along = (offset @ self.direction)[:, None] * self.direction
        return np.asarray(np.linalg.norm(offset - along, axis=1) - self.radius_mm)


class Contact(NamedTuple):
    """A window between two arteries."""

    center_mm: Floats
    """(3,) its middle."""
    radius_mm: float
    """Radius of the inscribed sphere in it."""
    before: Artery
    """The artery that the way comes from."""
    after: Artery
    """The artery that it goes to."""
    across: Floats
    """(3,) the way through it: unit vector."""

    @property
    def artery_mm(self) -> float:
        """Radius of the thinner artery."""
        return min(self.before.radius_mm, self.after.radius_mm)

    @property
    def apart(self) -> float:
        """Distance between both axes over the sum of both radii."""
        away_mm = np.linalg.norm(self.after.point_mm - self.before.point_mm)
        return float(away_mm / (self.before.radius_mm + self.after.radius_mm))


def find_rings(lumen: Surface, spheres: Medial, cost: Floats, before: Ints) -> list[Ints]:
    """Find the ways round a lumen's rings: spheres (k,) from one twice round to itself, none for a tree.

    Every place but the ends is then passed once with half the ring before and behind it.

    Parameters
    ----------
    lumen : the wall.
    spheres, cost, before : the medial graph (n spheres) and a tree of shortest paths on it, (n,) and (n,).
    """
    if not lumen.n_rings:
        return []
    edges, whence = meetings(spheres, cost, before, ROUND)
    edges = edges[lumen.closed.crosses(*np.moveaxis(spheres.points[whence], 1, 0))]
    edges = edges[np.argsort(cost[edges].sum(axis=1))]
    is_met = np.zeros(len(cost), dtype=bool)
    is_met[edges] = True
    label = triangles.joined(spheres.edges[is_met[spheres.edges].all(axis=1)], len(cost))
    shortest = np.sort(np.unique(label[edges[:, 0]], return_index=True)[1])
    rings = (ring_through(before, edge) for edge in edges[shortest])
    return [np.concatenate([ring, ring, ring[:1]]) for ring in rings]


def find_contact(lumen: Surface, spheres: Medial, way: Ints) -> Contact | None:
    """Find the narrowest window on a way (k,) along the spheres of a lumen."""
    place = curves.arc_length(spheres.points[way])
    points = curves.interpolate(place, spheres.points[way], np.arange(0.0, place[-1], STEP_MM))
    radius = lumen.inscribed_radius(points)
    waists = np.flatnonzero(radius == minimum_filter1d(radius, round(THROAT_MM / STEP_MM)))
    found = (_contact_at(points, radius, int(i), spheres) for i in waists[np.argsort(radius[waists])])
    return next((contact for contact in found if contact is not None), None)


def _contact_at(points: Floats, radius: Floats, waist: int, spheres: Medial) -> Contact | None:
    """The window at a waist of the path; None for a stenosis, a branch or a communicating artery."""
    before, after = (_artery(points[waist::sense], radius[waist::sense]) for sense in (-1, 1))
    if before is None or after is None:
        return None
    half = max(1, round(0.3 * min(before.radius_mm, after.radius_mm) / STEP_MM))
    if waist < half or waist + half >= len(points):
        return None
    across = points[waist + half] - points[waist - half]
    contact = Contact(points[waist], float(radius[waist]), before, after, across / np.linalg.norm(across))
    if contact.radius_mm > WAIST * contact.artery_mm or not TOGETHER < contact.apart < APART:
        return None
    passes = [
        _angle(side.direction, across) > TURN_RAD and _goes_on(spheres, side, points[waist]) for side in (before, after)
    ]
    if all(passes):
        return contact
    return _at_sac(contact, passes) if contact.radius_mm <= radius.min() else None


def _at_sac(contact: Contact, passes: list[bool]) -> Contact | None:
    """The narrowest window on a way, if it is one between an artery that passes it and a sac at least as wide.

    A sac's neck is wider than that.
    """
    if sum(passes) != 1 or contact.radius_mm > SMALL * contact.artery_mm:
        return None
    artery, sac = (contact.before, contact.after) if passes[0] else (contact.after, contact.before)
    if sac.radius_mm < artery.radius_mm:
        return None
    return contact._replace(before=artery, after=sac._replace(direction=np.zeros(3)))


def _goes_on(spheres: Medial, artery: Artery, waist_mm: Floats) -> bool:
    """Tell whether an artery goes on beyond the point where the way turns off it, not only through the window."""
    near = cKDTree(spheres.points).query_ball_point(artery.point_mm, AHEAD[1] * artery.radius_mm)
    away, wide = spheres.points[near] - artery.point_mm, spheres.radius[near] > SAME * artery.radius_mm
    distance, window = np.linalg.norm(away, axis=1), waist_mm - artery.point_mm
    beyond = wide & (distance > AHEAD[0] * artery.radius_mm)
    onward = away @ artery.direction > np.cos(ONWARD_RAD) * distance
    aside = away @ window < np.cos(ASIDE_RAD) * distance * np.linalg.norm(window)
    return bool((beyond & onward & aside).any())


def _artery(points: Floats, radius: Floats) -> Artery | None:
    """The artery that a path (n, 3) comes to from a waist, directed towards the waist; None where there is none."""
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
    """Angle between two lines along vectors (3,), from 0 to a right angle."""
    cosine = abs(float(one @ other)) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12)
    return float(np.arccos(min(cosine, 1.0)))


def part(vessel: Vessel, contact: Contact, *, holds_inlet: bool) -> Vessel | None:
    """Close a window from both sides.

    Parameters
    ----------
    vessel : lumen and openings.
    contact : the window.
    holds_inlet : where the vessel falls apart, keep the part with the inlet; the larger part otherwise.

    Returns
    -------
    vessel : with a note of what was cut and where, to be traced anew; None where there is no clean cut, where it
        would leave fewer than two openings, or take off what a window feeds that is not small.
    """
    cut = _cut(vessel.lumen, contact)
    if cut is None:
        return None
    vertices, faces = cut
    kept = _kept(vertices, faces, vessel.inlet.center_mm if holds_inlet else None)
    whole = replace(vessel, lumen=Surface(*triangles.compact(vertices, faces[kept])))
    share = float(1 - triangles.areas(vertices[faces[kept]]).sum() / triangles.areas(vertices[faces]).sum())
    parted = still_open(replace(whole, notes=(*vessel.notes, _note(contact, share))))
    if parted is None or kept.all() or contact.radius_mm < SMALL * contact.artery_mm:
        return parted
    return parted if len(vessel.openings) - len(parted.openings) >= 2 else None


def part_ring(vessel: Vessel, contact: Contact) -> Vessel | None:
    """Close a window on a ring from both sides; None where there is no clean cut, or the vessel would fall apart."""
    cut = _cut(vessel.lumen, contact)
    if cut is None or triangles.components(cut[1], len(cut[0])).any():
        return None
    return replace(vessel, lumen=Surface(*cut), centerlines=(), notes=(*vessel.notes, _note(contact, 0.0)))


def _cut(lumen: Surface, contact: Contact) -> tuple[Floats, Ints] | None:
    """Vertices and faces of a wall whose window is closed from both sides; None where there is no clean cut."""
    ring = _ring(lumen, contact)
    if ring is None:
        return None
    rest = lumen.faces[~ring]
    at_cut = np.zeros(len(lumen.vertices_mm), dtype=bool)
    at_cut[lumen.faces[ring]] = True
    lids = [loop for loop in triangles.boundary_loops(lumen.vertices_mm, rest) if at_cut[loop].all()]
    return triangles.compact(*triangles.cap(lumen.vertices_mm, rest, lids)) if len(lids) == 2 else None


def _ring(lumen: Surface, contact: Contact) -> Bools | None:
    """Faces (m,) around the window, in the crevice between the two arteries; None where they are no ring about it.

    The crevice lies half way between both arteries, or, where they are not as round and straight as that, square to
    the way: the shorter ring is taken.
    """
    points = np.concatenate([lumen.vertices_mm, contact.center_mm[None]])
    half_way = contact.before.height_mm(points) - contact.after.height_mm(points)
    rings = [
        _ring_at(lumen, contact, level) for level in (half_way - half_way[-1], (points - points[-1]) @ contact.across)
    ]
    reach_mm, ring = min(rings, key=lambda ring: ring[0])
    return ring if reach_mm < REACH * contact.artery_mm else None


def _ring_at(lumen: Surface, contact: Contact, level: Floats) -> tuple[float, Bools]:
    """The faces (m,) at level 0 that hang together with those nearest to the window, and how far they reach from it."""
    is_after = (level > 0)[lumen.faces]
    ring = np.asarray(is_after.any(axis=1) & ~is_after.all(axis=1))
    cut = np.flatnonzero(ring)
    if not len(cut):
        return np.inf, ring
    distance = np.linalg.norm(lumen.corners_mm[cut].mean(axis=1) - contact.center_mm, axis=1)
    label = triangles.components(lumen.faces[cut], len(lumen.vertices_mm))
    mine = label == label[distance.argmin()]
    ring[cut[~mine]] = False
    return float(distance[mine].max()), ring


def _kept(vertices: Floats, faces: Ints, inlet_mm: Floats | None) -> Bools:
    """Faces (m,) of the part at the inlet (3,), or of the part of largest area."""
    label = triangles.components(faces, len(vertices))
    if inlet_mm is not None:
        return np.asarray(label == label[np.linalg.norm(vertices[faces].mean(axis=1) - inlet_mm, axis=1).argmin()])
    return np.asarray(label == np.bincount(label, triangles.areas(vertices[faces])).argmax())


def _note(contact: Contact, lost: float) -> str:
    place = ", ".join(f"{x:.1f}" for x in contact.center_mm)
    who = "Two arteries" if contact.after.direction.any() else "An artery and a sac"
    left = f"; what hung on it alone ({lost:.0%} of the wall) was left out" if lost > 0 else ""
    return f"{who} touch at {place} mm through a window {2 * contact.radius_mm:.2f} mm wide: parted there{left}."
