"""Braid: rows of a device whose wires cannot stretch, marched along the parent axis from the landing point."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, final

import numpy as np

from vstent.deploy.active_contour import ActiveContour, Progress, State, relax
from vstent.deploy.contour import Planes, circles, evenly_spaced, perimeters, planes
from vstent.deploy.wall import AbstractWall
from vstent.device import Design, Size, grid, row_spacing_mm
from vstent.errors import LandingError
from vstent.kernels.arrays import Bools, Floats
from vstent.stent import Landing
from vstent.units import MM_PER_UM
from vstent.vessel import Anatomy

ROUNDS = 8
"""Expansion and marching alternate at most so often."""
SETTLED_MM = 0.005
"""Rows have settled when none moves further than this from one round to the next."""

TABLE_ROWS = 2001
"""Samples of the row spacing along the artery."""
BEYOND_MM = 500.0
"""Rows are counted so far beyond the artery, to say by how much a device misses it."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The contour's diameter along the parent axis."""

    abscissa_mm: Floats
    """(k,) arc lengths."""
    diameter_mm: Floats
    """(k,) diameters of the circles of the same perimeter."""

    def at(self, abscissa_mm: Floats) -> Floats:
        """Return the diameter at arc lengths; beyond the ends it stays what it is there."""
        return np.interp(abscissa_mm, self.abscissa_mm, self.diameter_mm)

    def corrected(self, abscissa_mm: Floats, diameter_mm: Floats) -> "Profile":
        """Return the profile through (r,) measured diameters; beyond them it keeps its shape, shifted."""
        error_mm = np.interp(self.abscissa_mm, abscissa_mm, diameter_mm - self.at(abscissa_mm))
        outside = (self.abscissa_mm < abscissa_mm[0]) | (self.abscissa_mm > abscissa_mm[-1])
        together = np.concatenate([self.abscissa_mm[outside], abscissa_mm])
        values = np.concatenate([(self.diameter_mm + error_mm)[outside], diameter_mm])
        order = np.argsort(together)
        return Profile(together[order], values[order])


def expected_profile(design: Design, anatomy: Anatomy) -> Profile:
    """Diameter that the contour will have where it lies against the landing surface."""
    offset_mm = design.wall_offset_um * MM_PER_UM
    return Profile(anatomy.axis.abscissa_mm, 2 * (anatomy.section_radius_mm - offset_mm))


