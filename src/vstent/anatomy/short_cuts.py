"""Correct shortcuts: places where the path of shortest travel time does not follow the arteries.

Two cases are corrected, because the artery that the path leaves out would be lost:

- A sac touches its artery a second time, or the blur of the scan joins them, and the path runs through the sac. A
  second path is sought that avoids wide spheres. It is used where it is an artery beside a sac.
- Blood enters through one arm of a fork, such as a vertebral artery, and the path to the other arm turns back at the
  fork. It cuts through the crotch between the arms, which is a sac or two walls joined by the scan, and misses the
  junction. The corrected path follows both arms, along the path to a third opening and back.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.kernels import curves, medial
from vstent.kernels.arrays import Floats, Ints

STEP_MM: Final = 0.1
"""Spacing in mm of the points at which a path is examined."""
WIDE: Final = 1.3
"""A path may run through a sac where it is wider than the surrounding artery by this factor."""
WIDE_WINDOW_MM: Final = 60.0
"""Length in mm, longer than a giant sac, over which the width of the surrounding artery is estimated."""
WIDE_PERCENTILE: Final = 25.0
"""Percentile of the inscribed radii over that length that is the artery's radius."""
SHUN: Final = 3.0
"""Exponent with which the travel speed falls where a sphere is wider than the artery by more than `WIDE`."""
AS_WIDE: Final = 0.75
"""A second path is the artery only if it is nowhere narrower than this fraction of the artery."""
SAC: Final = 1.5
"""A second path is the artery only if the sac is wider than all of it by this factor."""
BESIDE: Final = 0.5
"""A second path is the artery only if it is somewhere outside the sac by this many of its own radii."""
CROTCH_SAC: Final = 1.2
"""Between two arms of a fork, a path runs through a sac where it is wider by this factor than the path along the
arms."""
CROTCH: Final = 1.25
"""Between two arms of a fork, a path runs between two joined walls where it is narrower by this factor than the path
along the arms."""
N_BETWEEN: Final = 8
"""Number of points between two paths at which the lumen is tested."""
LUMEN: Final = 0.9
"""Smallest fraction of these points in the lumen for a crotch. A crevice beside a sac and the middle of a ring of
arteries have less."""


def along_arms(graph: medial.Medial, paths: Sequence[Ints], radius_cap: Floats) -> list[Ints]:
    """Correct each path (k,) to follow both arms of a fork where it cuts through the crotch between them."""
    times, corrected = medial.cost_graph(graph, radius_cap), []
    for path in paths:
        _, before = medial.shortest_paths(times, int(path[-1]))
        along = path
        for other in paths:  # up to where it meets the way onward to this path's end, and on along that way
            onward = medial.path_to(before, int(other[-1]))[::-1]
            fork = int(np.isin(other, onward).argmax())
            way = np.concatenate([other[:fork], onward[np.flatnonzero(onward == other[fork])[0] :]])
            along = _replaced(along, [both for both in _apart(along, way) if _is_crotch(graph, *both)])
        corrected.append(along)
    return corrected


def around_sacs(graph: medial.Medial, path: Ints, speed_cap: float) -> tuple[Ints, list[str]]:
    """Correct a path (k,) to follow the artery around each sac that it runs through, where there is one; with notes."""
    abscissa = curves.arc_length(graph.points[path])
    even = np.linspace(0.0, abscissa[-1], max(2, round(abscissa[-1] / STEP_MM)))
    radius = np.interp(even, abscissa, graph.radius[path])
    artery_mm = curves.running_percentile(radius, WIDE_PERCENTILE, round(WIDE_WINDOW_MM / STEP_MM))
    tree = cKDTree(curves.interpolate(abscissa, graph.points[path], even))
    if not (graph.radius[path] > WIDE * artery_mm[tree.query(graph.points[path])[1]]).any():
        return path, []
    parent_mm = artery_mm[tree.query(graph.points)[1]]
    speed = speed_cap * parent_mm * np.minimum(1.0, WIDE * parent_mm / graph.radius) ** SHUN
    _, before = medial.shortest_paths(medial.cost_graph(graph, speed), int(path[0]))
    sacs, notes = [], []
    for through, around in _apart(path, medial.path_to(before, int(path[-1]))):
        taken_mm, widest = graph.radius[around], through[graph.radius[through].argmax()]
        is_sac = graph.radius[widest] >= SAC * taken_mm.max() and taken_mm.min() >= AS_WIDE * parent_mm[around].min()
        if not is_sac or not _is_beside(graph, through, around):
            continue
        sacs.append((through, around))
        at_mm = ", ".join(f"{x:.0f}" for x in graph.points[widest])
        notes.append(
            f"The sac {2 * graph.radius[widest]:.0f} mm wide near {at_mm} mm opens into the artery at two places, "
            "or touches it. The artery is assumed to run around it, and the wider opening to be the neck. If this "
            "is wrong, separate them in the surface."
        )
    return _replaced(path, sacs), notes


def _apart(path: Ints, other: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Yield the pieces of two paths between vertices that they share, in the order of the first path."""
    place = {int(vertex): k for k, vertex in enumerate(path)}
    left = here = 0
    for k, vertex in enumerate(other):
        there = place.get(int(vertex), 0)
        if there > here:
            if there > here + 1 or k > left + 1:
                yield path[here : there + 1], other[left : k + 1]
            left, here = k, there


def _replaced(path: Ints, instead: Sequence[tuple[Ints, Ints]]) -> Ints:
    """Return a path with some of its pieces replaced."""
    for through, around in instead:
        first, last = (int(np.flatnonzero(path == end)[0]) for end in through[[0, -1]])
        path = np.concatenate([path[:first], around, path[last + 1 :]])
    return path


def _is_crotch(graph: medial.Medial, through: Ints, around: Ints) -> bool:
    """Return whether a path runs through the crotch of a fork while the other (k,) follows its arms."""
    cut_mm, taken_mm = graph.radius[through], graph.radius[around]
    is_sac = cut_mm.max() > CROTCH_SAC * taken_mm.max() and taken_mm.min() > AS_WIDE * cut_mm.min()
    is_between = taken_mm.min() > CROTCH * cut_mm.min() and taken_mm.max() < SAC * cut_mm.max()
    if not (is_sac or is_between) or not _is_beside(graph, through, around):
        return False
    # The space between the paths is lumen; in a ring of arteries it is tissue.
    start, end = graph.points[around], graph.points[through]
    across = end[cKDTree(end).query(start)[1]] - start
    between = start + np.linspace(0.0, 1.0, N_BETWEEN + 2)[1:-1, None, None] * across
    distance, sphere = cKDTree(graph.points).query(between)
    return bool((distance < graph.radius[sphere]).mean() > LUMEN)


def _is_beside(graph: medial.Medial, through: Ints, around: Ints) -> bool:
    """Return whether a path (k,) is somewhere outside the spheres of another."""
    apart_mm = np.linalg.norm(graph.points[around, None] - graph.points[through], axis=2) - graph.radius[through]
    return bool((apart_mm.min(axis=1) > BESIDE * graph.radius[around]).any())
