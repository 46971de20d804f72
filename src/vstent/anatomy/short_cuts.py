"""Short cuts: where a path of least time does not follow the arteries, what it leaves out of them would be lost.

A sac that touches its artery a second time leads from the one place to the other, or a scan's blur joins them. So a
second way is sought, which shuns what is wider than the artery, and taken where it is an artery beside a sac.

And where blood comes in by one arm of a fork, as by a vertebral artery, the path to the other arm turns back at the
fork: it cuts through the crotch, be it a sac or two walls that the scan has joined, and misses where they meet. Along
the path to a third opening, and back from there, it would not.
"""

from collections.abc import Iterator, Sequence
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
CROTCH_SAC: Final = 1.2
"""Between two arms of a fork a path runs through a sac where it is wider by this factor than all of the way..."""
CROTCH: Final = 1.25
"""... by the fork, and slips between two walls where it is narrower by this one."""
N_BETWEEN: Final = 8
"""Points at which the lumen is sought on the way across from the one path to the other..."""
LUMEN: Final = 0.9
"""... of which at least this fraction lies in it: a crevice beside a sac does not, nor does the middle of a ring."""


def along_arms(graph: medial.Medial, paths: Sequence[Ints], radius_cap: Floats) -> list[Ints]:
    """Return the paths, each led by the fork where it cuts through the crotch from one arm to another.

    Parameters
    ----------
    graph : the medial graph.
    paths : (k,) vertices each, of the paths of least time from the inlet to every outlet.
    radius_cap : (n,) cap on the travel speed on them.
    """
    times, led = medial.cost_graph(graph, radius_cap), []
    for path in paths:
        _, before = medial.shortest_paths(times, int(path[-1]))
        found = path
        for other in paths:
            way = _by_way_of(other, medial.path_to(before, int(other[-1]))[::-1])
            found = _led(found, [both for both in _apart(found, way) if _is_crotch(graph, *both)])
        led.append(found)
    return led


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
    apart = _apart(path, _shunning(graph, path, parent_mm, speed_cap))
    sacs = [both for both in apart if _is_artery(graph, *both, parent_mm)]
    return _led(path, sacs), [_sentence(graph, through) for through, _ in sacs]


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


def _by_way_of(other: Ints, onward: Ints) -> Ints:
    """The way along a path as far as to where it meets the one on from its end, and along that."""
    fork = int(np.isin(other, onward).argmax())
    return np.concatenate([other[:fork], onward[np.flatnonzero(onward == other[fork])[0] :]])


def _apart(path: Ints, other: Ints) -> Iterator[tuple[Ints, Ints]]:
    """The pieces of two paths that part, from one vertex that they share to the next, in the order of the first."""
    place = {int(vertex): k for k, vertex in enumerate(path)}
    left = here = 0
    for k, vertex in enumerate(other):
        there = place.get(int(vertex), 0)
        if there > here:
            if there > here + 1 or k > left + 1:
                yield path[here : there + 1], other[left : k + 1]
            left, here = k, there


def _led(path: Ints, instead: Sequence[tuple[Ints, Ints]]) -> Ints:
    """A path that takes others (k,) instead of some of its pieces."""
    for through, around in instead:
        first, last = (int(np.flatnonzero(path == end)[0]) for end in through[[0, -1]])
        path = np.concatenate([path[:first], around, path[last + 1 :]])
    return path


def _is_artery(graph: medial.Medial, through: Ints, around: Ints, parent_mm: Floats) -> bool:
    """Tell whether, where a path runs through a sac, a way around (k,) is an artery (n,) beside it."""
    taken_mm = graph.radius[around]
    if graph.radius[through].max() < SAC * taken_mm.max():
        return False
    if taken_mm.min() < AS_WIDE * parent_mm[around].min():
        return False
    return _is_beside(graph, through, around)


def _is_crotch(graph: medial.Medial, through: Ints, around: Ints) -> bool:
    """Tell whether a path runs through the crotch of a fork that a way around (k,) goes by along its arms."""
    cut_mm, taken_mm = graph.radius[through], graph.radius[around]
    is_sac = cut_mm.max() > CROTCH_SAC * taken_mm.max() and taken_mm.min() > AS_WIDE * cut_mm.min()
    is_between = taken_mm.min() > CROTCH * cut_mm.min() and taken_mm.max() < SAC * cut_mm.max()
    return (is_sac or is_between) and _is_beside(graph, through, around) and _is_lumen_between(graph, through, around)


def _is_beside(graph: medial.Medial, through: Ints, around: Ints) -> bool:
    """Tell whether a way (k,) runs outside the spheres of a path somewhere."""
    apart_mm = np.linalg.norm(graph.points[around, None] - graph.points[through], axis=2) - graph.radius[through]
    return bool((apart_mm.min(axis=1) > BESIDE * graph.radius[around]).any())


def _is_lumen_between(graph: medial.Medial, through: Ints, around: Ints) -> bool:
    """Tell whether lumen lies between two ways: in a ring of arteries tissue does."""
    ends = graph.points[around], graph.points[through]
    across = ends[1][cKDTree(ends[1]).query(ends[0])[1]] - ends[0]
    between = ends[0] + np.linspace(0.0, 1.0, N_BETWEEN + 2)[1:-1, None, None] * across
    distance, sphere = cKDTree(graph.points).query(between)
    return bool((distance < graph.radius[sphere]).mean() > LUMEN)


def _sentence(graph: medial.Medial, through: Ints) -> str:
    widest = through[graph.radius[through].argmax()]
    place = ", ".join(f"{x:.0f}" for x in graph.points[widest])
    return (
        f"The sac {2 * graph.radius[widest]:.0f} mm wide near {place} mm opens into the artery at two places, "
        "or touches it. The artery is assumed to run around it, and the wider opening to be the neck. If this "
        "is wrong, separate them in the surface."
    )
