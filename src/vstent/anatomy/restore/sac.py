"""Cut off the sac, the lumen outside the landing surface that contains a bulge's dome, and find its neck."""

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
from vstent.kernels.smoothing import region

ON_ARTERY_MM: Final = 0.5
"""A flank is attached to the parent artery if its rim comes this close to the height where it begins, in mm."""
FLAT: Final = 0.2
"""A sac is rejected as uneven wall if its volume is below this fraction of (neck area)^(3/2); a half sphere has
0.38."""
ROUND: Final = 0.6
"""A shape is rejected as debris of the scan if its sphericity is below this. Sacs, including lobed ones, have 0.7 to
0.85."""
PASSING: Final = 2.5
"""A branch passes under a sac that begins within this many of the branch's radii."""
NEAR_MM: Final = 12.0
"""Length of branch and of parent artery on each side of the fork, in mm, that is used to restore a branch under a
sac."""
TURNED_BACK: Final = -0.5
"""Smallest cosine of the angle between branch and parent artery that a wall can follow: a turn of 120 degrees."""
EQUAL: Final = 0.6
"""A branch thinner than this fraction of the parent artery does not shape its wall; a tube represents it."""
COURSE_STEP_MM: Final = 0.1
"""Spacing of the points of a path from a branch into the parent artery, in mm."""
OWN_WALL: Final = 0.25
"""A restored branch ends at the first section outside the parent artery with less than this fraction of original
wall."""
FEWEST_SECTIONS: Final = 8
"""Fewest sections of a restored branch; a shorter piece is not used."""
SETTLING: Final = 6.0
"""The border of the neck is optimized within this many times the height where the flank begins."""
N_RINGS: Final = 12
"""Number of rings of triangles in the neck."""
N_SKIRT: Final = 4
"""Number of strips of triangles between flank and neck."""
ON_SAC_MM: Final = 0.05
"""Points whose median distance outside a sac is below this, in mm, belong to that sac."""


def cut_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], bulge: Bulge) -> Aneurysm | None:
    """Cut the sac of a bulge off the lumen, and branches that arise from it or beside it off along their own tubes."""
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
        # A sac that touches its artery a second time has two openings, and the false one may have the longer rim.
        if np.median(landing.surface.closest(flank.vertices_mm[loop])[1]) < low_mm + ON_ARTERY_MM:
            mouths = [flank.rim, *other_loops[:k], *other_loops[k + 1 :]]
            other = _cut_off(vessel, artery, flank._replace(rim=loop), mouths, low_mm)
            found = max(found, other, key=lambda one: one.neck.area_mm2)
    return found if is_sac(found) else None


def is_sac(aneurysm: Aneurysm) -> bool:
    """Return whether a shape that was cut off is neither flat nor debris of the scan."""
    volume_mm3, area_mm2 = aneurysm.sac.volume_mm3, aneurysm.sac.area_mm2
    # Sphericity: area of the sphere of equal volume over the sac's (Wadell 1935, J. Geol. 43:250).
    roundness = float(np.cbrt(36 * np.pi * max(volume_mm3, 0.0) ** 2)) / area_mm2
    return volume_mm3 >= FLAT * aneurysm.neck.area_mm2**1.5 and roundness >= ROUND


def is_beside_branch(landing: Landing, side_lines: Sequence[Centerline], bulge: Bulge) -> bool:
    """Return whether a branch leaves the parent artery under a bulge or beside it."""
    foot = cKDTree(bulge.foot_mm)
    for line in side_lines:
        is_apart = landing.surface.closed.signed_distance(line.points_mm) > -0.5 * line.inscribed_radius_mm
        if (is_apart & (foot.query(line.points_mm)[0] < PASSING * line.inscribed_radius_mm)).any():
            return True
    return False


def _cut_off(vessel: Vessel, artery: Artery, flank: Flank, other_loops: list[Ints], low_mm: float) -> Aneurysm:
    """Return the sac above a flank's rim, continued down to the artery."""
    flank = unblurred(flank, vessel.blur_mm) if vessel.blur_mm else flank
    rings = skirt(flank.levelled(low_mm), artery, vessel.closed, n_rings=N_SKIRT)
    return _aneurysm(artery, flank, other_loops, rings)


