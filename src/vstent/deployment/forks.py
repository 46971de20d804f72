"""The way of a stent at a fork: through a cell in the wall of one that is there, or side by side with another one.

Both are a path of their own, on which a device is deployed as on any other: an axis, and a tube around it that is the
landing surface where nothing else is in the way. A stent of another path that is there before narrows it: the tube
stays inside its inner face, passes through one cell and widens again beyond it. Stents side by side share their common
part: each has the points that are nearer to its axis than to that of the other.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, minimum_filter
from scipy.spatial import cKDTree

from vstent.anatomy.restore.paths import on_path
from vstent.deployment.contour import bilinear, normals, planes, untwisted
from vstent.deployment.coverage import pore_areas_mm2, pore_places
from vstent.deployment.wall import TreeWall, inner_nodes_mm, landing_wall
from vstent.devices.design import Braid, piece_length_mm
from vstent.devices.formulas import grid
from vstent.devices.stent import Stent, tube_faces
from vstent.errors import LandingError
from vstent.geometry.surface import Surface, joined
from vstent.geometry.vessel import Anatomy, Centerline, Path
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats
from vstent.units import MM_PER_UM

STEP_MM: Final = 0.1
"""Distance between the rings of a tube, in mm."""
N_RAYS: Final = 72
"""Vertices in a ring."""
CATHETER_MM: Final = 0.7
"""Narrowest passage, in mm: a microcatheter for stents (0.021 inch inside) is 0.7 mm wide outside."""
NEAR_MM: Final = 2.0
"""Largest distance of such a cell from the axis of the second stent where it leaves the first, in mm."""
FACING: Final = 0.5
"""Smallest cosine of the angle between that axis and the normal of the cell."""
OPENING: Final = 0.7
"""Increase of a stent's radius per length beyond a passage, without unit; an estimate: a waist as long as a cell."""
SPARE_MM: Final = 0.02
"""Gap between a tube and the struts that are there, in mm."""
BENT_MM: Final = 2.5
"""Length on each side of a passage, in mm, over which the axis is led to the middle of the cell."""
STRAIGHT_MM: Final = 1.0
"""Length on each side of a passage, in mm, over which the axis turns into the direction across the cell."""
BLUR_MM: Final = 0.3
"""Length over which steps of a tube are smoothed, in mm."""
ROUND_RAYS: Final = 2
"""Number of rays over which corners of a tube are rounded."""
HALF_CENTER: Final = 4 / (3 * np.pi)
"""Distance of the centroid of half a disk from the middle of the disk, in radii."""
PARTED_MM: Final = 3.0
"""Distance between the axes of stents side by side, in mm, in whose direction they lie beside each other."""


class Passage(NamedTuple):
    """Cell in the wall of a stent through which another one passes."""

    center_mm: Floats
    """(3,) middle of the circle."""
    outward: Floats
    """(3,) unit normal of the wall there."""
    radius_mm: float
    """Radius of the largest circle between its struts."""


def passage(stent: Stent, path: Path) -> Passage | None:
    """Return the cell of a stent through which a path leaves it; None where none does.

    It is the cell nearest to the axis of the path, of those that face its direction and are wide enough.
    """
    points_mm = path.axis.points_mm
    leaves = np.flatnonzero(stent.contour.crosses(points_mm[:-1], points_mm[1:]))
    if not len(leaves):
        return None
    start_mm = points_mm[leaves[-1]]
    ahead = points_mm[leaves[-1] + 1] - start_mm
    ahead = ahead / np.linalg.norm(ahead)
    leaves_mm = start_mm + stent.contour.first_hit(start_mm[None], ahead[None])[0] * ahead
    away_mm = curves.lengths(pore_areas_mm2(stent)[1] - leaves_mm)
    near = np.argsort(away_mm)[: np.count_nonzero(away_mm < NEAR_MM) + 1]
    cells = [_cell(stent, float(row), float(column)) for row, column in np.transpose(pore_places(stent))[near]]
    facing = [cell for cell in cells if cell.outward @ ahead > FACING]
    return next((cell for cell in facing if 2 * cell.radius_mm > CATHETER_MM), (facing or cells)[0])


