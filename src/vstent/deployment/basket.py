"""Deploy a basket in a sac: a closed braid of constant wire length between the neck, the wall and the dome.

The basket lies on the path of the sac, from the middle of the neck through the middles of its sections to the dome. It
is as wide as the free device or as the wall allows, row by row and around the axis. Its wires keep their length, so
that a narrower basket is taller: one factor on its height is found for which as many rows of crossings fit along the
mean section as in the free device (`vstent.devices.formulas.rows_along`). Then the crossings move inside the wall until
the pieces of wire have their length.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter, minimum_filter
from scipy.optimize import brentq

from vstent.anatomy.morphology import ON_NECK_MM, Measures
from vstent.deployment import wires
from vstent.deployment.contour import circles, evenly_spaced, normals, perimeters
from vstent.deployment.coverage import coverage_fractions, pore_areas_mm2, pore_places, quad_areas_mm2, quad_middles_mm
from vstent.deployment.wall import APPOSED_GAP_MM, LOOSE_FRACTION
from vstent.devices.design import Basket, Size, piece_length_mm
from vstent.devices.formulas import grid, meridian_mm, rows_along
from vstent.devices.stent import Deployment, Landing, Stent
from vstent.errors import LandingError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

WIDER_MM: Final = 1.0
"""Width of the proposed size above the sac's, and height below it, in mm: the rule of one up, one down."""
OUT_MM: Final = 0.5
"""Length, in mm, by which the end of the proposed size may lie below the middle of the neck."""
BODY_FRACTION: Final = 0.9
"""Fraction of the largest radius above which a row belongs to the body of the basket, whose gaps are measured."""
TOLD_MM: Final = 0.5
"""Smallest length, in mm, by which a basket stands out and that is reported."""
NEAR_MM: Final = 0.3
"""Distance, in mm, within which a node outside the wall is put back."""
FACTORS: Final = (0.3, 3.0)
"""Smallest and largest height of a deployed basket, in heights of the free one."""
CUP_FACTORS: Final = (0.01, 1.0)
"""Smallest and largest height of the rim of a cup, in diameters of the flat disk."""
CUP_POWER: Final = 3.0
"""Power of the free radius with which a cup rises from its marker; an estimate: flat on the neck, steep at the rim."""
CUP_WIDER: Final = 1.25
"""Diameter of the proposed cup over the mean width of the sac; an estimate after sizes in use, 1.2 to 1.4."""
LAYERS: Final = 2.5
"""Distance between the two layers of a cup, in distances of the contour from the wall."""
TALL: Final = 1.25
"""Height of a sac over its width from which width and height are swapped in the rule, without unit; an estimate.

With the swap, 20 of 20 devices in tall sacs were adequate, without it none or one of 5 (AJNR 2024, 45:731).
"""
CENTERINGS, CENTER_SIGMA = 3, 0.1
"""Number of times that the axis is moved to the middles of the sections, and width of their mean, in heights."""
OPENED, SMOOTHED = (9, 15), (2.0, 3.0)
"""Sections and columns within which wires bridge a recess of the wall, and over which the reach is averaged."""
RELAXATIONS, RELAXED_SHARE, INSIDE_EVERY = 200, 0.2, 10
"""Number of rounds in which crossings move, share of the error of a piece by which each does, and rounds between those
in which the wall puts them back."""
SECTORS: Final = 72
"""Number of sectors around the axis in which the outline is measured."""
RIM_MM: Final = 0.01
"""Height of the lowest section above the lowest point of the wall, in mm: rays through the rim meet it or not."""
STATIONS: Final = 120
"""Number of sections of the sac that are measured along its axis."""


