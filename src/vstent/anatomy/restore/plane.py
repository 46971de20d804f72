"""Find the neck plane: the plane that separates a sac from all arteries with the least surface for its volume.

Of all planes that leave every artery on one side and the sac's dome on the other, the neck plane has the smallest ratio

    (area of the section + area of artery wall beyond the plane) / volume beyond the plane.

Below the neck the section grows faster than the volume, because the wall turns away into the arteries; above it the
volume shrinks faster than the section. The ratio is that of Cheeger (1970, Problems in Analysis, Princeton, 195), whose
smallest value defines the bottleneck of a body. The second area keeps stumps of arteries out of the sac. Where the
section has several pieces, a pouch of the sac that hangs back through the plane belongs to the sac.
"""

from typing import Final, NamedTuple

import numpy as np

from vstent.anatomy.restore.bulges import FLANK, Bulge
from vstent.anatomy.restore.neck import BRANCH_SHARE
from vstent.anatomy.restore.tubes import Tubes
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm, NeckPlane
from vstent.kernels import curves, sections, topology, triangles
from vstent.kernels.arrays import Floats, Ints

REACH: Final = 2.0
"""Wall farther from the bulge than this many radii of the artery there is beyond the neck; arteries are open there."""
THIN: Final = 0.55
"""A branch thinner than this fraction of the artery may arise from the sac: it does not have to be outside."""
LEAST_SHARE: Final = 0.5
"""Smallest fraction of the bulge's wall in a sac; with less the plane cuts off a lobe."""
TILT_RAD: Final = np.radians(80.0)
"""Largest angle in rad between the normal of a plane and the direction from the bulge's foot to its middle."""
N_DIRECTIONS: Final = 120
"""Number of normals on the whole sphere from which those of the first planes are taken."""
OFFSETS: Final = np.linspace(-0.5, 0.7, 13)
"""Places of the first planes along their normals from the bulge's foot, as fractions of the bulge's height."""
N_STARTS: Final = 2
"""Number of first planes from which the best one is searched."""
APART_RAD: Final = np.radians(25.0)
"""Smallest angle between the normals of these planes in rad."""
STEP: Final = 0.25
"""First step of the search, in mm and as tangent of an angle."""
NEARLY: Final = 0.1
"""A plane separates nearly as well if its ratio is larger by at most this fraction."""
NEAR_OFFSETS: Final = np.linspace(-0.6, 0.6, 13)
"""Offsets of the planes that are compared with the best one, in radii of its section."""
NEAR_TILTS: Final = np.tan(np.radians([10.0, 20.0]))
"""Tangents of their angles with it."""
ARTERY, BULGE, BRANCH = 2, 3, 4
"""Columns of the measures of a sac: artery wall, wall of the bulge, and cut branches in it; areas in mm2."""