def _cell(stent: Stent, row: float, column: float) -> Passage:
    """Return the largest circle between the struts around a cell, at a fractional lattice row and column."""
    shape = grid(stent.design, stent.size)
    fine = np.linspace(-0.5, 0.5, 21)
    rows, columns = (values.ravel() for values in np.meshgrid(row + fine, column + fine, indexing="ij"))
    charts = np.concatenate([stent.nodes_mm, normals(stent.nodes_mm)], axis=2)
    places = bilinear(charts, rows * shape.row_split, columns * shape.column_split)
    starts_mm, ends_mm, half_mm = stent.pieces_mm
    middle_mm = places[:, :3].mean(axis=0)
    is_near = curves.lengths(starts_mm - middle_mm) < 2 * stent.spacing_mm
    along = np.linspace(0.0, 1.0, 5)[:, None, None]
    wires_mm = (starts_mm + along * (ends_mm - starts_mm))[:, is_near].reshape(-1, 3)
    clear_mm = cKDTree(wires_mm).query(places[:, :3])[0] - half_mm.max()
    best = int(clear_mm.argmax())
    outward = places[best, 3:] / np.linalg.norm(places[best, 3:])
    return Passage(places[best, :3], outward, float(clear_mm[best]))


class Way(NamedTuple):
    """The path on which a device is deployed."""

    anatomy: Anatomy
    """The artery with this path in the first place."""
    wall: TreeWall
    """Wall against which the device opens."""
    is_patient: Bools
    """(f,) whether each triangle of the wall is the patient's own."""
    plain_mm: Floats | None = None
    """(n,) arc lengths on the plain path, in mm, of the points of this one's axis; None where it is the plain path."""
    nested_to_mm: float = np.inf
    """Arc length on its own axis up to which it lies inside the stents that are there, in mm."""

    def from_plain_mm(self, abscissa_mm: float) -> float:
        """Return the arc length on its own axis, in mm, at one on the plain path."""
        if self.plain_mm is None:
            return abscissa_mm
        return float(np.interp(abscissa_mm, self.plain_mm, self.anatomy.parent.axis.abscissa_mm))

    def to_plain_mm(self, abscissa_mm: Floats) -> Floats:
        """Return arc lengths (n,) on the plain path, in mm, at those (n,) on its own axis."""
        if self.plain_mm is None:
            return abscissa_mm
        return np.interp(abscissa_mm, self.anatomy.parent.axis.abscissa_mm, self.plain_mm)


def way(anatomy: Anatomy, inside: Sequence[Stent] = (), beside: Sequence[str] = (), start_mm: float = -np.inf) -> Way:
    """Return the path of a device that begins at `start_mm` of the first path, or before any fork.

    `inside` are devices that are there before, `beside` the names of the paths of devices side by side with it. A
    LandingError says that it cannot pass the wall of one of them.
    """
    path = anatomy.parent
    same = [stent for stent in inside if stent.path == path.name]
    others = [stent for stent in inside if stent.path != path.name]
    if not others and not beside:
        return Way(anatomy, *landing_wall(anatomy, same))
    axis_mm = curves.resample(path.axis.points_mm, STEP_MM)
    plain_mm = path.axis.length_mm * np.linspace(0.0, 1.0, len(axis_mm))
    centers_mm, waists, nested_to_mm = axis_mm, list[tuple[Stent, Passage]](), np.inf
    for stent in others:
        cell = passage(stent, path)
        if cell is not None and path.axis.nearest_abscissa_mm(cell.center_mm[None])[0] < start_mm:
            nested_to_mm = -np.inf
        elif cell is not None:
            _check(stent, cell)
            centers_mm = _through(centers_mm, cell)
            waists.append((stent, cell))
    for name in beside:
        centers_mm = _aside(centers_mm, path, on_path(anatomy, name).parent)
    axis = Centerline(centers_mm, np.interp(plain_mm, path.axis.abscissa_mm, path.axis.inscribed_radius_mm))
    ahead = planes(axis).at(axis.abscissa_mm)[1][:, 0]
    at_mm = [float(axis.nearest_abscissa_mm(cell.center_mm[None])[0]) for _, cell in waists]
    for (_, cell), here_mm in zip(waists, at_mm, strict=True):
        share = np.exp(-(((axis.abscissa_mm - here_mm) / STRAIGHT_MM) ** 2))[:, None]
        ahead = (1 - share) * ahead + share * cell.outward
        ahead /= curves.lengths(ahead)[:, None]
    angle = 2 * np.pi * np.arange(N_RAYS) / N_RAYS
    frames = untwisted(ahead, centers_mm.mean(axis=0) - centers_mm[0])
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ frames[:, 1:]
    origins_mm = np.repeat(centers_mm, N_RAYS, axis=0)
    wall_mm, face = path.landing_surface.first_hits(origins_mm, rays.reshape(-1, 3))
    wall_mm = wall_mm.reshape(-1, N_RAYS)
    section_mm = np.interp(plain_mm, path.axis.abscissa_mm, path.section_radius_mm)[:, None]
    wall_mm = np.where(np.isfinite(wall_mm), wall_mm, section_mm)  # at the open ends
    limit_mm = _limit_mm(axis.abscissa_mm, origins_mm, rays, others, list(zip(waists, at_mm, strict=True)))
    for name in beside:
        limit_mm = np.minimum(limit_mm, _share_mm(centers_mm, rays, path, on_path(anatomy, name).parent))
    rho_mm = np.minimum(wall_mm, limit_mm)
    steps = max(1, round(BLUR_MM / STEP_MM))
    eroded_mm = minimum_filter(rho_mm, (2 * steps + 1, 2 * ROUND_RAYS + 1), mode=("nearest", "wrap"))
    smooth_mm = gaussian_filter(eroded_mm, (steps, ROUND_RAYS), mode=("nearest", "wrap"))
    rho_mm = np.where(limit_mm < wall_mm + BLUR_MM, np.minimum(smooth_mm, rho_mm), rho_mm)
    surface = Surface((centers_mm[:, None] + rho_mm[..., None] * rays).reshape(-1, 3), tube_faces(*rho_mm.shape))
    is_wall = (rho_mm > wall_mm - SPARE_MM).ravel()
    last = len(path.landing_surface.faces) - 1
    is_restored = is_wall & path.is_restored_face[np.minimum(face, last)]
    own = is_wall & path.is_patient_face[np.minimum(face, last)]
    narrowed = replace(
        path,
        axis=Centerline(centers_mm, surface.closest(centers_mm)[1]),
        section_radius_mm=np.sqrt((rho_mm**2).mean(axis=1)),
        landing_surface=surface,
        is_restored=is_restored,
    )
    derived = replace(anatomy, paths=(narrowed, *anatomy.paths[1:]))
    nested_to_mm = min([nested_to_mm, *at_mm])
    return Way(
        derived, *landing_wall(derived, same, np.asarray(own[surface.faces].all(axis=1))), plain_mm, nested_to_mm
    )


