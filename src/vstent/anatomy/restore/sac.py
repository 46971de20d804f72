"""The sac: the lumen outside the landing surface that holds a bulge's dome, and the neck that closes it."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.restore.axis import Mouth, fit_axis
from vstent.anatomy.restore.bulges import FLANK, Bulge, bulge_at
from vstent.anatomy.restore.drawn import Drawn
from vstent.anatomy.restore.landing import Landing, close_landing
from vstent.anatomy.restore.neck import Artery, Flank, apart_mm, believed_from_mm, skirt, unblurred
from vstent.anatomy.restore.tubes import tubes_of
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm, Centerline, Vessel
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.regions import region

ON_ARTERY_MM: Final = 0.5
"""A flank whose rim comes nearer than this to the height where it begins stands on the parent artery."""
FLAT: Final = 0.2
"""Less volume than this fraction of neck area to the power 3/2 is an uneven wall (a half sphere has 0.38)."""
ROUND: Final = 0.6
"""A shape with more than 1 / 0.6 times the surface of the sphere of its volume is a scan's debris: sacs, lobed ones
too, have 0.7 to 0.85."""
PASSING: Final = 2.5
"""A branch passes under a sac that begins within this many of its radii..."""
NEAR_MM: Final = 12.0
"""... and is restored as the parent artery is where the sac begins within this distance..."""
TURNED_BACK: Final = -0.5
"""A way that turns by more than 120 degrees is none for a wall to follow."""
EQUAL: Final = 0.6
"""A branch thinner than this many times the parent artery leaves its wall as it is: a tube stands for it."""
COURSE_STEP_MM: Final = 0.1
"""Spacing of the points of such a way."""
OWN_WALL: Final = 0.25
"""... and beyond the last section outside the parent artery of which less than this fraction is the patient's own."""
FEWEST_SECTIONS: Final = 8
"""A shorter piece is no artery."""
SETTLING: Final = 6.0
"""The neck's border on the wall settles within this many times the height where the flank begins."""
N_RINGS: Final = 12
"""Rings of the neck's triangles."""
N_SKIRT: Final = 4
"""Strips of triangles between the flank and the neck."""
ON_SAC_MM: Final = 0.05
"""What lies for the most part no further outside a sac than this is a part of it."""


def cut_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], bulge: Bulge) -> Aneurysm | None:
    """Cut the sac of a bulge off the lumen; None where it does not hang on the parent artery, or is flat.

    Side branches that leave from the sac or beside it are cut off along their own tubes.
    """
    lumen = vessel.lumen
    artery = _artery(vessel, landing, side_lines, bulge)
    height_mm = artery.height_mm(lumen.vertices_mm, lumen.vertex_normals)
    parent_mm = landing.section_radius_mm[landing.nearest_sections(lumen.vertices_mm)]
    core = bulge_at(lumen, height_mm, height_mm > FLANK * parent_mm, bulge.dome_mm)
    if core is None:
        return None
    low_mm = _low_mm(vessel, landing, core)
    flank, other_loops = _flank(lumen, height_mm, low_mm, core.dome_mm, landing)
    if flank is None:
        return None
    found = _cut_off(vessel, artery, flank, other_loops, low_mm)
    for k, loop in enumerate(other_loops):
        # A sac that touches its artery opens into it at two places, and the touch has the longer flare at times.
        if np.median(landing.surface.closest(flank.vertices_mm[loop])[1]) < low_mm + ON_ARTERY_MM:
            mouths = [flank.rim, *other_loops[:k], *other_loops[k + 1 :]]
            other = _cut_off(vessel, artery, flank._replace(rim=loop), mouths, low_mm)
            found = max(found, other, key=lambda one: one.neck.area_mm2)
    is_flat = found.sac.volume_mm3 < FLAT * found.neck.area_mm2**1.5
    return None if is_flat or _roundness(found.sac) < ROUND else found


def _cut_off(vessel: Vessel, artery: Artery, flank: Flank, other_loops: list[Ints], low_mm: float) -> Aneurysm:
    """The sac above a flank's rim, continued down to the artery."""
    flank = unblurred(flank, vessel.blur_mm) if vessel.blur_mm else flank
    rings = skirt(flank.levelled(low_mm), artery, vessel.closed, n_rings=N_SKIRT)
    return _aneurysm(artery, flank, other_loops, rings)


def _low_mm(vessel: Vessel, landing: Landing, bulge: Bulge) -> float:
    """Height above the artery from which on a bulge's flank is believed."""
    most_mm = FLANK * float(np.median(landing.section_radius_mm[landing.nearest_sections(bulge.foot_mm)]))
    return believed_from_mm(vessel.lumen, bulge.foot_mm, most_mm, vessel.blur_mm)