@dataclass(frozen=True, eq=False)
class Room:
    """The room of a sac around its path."""

    origin_mm: Floats
    """(3,) middle of the neck."""
    frame: Floats
    """(3, 3) unit vectors in rows: from there to the middle of the sac, and two across that direction."""
    heights_mm: Floats
    """(k,) heights of the sections above the middle of the neck, in mm, from the lowest wall to the dome."""
    centers_mm: Floats
    """(k, 2) middles of the sections, across that direction, in mm: the axis of the path."""
    reach_mm: Floats
    """(k, columns) distance of the wall from the axis, in mm; that of the neck's rim where there is no wall."""
    wall: Surface
    """Wall of the sac, without the neck."""
    neck_width_mm: float
    """Largest width of the neck, in mm."""

    @property
    def height_mm(self) -> float:
        """Height of the dome above the middle of the neck along the axis, in mm."""
        return float(self.heights_mm[-1])

    @property
    def width_mm(self) -> float:
        """Mean over all directions of the widest section, in mm."""
        return 2 * float(self.reach_mm.mean(axis=1).max())

    def polar(self, points_mm: Floats) -> tuple[Floats, Floats, Floats]:
        """Return height along the axis, distance from it, both in mm, and angle about it in rad of points (n, 3)."""
        along, first, second = ((points_mm - self.origin_mm) @ self.frame.T).T
        return along, np.hypot(first, second), np.arctan2(second, first)

    def place(self, heights_mm: Floats, in_plane_mm: Floats) -> Floats:
        """Return points (n, columns, 3) at heights (n,) and in-plane coordinates (n, columns, 2), in mm."""
        centers_mm = curves.interpolate(self.heights_mm, self.centers_mm, heights_mm)[:, None]
        along_mm = heights_mm[:, None, None] * self.frame[0]
        return self.origin_mm + along_mm + (centers_mm + in_plane_mm) @ self.frame[1:]


@lru_cache(maxsize=8)
def room_of(aneurysm: Aneurysm, columns: int) -> Room:
    """Measure the room of a sac on rays across its path, as many as there are columns."""
    plane, sac = aneurysm.plane or aneurysm.mean_plane, aneurysm.sac
    corners_mm = sac.corners_mm
    volumes = np.einsum("ij,ij->i", corners_mm[:, 0], np.cross(corners_mm[:, 1], corners_mm[:, 2]))
    middle_mm = np.asarray((volumes[:, None] * corners_mm.sum(axis=1)).sum(axis=0) / (4 * volumes.sum()))
    origin_mm = plane.center_mm
    axis = (middle_mm - origin_mm) / np.linalg.norm(middle_mm - origin_mm)
    first = curves.any_perpendicular(axis)
    is_wall = aneurysm.neck.closest(corners_mm.mean(axis=1))[1] > ON_NECK_MM
    wall = Surface(*triangles.compact(sac.vertices_mm, sac.faces[is_wall]))
    height_mm = float((middle_mm - origin_mm) @ axis) + float(wall.first_hit(middle_mm[None], axis[None])[0])
    low_mm = ((wall.vertices_mm - origin_mm) @ axis).min()  # below the middle where the neck is a saddle
    room = Room(
        origin_mm,
        np.stack([axis, first, np.cross(axis, first)]),
        np.linspace(min(0.0, float(low_mm)) + RIM_MM, height_mm, STATIONS),
        np.zeros((STATIONS, 2)),
        np.zeros((STATIONS, columns)),
        wall,
        float(np.ptp(plane.rim_mm @ _across(axis, first).T, axis=0).max()),
    )
    ring = circles(np.ones(STATIONS), columns)
    for _ in range(CENTERINGS):
        to_wall_mm = _reach_mm(room, ring)[..., None] * ring
        flat_mm = np.pad(to_wall_mm, ((0, 0), (0, 0), (0, 1)))
        off_mm = np.array([triangles.polygon_centroid(one)[:2] for one in flat_mm[:-1]])
        middle_mm = room.centers_mm + np.concatenate([off_mm, off_mm[-1:]])
        room = replace(room, centers_mm=gaussian_filter1d(middle_mm, CENTER_SIGMA * STATIONS, axis=0, mode="nearest"))
    reach_mm = _reach_mm(room, ring)
    smooth = minimum_filter(reach_mm, OPENED, mode=("nearest", "wrap"))
    smooth = maximum_filter(smooth, OPENED, mode=("nearest", "wrap"))
    smooth = np.asarray(gaussian_filter(smooth, SMOOTHED, mode=("nearest", "wrap")), dtype=np.float64)
    return replace(room, reach_mm=np.minimum(smooth, reach_mm))