def _limit_mm(
    abscissa_mm: Floats,
    origins_mm: Floats,
    rays: Floats,
    others: Sequence[Stent],
    waists: Sequence[tuple[tuple[Stent, Passage], float]],
) -> Floats:
    """Return the length (n, rays) of rays up to the faces of other stents, and within cones about their cells.

    `waists` are the stents that are passed, their cells and the arc lengths of these, in mm, on the axis.
    """
    limit_mm = np.full(rays.shape[:2], np.inf)
    if others:
        rows_mm = [face_mm for stent in others for face_mm in _faces_mm(stent)]
        faces = joined([Surface(one.reshape(-1, 3), tube_faces(*one.shape[:2])) for one in rows_mm])
        limit_mm = faces.first_hit(origins_mm, rays.reshape(-1, 3)).reshape(rays.shape[:2]) - SPARE_MM
    for (stent, cell), here_mm in waists:
        from_mm, waist_mm = np.abs(abscissa_mm - here_mm)[:, None], cell.radius_mm - SPARE_MM
        inner_mm, outer_mm = _faces_mm(stent)
        depth_mm = float(curves.lengths(outer_mm - inner_mm).max())
        sunk_mm = waist_mm**2 / stent.row_diameter_mm.mean() + depth_mm  # of a round wall below its tangent plane
        limit_mm = np.where(from_mm < sunk_mm, np.maximum(limit_mm, waist_mm), limit_mm)
        limit_mm = np.minimum(limit_mm, waist_mm + OPENING * np.maximum(from_mm - depth_mm, 0.0))
    return limit_mm


def pushed_mm(stent: Stent) -> float:
    """Return the width of a cell that is pushed open as far as its struts allow, in mm.

    They turn and keep their length: of all polygons with these sides the regular one holds the largest circle. A whole
    cell has four of them; one that is open to a neighbor, because a crown between them is free, has eight.
    """
    sides = 4 if stent.design.joined_fraction == 1 else 8
    half_mm = float(stent.pieces_mm[2].max())
    return piece_length_mm(stent.design, stent.size) / float(np.tan(np.pi / sides)) - 2 * half_mm


def _check(stent: Stent, cell: Passage) -> None:
    """Raise a LandingError where no stent can pass a cell."""
    if isinstance(stent.design, Braid):
        raise LandingError(
            f"A stent cannot pass through the wall of {stent.design.name}, a braid whose pores are "
            f"{2 * cell.radius_mm:.2f} mm wide. Begin it at the fork (@ fork), place both side by side (|), choose a "
            "laser-cut stent before it, or insist with & in place of +: both are then deployed as if alone."
        )
    if 2 * cell.radius_mm < CATHETER_MM:
        raise LandingError(
            f"The cell of {stent.design.name} through which the stent would pass is {2 * cell.radius_mm:.2f} mm wide, "
            f"and a microcatheter {CATHETER_MM:g} mm. Its struts could turn until it is {pushed_mm(stent):.1f} mm, but "
            "that is not modelled: move the first stent along the artery, or begin the second at the fork (@ fork)."
        )