def is_in_one(points_mm: Floats, aneurysms: Sequence[Aneurysm]) -> bool:
    """Tell whether most of the points (n, 3) of a sac or bulge lie in or on one of the sacs."""
    return any(np.median(one.sac.signed_distance(points_mm)) < ON_SAC_MM for one in aneurysms)


def drawn_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], drawn: Drawn) -> Aneurysm:
    """Close the sac behind a neck that was drawn; side branches that leave from it are cut off along their tubes."""
    artery = _artery(vessel, landing, side_lines, drawn.bulge)
    normals = Surface(drawn.vertices_mm, drawn.faces).vertex_normals
    in_branch_mm = _low_mm(vessel, landing, drawn.bulge) - artery.above_branches_mm(drawn.vertices_mm, normals)
    vertices, faces, _ = triangles.clip(drawn.vertices_mm, drawn.faces, in_branch_mm)
    vertices, faces = triangles.part_at(vertices, faces, drawn.bulge.dome_mm)
    loops = list(triangles.boundary_loops(vertices, faces))
    cut = cKDTree(drawn.cut_mm)
    rim = loops.pop(int(np.argmin([np.median(cut.query(vertices[loop])[0]) for loop in loops])))
    rings = np.stack([vertices[rim], drawn.neck_of(vertices[rim])])
    return _aneurysm(artery, Flank(vertices, faces, np.zeros(len(vertices)), rim), loops, rings)


def _aneurysm(artery: Artery, flank: Flank, other_loops: list[Ints], rings: Floats) -> Aneurysm:
    """The sac of a flank, the mouths of its branches, and its continuation, rings (n, k, 3), down to the neck."""
    neck = _neck(artery, rings[-1])
    sac = _closed_sac(flank, other_loops, rings, neck)
    abscissa = curves.project(artery.landings[0].points_mm, rings[-1])[0]
    return Aneurysm(sac, neck, rings[-1], float(abscissa.min()), float(abscissa.max()))


def _is_island(lumen: Surface, is_low: Bools) -> Bools:
    """Tell the vertices (n,) of low wall from which no low wall leads to an opening.

    There the sac itself touches an artery that it does not hang on.
    """
    edges = triangles.directed_edges(lumen.faces)
    edges = edges[is_low[edges].all(axis=1)]
    label = triangles.joined(edges, len(is_low))
    ends = np.unique(triangles.open_edges(lumen.faces))
    return is_low & ~np.isin(label, label[ends[is_low[ends]]])


def _roundness(sac: Surface) -> float:
    """Surface of the sphere of the same volume over the sac's own (Wadell 1935, J. Geol. 43:250)."""
    return float(np.cbrt(36 * np.pi * max(sac.volume_mm3, 0.0) ** 2)) / sac.area_mm2


def _flank(
    lumen: Surface, height_mm: Floats, low_mm: float, dome_mm: Floats, landing: Landing
) -> tuple[Flank | None, list[Ints]]:
    """The sac's wall above a height, and its edges apart from the rim; None where it does not stand on the artery."""
    is_touching = _is_island(lumen, height_mm < low_mm)
    height_mm = np.where(is_touching, 2.0 * low_mm, height_mm)
    level = _level(lumen, height_mm, low_mm)
    placed, faces, _ = triangles.clip(np.column_stack([lumen.vertices_mm, height_mm]), lumen.faces, level)
    placed, faces = triangles.compact(placed, triangles.faces_at(placed[:, :3], faces, dome_mm))
    vertices, height_mm = placed[:, :3], placed[:, 3]
    loops = triangles.boundary_loops(vertices, faces)
    near = [landing.surface.closest(vertices[loop])[1].min() < low_mm + ON_ARTERY_MM for loop in loops]
    if not any(near):
        return None, []
    # The longest edge at the artery is the rim; others are the mouths of branches that leave from the sac.
    rim = near.index(True)
    return Flank(vertices, faces, height_mm, loops[rim]), [*loops[:rim], *loops[rim + 1 :]]


def _level(lumen: Surface, height_mm: Floats, low_mm: float) -> Floats:
    """Level (n,), negative on the wall above a height, with a border that is short where the height hardly decides.

    It is shifted by the square of `low_mm` times its curvature at most, and a spike narrower than `low_mm` goes where
    the height hardly exceeds it.
    """
    excess = height_mm - low_mm
    member = np.flatnonzero(_near_border(lumen, excess, SETTLING * low_mm))
    level = -excess
    if not len(member):
        return level
    number = np.full(len(height_mm), -1)
    number[member] = np.arange(len(member))
    faces = number[lumen.faces[(number[lumen.faces] >= 0).all(axis=1)]]
    edge = np.zeros(len(member), dtype=bool)
    edge[np.unique(triangles.open_edges(faces))] = True
    gain = np.clip(excess[member], -low_mm, low_mm) / low_mm**2
    level[member] = low_mm * region(lumen.vertices_mm[member], faces, gain, edge, low_mm)
    return level