def _reach_mm(room: Room, ring: Floats) -> Floats:
    """Return the distance (k, columns) of the wall from the axis on rays along unit vectors (k, columns, 2), in mm."""
    centers_mm = room.place(room.heights_mm, np.zeros_like(ring)).reshape(-1, 3)
    reach_mm = room.wall.first_hit(centers_mm, (ring @ room.frame[1:]).reshape(-1, 3)).reshape(ring.shape[:2])
    reach_mm[-1] = 0.0
    for row in range(len(ring) - 2, -1, -1):  # below the rim of the neck a ray meets no wall
        reach_mm[row] = np.where(np.isfinite(reach_mm[row]), reach_mm[row], reach_mm[row + 1])
    return reach_mm


def _across(axis: Floats, first: Floats) -> Floats:
    """Return unit vectors (n, 3) across an axis."""
    angle = np.pi * np.arange(90) / 90
    return np.outer(np.cos(angle), first) + np.outer(np.sin(angle), np.cross(axis, first))


def propose_basket(basket: Basket, anatomy: Anatomy) -> Size:
    """Propose a size by the rule in use: one mm wider than the mean of the sac's widths, one lower than its height.

    In a tall sac, width and height are swapped in this rule where that fits: the sac makes the wide, low device tall.
    A lower one is proposed where it would stand out far into the artery. Of cups, the smallest is proposed that is
    wider than the sac by a factor. A LandingError says that there is no sac, or that its neck is wider than any size.
    """
    room = room_of(_sac(anatomy, basket), basket.n_columns)
    fitting = [size for size in basket.sizes if size.diameter_mm > room.neck_width_mm]
    if not fitting:
        raise LandingError(_too_wide(basket, room, max(size.diameter_mm for size in basket.sizes)))
    if basket.is_cup:
        wide = [size for size in fitting if size.diameter_mm >= CUP_WIDER * room.width_mm]
        return min(wide or [max(fitting, key=lambda size: size.diameter_mm)], key=lambda size: size.diameter_mm)
    if room.height_mm > TALL * room.width_mm:
        swapped = _nearest(fitting, room.height_mm + WIDER_MM, room.width_mm - WIDER_MM)[-1]
        with suppress(LandingError):
            if _lies(basket, room, swapped, 0.0)[0][0] >= -OUT_MM:
                return swapped
    same = _nearest(fitting, room.width_mm + WIDER_MM, room.height_mm - WIDER_MM)
    while len(same) > 1 and _lies(basket, room, same[-1], 0.0)[0][0] < -OUT_MM:
        same.pop()
    return same[-1]


def _nearest(sizes: Sequence[Size], width_mm: float, height_mm: float) -> list[Size]:
    """Return the sizes of the width nearest to a wanted one, by height, up to the height nearest to a wanted one."""
    nearest_mm = min({size.diameter_mm for size in sizes}, key=lambda one: abs(one - width_mm))
    same = sorted((size for size in sizes if size.diameter_mm == nearest_mm), key=lambda size: size.length_mm)
    best = min(range(len(same)), key=lambda k: abs(same[k].length_mm - height_mm))
    return same[: best + 1]


