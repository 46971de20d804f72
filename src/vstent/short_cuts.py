"""Short cuts: a sac that touches its artery a second time leads from the one place to the other.

Or a scan's blur joins them. A path of least time runs through it, and the artery in between would be lost. So a second
way is sought, which shuns what is wider than the artery, and taken where it is an artery beside a sac.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.kernels import curves, medial
from vstent.kernels.arrays import Floats, Ints

STEP_MM: Final = 0.1
"""Spacing of the points at which a path is looked at."""
WIDE: Final = 1.3
"""Where a path is wider by this factor than the artery around, it may run through a sac..."""
WIDE_WINDOW_MM: Final = 60.0
WIDE_PERCENTILE: Final = 25.0
"""... the artery being as wide as this percentile within this length: longer than a giant sac."""
SHUN: Final = 3.0
"""A way around a sac is sought at a speed that falls with this power of the width beyond that."""
AS_WIDE: Final = 0.75
"""... and is the artery where it is nowhere narrower than this fraction of it..."""
SAC: Final = 1.5
"""... the sac wider by this factor than all of it..."""
BESIDE: Final = 0.5
"""... and its axis somewhere outside the sac by this many of its radii."""


def around_sacs(graph: medial.Medial, path: Ints, speed_cap: float) -> tuple[Ints, list[str]]:
    """Return the way around the sacs that a path runs through, where the artery has one, and a sentence on each.

    Parameters
    ----------
    graph : the medial graph.
    path : (k,) vertices of the path of least time.
    speed_cap : the travel speed is at most this many radii of the artery.
    """
    points, artery_mm = _artery_along(graph, path)
    tree = cKDTree(points)
    if not (graph.radius[path] > WIDE * artery_mm[tree.query(graph.points[path])[1]]).any():
        return path, []
    parent_mm = artery_mm[tree.query(graph.points)[1]]
    joined, notes = [path[:1]], []
    for through, around in _apart(path, _shunning(graph, path, parent_mm, speed_cap)):
        goes_around = _is_artery(graph, through, around, parent_mm)
        joined.append((around if goes_around else through)[1:])
        notes += [_sentence(graph, through)] if goes_around else []
    return np.concatenate(joined), notes


def _artery_along(graph: medial.Medial, path: Ints) -> tuple[Floats, Floats]:
    """Points (n, 3) along a path, evenly spaced, and the radius (n,) that the artery has there, whatever sac it is."""
    abscissa = curves.arc_length(graph.points[path])
    even = np.linspace(0.0, abscissa[-1], max(2, round(abscissa[-1] / STEP_MM)))
    radius = np.interp(even, abscissa, graph.radius[path])
    artery_mm = curves.running_percentile(radius, WIDE_PERCENTILE, round(WIDE_WINDOW_MM / STEP_MM))
    return curves.interpolate(abscissa, graph.points[path], even), artery_mm


def _shunning(graph: medial.Medial, path: Ints, parent_mm: Floats, speed_cap: float) -> Ints:
    """The way between a path's ends at a speed that falls where a sphere is wider than the artery (n,) nearby."""
    speed = speed_cap * parent_mm * np.minimum(1.0, WIDE * parent_mm / graph.radius) ** SHUN
    _, before = medial.shortest_paths(medial.cost_graph(graph, speed), int(path[0]))
    return medial.path_to(before, int(path[-1]))


def _apart(path: Ints, other: Ints) -> Iterator[tuple[Ints, Ints]]:
    """The pieces of two paths from one vertex that they share to the next, in the order of the first."""
    place = {int(vertex): k for k, vertex in enumerate(path)}
    left = here = 0
    for k, vertex in enumerate(other):
        there = place.get(int(vertex), 0)
        if there > here:
            yield path[here : there + 1], other[left : k + 1]
            left, here = k, there


def _is_artery(graph: medial.Medial, through: Ints, around: Ints, parent_mm: Floats) -> bool:
    """Tell whether, where a path runs through a sac, a way around (k,) is an artery (n,) beside it."""
    taken_mm = graph.radius[around]
    if graph.radius[through].max() < SAC * taken_mm.max():
        return False
    if taken_mm.min() < AS_WIDE * parent_mm[around].min():
        return False
    apart_mm = np.linalg.norm(graph.points[around, None] - graph.points[through], axis=2) - graph.radius[through]
    return bool((apart_mm.min(axis=1) > BESIDE * taken_mm).any())


def _sentence(graph: medial.Medial, through: Ints) -> str:
    widest = through[graph.radius[through].argmax()]
    place = ", ".join(f"{x:.0f}" for x in graph.points[widest])
    return (
        f"The sac {2 * graph.radius[widest]:.0f} mm wide about {place} mm opens into the artery at two places, or "
        "touches it: the artery is taken to go around, and the wider opening for the neck; part them in the surface."
    )