def _near_border(lumen: Surface, excess: Floats, reach_mm: float) -> Bools:
    """Tell the vertices (n,) that lie within `reach_mm` of where the excess (n,) changes sign."""
    is_above = excess[lumen.faces] > 0
    crossed = is_above.any(axis=1) & ~is_above.all(axis=1)
    border = lumen.vertices_mm[np.unique(lumen.faces[crossed])]
    if not len(border):
        return np.zeros(len(excess), dtype=bool)
    return np.asarray(cKDTree(border).query(lumen.vertices_mm, distance_upper_bound=reach_mm)[0]) < reach_mm


def _artery(vessel: Vessel, landing: Landing, lines: Sequence[Centerline], bulge: Bulge) -> Artery:
    """The arteries around a sac: the parent, the branches that pass under it too, and those elsewhere or from it."""
    landings, proper = [landing], []
    foot = cKDTree(bulge.foot_mm)
    for line in lines:
        depth = np.min([one.solid.signed_distance(line.points_mm) for one in landings], axis=0)
        is_apart = depth > -0.5 * line.inscribed_radius_mm
        in_sac = bulge.distances_mm(line.points_mm) < 1.2 * line.inscribed_radius_mm
        inner = np.flatnonzero(~is_apart | in_sac)
        is_branch = np.arange(len(line.points_mm)) > (inner[-1] if len(inner) else -1)
        gap = np.asarray(foot.query(line.points_mm)[0])
        passes = (is_apart & (gap < PASSING * line.inscribed_radius_mm)).any()
        side = _beside(vessel.lumen, landing, line, bulge) if passes else None
        if side is not None:
            landings.append(side)
            place, _ = curves.project(side.points_mm, line.points_mm)
            is_branch &= (place <= 0) | (place >= curves.arc_length(side.points_mm)[-1])
        proper += [Centerline(line.points_mm[run], line.inscribed_radius_mm[run]) for run in _runs(is_branch)]
    branches = tubes_of(proper)
    along_mm = np.concatenate([np.zeros(0), *(line.abscissa_mm for line in proper)])
    return Artery(tuple(landings), branches, apart_mm(landings, branches, along_mm, _low_mm(vessel, landing, bulge)))


