"""Trace a vessel: from its wall to openings, centerlines and maximum inscribed spheres.

A centerline is the path of shortest travel time from the inlet to another opening, along the Voronoi vertices inside
the lumen, with the inscribed radius as speed (Antiga et al. 2003, IEEE Trans. Med. Imaging 22:674; Piccinelli et al.
2009, IEEE Trans. Med. Imaging 28:1141). With this speed the wide spheres of a sac attract the path. Here the speed is
limited to `SPEED_CAP` times the radius of the artery on both sides of the sac, so that no path detours into a sac.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.contacts import find_contact, part
from vstent.anatomy.openings import guessed, named, open_ends, with_inlets
from vstent.anatomy.short_cuts import along_arms, around_sacs
from vstent.errors import VesselError
from vstent.geometry.spheres import centered
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Vessel
from vstent.kernels import curves, medial
from vstent.kernels.arrays import Floats, Ints

SPEED_CAP: Final = 1.1
"""Upper limit of the travel speed, in parent radii."""
STEP_MM: Final = 0.1
"""Spacing of the centerline points in mm."""
PARENT_WINDOW_MM: Final = 16.0
"""Length in mm, longer than a neck, of the window over which the parent radius is a percentile of the inscribed
radii."""
PARENT_PERCENTILE: Final = 35.0
"""Percentile of the inscribed radii that is the parent radius."""
SMOOTHED_DIAMETERS: Final = 0.75
"""Longest wavelength that is smoothed out of a centerline, in local diameters."""
THIN: Final = 0.3
"""An outlet without a connection to the inlet is closed if it is narrower than this fraction of the inlet."""
MOST_CONTACTS: Final = 12
"""Largest number of contacts between arteries that are separated."""


def trace(vessel: Vessel, *, inlet_mm: Floats | None = None) -> Vessel:
    """Find the openings of a vessel and a centerline from the inlet to every other opening.

    Parameters
    ----------
    vessel : repaired lumen, open or closed by flat caps, with or without openings.
    inlet_mm : (3,) point near the opening that is the inlet, or (k, 3) points near all openings through which blood
        enters, in mm; the first is where the parent artery begins. Where not given, the widest opening is the inlet,
        with a note if another one is nearly as wide.

    Returns
    -------
    vessel : vessel with openings and centerlines; touching arteries are separated.

    Raises
    ------
    InputError
        When a point of `inlet_mm` is near no opening, two points are near the same one, or no opening is left as an
        outlet.
    VesselError
        When fewer than two ends are found, or an opening cannot be reached from the inlet.
    """
    is_guess = not vessel.openings and inlet_mm is None
    vessel, spheres = (vessel, vessel.lumen.medial) if vessel.openings else open_ends(vessel)
    if inlet_mm is not None:
        vessel = with_inlets(vessel, np.atleast_2d(np.asarray(inlet_mm, dtype=np.float64)))
    vessel, graph, paths = _paths(vessel, spheres)
    for _ in range(MOST_CONTACTS):
        contacts = (find_contact(graph.points[path], graph.radius[path], graph) for path in paths)
        parted = (
            part(vessel, contact, holds_inlet=inlet_mm is not None) for contact in contacts if contact is not None
        )
        without_contact = next((other for other in parted if other is not None), None)
        if without_contact is None:
            break
        vessel, graph, paths = _paths(without_contact, without_contact.lumen.medial)
    lines = tuple(_centerline(vessel.lumen, graph.points[path], graph.radius[path]) for path in paths)
    return replace(guessed(vessel) if is_guess else vessel, centerlines=lines)


def _paths(vessel: Vessel, spheres: medial.Medial) -> tuple[Vessel, medial.Medial, list[Ints]]:
    """Return the vessel with its reachable openings, the medial graph, and the path to each of these openings."""
    vessel, graph = _reachable(vessel, spheres)
    ends = range(len(graph.points) - len(vessel.openings), len(graph.points))

    def shortest(cap_mm: Floats | float) -> list[Ints]:
        _, before = medial.shortest_paths(medial.cost_graph(graph, cap_mm), ends[0])
        return [medial.path_to(before, end) for end in ends[1:]]

    cap_mm = _radius_cap(graph, shortest(np.inf))
    paths = along_arms(graph, shortest(cap_mm), cap_mm)
    corrected = [around_sacs(graph, path, SPEED_CAP) for path in paths]
    notes = dict.fromkeys([*vessel.notes, *chain(*(notes for _, notes in corrected))])
    return replace(vessel, notes=tuple(notes)), graph, [path for path, _ in corrected]


def parent_radius_mm(abscissa_mm: Floats, radius_mm: Floats) -> Floats:
    """Return the radius (n,) of the artery at each point (n,) of a path in mm, without the sacs that it passes.

    The result is a running percentile of the inscribed radii (n,) over `PARENT_WINDOW_MM`.
    """
    step = float(abscissa_mm[-1]) / max(len(abscissa_mm) - 1, 1)
    return curves.running_percentile(radius_mm, PARENT_PERCENTILE, round(PARENT_WINDOW_MM / step))


def _reachable(vessel: Vessel, spheres: medial.Medial) -> tuple[Vessel, medial.Medial]:
    """Return the vessel without unreachable narrow outlets, and the medial graph with its openings as last vertices.

    Raise an error for other unreachable openings.
    """
    ends = np.array([opening.center_mm for opening in vessel.openings])
    reach = np.array([0.25 * opening.diameter_mm for opening in vessel.openings])
    graph = medial.with_terminals(spheres, ends, reach)
    first = len(spheres.points)
    is_reached = np.isfinite(medial.shortest_paths(medial.cost_graph(graph), first)[0])
    lost = [opening for opening, reached in zip(vessel.openings, is_reached[first:], strict=True) if not reached]
    leads_out = any(outlet not in lost for outlet in vessel.outlets)
    for opening in lost:
        if opening.is_inlet or opening.diameter_mm > THIN * vessel.inlet.diameter_mm or not leads_out:
            raise VesselError(
                f"{opening.role}, {opening.described}, is not connected to the inlet (diameter "
                f"{vessel.inlet.diameter_mm:.1f} mm), because the lumen is interrupted between them: lower the "
                "threshold, or remove that part"
            )
    is_reached[:first] = True
    notes = tuple(f"An opening {opening.described} has no connection to the inlet and was closed." for opening in lost)
    openings = named(vessel.inlets, [opening for opening in vessel.openings if opening not in lost])
    return replace(vessel, openings=openings, notes=(*vessel.notes, *notes)), graph.where(is_reached)


def _radius_cap(graph: medial.Medial, paths: Sequence[Ints]) -> Floats:
    """Return the limit (n,) of the travel speed: `SPEED_CAP` times the parent radius of the nearest path point."""
    points, parents = [], []
    for path in paths:
        abscissa = curves.arc_length(graph.points[path])
        even = np.linspace(0.0, abscissa[-1], max(2, round(abscissa[-1] / STEP_MM)))
        points.append(curves.interpolate(abscissa, graph.points[path], even))
        parents.append(parent_radius_mm(even, np.interp(even, abscissa, graph.radius[path])))
    nearest = cKDTree(np.concatenate(points)).query(graph.points)[1]
    return SPEED_CAP * np.concatenate(parents)[nearest]


def _centerline(wall: Surface, path_mm: Floats, radius_mm: Floats) -> Centerline:
    """Return a smooth, evenly spaced centerline along a path with inscribed radii."""
    points = curves.resample(path_mm, STEP_MM)
    abscissa, along = curves.arc_length(path_mm), np.linspace(0.0, 1.0, len(points))
    radius = np.maximum(np.interp(along * abscissa[-1], abscissa, radius_mm), STEP_MM)
    weight = np.ones(len(points))
    weight[[0, -1]] = 1e6  # the ends stay
    # Voronoi vertices scatter at scales below a diameter, so only longer waves are kept. Third differences preserve
    # bends. Second differences would pull them inwards.
    waves = 2.0 * radius * SMOOTHED_DIAMETERS / (2 * np.pi * STEP_MM)
    points = centered(wall, curves.smooth(points, weight, waves**6, order=3), radius)
    return Centerline(points, wall.inscribed_radius(points))