def deploy_basket(basket: Basket, anatomy: Anatomy, size: Size | None, landing: Landing) -> Deployment:
    """Deploy a basket in the largest sac, its proximal end at a height above the middle of the neck.

    It is lower where the sac is not high enough. A LandingError says that there is no sac, or that it does not fit.
    """
    if landing.anchor != "proximal":
        raise LandingError(f"{basket.name} is placed by its proximal end: give a shift from the neck instead.")
    began = time.perf_counter()
    aneurysm, size = _sac(anatomy, basket), size or propose_basket(basket, anatomy)
    room, offset_mm = room_of(aneurysm, basket.n_columns), basket.wall_offset_um * MM_PER_UM
    if size.diameter_mm <= room.neck_width_mm:
        raise LandingError(_too_wide(basket, room, size.diameter_mm))
    if not -room.height_mm < landing.abscissa_mm < room.height_mm:
        raise LandingError(
            f"A shift of {landing.abscissa_mm:g} mm puts {basket.name} outside the sac, which is {room.height_mm:.1f} "
            "mm high. Give a smaller one."
        )
    heights_mm, in_plane_mm, count = _lies(basket, room, size, landing.abscissa_mm)
    rows = grid(basket, size).rows
    wanted = np.linspace(0.0, count[-1], rows // 2 + 1 if basket.is_cup else rows)
    flat_mm = curves.interpolate(count, in_plane_mm.reshape(len(count), -1), wanted).reshape(len(wanted), -1, 2)
    row_mm = np.interp(wanted, count, heights_mm)
    nodes_mm = room.place(row_mm, evenly_spaced(flat_mm))
    nodes_mm = _relaxed(nodes_mm, piece_length_mm(basket, size), room.wall, offset_mm)
    if basket.is_cup:
        inner_mm = nodes_mm - LAYERS * offset_mm * normals(nodes_mm)
        nodes_mm, row_mm = np.concatenate([nodes_mm, inner_mm[-2::-1]]), np.concatenate([row_mm, row_mm[-2::-1]])
    drawn = wires.draw(basket, size, nodes_mm, None)
    stent = Stent(basket, size, nodes_mm, row_mm, *drawn)
    gap_mm = np.maximum(room.wall.closest(nodes_mm.reshape(-1, 3))[1] - offset_mm, 0.0).reshape(nodes_mm.shape[:2])
    return Deployment(
        stent=stent,
        outcome="terminated",
        advice=_advise(anatomy, stent, gap_mm, landing.abscissa_mm),
        terminated_fraction=np.ones(1),
        seconds=time.perf_counter() - began,
        wall_gap_mm=gap_mm,
        history_mm=np.stack([nodes_mm, nodes_mm]),
        energy_mm2=np.zeros(2),
    )


def _lies(basket: Basket, room: Room, size: Size, lowest_mm: float) -> tuple[Floats, Floats, Floats]:
    """Return heights (m,), in-plane coordinates (m, columns, 2) and rows of crossings (m,) along the section in a sac.

    The lower end lies at a height above the middle of the neck, or lower where the sac is not high enough. Of a cup it
    is one layer, from the marker to the rim.
    """
    offset_mm = basket.wall_offset_um * MM_PER_UM
    free_heights_mm, free_radius_mm = meridian_mm(basket, size)
    rows = float(rows_along(basket, size, free_heights_mm, free_radius_mm)[-1])

    if basket.is_cup:
        rows, shape = rows / 2, np.linspace(0.0, 1.0, len(free_radius_mm))
        free_radius_mm = basket.marker_radius_mm + shape * (free_radius_mm.max() - basket.marker_radius_mm)
        free_heights_mm = size.diameter_mm * shape**CUP_POWER

    def section(factor: float) -> tuple[Floats, Floats, Floats]:
        heights_mm = factor * free_heights_mm
        heights_mm = heights_mm + min(lowest_mm, room.height_mm - offset_mm - heights_mm[-1])
        reach_mm = curves.interpolate(room.heights_mm, room.reach_mm, heights_mm) - offset_mm
        radius_mm = np.maximum(np.minimum(free_radius_mm[:, None], reach_mm), basket.marker_radius_mm)
        in_plane_mm = radius_mm[..., None] * circles(np.ones(len(heights_mm)), basket.n_columns)
        return heights_mm, in_plane_mm, rows_along(basket, size, heights_mm, perimeters(in_plane_mm) / (2 * np.pi))

    low, high = CUP_FACTORS if basket.is_cup else FACTORS
    if basket.is_cup and section(low)[2][-1] >= rows:
        return section(low)
    if not section(low)[2][-1] < rows < section(high)[2][-1]:
        raise LandingError(f"{basket.name} {size.label} does not fit this sac. Choose another size.")
    factor = brentq(lambda one: section(one)[2][-1] - rows, low, high, xtol=1e-5)
    return section(factor)


def measure_basket(anatomy: Anatomy, deployment: Deployment) -> Measures:
    """Measure a basket: compression, what stands out into the artery, gaps to the wall, and wires over the neck."""
    stent, plane = deployment.stent, anatomy.aneurysms[0].plane or anatomy.aneurysms[0].mean_plane
    starts_mm, ends_mm, half_mm = stent.pieces_mm
    is_beyond = (0.5 * (starts_mm + ends_mm) - plane.center_mm) @ plane.normal < 0
    metal_mm2 = 2 * half_mm[is_beyond] @ curves.lengths(ends_mm - starts_mm)[is_beyond]
    named: Measures = {"device": stent.design.name, "size": stent.size.label, "metal_in_artery_mm2": float(metal_mm2)}
    return named | _shape(anatomy, stent, deployment.wall_gap_mm) | _over_neck(anatomy, stent)


def _shape(anatomy: Anatomy, stent: Stent, gap_mm: Floats) -> dict[str, float]:
    """Return sizes, compression, protrusion and gaps."""
    size, aneurysm = stent.size, anatomy.aneurysms[0]
    room, points_mm = room_of(aneurysm, stent.nodes_mm.shape[1]), stent.nodes_mm.reshape(-1, 3)
    around_mm = np.roll(stent.nodes_mm, -1, axis=1) - stent.nodes_mm
    area_mm2 = (0.5 * np.cross(stent.nodes_mm - room.origin_mm, around_mm) @ room.frame[0]).sum(axis=1)
    mean_mm = 2 * np.sqrt(area_mm2 / np.pi)
    height_mm = float(np.ptp(stent.row_abscissa_mm))
    is_body = mean_mm >= BODY_FRACTION * mean_mm.max()
    middles_mm = np.repeat(stent.nodes_mm.mean(axis=1), stent.nodes_mm.shape[1], axis=0)
    beyond_mm = np.where(room.wall.crosses(middles_mm, points_mm), room.wall.closest(points_mm)[1], 0.0)
    outside_mm = np.where(beyond_mm > 0, 0.0, aneurysm.sac.signed_distance(points_mm))
    filled = {
        "height_gain_fraction": height_mm / size.length_mm - 1,
        "volume_ratio_fraction": float(np.trapezoid(area_mm2, stent.row_abscissa_mm)) / abs(aneurysm.sac.volume_mm3),
    }
    is_cup = isinstance(stent.design, Basket) and stent.design.is_cup
    return ({} if is_cup else filled) | {
        "label_diameter_mm": size.diameter_mm,
        "label_length_mm": size.length_mm,
        "basket_width_mm": float(mean_mm.max()),
        "basket_height_mm": height_mm,
        "width_compression_fraction": 1 - float(mean_mm.max()) / size.free_diameter_mm,
        "sac_width_mm": room.width_mm,
        "sac_axis_height_mm": room.height_mm,
        "protrusion_mm": float(outside_mm.max(initial=0.0)),
        "max_outside_mm": float(beyond_mm.max()),
        "apposed_fraction": float((gap_mm[is_body] < APPOSED_GAP_MM).mean()),
        "mean_wall_gap_mm": float(gap_mm[is_body].mean()),
        "max_wall_gap_mm": float(gap_mm[is_body].max()),
    }


def _over_neck(anatomy: Anatomy, stent: Stent) -> dict[str, float]:
    """Return what of the neck the basket leaves open, seen along its axis, and its wires over the neck."""
    aneurysm, columns = anatomy.aneurysms[0], stent.nodes_mm.shape[1]
    room = room_of(aneurysm, columns)
    _, from_axis_mm, at = room.polar(stent.nodes_mm.reshape(-1, 3))
    turn = 2 * np.pi * np.arange(SECTORS) / SECTORS - np.pi
    outline_mm = np.zeros(SECTORS)
    np.maximum.at(outline_mm, np.rint((at + np.pi) * SECTORS / (2 * np.pi)).astype(int) % SECTORS, from_axis_mm)

    neck = aneurysm.neck
    _, radius_mm, angle = room.polar(neck.corners_mm.mean(axis=1))
    area_mm2 = neck.areas_mm2 * np.abs(neck.normals @ room.frame[0])
    is_open = radius_mm > np.interp(angle, turn, outline_mm, period=2 * np.pi)
    gap_mm = float(stent.contour.closest(aneurysm.neck_mm)[1].max()) - stent.design.wall_offset_um * MM_PER_UM
    covered, quads_mm2 = coverage_fractions(stent), quad_areas_mm2(stent)
    found = {
        "neck_uncovered_fraction": float(area_mm2[is_open].sum() / area_mm2.sum()),
        "max_neck_gap_mm": max(0.0, gap_mm),
        "metal_coverage_fraction": float(np.average(covered, weights=quads_mm2)),
    }
    widest, (_, rim_mm, rim_angle) = perimeters(stent.nodes_mm).argmax(), room.polar(aneurysm.neck_mm)
    order = np.argsort(rim_angle)

    def is_over(points_mm: Floats, row: Ints) -> Bools:
        """Return whether points (n, 3), on rows (n,), are on the base and above the neck."""
        _, at_mm, at = room.polar(points_mm)
        return np.asarray((at_mm < np.interp(at, rim_angle[order], rim_mm[order], period=2 * np.pi)) & (row < widest))

    row = np.repeat(np.arange(len(covered)), columns)
    on_neck = is_over(quad_middles_mm(stent.nodes_mm).reshape(-1, 3), row)
    if on_neck.any() and isinstance(stent.design, Basket):
        marker_mm2 = np.pi * stent.design.marker_radius_mm**2
        metal_mm2 = float((covered * quads_mm2).ravel()[on_neck].sum()) + marker_mm2
        found["neck_metal_coverage_fraction"] = metal_mm2 / (float(quads_mm2.ravel()[on_neck].sum()) + marker_mm2)
    pore_mm2, pores_mm, _ = pore_areas_mm2(stent)
    on_neck = is_over(pores_mm, pore_places(stent)[0])
    if on_neck.any():
        found["neck_pore_density_per_mm2"] = float(on_neck.sum() / pore_mm2[on_neck].sum())
    return found


def _relaxed(nodes_mm: Floats, piece_mm: float, wall: Surface, offset_mm: float) -> Floats:
    """Return nodes (rows, columns, 3) moved inside a wall until the pieces of wire have their length.

    In every round, each piece moves the crossings at its ends toward its length. Where the wall is round, the pieces
    have it from the start. The ends of the basket stay.
    """
    rows, columns = nodes_mm.shape[:2]
    is_crossing = (np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0)[..., None]
    nodes_mm = nodes_mm.copy()
    for done in range(RELAXATIONS):
        move_mm = np.zeros_like(nodes_mm)
        for hand in (1, -1):
            along_mm = np.roll(nodes_mm, -hand, axis=1)[1:] - nodes_mm[:-1]
            shorter_mm = (1 - piece_mm / curves.lengths(along_mm))[..., None] * along_mm * is_crossing[:-1]
            move_mm[:-1] += shorter_mm
            move_mm[1:] -= np.roll(shorter_mm, hand, axis=1)
        move_mm[[0, -1]] = 0.0
        nodes_mm += RELAXED_SHARE * move_mm
        if done % INSIDE_EVERY == INSIDE_EVERY - 1:
            nodes_mm = _inside(wall, nodes_mm, offset_mm)
    beside_mm = np.roll(nodes_mm, 1, axis=1) + np.roll(nodes_mm, -1, axis=1)
    middle_mm = 0.5 * beside_mm
    middle_mm[1:-1] = 0.25 * (beside_mm[1:-1] + nodes_mm[2:] + nodes_mm[:-2])
    return _inside(wall, np.where(is_crossing, nodes_mm, middle_mm), offset_mm)


def _inside(wall: Surface, nodes_mm: Floats, offset_mm: float) -> Floats:
    """Return nodes (rows, columns, 3) that keep a distance from the wall of a sac."""
    points_mm = nodes_mm.reshape(-1, 3)
    closest_mm, distance_mm, face = wall.closest(points_mm)
    height_mm = np.einsum("ij,ij->i", closest_mm - points_mm, wall.normals[face])
    aside_mm2 = distance_mm**2 - height_mm**2  # of points beyond the rim of the neck
    is_near = (height_mm < offset_mm) & (distance_mm < NEAR_MM) & (aside_mm2 < offset_mm**2)
    moved_mm = closest_mm - offset_mm * wall.normals[face]
    return np.where(is_near[:, None], moved_mm, points_mm).reshape(nodes_mm.shape)


def _sac(anatomy: Anatomy, basket: Basket) -> Aneurysm:
    """Return the largest sac; a LandingError says that there is none."""
    if not anatomy.aneurysms:
        raise LandingError(f"This artery has no sac, and {basket.name} lies in one. Choose a device for arteries.")
    return anatomy.aneurysms[0]


def _too_wide(basket: Basket, room: Room, widest_mm: float) -> str:
    """Return why a neck is too wide for a basket."""
    return (
        f"The neck is up to {room.neck_width_mm:.1f} mm wide, and {basket.name} {widest_mm:g} mm: the basket would not "
        "stay in the sac. Choose a wider basket or another treatment."
    )


def _advise(anatomy: Anatomy, stent: Stent, gap_mm: Floats, wanted_mm: float) -> str:
    """Describe how a basket lies, wanted at a height above the neck, and what to do if it does not fit."""
    found = _shape(anatomy, stent, gap_mm) | _over_neck(anatomy, stent)
    lies = (
        f"{stent.design.name} {stent.size.label} is {found['basket_width_mm']:.1f} mm wide and "
        f"{found['basket_height_mm']:.1f} mm high in a sac of {found['sac_width_mm']:.1f} x "
        f"{found['sac_axis_height_mm']:.1f} mm"
    )
    if wanted_mm - stent.proximal_abscissa_mm > TOLD_MM and wanted_mm > 0:
        lies += (
            f", {wanted_mm - stent.proximal_abscissa_mm:.1f} mm lower than asked for, because the dome is in the way"
        )
    if found["protrusion_mm"] > TOLD_MM:
        lower = [one for one in stent.design.sizes if one.diameter_mm == stent.size.diameter_mm]
        has_lower = any(one.length_mm < stent.size.length_mm for one in lower)
        remedy = " (choose a lower size)" if has_lower else ""
        lies += f", stands out {found['protrusion_mm']:.1f} mm into the artery{remedy}"
    if found["neck_uncovered_fraction"] > 0:
        lies += f", and leaves {found['neck_uncovered_fraction']:.0%} of the neck open (choose a wider size)"
    loose = 1 - found["apposed_fraction"]
    if loose <= LOOSE_FRACTION:
        return f"{lies}; {1 - loose:.0%} of its body is apposed."
    return f"{lies}; {loose:.0%} of its body is not apposed, with gaps up to {found['max_wall_gap_mm']:.2f} mm."