def _runs(member: Bools) -> list[slice]:
    """Stretches of two members (n,) or more in a row."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], member, [False]]).astype(int)))
    return [slice(first, last) for first, last in change.reshape(-1, 2) if last - first > 1]


def _beside(lumen: Surface, landing: Landing, line: Centerline, bulge: Bulge) -> Landing | None:
    """The landing surface from a branch into the parent artery under a sac, as far as the branch is none of the sac's.

    The wall between two branches, where a sac at their fork sits, is that of the way from one into the other.
    """
    course = _into_parent(landing, line, bulge)
    if course is None:
        return None
    side = close_landing(lumen, fit_axis(lumen, course, [Mouth(bulge.foot_mm, bulge.inward)]))
    is_own = (~side.is_restored).mean(axis=1) > OWN_WALL
    is_own &= bulge.distances_mm(side.points_mm) > 1.2 * side.section_radius_mm
    lost = np.flatnonzero(~is_own & (landing.solid.signed_distance(side.points_mm) > 0))
    end = lost[0] if len(lost) else len(side.points_mm)
    if end < FEWEST_SECTIONS:
        return None
    return Landing(side.points_mm[:end], side.rho_mm[:end], side.is_restored[:end])


def _into_parent(landing: Landing, line: Centerline, bulge: Bulge) -> Centerline | None:
    """The way from a branch into the parent artery: to where the sac is, unless that turns back; None for none."""
    depth = landing.solid.signed_distance(line.points_mm)
    inside = np.flatnonzero(depth < -0.5 * line.inscribed_radius_mm)
    if not len(inside):
        return None
    fork, radius = int(inside[-1]), float(line.inscribed_radius_mm[inside[-1]])
    ends = np.stack([line.points_mm[fork], bulge.foot_mm.mean(axis=0)])
    place, middle = curves.project(landing.points_mm, ends)[0]
    beyond = line.abscissa_mm - line.abscissa_mm[fork]
    away = np.flatnonzero((beyond > radius) & (beyond < NEAR_MM))[::-1]
    ahead = curves.arc_length(landing.points_mm) - place
    sense = 1 if middle > place - radius else -1
    for side in (sense, -sense):
        parent = np.flatnonzero((side * ahead > radius) & (side * ahead < NEAR_MM))[::side]
        if min(len(parent), len(away)) < FEWEST_SECTIONS:
            continue
        if np.median(line.inscribed_radius_mm[away]) < EQUAL * np.median(landing.section_radius_mm[parent]):
            return None
        one, other = line.points_mm[away], landing.points_mm[parent]
        chords = one[-1] - one[0], other[-1] - other[0]
        if chords[0] @ chords[1] > TURNED_BACK * float(np.linalg.norm(chords[0]) * np.linalg.norm(chords[1])):
            widths = np.concatenate([line.inscribed_radius_mm[away], landing.section_radius_mm[parent]])
            return _evenly(np.concatenate([one, other]), widths)
    return None


def _evenly(points_mm: Floats, radius_mm: Floats) -> Centerline:
    """A centerline through points (n, 3) with radii (n,), its own points evenly spaced."""
    even = curves.resample(points_mm, COURSE_STEP_MM)
    share = np.linspace(0.0, curves.arc_length(points_mm)[-1], len(even))
    return Centerline(even, np.interp(share, curves.arc_length(points_mm), radius_mm))


def _neck(artery: Artery, rim_mm: Floats) -> Surface:
    """The arteries' wall inside a closed curve (k, 3) on it: rings from the curve to its middle.

    The outermost ring is the curve itself, so that the sac closes without a gap; where it lies off the landing surface
    the rings do as a membrane would. The curve runs with the sac's wall, so the faces along it look into the sac.
    """
    landing = artery.landings[0]
    grid = landing.grid_of(rim_mm)
    grid[:, 1] = np.unwrap(grid[:, 1], period=landing.n_rays)
    middle = grid.mean(axis=0)
    lift = np.fft.rfft(rim_mm - landing.at_grid(grid), axis=0)
    wave = np.arange(len(lift))[:, None]
    share = np.linspace(1.0, 0.0, N_RINGS + 1)
    # A harmonic function on a disc: waves around its rim decay inwards with the power of their number.
    rings = [
        landing.at_grid(middle + f * (grid - middle)) + np.fft.irfft(f**wave * lift, n=len(grid), axis=0) for f in share
    ]
    if len(artery.landings) > 1:
        rings = [rings[0], *(artery.onto(ring) for ring in rings[1:])]
    vertices = np.concatenate([*rings[:-1], rings[-1][:1]])
    k = len(rim_mm)
    here, there = np.arange(k), (np.arange(k) + 1) % k
    faces = [np.stack([np.full(k, N_RINGS * k), (N_RINGS - 1) * k + here, (N_RINGS - 1) * k + there], axis=1)]
    for ring in range(N_RINGS - 1):
        a, b = ring * k, (ring + 1) * k
        faces.append(np.stack([a + here, a + there, b + here], axis=1))
        faces.append(np.stack([a + there, b + there, b + here], axis=1))
    return Surface(vertices, np.concatenate(faces))


def _closed_sac(flank: Flank, other_loops: list[Ints], rings: Floats, neck: Surface) -> Surface:
    """The sac's wall, its branches' mouths, its continuation to the artery and its neck as one closed surface."""
    points, wall = triangles.cap(flank.vertices_mm, flank.faces, other_loops)
    n_below, k = len(rings) - 1, len(flank.rim)
    # The skirt's first ring is the rim, the neck's first ring is the skirt's last: those vertices are shared.
    number = np.concatenate([flank.rim, len(points) + np.arange(n_below * k)]).reshape(-1, k)
    strips = [_strip(number[i], number[i + 1]) for i in range(n_below)]
    first = len(points) + n_below * k
    on_neck = np.concatenate([number[-1], first + np.arange(len(neck.vertices_mm) - k)])
    vertices = np.concatenate([points, rings[1:].reshape(-1, 3), neck.vertices_mm[k:]])
    return Surface(vertices, np.concatenate([wall, *strips, on_neck[neck.faces[:, ::-1]]]))


def _strip(upper: Ints, lower: Ints) -> Ints:
    """Triangles between two rings of vertices (k,), seen from outside; the rings run with the wall above them."""
    ahead_up, ahead_low = np.roll(upper, -1), np.roll(lower, -1)
    return np.concatenate([np.stack([ahead_up, upper, lower], 1), np.stack([ahead_up, lower, ahead_low], 1)])