def march(design: Design, size: Size, landing: Landing, profile: Profile) -> Floats:
    """Arc lengths (rows,) of the rows: from each to the next it is h(D), so rows are counted by the integral of ds/h.

    The landing point is the middle row, the first (proximal) or the last (distal). Rows may leave the artery, where
    the diameter is that of its end: ask `check_inside`.
    """
    shape = grid(design, size)
    start = {"proximal": 0, "center": (shape.rows - 1) // 2, "distal": shape.rows - 1}[landing.anchor]
    first, last = profile.abscissa_mm[[0, -1]]
    table_mm = np.concatenate([[first - BEYOND_MM], np.linspace(first, last, TABLE_ROWS), [last + BEYOND_MM]])
    per_mm = shape.row_split / row_spacing_mm(design, size, profile.at(table_mm))
    count = np.concatenate([[0.0], np.cumsum(0.5 * (per_mm[1:] + per_mm[:-1]) * np.diff(table_mm))])
    wanted = np.interp(landing.abscissa_mm, table_mm, count) + np.arange(shape.rows) - start
    return np.interp(wanted, count, table_mm)


def check_inside(design: Design, size: Size, abscissa_mm: Floats, artery_mm: float) -> None:
    """See that the rows (rows,) lie on an artery of length `artery_mm`.

    Raises
    ------
    LandingError
        When they do not; the sentence says where the device would lie and what to do.
    """
    first, last = float(abscissa_mm[0]), float(abscissa_mm[-1])
    if first >= 0 and last <= artery_mm:
        return
    length_mm = last - first
    lies = (
        f"{design.name} {size.label} would lie from {first:.1f} to {last:.1f} mm of a parent artery that runs "
        f"from 0 to {artery_mm:.1f} mm"
    )
    if length_mm > artery_mm:
        raise LandingError(
            f"{lies}: deployed it is {length_mm:.1f} mm long, longer than the artery. Choose a shorter size."
        )
    end, by_mm = ("proximal", -first) if first < 0 else ("distal", last - artery_mm)
    move = "distally" if first < 0 else "proximally"
    raise LandingError(
        f"{lies}: it leaves the artery by {by_mm:.1f} mm at the {end} end. "
        f"Land it at least {by_mm:.1f} mm more {move} or choose a shorter size."
    )


@final
@dataclass(frozen=True)
class FreeDiameter:
    """Stops a row when its perimeter reaches the device's free one: a wider artery stays untouched."""

    diameter_mm: float
    """The free diameter."""

    def __call__(self, before_mm: Floats, after_mm: Floats) -> tuple[Floats, Bools]:
        """Let every row go from `before_mm` towards `after_mm` only as far as its perimeter may grow."""
        allowed = np.pi * self.diameter_mm
        old, new = perimeters(before_mm), perimeters(after_mm)
        is_over = new >= allowed
        share = np.where(is_over, (allowed - old) / np.where(is_over, np.maximum(new - old, 1e-12), 1.0), 1.0)
        share = np.clip(share, 0.0, 1.0)[:, None, None]
        nodes_mm = before_mm + share * (after_mm - before_mm)
        return nodes_mm, np.broadcast_to(is_over[:, None], nodes_mm.shape[:2])


@final
@dataclass(frozen=True, eq=False)
class Settled:
    """A contour whose rows lie where its wires put them."""

    nodes_mm: Floats
    """(rows, columns, 3) nodes."""
    abscissa_mm: Floats
    """(rows,) arc lengths of the rows."""
    outcome: Literal["terminated", "iteration_limit"]
    """Whether enough nodes terminated."""
    terminated_fraction: tuple[float, ...]
    """After every iteration."""
    history_mm: tuple[Floats, ...]
    """The contour before the first and after every iteration."""


@final
@dataclass(frozen=True, eq=False)
class Expansion:
    """One device opening at one place of one artery."""

    design: Design
    """The device."""
    size: Size
    """Its size."""
    landing: Landing
    """Where it is to lie."""
    anatomy: Anatomy
    """The artery."""
    method: ActiveContour
    """The contour's weights."""
    wall: AbstractWall
    """The artery's wall."""

    @cached_property
    def across(self) -> Planes:
        """Planes on which rows lie."""
        return planes(self.anatomy.axis)

    @cached_property
    def free(self) -> FreeDiameter:
        """The device's own limit."""
        return FreeDiameter(self.size.free_diameter_mm)

    def rows_mm(self, profile: Profile) -> Floats:
        """Arc lengths (rows,) of the rows where the contour has this profile, all of them in the artery."""
        rows_mm = march(self.design, self.size, self.landing, profile)
        check_inside(self.design, self.size, rows_mm, self.anatomy.axis.length_mm)
        return rows_mm

    def initial(self, rows_mm: Floats) -> State:
        """Start with circles of the maximum inscribed spheres, no wider than the free device."""
        axis = self.anatomy.axis
        radius_mm = np.interp(rows_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
        radius_mm = np.minimum(radius_mm, 0.5 * self.size.free_diameter_mm)
        nodes_mm = self.across.place(rows_mm, circles(radius_mm, grid(self.design, self.size).columns))
        return self.method.init(nodes_mm, self.across.at(rows_mm)[0], self.wall)

    def moved(self, state: State, old_mm: Floats, new_mm: Floats) -> State:
        """Move the rows along the axis, keeping the contour's shape, space nodes evenly and put them to the wall.

        A node that had terminated goes back to the wall by eq. (6, 7) as far as its row's free perimeter allows; one
        that still moves does so only where it would be outside or nearer than dd.
        """
        in_plane_mm = evenly_spaced(self.across.coordinates(old_mm, state.nodes_mm))
        nodes_mm = self.across.place(new_mm, _interpolated(old_mm, in_plane_mm, new_mm))
        held = state.is_terminated
        state = replace(state, nodes_mm=nodes_mm, centers_mm=self.across.at(new_mm)[0])
        state = self.method.classify(state, np.ones_like(held), self.wall)
        points_mm = state.nodes_mm.reshape(-1, 3)
        is_off = held.ravel() & (state.contact.distance_mm > self.method.dd_mm)
        back_mm = self.method.relocated_mm(points_mm, np.zeros_like(is_off), state.contact)
        back_mm = np.where(is_off[:, None], back_mm, points_mm).reshape(nodes_mm.shape)
        return replace(state, nodes_mm=self.free(state.nodes_mm, back_mm)[0])


def settle(expansion: Expansion, progress: Progress | None = None) -> Settled:
    """Expand the contour and march its rows in turn until the rows stay where they are.

    Raises
    ------
    LandingError
        When the device does not fit the artery.
    """
    profile = expected_profile(expansion.design, expansion.anatomy)
    rows_mm = expansion.rows_mm(profile)
    state = expansion.initial(rows_mm)
    fractions: list[float] = []
    history = [state.nodes_mm]
    for _ in range(ROUNDS):
        relaxed = relax(expansion.method, state, expansion.wall, limit=expansion.free, progress=progress)
        fractions.extend(relaxed.terminated_fraction)
        history.extend(relaxed.history_mm)
        profile = profile.corrected(rows_mm, perimeters(relaxed.state.nodes_mm) / np.pi)
        old_mm, rows_mm = rows_mm, expansion.rows_mm(profile)
        state = expansion.moved(relaxed.state, old_mm, rows_mm)
        if np.abs(rows_mm - old_mm).max() < SETTLED_MM:
            break
    history[-1] = state.nodes_mm
    return Settled(state.nodes_mm, rows_mm, relaxed.outcome, tuple(fractions), tuple(history))


def _interpolated(old_mm: Floats, values: Floats, new_mm: Floats) -> Floats:
    """Values (n, m, d) known at arc lengths (n,), linear between them and constant beyond, at (k,)."""
    i = np.clip(np.searchsorted(old_mm, new_mm, side="right") - 1, 0, len(old_mm) - 2)
    share = np.clip((new_mm - old_mm[i]) / (old_mm[i + 1] - old_mm[i]), 0.0, 1.0)[:, None, None]
    return (1 - share) * values[i] + share * values[i + 1]
