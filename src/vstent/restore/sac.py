"""The sac: the lumen outside the landing surface that holds a bulge's dome, and the neck that closes it."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.restore.bulges import FLANK, Bulge, bulge_at
from vstent.restore.drawn import Drawn
from vstent.restore.landing import Landing
from vstent.restore.neck import Artery, Flank, believed_from_mm, skirt, unblurred
from vstent.restore.tubes import Tubes, tubes_of
from vstent.surface import Surface
from vstent.vessel import Aneurysm, Centerline, Vessel

ON_ARTERY_MM: Final = 0.5
"""A flank whose rim comes nearer than this to the height where it begins stands on the parent artery."""
FLAT: Final = 0.2
"""Less volume than this fraction of neck area to the power 3/2 is an uneven wall (a half sphere has 0.38)."""
ROUND: Final = 0.6
"""A shape with more than 1 / 0.6 times the surface of the sphere of its volume is a scan's debris: sacs, lobed ones
too, have 0.7 to 0.85."""
N_RINGS: Final = 12
"""Rings of the neck's triangles."""
N_SKIRT: Final = 4
"""Strips of triangles between the flank and the neck."""


def cut_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], bulge: Bulge) -> Aneurysm | None:
    """Cut the sac of a bulge off the lumen; None where it does not hang on the parent artery, or is flat.

    Side branches that leave from the sac or beside it are cut off along their own tubes.
    """
    lumen = vessel.lumen
    artery = Artery(landing, _branch_tubes(side_lines, landing, bulge))
    height_mm = artery.height_mm(lumen.vertices_mm, lumen.vertex_normals)
    parent_mm = landing.section_radius_mm[landing.nearest_sections(lumen.vertices_mm)]
    core = bulge_at(lumen, height_mm, height_mm > FLANK * parent_mm, bulge.dome_mm)
    if core is None:
        return None
    low_mm = _low_mm(vessel, landing, core)
    flank, other_loops = _flank(lumen, height_mm, low_mm, core.dome_mm, landing)
    if flank is None:
        return None
    flank = unblurred(flank, vessel.blur_mm) if vessel.blur_mm else flank
    rings = skirt(flank, artery, vessel.closed, n_rings=N_SKIRT)
    found = _aneurysm(landing, flank, other_loops, rings)
    is_flat = found.sac.volume_mm3 < FLAT * found.neck.area_mm2**1.5
    return None if is_flat or _roundness(found.sac) < ROUND else found


def _low_mm(vessel: Vessel, landing: Landing, bulge: Bulge) -> float:
    """Height above the artery from which on a bulge's flank is believed."""
    most_mm = FLANK * float(np.median(landing.section_radius_mm[landing.nearest_sections(bulge.foot_mm)]))
    return believed_from_mm(vessel.lumen, bulge.foot_mm, most_mm, vessel.blur_mm)


def drawn_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], drawn: Drawn) -> Aneurysm:
    """Close the sac behind a neck that was drawn; side branches that leave from it are cut off along their tubes."""
    artery = Artery(landing, _branch_tubes(side_lines, landing, drawn.bulge))
    normals = Surface(drawn.vertices_mm, drawn.faces).vertex_normals
    in_branch_mm = _low_mm(vessel, landing, drawn.bulge) - artery.above_branches_mm(drawn.vertices_mm, normals)
    vertices, faces, _ = triangles.clip(drawn.vertices_mm, drawn.faces, in_branch_mm)
    vertices, faces = triangles.part_at(vertices, faces, drawn.bulge.dome_mm)
    loops = list(triangles.boundary_loops(vertices, faces))
    cut = cKDTree(drawn.cut_mm)
    rim = loops.pop(int(np.argmin([np.median(cut.query(vertices[loop])[0]) for loop in loops])))
    rings = np.stack([vertices[rim], drawn.neck_of(vertices[rim])])
    return _aneurysm(landing, Flank(vertices, faces, np.zeros(len(vertices)), rim), loops, rings)


def _aneurysm(landing: Landing, flank: Flank, other_loops: list[Ints], rings: Floats) -> Aneurysm:
    """The sac of a flank, the mouths of its branches, and its continuation, rings (n, k, 3), down to the neck."""
    neck = _neck(landing, rings[-1])
    sac = _closed_sac(flank, other_loops, rings, neck)
    abscissa = curves.project(landing.points_mm, rings[-1])[0]
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
    height_mm = np.where(is_touching, 1.001 * low_mm, height_mm)
    vertices, faces, below = triangles.clip(lumen.vertices_mm, lumen.faces, low_mm - height_mm)
    faces = triangles.faces_at(vertices, faces, dome_mm)
    used = np.unique(faces)
    vertices, faces = triangles.compact(vertices, faces)
    loops = triangles.boundary_loops(vertices, faces)
    near = [landing.surface.closest(vertices[loop])[1].min() < low_mm + ON_ARTERY_MM for loop in loops]
    if not any(near):
        return None, []
    # The longest edge at the artery is the rim; others are the mouths of branches that leave from the sac.
    rim = near.index(True)
    return Flank(vertices, faces, low_mm - below[used], loops[rim]), [*loops[:rim], *loops[rim + 1 :]]


def _branch_tubes(lines: Sequence[Centerline], landing: Landing, bulge: Bulge) -> Tubes:
    """Tubes of the side branches beyond the parent artery, and beyond the sac where they leave from it."""
    proper = []
    for line in lines:
        in_artery = landing.solid.signed_distance(line.points_mm) < -0.5 * line.inscribed_radius_mm
        in_sac = bulge.distances_mm(line.points_mm) < 1.2 * line.inscribed_radius_mm
        inner = np.flatnonzero(in_artery | in_sac)
        first = inner[-1] + 1 if len(inner) else 0
        if len(line.points_mm) - first > 1:
            proper.append(Centerline(line.points_mm[first:], line.inscribed_radius_mm[first:]))
    return tubes_of(proper)


def _neck(landing: Landing, rim_mm: Floats) -> Surface:
    """The landing surface inside a closed curve (k, 3) on it: rings from the curve to its middle.

    The outermost ring is the curve itself, so that the sac closes without a gap; where it lies off the landing surface
    the rings do as a membrane would. The curve runs with the sac's wall, so the faces along it look into the sac.
    """
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