def _low_mm(vessel: Vessel, landing: Landing, bulge: Bulge) -> float:
    """Return the height above the artery, in mm, above which a bulge's flank is free of blur."""
    most_mm = FLANK * float(np.median(landing.section_radius_mm[landing.nearest_sections(bulge.foot_mm)]))
    return believed_from_mm(vessel.lumen, bulge.foot_mm, most_mm, vessel.blur_mm)


def is_in_one(points_mm: Floats, aneurysms: Sequence[Aneurysm]) -> bool:
    """Return whether most points (n, 3) of a sac or bulge lie in or on one of the aneurysms."""
    return any(np.median(one.sac.signed_distance(points_mm)) < ON_SAC_MM for one in aneurysms)


def drawn_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], drawn: Drawn) -> Aneurysm:
    """Cut off the sac at a neck drawn by hand; side branches that arise from it are cut off along their tubes."""
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


def is_island(lumen: Surface, is_low: Bools) -> Bools:
    """Return whether each vertex (n,) is low wall without a connection to an opening over low wall."""
    edges = triangles.directed_edges(lumen.faces)
    edges = edges[is_low[edges].all(axis=1)]
    label = triangles.joined(edges, len(is_low))
    ends = np.unique(triangles.open_edges(lumen.faces))
    return is_low & ~np.isin(label, label[ends[is_low[ends]]])


def _flank(
    lumen: Surface, height_mm: Floats, low_mm: float, dome_mm: Floats, landing: Landing
) -> tuple[Flank | None, list[Ints]]:
    """Return the sac's wall above a height and its edges other than the rim; None where it is not on the artery."""
    # There the sac touches an artery from which it does not arise.
    is_touching = is_island(lumen, height_mm < low_mm)
    height_mm = np.where(is_touching, 2.0 * low_mm, height_mm)
    level = _level(lumen, height_mm, low_mm)
    placed, faces, _ = triangles.clip(np.column_stack([lumen.vertices_mm, height_mm]), lumen.faces, level)
    placed, faces = triangles.compact(placed, triangles.faces_at(placed[:, :3], faces, dome_mm))
    vertices, height_mm = placed[:, :3], placed[:, 3]
    loops = triangles.boundary_loops(vertices, faces)
    near = [landing.surface.closest(vertices[loop])[1].min() < low_mm + ON_ARTERY_MM for loop in loops]
    if not any(near):
        return None, []
    # The longest edge at the artery is the rim. Other edges are mouths of branches that arise from the sac.
    rim = near.index(True)
    return Flank(vertices, faces, height_mm, loops[rim]), [*loops[:rim], *loops[rim + 1 :]]


def _level(lumen: Surface, height_mm: Floats, low_mm: float) -> Floats:
    """Return a level (n,), negative on the wall above a height, with a short border where the height is flat."""
    # The border moves by at most low_mm squared times its curvature. Spikes narrower than low_mm vanish where the
    # height hardly exceeds it.
    excess = height_mm - low_mm
    is_above = excess[lumen.faces] > 0
    border = lumen.vertices_mm[np.unique(lumen.faces[is_above.any(axis=1) & ~is_above.all(axis=1)])]
    level = -excess
    if not len(border):
        return level
    reach_mm = SETTLING * low_mm
    is_near = np.asarray(cKDTree(border).query(lumen.vertices_mm, distance_upper_bound=reach_mm)[0]) < reach_mm
    member = np.flatnonzero(is_near)
    number = np.full(len(height_mm), -1)
    number[member] = np.arange(len(member))
    faces = number[lumen.faces[(number[lumen.faces] >= 0).all(axis=1)]]
    edge = np.zeros(len(member), dtype=bool)
    edge[np.unique(triangles.open_edges(faces))] = True
    gain = np.clip(excess[member], -low_mm, low_mm) / low_mm**2
    level[member] = low_mm * region(lumen.vertices_mm[member], faces, gain, edge, low_mm)
    return level


def _artery(vessel: Vessel, landing: Landing, lines: Sequence[Centerline], bulge: Bulge) -> Artery:
    """Return the arteries around a sac: the parent artery, branches that pass under the sac, and all other branches."""
    landings, proper = [landing], []
    foot = cKDTree(bulge.foot_mm)
    for line in lines:
        depth = np.min([one.surface.closed.signed_distance(line.points_mm) for one in landings], axis=0)
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
        runs = np.flatnonzero(np.diff(np.concatenate([[False], is_branch, [False]]).astype(int))).reshape(-1, 2)
        slices = [slice(first, last) for first, last in runs if last - first > 1]
        proper += [Centerline(line.points_mm[run], line.inscribed_radius_mm[run]) for run in slices]
    branches = tubes_of(proper)
    along_mm = np.concatenate([np.zeros(0), *(line.abscissa_mm for line in proper)])
    return Artery(tuple(landings), branches, apart_mm(landings, branches, along_mm, _low_mm(vessel, landing, bulge)))


