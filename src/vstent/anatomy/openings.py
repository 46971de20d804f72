"""Find the ends of a vessel and open them: open loops, flat caps, and arms that end blind.

An exported surface is open at its ends or closed by flat caps. A surface from a scan is open where the vessel leaves
the image, and ends blind where the contrast fades.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.errors import InputError, VesselError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Opening, Vessel, roles
from vstent.kernels import curves, medial, topology, triangles
from vstent.kernels.arrays import Floats, Ints
from vstent.units import counted, place

CAP_ANGLE_RAD: Final = np.radians(6.0)
"""Largest angle between neighbouring faces of a flat cap, in rad."""
CAP_RIM_RAD: Final = np.radians(35.0)
"""Smallest angle between cap and wall at a sharp edge of the rim, in rad."""
CAP_RIM_EDGES: Final = 8
"""Fewest edges in the outline of a cap; a patch with fewer may be a large triangle of a coarse wall."""
FEWEST_RIM_EDGES: Final = 6
"""Fewest edges in the outline of a cap where the lumen behind the patch is as narrow as the patch."""
CAP_AREA_MM2: Final = 0.3
"""Smallest area of a cap in mm2: a vessel 0.6 mm wide."""
ARM_SLENDERNESS: Final = 6.0
"""A blind arm longer than this many of its median radii is a vessel; a shorter one is a sac or a bump."""
STUMP_SLENDERNESS: Final = 2.5
"""The same where the vessel would otherwise have fewer than two openings: a piece cut out close to a sac has short
ends."""
ARM_SWELLING: Final = 1.35
"""An arm is a sac on a stalk if its widest sphere near the tip exceeds its median radius by this factor."""
ARM_WIDENING: Final = 1.6
"""An arm that widens by this factor beyond a narrow place begins there: a lobed sac is then short, an artery long."""
ARM_SHARE: Final = 0.15
"""Largest fraction of the wall that opening an arm removes: its tip with the small branches on it."""
ARM_RADIUS_MM: Final = 0.5
"""Blind arms with a smaller radius, in mm, stay closed: their flow is negligible."""
FARTHEST_MM: Final = 5.0
"""Largest distance of a given point from its opening, in mm; `FARTHEST_DIAMETERS` applies where that is larger."""
FARTHEST_DIAMETERS: Final = 2.0
"""Largest distance of a given point from its opening, in diameters of the opening."""
STILL: Final = 0.1
"""An end is the same opening as before if its center moved by less than this many diameters."""
NEARLY: Final = 0.8
"""An outlet wider than this fraction of an automatically chosen inlet may be the true inlet."""


def open_ends(vessel: Vessel) -> tuple[Vessel, medial.Medial]:
    """Cut open and list the ends of a vessel; raise a VesselError if it has fewer than two.

    The widest end is the inlet. The outlets are numbered from the widest to the narrowest.
    """
    lumen, n_caps = _without_caps(vessel.lumen)
    notes = [f"{counted(n_caps, 'flat cap')} removed to open the vessel."] if n_caps else []
    if not len(lumen.faces):
        raise VesselError(
            "the surface has flat sides only and no round wall between them, so it is not a vessel: give the "
            "wall of a vessel"
        )
    closed = lumen
    lumen, n_arms = _with_open_arms(lumen, ARM_SLENDERNESS)
    if n_arms:
        notes.append(f"{counted(n_arms, 'blind arm')} cut open perpendicular to the axis.")
    if len(lumen.boundary_loops) < 2:
        lumen, n_stumps = _with_open_arms(lumen, STUMP_SLENDERNESS)
        notes.append(f"{counted(n_stumps, 'short blind arm')} cut open, because blood had no other way in or out.")
    spheres = closed.medial if lumen is closed else medial.within(closed.medial, lumen.closed.tree)
    loops = lumen.boundary_loops
    if len(loops) < 2:
        raise VesselError(
            f"the surface near {place(lumen.vertices_mm.mean(axis=0))} has {counted(len(loops), 'opening')}, "
            "but a flow needs an inlet and an outlet: cut the vessel open at its ends, or give a longer "
            "piece; in a scan it may be bone: choose a point in the artery (--at), or crop the scan where the "
            "two touch"
        )
    ends = []
    for loop in loops:
        # A loop follows the orientation of its faces, so it is clockwise seen from outside the opening.
        vector = -triangles.polygon_area_vector(lumen.vertices_mm[loop])
        area = float(np.linalg.norm(vector))
        center = triangles.polygon_centroid(lumen.vertices_mm[loop])
        ends.append(Opening(center, vector / max(area, 1e-300), area, "outlet"))
    openings = named([max(ends, key=lambda opening: opening.area_mm2)], ends)
    return replace(vessel, lumen=lumen, openings=openings, centerlines=(), notes=(*vessel.notes, *notes)), spheres


def opening_at(vessel: Vessel, point_mm: Floats) -> Opening:
    """Return the opening nearest to a point (3,) beside it or in the lumen.

    An InputError is raised for a point outside the lumen and farther than 5 mm and two diameters from all openings.
    """
    nearest = min(vessel.openings, key=lambda opening: opening.away_mm(point_mm))
    if _is_far(nearest, point_mm) and vessel.lumen.closed.signed_distance(point_mm[None])[0] > 0:
        raise InputError(
            f"no opening of the vessel is near {place(point_mm)}; the nearest, {nearest.described}, is "
            f"{nearest.away_mm(point_mm):.0f} mm away: give a point near an opening, in LPS mm"
        )
    return nearest


def with_inlets(vessel: Vessel, inlets_mm: Floats) -> Vessel:
    """Return the vessel with the openings at given points (k, 3) as its inlets, with a note on each distant point.

    An InputError is raised when a point is near no opening, two points are near the same one, or no opening is left as
    an outlet.
    """
    inlets = [opening_at(vessel, inlet_mm) for inlet_mm in inlets_mm]
    for k, inlet in enumerate(inlets):
        first = inlets.index(inlet)
        if first < k:
            raise InputError(
                f"two inlets are the same opening, {inlet.described}, which is the nearest to "
                f"{place(inlets_mm[first])} and {place(inlets_mm[k])}: give one point near each inlet"
            )
    if len(inlets) == len(vessel.openings):
        raise InputError(
            f"all {len(inlets)} openings of the vessel are inlets and none is an outlet: remove the inlet "
            f"{inlets[-1].described}, or another one"
        )
    notes = (
        f"The inlet, {inlet.described}, is {inlet.away_mm(inlet_mm):.0f} mm from the given point."
        for inlet, inlet_mm in zip(inlets, inlets_mm, strict=True)
        if _is_far(inlet, inlet_mm)
    )
    openings = named(inlets, vessel.openings)
    return replace(vessel, openings=openings, centerlines=(), notes=(*vessel.notes, *notes))


def guessed(vessel: Vessel) -> Vessel:
    """Return the vessel with a note if an outlet is nearly as wide as its automatically chosen inlet."""
    # The note gives the position of the outlet, because its number changes when ends are trimmed.
    widest = vessel.outlets[0]
    if widest.diameter_mm <= NEARLY * vessel.inlet.diameter_mm:
        return vessel
    note = (
        f"The inlet, {vessel.inlet.described}, was chosen because it is the widest opening, but "
        f"the outlet, {widest.described}, is nearly as wide. Choose the inlet if this is wrong, and every further "
        "inlet (--inlet)."
    )
    return replace(vessel, notes=(*vessel.notes, note))


def _is_far(opening: Opening, point_mm: Floats) -> bool:
    """Return whether a point (3,) is too far from an opening to belong to it."""
    return opening.away_mm(point_mm) > max(FARTHEST_MM, FARTHEST_DIAMETERS * opening.diameter_mm)


def still_open(vessel: Vessel) -> Vessel | None:
    """Return the vessel with those of its openings that its lumen still has; None if no inlet and outlet are left.

    If all inlets are gone, the widest remaining opening is the inlet.
    """
    tree = cKDTree(vessel.lumen.loop_centers_mm) if len(vessel.lumen.boundary_loops) else None
    left = [o for o in vessel.openings if tree is not None and tree.query(o.center_mm)[0] < STILL * o.diameter_mm]
    if len(left) < 2 or all(opening.is_inlet for opening in left):
        return None
    inlets = [o for o in left if o.is_inlet] or [max(left, key=lambda opening: opening.area_mm2)]
    return replace(vessel, openings=named(inlets, left), centerlines=())


def named(inlets: Sequence[Opening], openings: Sequence[Opening]) -> tuple[Opening, ...]:
    """Return the openings with their roles: inlets in the order given, and the others as outlets, the widest first."""
    outlets = sorted((o for o in openings if o not in inlets), key=lambda opening: -opening.area_mm2)
    in_order = zip([*inlets, *outlets], roles(len(inlets), len(outlets)), strict=True)
    return tuple(replace(opening, role=role) for opening, role in in_order)


def _without_caps(lumen: Surface) -> tuple[Surface, int]:
    """Return the surface without its flat caps (round coplanar patches with a sharp rim), and the number of caps."""
    pairs = topology.face_neighbours(lumen.faces)
    turn = np.arccos(np.clip(np.einsum("ij,ij->i", lumen.normals[pairs[:, 0]], lumen.normals[pairs[:, 1]]), -1, 1))
    label = triangles.joined(pairs[turn < CAP_ANGLE_RAD], len(lumen.faces))
    n_patches = int(label.max()) + 1
    area = np.bincount(label, lumen.areas_mm2)
    rim = label[pairs[:, 0]] != label[pairs[:, 1]]
    edges = np.bincount(label[pairs[rim]].ravel(), minlength=n_patches)
    sharp = np.bincount(label[pairs[rim & (turn > CAP_RIM_RAD)]].ravel(), minlength=n_patches)
    is_cap = np.zeros(n_patches, dtype=bool)
    for patch in np.flatnonzero((area > CAP_AREA_MM2) & (edges >= FEWEST_RIM_EDGES) & (sharp > 0.8 * edges)):
        member = label == patch
        weight = lumen.areas_mm2[member]
        total = weight.sum()
        mean = weight @ lumen.normals[member] / total
        outline = lumen.vertices_mm[triangles.open_edges(lumen.faces[member])]
        perimeter = np.linalg.norm(np.diff(outline, axis=1), axis=2).sum()
        if np.linalg.norm(mean) <= np.cos(CAP_ANGLE_RAD) or 4 * np.pi * total <= 0.6 * perimeter**2:
            continue
        # Where the lumen two patch radii behind it is as narrow as the patch, a cap may have few edges.
        radius = float(np.sqrt(total / np.pi))
        behind = weight @ lumen.corners_mm[member].mean(axis=1) / total - 2.0 * radius * mean
        is_cap[patch] = edges[patch] >= CAP_RIM_EDGES or lumen.closest(behind[None])[1][0] < 1.5 * radius
    if not is_cap.any():
        return lumen, 0
    vertices, faces = triangles.compact(lumen.vertices_mm, lumen.faces[~is_cap[label]])
    return Surface(vertices, faces), int(is_cap.sum())


def _with_open_arms(lumen: Surface, slenderness: float) -> tuple[Surface, int]:
    """Return the surface with its long blind arms cut open, and the number of these arms."""
    graph = lumen.medial
    roots = np.asarray(cKDTree(graph.points).query(lumen.loop_centers_mm)[1], dtype=np.int32)
    n_cut = 0
    for path in medial.arms(graph, roots, slenderness, ARM_RADIUS_MM):
        cut = _blind_end(graph, path, slenderness)
        opened = None if cut is None else cut_square(lumen, *cut, ARM_SHARE)
        # A cut must add one end. A cut that also removes an end has reached another artery.
        if opened is not None and len(opened.boundary_loops) > len(lumen.boundary_loops):
            lumen, n_cut = opened, n_cut + 1
    return (Surface(*triangles.largest_part(lumen.vertices_mm, lumen.faces)) if n_cut else lumen), n_cut


def _blind_end(graph: medial.Medial, path: Ints, slenderness: float) -> tuple[Floats, Floats, float] | None:
    """Return center and direction of the cut that opens an arm (path to its tip), and its radius.

    None for a sac, and for an arm whose tip is also reached in another way, through a loop of arteries.
    """
    points_mm, radius_mm = graph.points[path], graph.radius[path]
    abscissa, typical = curves.arc_length(points_mm), float(np.median(radius_mm))
    # Connections less than half as wide as the arm, or thinner than the thinnest arm, carry no relevant flow.
    behind = points_mm[np.searchsorted(abscissa, abscissa[-1] - 3.0 * typical)]
    passable = graph.radius > max(0.5 * typical, ARM_RADIUS_MM)
    passable &= np.linalg.norm(graph.points - behind, axis=1) > 1.25 * typical
    passable[path[[0, -1]]] = True
    label = triangles.joined(graph.edges[passable[graph.edges].all(axis=1)], len(passable))
    outside = abscissa > 1.5 * radius_mm[0]
    if label[path[0]] == label[path[-1]] or outside.sum() < 3:
        return None
    along = np.where(outside, radius_mm, np.inf)
    widening = np.where(outside, radius_mm, 0.0) / np.minimum.accumulate(along)
    if widening.max() > ARM_WIDENING:
        outside &= abscissa >= abscissa[along[: widening.argmax()].argmin()]
    typical = float(np.median(radius_mm[outside]))
    body = outside & (radius_mm > 0.75 * typical)
    length = abscissa[body][-1] - abscissa[body][0]
    outer = body & (abscissa > abscissa[body][0] + 0.5 * length)
    if length < slenderness * typical or radius_mm[outer].max() > ARM_SWELLING * typical:
        return None
    end = float(abscissa[body][-1]) - typical
    center, before = curves.interpolate(abscissa, points_mm, np.array([end, end - 2 * typical]))
    return center, (center - before) / np.linalg.norm(center - before), typical


def cut_square(
    lumen: Surface, center_mm: Floats, direction: Floats, radius_mm: float, most: float = 1.0
) -> Surface | None:
    """Cut off the wall beyond a plane (center and direction (3,)), where it is connected to the section there."""
    height = (lumen.vertices_mm - center_mm) @ direction
    distance = np.linalg.norm(lumen.vertices_mm - center_mm, axis=1)
    beyond = height > 0
    if not (beyond & (distance < 2.0 * radius_mm)).any():
        return None
    edges = triangles.directed_edges(lumen.faces)
    label = triangles.joined(edges[beyond[edges].all(axis=1)], len(height))
    tip = beyond & (label == label[np.argmin(np.where(beyond, distance, np.inf))])
    if tip.mean() > most:
        return None
    level = np.where(tip, height, np.minimum(height, -1e-9))
    vertices, faces, _ = triangles.clip(lumen.vertices_mm, lumen.faces, level)
    return Surface(vertices, faces)