def _through(centers_mm: Floats, cell: Passage) -> Floats:
    """Return an axis (n, 3) led through the middle of a cell, at a right angle to it."""
    here = int(np.linalg.norm(centers_mm - cell.center_mm, axis=1).argmin())
    from_mm = curves.arc_length(centers_mm)
    from_mm = from_mm - from_mm[here]

    def bump(length_mm: float) -> Floats:
        near = np.clip(np.abs(from_mm) / length_mm, 0.0, 1.0)
        return (0.5 + 0.5 * np.cos(np.pi * near))[:, None]

    turned = cell.outward - curves.tangents(centers_mm)[here]
    moved_mm = centers_mm + bump(BENT_MM) * (cell.center_mm - centers_mm[here])
    return np.asarray(moved_mm + from_mm[:, None] * bump(STRAIGHT_MM) * turned)


def _faces_mm(stent: Stent) -> tuple[Floats, Floats]:
    """Return the inner and the outer face (rows, columns, 3) of a stent."""
    outer_mm = stent.nodes_mm + stent.design.wall_offset_um * MM_PER_UM * normals(stent.nodes_mm)
    return inner_nodes_mm(stent), outer_mm


def _aside(axis_mm: Floats, path: Path, other: Path) -> Floats:
    """Return an axis (n, 3) moved to its side of the part that its path shares with another one.

    A LandingError says that the paths do not part.
    """
    foot_mm, away_mm = curves.project(other.axis.points_mm, axis_mm)
    is_parted = away_mm > PARTED_MM
    if not is_parted.any() or is_parted[0]:
        raise LandingError(f"Paths {path.name} and {other.name} do not run side by side to a fork: choose others.")
    parted = int(is_parted.argmax())
    radius_mm = np.interp(
        np.linspace(0.0, path.axis.length_mm, len(axis_mm)), path.axis.abscissa_mm, path.section_radius_mm
    )
    centroid_mm = HALF_CENTER * radius_mm
    shared = int(np.flatnonzero(away_mm[:parted] < centroid_mm[:parted])[-1])
    across = curves.parallel_frames(axis_mm)[:, 1:]
    toward = across[shared] @ (other.axis.at(foot_mm[parted : parted + 1])[0] - axis_mm[parted])
    toward = toward / np.linalg.norm(toward)
    shift_mm = gaussian_filter(np.maximum(centroid_mm - 0.5 * away_mm, 0.0), 0.5 / STEP_MM, mode="nearest")
    return np.asarray(axis_mm - shift_mm[:, None] * (toward @ across))


def _share_mm(centers_mm: Floats, rays: Floats, path: Path, other: Path) -> Floats:
    """Return the length (n, rays) of rays from an axis (n, 3) up to the middle between it and that of another path."""
    beside_mm = _aside(curves.resample(other.axis.points_mm, STEP_MM), other, path)
    foot_mm = curves.project(beside_mm, centers_mm)[0]
    toward_mm = curves.interpolate(curves.arc_length(beside_mm), beside_mm, foot_mm) - centers_mm
    apart_mm = curves.lengths(toward_mm)
    cosine = np.einsum("nrk,nk->nr", rays, toward_mm / apart_mm[:, None])
    return np.where(cosine > 0, (0.5 * apart_mm - SPARE_MM)[:, None] / np.maximum(cosine, 1e-9), np.inf)


def beyond_mm(path: Path, stents: Sequence[Stent]) -> float:
    """Return the arc length on a path, in mm, beyond which its sections are clear of stents of other paths."""
    centers_mm = path.axis.points_mm
    rings_mm = path.landing_surface.vertices_mm.reshape(len(centers_mm), -1, 3)
    starts_mm = np.broadcast_to(centers_mm[:, None], rings_mm.shape).reshape(-1, 3)
    crosses = [stent.contour.crosses(starts_mm, rings_mm.reshape(-1, 3)) for stent in stents if stent.path != path.name]
    if not crosses or not np.any(crosses):
        raise LandingError(
            "A device that begins at the fork (@ fork) needs a stent before it that passes the fork on another path."
        )
    is_crossed = np.any(crosses, axis=0).reshape(rings_mm.shape[:2]).any(axis=1)
    return float(path.axis.abscissa_mm[np.flatnonzero(is_crossed)[-1]]) + 2 * BLUR_MM