class Wall(NamedTuple):
    """The wall of a bulge and of the arteries beside it, with arteries cut open."""

    sheet: sections.Sheet
    """The wall; the weights of a face are its shares of `ARTERY`, `BULGE` and `BRANCH`."""
    seed: int
    """Face in the dome."""

    def ratios(self, points_mm: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Return surface over volume (k,) for planes (k, 3), infinite without a sac, and the areas of sections (k,)."""
        measures, is_closed = sections.beyond(self.sheet, self.seed, points_mm, normals)
        volume, section = measures.T[:2]
        is_sac = is_closed & (volume > 0) & (section > 0)
        is_sac &= measures[:, BULGE] > LEAST_SHARE * self.sheet.terms[:, 2 + BULGE].sum()
        return np.where(is_sac, (section + measures[:, ARTERY]) / np.where(is_sac, volume, 1.0), np.inf), section


def plane_sac(lumen: Surface, tubes: Tubes, bulge: Bulge) -> Aneurysm | None:
    """Cut a sac off the lumen at its neck plane."""
    height, sphere = tubes.height_mm(lumen.vertices_mm)
    away_mm = bulge.distances_mm(lumen.vertices_mm)
    radius = tubes.radius_mm[sphere]
    fields = np.column_stack([lumen.vertices_mm, height / radius, away_mm])
    near = (away_mm < REACH * radius)[lumen.faces].all(axis=1)
    fields, faces = triangles.compact(fields, triangles.faces_at(lumen.vertices_mm, lumen.faces[near], bulge.dome_mm))
    fields, faces = _without_contacts(fields, faces)
    artery_mm = float(np.median(tubes.radius_mm[tubes.height_mm(bulge.foot_mm)[1]]))
    for thin_mm in (THIN * artery_mm, np.inf):
        wall = _wall(fields, faces, thin_mm, bulge)
        best = _best(wall, bulge)
        if best is None:
            continue
        point, normal, measures, area_mm2 = best
        if measures[BRANCH] > 0:
            without = _best(_wall(fields, faces, 0.0, bulge), bulge)
            area_mm2 = area_mm2 if without is None else np.append(area_mm2, without[2][1])
        sac, neck = cut_at(wall, point, normal)
        share = measures[BULGE] / wall.sheet.terms[:, 2 + BULGE].sum()
        band_mm2 = float(area_mm2.min()), float(area_mm2.max())
        plane = NeckPlane(normal, neck.vertices_mm[:-1], band_mm2, float(share))
        return Aneurysm(sac, neck, plane.rim_mm, plane)
    return None


def _without_contacts(fields: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Return the wall with the bulge closed where it touches an artery that it also reaches through its foot."""
    # Through such a contact every part with the dome would reach an open artery, and no plane at the foot would close
    # it. A branch that arises from the sac is reached through its mouth alone, and stays.
    is_own = (fields[:, -1] == 0)[faces].all(axis=1)
    own, rest = faces[is_own], faces[~is_own]
    side = np.full(len(fields), -1)
    side[rest] = topology.face_components(rest)[:, None]
    loops = triangles.boundary_loops(fields[:, :3], own)  # the foot first
    for loop in loops[1:]:
        if side[loop[0]] == side[loops[0][0]]:
            ring, twin = len(fields) + np.arange(len(loop)), np.arange(len(fields))
            twin[loop] = ring
            fan = np.stack([np.roll(ring, -1), ring, np.full(len(ring), ring[-1] + 1)], axis=1)
            own = np.concatenate([twin[own], fan])
            fields = np.concatenate([fields, fields[loop], fields[loop].mean(axis=0)[None]])
    return fields, np.concatenate([rest, own]).astype(np.int32)


def _wall(fields: Floats, faces: Ints, thin_mm: float, bulge: Bulge) -> Wall:
    """Return the wall with points, heights and distances (n, 5), and branches thinner than `thin_mm` closed."""
    loops = triangles.boundary_loops(fields[:, :3], faces)
    radius_mm = [np.sqrt(np.linalg.norm(triangles.polygon_area_vector(fields[loop, :3])) / np.pi) for loop in loops]
    widest = int(np.argmax(radius_mm)) if loops else -1
    thin = [loop for k, loop in enumerate(loops) if radius_mm[k] < thin_mm and k != widest]
    points, faces = triangles.cap(fields[:, :3], faces, thin)
    is_cap = np.arange(len(points)) >= len(fields)
    share, away_mm = np.zeros((2, len(points)))
    share[~is_cap], away_mm[~is_cap] = fields[:, 3:].T
    artery = np.clip((FLANK - share) / (FLANK - BRANCH_SHARE), 0.0, 1.0)
    weights = np.column_stack([artery, ~is_cap & (away_mm == 0), is_cap])
    seed = int(np.linalg.norm(points[faces].mean(axis=1) - bulge.dome_mm, axis=1).argmin())
    return Wall(sections.sheet(points, faces, weights[faces].mean(axis=1)), seed)


def _best(wall: Wall, bulge: Bulge) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Return point (3,), normal (3,) and measures (5,) of the best plane, and sections (k,) of nearly as good ones.

    None where no plane separates the sac from the arteries that are open.
    """
    from scipy.optimize import minimize

    points, normals = _first_planes(bulge)
    ratio, area_mm2 = wall.ratios(points, normals)
    starts: list[int] = []
    for k in np.argsort(ratio):
        is_apart = all(normals[k] @ normals[other] < np.cos(APART_RAD) for other in starts)
        if np.isfinite(ratio[k]) and is_apart and len(starts) < N_STARTS:
            starts.append(int(k))
    if not starts:
        return None

    def cost(x: Floats, k: int) -> float:
        return float(np.log(wall.ratios(*_planes(points[k], normals[k], x[None]))[0][0]))

    simplex = np.concatenate([np.zeros((1, 3)), STEP * np.eye(3)])
    results = [
        minimize(
            cost,
            np.zeros(3),
            (k,),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 2e-3, "fatol": 1e-4, "maxfev": 300},
        )
        for k in starts
    ]
    k, result = min(zip(starts, results, strict=True), key=lambda pair: float(pair[1].fun))
    point, normal = (row[0] for row in _planes(points[k], normals[k], result.x[None]))
    measures = sections.beyond(wall.sheet, wall.seed, point[None], normal[None])[0][0]
    turn = np.pi / 4 * np.arange(8)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    tilts = np.concatenate([np.zeros((1, 2)), *(tangent * ring for tangent in NEAR_TILTS)])
    offsets_mm = np.repeat(float(np.sqrt(measures[1] / np.pi)) * NEAR_OFFSETS, len(tilts))
    near = np.column_stack([offsets_mm, np.tile(tilts, (len(NEAR_OFFSETS), 1))])
    near_ratio, near_mm2 = wall.ratios(*_planes(point, normal, near))
    is_good = np.concatenate([ratio, near_ratio]) < (1 + NEARLY) * near_ratio.min()
    return point, normal, measures, np.concatenate([area_mm2, near_mm2])[is_good]


def _first_planes(bulge: Bulge) -> tuple[Floats, Floats]:
    """Return points (k, 3) and unit normals (k, 3) of planes through a bulge, in all directions out of its foot."""
    foot = bulge.foot_mm.mean(axis=0)
    middle = bulge.points_mm.mean(axis=0) - foot
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    every = np.concatenate([middle[None], curves.directions(N_DIRECTIONS)])
    every = every[every @ middle > np.cos(TILT_RAD)]
    top_mm = ((bulge.points_mm - foot) @ every.T).max(axis=0)
    points = foot + (OFFSETS[:, None] * top_mm)[..., None] * every
    return points.reshape(-1, 3), np.broadcast_to(every, points.shape).reshape(-1, 3)


def _planes(point: Floats, normal: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Return points and normals (k, 3) of planes near one: offset in mm and tangents of two angles, the rows of `x`."""
    first = curves.any_perpendicular(normal)
    normals = normal + x[:, 1:2] * first + x[:, 2:] * np.cross(normal, first)
    return point + x[:, :1] * normal, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def cut_at(wall: Wall, point: Floats, normal: Floats) -> tuple[Surface, Surface]:
    """Cut a sac off its wall by a plane through a point (3,) with a normal (3,); return sac and neck."""
    vertices, faces = wall.sheet.vertices, wall.sheet.faces
    height_mm = (vertices - point) @ normal
    is_up, edges = height_mm > 0, triangles.directed_edges(faces)
    label = triangles.joined(edges[is_up[edges].all(axis=1)], len(is_up))
    corner = faces[wall.seed][is_up[faces[wall.seed]]][0]
    is_beyond = is_up & (label == label[corner])
    # A pouch has no way to the open ends of the wall. It is not cut: its vertices are on the sac's side of the level.
    label = triangles.joined(edges[~is_beyond[edges].any(axis=1)], len(is_up))
    is_sac = is_beyond | ~np.isin(label, label[np.unique(triangles.open_edges(faces))])
    level = np.where(is_sac, -1.0, 1.0) * np.maximum(np.abs(height_mm), 1e-9)
    vertices, faces, _ = triangles.clip(vertices, faces, level)
    vertices, faces = triangles.compact(vertices, faces)
    loops = sorted(
        triangles.boundary_loops(vertices, faces),
        key=lambda loop: -float(np.linalg.norm(triangles.polygon_area_vector(vertices[loop]))),
    )
    points, closed = triangles.cap(vertices, faces, loops)
    k, rim = len(loops[0]), np.append(vertices[loops[0]], points[len(vertices)][None], axis=0)
    here, there = np.arange(k), (np.arange(k) + 1) % k
    return Surface(points, closed), Surface(rim, np.stack([here, there, np.full(k, k)], axis=1))
