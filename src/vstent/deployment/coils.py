"""Fill a sac with coils: elastic rods with the curl of their free loops, pushed in through a catheter at the neck.

Coil after coil enters, the framing coil first, until the packing density is reached (`vstent.kernels.rods`). The rods
touch each other, the wall and the neck without friction; older ones move in fewer steps, as if held by it. At the end
all move until bending and contact are in balance. Blood is not there yet, and neither gravity nor the catheter's own
width matters.

The neck is closed for coils: by a stent, whose wires they do not cross, or else as by a balloon in the artery.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from vstent.anatomy.morphology import Measures
from vstent.deployment.method import Progress
from vstent.devices.catalogue import find_design
from vstent.devices.design import Basket, Coil, Size
from vstent.devices.stent import Coils, Deployment, Stent
from vstent.errors import LandingError
from vstent.geometry.vessel import Anatomy, Aneurysm
from vstent.kernels import curves, rods
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM, counted

DENSITY_FRACTION: Final = 0.25
"""Packing density unless another one is given: sacs packed to 24 % and more did not compact (PMC7977130)."""
DENSEST_FRACTION: Final = 0.4
"""Largest packing density that may be asked for: about what is reached with a stent (40 +- 7 %, PMC3653595)."""
GRID_MM, MOST_POINTS = 0.1, 600_000
"""Smallest spacing of the grid on which the distance to the wall is sampled, in mm, and number of its points."""
ROUNDED: Final = 0.2
"""What interpolation takes off thin struts in the distance from a stent, in spacings of that grid."""
FRAMING_SHARE, FRAMING_TURN = 0.4, (np.pi / 3, 2 * np.pi / 3)
"""Largest share of the length that the framing coil is, and range of the angle by which its loops turn."""
SMALLER, SMALLEST = 0.8, 0.3
"""Largest ratio of the loops of a coil to those of the coil before, and smallest to those of the framing coil."""
TOUCHING: Final = 1.04
"""Distance between axes at which coils touch, in wound diameters: more than 1, because contacts give way a little."""
STRETCH, TWIST, SHARPEST, CONTACT = 3e4, 1.2, 1.5, 20.0
"""Stiffness of stretch (times a segment) and of twist (that of round springs), both over that of bending; smallest
radius of bends, in wound diameters, from which a coil is stiffer; and stiffness of contact, per mm3."""
DRAG, STEPS = 0.3, 8
"""Drag of a node, in bending stiffness per mm3 and step, and number of steps in which a coil enters by a segment."""
SETTLING: Final = ((0.1, 300), (1.0, 300), (10.0, 200), (100.0, 200))
"""Drag and steps of one round of the search for balance; less drag moves loops, more lets contacts settle."""
ROUNDS, BALANCED = 12, 0.05
"""Largest number of such rounds, and what may remain of the contact forces."""
TRIES, ENOUGH, LEAST_NODES, KINKED = 5, 0.6, 12, 1.1
"""Attempts to push in a coil, each from another place; part of it that is enough, so that a shorter coil is taken;
number of nodes below which none entered; and bending radius, in wound diameters, below which it is kinked."""
TIP_CLEARANCE: Final = 1.3
"""Distance of the tip of the catheter from the coils that is looked for, in wound diameters."""
ZONE: Final = 2.0
"""Thickness of the zones at the neck and at the wall whose density is measured, in wound diameters."""


class Room(NamedTuple):
    """Where coils may lie: distance to its border on a grid, negative inside."""

    distance_mm: Floats
    """(i, j, k) values at the points of the grid."""
    low_mm: Floats
    """(3,) first point."""
    spacing_mm: float
    """Distance between points."""

    def points_mm(self, mask: Bools) -> Floats:
        """Return the points (n, 3) of the grid in a mask."""
        return self.low_mm + np.argwhere(mask) * self.spacing_mm


def deploy_coils(
    coil: Coil | str,
    anatomy: Anatomy,
    filling: float | Sequence[Size] | None = None,
    *,
    inside: Sequence[Stent] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> Deployment:
    """Fill the largest sac with coils of one line.

    Parameters
    ----------
    coil : Coil or str
        The line of coils, or its key or name in the catalogue.
    anatomy : Anatomy
        The restored artery.
    filling : float or sequence of Size, optional
        Packing density, volume of the coils over that of the sac, or the sizes of all coils in their order; None is
        a density of 0.25.
    inside : sequence of Stent, optional
        Devices that are already in the artery; the coils stay outside them.
    seed : int, optional
        Number from which the places of the catheter and the turns of the framing coil are drawn.
    progress : callable, optional
        Called after every coil with their number and the fraction of the length that has entered.

    Returns
    -------
    Deployment
        The coils; `Deployment.stent` is a `Coils`. Its outcome is ``iteration_limit`` where the density was not
        reached, or forces are not in balance.

    Raises
    ------
    LandingError
        There is no sac, or the density cannot be reached by any coils.
    """
    began, line = time.perf_counter(), find_design(coil) if isinstance(coil, str) else coil
    if not isinstance(line, Coil):
        raise LandingError(f"{line.name} is no line of coils. Choose one, such as coils.")
    if any(isinstance(stent.design, Basket | Coil) for stent in inside):
        raise LandingError(
            "A basket and coils, or two lines of coils, do not share a sac: give each a treatment of its own."
        )
    if not anatomy.aneurysms:
        raise LandingError(f"This artery has no sac, and {line.name} lie in one. Choose a device for arteries.")
    aneurysm, wound_mm = anatomy.aneurysms[0], line.wound_diameter_um * MM_PER_UM
    sac_mm3, given = abs(aneurysm.sac.volume_mm3), filling if isinstance(filling, Sequence) else ()
    of_given = sum(size.length_mm for size in given) * np.pi / 4 * wound_mm**2 / sac_mm3
    wanted = filling if isinstance(filling, int | float) else of_given or DENSITY_FRACTION
    if not 0 < wanted <= DENSEST_FRACTION:
        raise LandingError(
            f"Coils cannot fill {wanted:.0%} of a sac. Give a packing density up to {DENSEST_FRACTION:.0%}, or fewer "
            "coils."
        )
    total_mm = wanted * sac_mm3 / (np.pi / 4 * wound_mm**2)
    pushed = _Filling(line, aneurysm, _room(aneurysm, inside, wound_mm), total_mm, np.random.default_rng(seed))
    shortest = min(line.sizes, key=lambda size: (size.length_mm, size.diameter_mm))
    sizes: list[Size] = []
    is_full = False
    while not is_full:
        size = next_size(line, sac_mm3, sizes, total_mm - pushed.length_mm, given)
        entered_mm = pushed.push(size, is_framing=not sizes, enough=1.0 if given else ENOUGH) if size else 0.0
        if size and not entered_mm and not given and size is not shortest:
            size, entered_mm = shortest, pushed.push(shortest, is_framing=not sizes)
        is_full = entered_mm == 0.0
        if size and entered_mm:
            is_whole = entered_mm > size.length_mm - pushed.wound_mm
            sizes.append(size if is_whole else replace(size, length_mm=round(entered_mm, 1)))
        if progress:
            progress(len(sizes), min(pushed.length_mm / total_mm, 1.0))
    imbalance = pushed.settle()
    if not sizes:
        raise LandingError(f"No coil of {line.name} enters this sac: it is too small for loops of 2 mm.")
    points_mm, starts = pushed.wires()
    diameters_um = np.full(len(sizes), line.wound_diameter_um)
    whole = Size(sizes[0].diameter_mm, float(sum(one.length_mm for one in sizes)), sizes[0].free_diameter_mm)
    flat = np.zeros((0, 0, 3)), np.zeros(0), points_mm, starts, diameters_um
    coils = Coils(line, whole, *flat, coils=tuple(sizes), seed=seed, sac=aneurysm.sac)
    is_reached = abs(coils.density_fraction - wanted) < 0.01 and imbalance < BALANCED
    return Deployment(
        stent=coils,
        outcome="terminated" if is_reached else "iteration_limit",
        advice=_advise(coils, wanted, imbalance),
        terminated_fraction=np.array([1.0 - imbalance]),
        seconds=time.perf_counter() - began,
        wall_gap_mm=np.zeros((0, 0)),
        history_mm=np.zeros((1, 0, 0, 3)),
        energy_mm2=np.zeros(1),
    )


def given_coils(line: Coil, sizes_mm: Sequence[tuple[float, float]]) -> list[Size]:
    """Return coils of a line by loops and length (c, 2), which need not be sizes that the catalogue lists."""
    margin_mm = line.sizes[0].free_diameter_mm - line.sizes[0].diameter_mm
    for given_mm, made, what in zip(
        zip(*sizes_mm, strict=True),
        ({one.diameter_mm for one in line.sizes}, {one.length_mm for one in line.sizes}),
        ("loops of {:g} to {:g} mm", "a length of {:g} to {:g} mm"),
        strict=True,
    ):
        if not min(made) <= min(given_mm) <= max(given_mm) <= max(made):
            raise LandingError(f"Coils of {line.name} have {what.format(min(made), max(made))}: change the sizes.")
    return [Size(loops_mm, length_mm, loops_mm + margin_mm) for loops_mm, length_mm in sizes_mm]


def next_size(
    coil: Coil, sac_mm3: float, before: Sequence[Size], left_mm: float, given: Sequence[Size] = ()
) -> Size | None:
    """Return the next coil for a sac in which some already are, and a length is missing; None where it is full.

    Where coils are given, it is the next of them.

    The loops of the framing coil are as wide as the sac, taken as a sphere, or as the largest that are narrower. Those
    of every further coil are narrower than those of the coil before. Each is as long as is made and missing.
    """
    if given:
        return given[len(before)] if len(before) < len(given) else None
    widths_mm = sorted({size.diameter_mm for size in coil.sizes})
    sac_mm = (6 * sac_mm3 / np.pi) ** (1 / 3)
    if before:
        most_mm = max(SMALLER * before[-1].diameter_mm, SMALLEST * before[0].diameter_mm, widths_mm[0])
        missing_mm = left_mm
    else:
        most_mm, missing_mm = max(sac_mm, widths_mm[0]), FRAMING_SHARE * left_mm
    for width_mm in reversed([one for one in widths_mm if one <= most_mm]):
        same = [size for size in coil.sizes if size.diameter_mm == width_mm]
        fitting = [size for size in same if size.length_mm <= missing_mm]
        if fitting:
            return max(fitting, key=lambda size: size.length_mm)
        if not before:
            return min(same, key=lambda size: size.length_mm)
    shortest = min(coil.sizes, key=lambda size: size.length_mm)
    return shortest if left_mm > 0.5 * shortest.length_mm else None


class _Filling:
    """Coils in a sac while it is filled."""

    def __init__(self, coil: Coil, aneurysm: Aneurysm, room: Room, total_mm: float, draw: Generator) -> None:
        self.wound_mm = wound_mm = coil.wound_diameter_um * MM_PER_UM
        self.room, self.draw, self.count = room, draw, 0
        self.rods, self.laws = _begun(int(1.2 * total_mm / wound_mm) + 400, wound_mm)
        plane = aneurysm.plane or aneurysm.mean_plane
        inner_mm = room.points_mm(room.distance_mm < -0.7 * wound_mm)
        height_mm = (inner_mm - plane.center_mm) @ plane.normal
        aside_mm = curves.lengths(inner_mm - plane.center_mm - height_mm[:, None] * plane.normal)
        is_near = (height_mm < 0.5 * height_mm.max(initial=0.0)) & (aside_mm < 0.7 * np.sqrt(plane.area_mm2 / np.pi))
        self.inner_mm = inner_mm[height_mm > 0]
        self.tips_mm, self.plane = inner_mm[is_near if is_near.any() else height_mm > 0], plane

    @property
    def length_mm(self) -> float:
        """Length of all coils, in mm."""
        return float(self.rods.is_segment[: self.count].sum() * self.wound_mm)

    def push(self, size: Size, *, is_framing: bool, enough: float = ENOUGH) -> float:
        """Push in one coil, and return the length that has entered; 0 where none does.

        Where it stalls or kinks early, it is drawn back and pushed from another place; the longest attempt counts. Of
        a coil that kinks the part before the kink counts, as a shorter coil.
        """
        entering, begin = round(size.length_mm / self.wound_mm), self.count
        most = min(entering, len(self.rods.x) - begin - 4)
        before = [values.copy() for values in self.rods]
        best: list[Floats] = []
        best_count = begin
        for number in range(TRIES if len(self.tips_mm) else 0):
            self._restore(before, begin)
            direction = self._place(begin, is_free=number > 0)
            self._curl(begin, entering + 3, 0.5 * size.free_diameter_mm, is_framing=is_framing)
            count = rods.advance(self.rods, self.laws, begin + 2, self.room, DRAG, STEPS, direction, most)[0]
            self.count, is_kinked = count - 1, True  # without the node that is still in the catheter
            for _ in range(3):
                if self.count - begin < LEAST_NODES:
                    break
                self.rods.is_segment[self.count - 1 :] = self.rods.is_held[:] = False
                rods.advance(self.rods, self.laws, self.count, self.room, *SETTLING[0], np.zeros(3), 0)
                radius_mm = bend_radii_mm(self.rods.x[begin : self.count], np.array([0, self.count - begin]))
                is_kinked = bool(radius_mm.min() < KINKED * self.wound_mm)
                if not is_kinked:
                    break
                self.count = begin + int((radius_mm < KINKED * self.wound_mm).argmax())
            if self.count > best_count and not is_kinked:
                best, best_count = [values.copy() for values in self.rods], self.count
            if self.count - begin > enough * entering:
                break
        if best_count - begin < LEAST_NODES:
            self._restore(before, begin)
            return 0.0
        self._restore(best, best_count)
        return (best_count - begin - 1) * self.wound_mm

    def settle(self) -> float:
        """Move all coils until their forces are in balance; return what remains over the contact forces."""
        imbalance = np.inf
        for _ in range(ROUNDS):
            for drag, steps in SETTLING:
                imbalance = rods.advance(self.rods, self.laws, self.count, self.room, drag, steps, np.zeros(3), 0)[1]
            if imbalance < BALANCED:
                break
        return float(imbalance)

    def wires(self) -> tuple[Floats, Ints]:
        """Return the axes (p, 3) of all coils, and the first point (c + 1,) of each, followed by p."""
        last = np.flatnonzero(~self.rods.is_segment[: self.count])
        return self.rods.x[: self.count], np.r_[0, last + 1].astype(np.int32)

    def _restore(self, state: Sequence[Floats], count: int) -> None:
        """Go back to an earlier state."""
        for values, earlier in zip(self.rods, state, strict=True):
            values[:] = earlier
        self.count = count

    def _place(self, begin: int, *, is_free: bool) -> Floats:
        """Place the first two nodes of a coil in the catheter, and return its direction.

        They are near the neck, pointing at the dome, where it is clear of coils, or, if free, in the widest gap of all.
        """
        tips_mm = self.inner_mm if is_free else self.tips_mm
        order = self.draw.permutation(len(tips_mm))[:400]
        others = cKDTree(self.rods.x[:begin]) if begin else cKDTree(np.full((1, 3), 1e9))
        away_mm = np.asarray(others.query(tips_mm[order])[0])
        is_clear = (away_mm > TIP_CLEARANCE * self.wound_mm) & (not is_free)
        tip_mm = tips_mm[order[is_clear.argmax() if is_clear.any() else away_mm.argmax()]]
        direction = self.plane.normal * (not is_free) + 0.4 * self.draw.normal(size=3)
        direction /= np.linalg.norm(direction)
        across = np.cross(direction, self.draw.normal(size=3))
        self.rods.x[begin], self.rods.x[begin + 1] = tip_mm, tip_mm - self.wound_mm * direction
        self.rods.frame[begin] = across / np.linalg.norm(across)
        self.rods.is_held[begin : begin + 2] = self.rods.is_segment[begin] = True
        return np.asarray(direction)

    def _curl(self, begin: int, count: int, radius_mm: float, *, is_framing: bool) -> None:
        """Give a coil its natural curvature: loops in one plane, or loops each of which turns against the one before.

        A loop of the framing coil turns over its last quarter.
        """
        place = np.arange(min(count, len(self.rods.x) - begin)) * self.wound_mm / (2 * np.pi * radius_mm)
        loop, turn = place.astype(int), np.zeros(len(place))
        if is_framing:
            angle = self.draw.uniform(*FRAMING_TURN, loop[-1] + 2) * self.draw.choice([-1, 1], loop[-1] + 2)
            angle = np.r_[0.0, np.cumsum(angle)]
            turn = angle[loop] + np.clip(4 * (place - loop) - 3, 0, 1) * (angle[loop + 1] - angle[loop])
        curl = self.wound_mm / radius_mm * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        self.rods.natural[begin : begin + len(place)] = curl


def _begun(size: int, wound_mm: float) -> tuple[rods.Rods, rods.Laws]:
    """Return rods with room for so many nodes, of which there are none, and their numbers."""
    nodes = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros((size, 2)), np.zeros(size, bool), np.zeros(size, bool)
    laws = wound_mm, TOUCHING * wound_mm, STRETCH * wound_mm, TWIST, 1 / SHARPEST, CONTACT
    return rods.Rods(*nodes), rods.Laws(*laws)


def warm() -> None:
    """Call the kernel of coils once on a short rod."""
    state, laws = _begun(8, 0.3)
    state.x[:, 0], state.frame[:, 1], state.is_segment[:3] = 0.3 * np.arange(8), 1.0, True
    room = Room(np.full((8, 8, 8), -1.0), np.zeros(3), 0.5)
    rods.advance(state, laws, 4, room, DRAG, 1, np.array([1.0, 0.0, 0.0]), 1)


def bend_radii_mm(points_mm: Floats, starts: Ints) -> Floats:
    """Return the radius (m,) of the circle by which polylines (p, 3) bend at each point that is not an end, in mm."""
    ends = np.r_[starts[:-1], starts[1:] - 1]
    inner = np.setdiff1d(np.arange(len(points_mm)), ends)
    before, after = points_mm[inner] - points_mm[inner - 1], points_mm[inner + 1] - points_mm[inner]
    size = curves.lengths(before) * curves.lengths(after)
    turn = 2 * curves.lengths(np.cross(before, after)) / (size + np.einsum("ij,ij->i", before, after)).clip(1e-12)
    return np.asarray(np.sqrt(size) / turn.clip(1e-12), dtype=np.float64)


@lru_cache(maxsize=4)
def _sac_room(aneurysm: Aneurysm, margin_mm: float) -> Room:
    """Sample the distance to the wall and the neck of a sac."""
    low_mm = aneurysm.sac.vertices_mm.min(axis=0) - margin_mm
    size_mm = aneurysm.sac.vertices_mm.max(axis=0) + margin_mm - low_mm
    spacing_mm = max(GRID_MM, float(np.prod(size_mm) / MOST_POINTS) ** (1 / 3))
    shape = np.ceil(size_mm / spacing_mm).astype(int) + 1
    points_mm = low_mm + np.indices(shape).reshape(3, -1).T * spacing_mm
    return Room(aneurysm.sac.signed_distance(points_mm).reshape(shape), low_mm, spacing_mm)


def _room(aneurysm: Aneurysm, inside: Sequence[Stent], wound_mm: float) -> Room:
    """Return where the axes of coils may lie: in the sac and outside the devices in the artery."""
    room = _sac_room(aneurysm, wound_mm)
    distance_mm = room.distance_mm.copy()
    for stent in inside:
        is_inner = distance_mm < wound_mm
        wire_mm = 0.5 * float(stent.wire_diameter_um.max()) * MM_PER_UM
        points_mm = room.points_mm(is_inner)
        wires_mm = np.concatenate(list(_finely(stent, wire_mm)))  # drawn off the contour
        to_wires_mm = cKDTree(wires_mm).query(points_mm)[0]
        to_stent_mm = np.minimum(stent.contour.closed.signed_distance(points_mm), to_wires_mm)
        distance_mm[is_inner] = np.maximum(distance_mm[is_inner], wire_mm + ROUNDED * room.spacing_mm - to_stent_mm)
    return room._replace(distance_mm=distance_mm)


def measure_coils(anatomy: Anatomy, coils: Coils) -> Measures:
    """Measure coils: density, whole and by zone, length, bends, coil beyond the plane of the neck, and its coverage."""
    aneurysm, wound_mm = anatomy.aneurysms[0], coils.design.wall_offset_um * 2 * MM_PER_UM
    first_mm, last_mm, _ = coils.pieces_mm
    middle_mm, length_mm = 0.5 * (first_mm + last_mm), curves.lengths(last_mm - first_mm)
    plane = aneurysm.plane or aneurysm.mean_plane
    height_mm = (middle_mm - plane.center_mm) @ plane.normal
    is_beyond = height_mm < 0
    radius_mm = bend_radii_mm(coils.wire_points_mm, coils.wire_starts)
    found: Measures = {
        "device": coils.design.name,
        "size": f"{coils.density_fraction:.0%}",
        "coils": ", ".join(one.coil_label for one in coils.coils),
        "coils_count": float(len(coils.coils)),
        "coil_length_mm": coils.wire_length_mm,
        "coil_volume_mm3": coils.volume_mm3,
        "packing_density_fraction": coils.density_fraction,
        "coil_beyond_neck_mm": float(length_mm[is_beyond].sum()),
        "metal_in_artery_mm2": float(wound_mm * length_mm[is_beyond].sum()),
        "protrusion_mm": max(0.0, 0.5 * wound_mm - float(height_mm.min())),
        "neck_covered_by_coils_fraction": _covered(aneurysm, coils),
        "median_bend_radius_mm": float(np.median(radius_mm)),
        "min_bend_radius_mm": float(radius_mm.min()),
        "seed_count": float(coils.seed),
    }
    inner_mm = (room := _sac_room(aneurysm, wound_mm)).points_mm(room.distance_mm < 0)
    of_room, of_coils = _zones(aneurysm, inner_mm, wound_mm), _zones(aneurysm, middle_mm, wound_mm)
    for number, name in enumerate(("neck", "boundary", "core")):
        zone_mm3 = (of_room == number).sum() * room.spacing_mm**3
        volume_mm3 = np.pi / 4 * wound_mm**2 * length_mm[of_coils == number].sum()
        if zone_mm3:
            found[f"{name}_density_fraction"] = float(volume_mm3 / zone_mm3)
    return found


def _zones(aneurysm: Aneurysm, points_mm: Floats, wound_mm: float) -> Ints:
    """Return the zone (n,) of points in a sac: 0 near the neck, 1 near the wall, 2 in the core."""
    at_neck = aneurysm.neck.closest(points_mm)[1] < ZONE * wound_mm
    at_wall = np.abs(aneurysm.sac.signed_distance(points_mm)) < ZONE * wound_mm
    return np.where(at_neck, 0, np.where(at_wall, 1, 2))


def _covered(aneurysm: Aneurysm, coils: Coils) -> float:
    """Return the fraction of the neck, seen along the normal of its plane, with coil up to a zone above it."""
    plane, half_mm = aneurysm.plane or aneurysm.mean_plane, coils.design.wall_offset_um * MM_PER_UM
    across = np.stack([one := curves.any_perpendicular(plane.normal), np.cross(plane.normal, one)])
    fine_mm = np.concatenate(list(_finely(coils, 0.5 * half_mm)))
    is_near = aneurysm.neck.closest(fine_mm)[1] < 2 * ZONE * half_mm
    if not is_near.any():
        return 0.0
    corners_mm = aneurysm.neck.corners_mm
    weights = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6
    samples_mm = np.einsum("sc,fcd->fsd", weights, corners_mm)
    away_mm = cKDTree(fine_mm[is_near] @ across.T).query(samples_mm.reshape(-1, 3) @ across.T)[0]
    area_mm2 = aneurysm.neck.areas_mm2 * np.abs(aneurysm.neck.normals @ plane.normal)
    is_covered = np.asarray(away_mm < half_mm).reshape(samples_mm.shape[:2])
    return float(np.average(is_covered.mean(axis=1), weights=area_mm2))


def _finely(stent: Stent, step_mm: float) -> Iterator[Floats]:
    """Yield points (n, 3) along every wire or coil about a step apart."""
    for first, last in pairwise(stent.wire_starts):
        yield curves.resample(stent.wire_points_mm[first:last], step_mm)


def _advise(coils: Coils, wanted: float, imbalance: float) -> str:
    """Describe how full a sac is, and what was not reached."""
    names = ", ".join(one.coil_label for one in coils.coils)
    text = (
        f"{counted(len(coils.coils), 'coil')} ({names}) with {coils.wire_length_mm / 10:.1f} cm in all fill "
        f"{coils.density_fraction:.1%} of the sac"
    )
    if coils.density_fraction - wanted >= 0.01:
        text += f", more than the {100 * wanted:.3g}% asked for, because no shorter coils are made"
    if wanted - coils.density_fraction >= 0.01:
        text += f"; {wanted:.0%} was not reached, because further coils would kink (choose a lower density)"
    if imbalance >= BALANCED:
        text += f"; their forces are not in balance: {imbalance:.0%} of the contact forces remain"
    return f"{text}."