def _beside(lumen: Surface, landing: Landing, line: Centerline, bulge: Bulge) -> Landing | None:
    """Return the landing surface from a branch into the parent artery, up to where it becomes the sac's wall."""
    # A sac at a fork sits on the wall between two branches, which is the wall of the path from one into the other.
    course = _into_parent(landing, line, bulge)
    if course is None:
        return None
    side = close_landing(lumen, fit_axis(lumen, course, [Mouth(bulge.foot_mm, bulge.inward)]))
    is_own = (~side.is_restored).mean(axis=1) > OWN_WALL
    is_own &= bulge.distances_mm(side.points_mm) > 1.2 * side.section_radius_mm
    lost = np.flatnonzero(~is_own & (landing.surface.closed.signed_distance(side.points_mm) > 0))
    end = lost[0] if len(lost) else len(side.points_mm)
    if end < FEWEST_SECTIONS:
        return None
    return Landing(side.points_mm[:end], side.rho_mm[:end], side.is_restored[:end])


def _into_parent(landing: Landing, line: Centerline, bulge: Bulge) -> Centerline | None:
    """Return the path from a branch into the parent artery, towards the sac if possible; None if there is none."""
    depth = landing.surface.closed.signed_distance(line.points_mm)
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
            points = np.concatenate([one, other])
            widths = np.concatenate([line.inscribed_radius_mm[away], landing.section_radius_mm[parent]])
            even, along = curves.resample(points, COURSE_STEP_MM), curves.arc_length(points)
            return Centerline(even, np.interp(np.linspace(0.0, along[-1], len(even)), along, widths))
    return None


def _neck(artery: Artery, rim_mm: Floats) -> Surface:
    """Return the arteries' wall inside a closed curve (k, 3), meshed in rings from the curve to its middle."""
    # The outermost ring is the curve itself, so that the sac closes without a gap. Where the curve is off the landing
    # surface, the rings follow it as a membrane would. The curve has the direction of the sac's rim, so the normals of
    # these faces point into the sac.
    landing = artery.landings[0]
    grid = landing.grid_of(rim_mm)
    grid[:, 1] = np.unwrap(grid[:, 1], period=landing.n_rays)
    middle = grid.mean(axis=0)
    lift = np.fft.rfft(rim_mm - landing.at_grid(grid), axis=0)
    wave = np.arange(len(lift))[:, None]
    share = np.linspace(1.0, 0.0, N_RINGS + 1)
    # The amplitude of wave number m of a harmonic function on a disc falls inwards as the radius to the power m.
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


def _aneurysm(artery: Artery, flank: Flank, other_loops: list[Ints], rings: Floats) -> Aneurysm:
    """Return the aneurysm of a flank, its branch mouths, and its continuation, rings (n, k, 3), down to the neck."""
    neck = _neck(artery, rings[-1])
    points, wall = triangles.cap(flank.vertices_mm, flank.faces, other_loops)
    n_below, k = len(rings) - 1, len(flank.rim)
    # The first ring of the skirt is the rim, and its last ring is the first ring of the neck: these vertices are
    # shared.
    number = np.concatenate([flank.rim, len(points) + np.arange(n_below * k)]).reshape(-1, k)
    upper, lower = number[:-1], number[1:]
    ahead_up, ahead_low = np.roll(upper, -1, axis=1), np.roll(lower, -1, axis=1)
    strips = np.stack([ahead_up, upper, lower, ahead_up, lower, ahead_low], axis=-1)
    strips = strips.reshape(n_below, k, 2, 3).transpose(0, 2, 1, 3).reshape(-1, 3)
    first = len(points) + n_below * k
    on_neck = np.concatenate([number[-1], first + np.arange(len(neck.vertices_mm) - k)])
    vertices = np.concatenate([points, rings[1:].reshape(-1, 3), neck.vertices_mm[k:]])
    return Aneurysm(Surface(vertices, np.concatenate([wall, strips, on_neck[neck.faces[:, ::-1]]])), neck, rings[-1])
