"""The default deployment method: wires of constant length set the distance between the rows of the device."""

from dataclasses import dataclass, replace
from functools import partial
from typing import final

import numpy as np

from vstent.deployment import pieces
from vstent.deployment.active_contour import State
from vstent.deployment.contour import evenly_spaced, perimeters, planes
from vstent.deployment.method import AbstractMethod, Opened, Placement, check_inside
from vstent.devices.design import Design, Size, widest_mm
from vstent.devices.formulas import free_diameters_mm, grid, row_spacing_mm
from vstent.devices.stent import Landing, row_diameters_mm
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats
from vstent.units import MM_PER_UM

ROUNDS = 8
"""Largest number of times that row positions are recomputed."""
SETTLED_MM = 0.1
"""Largest movement of a row between two rounds at which the rows have converged, in mm."""
LAST_STEPS = 5
"""Largest number of extra steps for the remaining nodes after 99 % have terminated."""
FLARE_ROUNDS = 6
"""Number of times that the rows of a device are placed whose free diameter varies along it."""
TABLE_ROWS = 501
"""Number of samples of the row spacing along the artery."""
FREELY = 0.999
"""Fraction of the free perimeter above which a row counts as stopped there and not at the wall."""
BEYOND_MM = 500.0
"""Length, in mm, by which row positions are computed beyond both ends of the artery.

It lets the error state how far the device would extend beyond the artery.
"""


@dataclass(frozen=True, eq=False)
class Profile:
    """Diameter of the contour along the parent axis, and curvature of the axis."""

    abscissa_mm: Floats
    """(k,) arc lengths along the axis, in mm."""
    diameter_mm: Floats
    """(k,) diameters of circles with the perimeter of the contour, in mm."""
    bend: tuple[Floats, Floats] = (np.zeros(1), np.zeros(1))
    """(m,) arc lengths in mm and (m,) curvatures of the axis there, per mm."""

    def at(self, abscissa_mm: Floats) -> Floats:
        """Return the diameter at arc lengths, in mm; beyond the ends it equals the end value."""
        return np.interp(abscissa_mm, self.abscissa_mm, self.diameter_mm)

    def spacing_mm(self, design: Design, size: Size, abscissa_mm: Floats) -> Floats:
        """Return the distance between lattice rows of a device at arc lengths, in mm."""
        return row_spacing_mm(design, size, self.at(abscissa_mm), np.interp(abscissa_mm, *self.bend))

    def corrected(self, abscissa_mm: Floats, diameter_mm: Floats) -> "Profile":
        """Return a profile that passes through measured diameters (r,) at increasing arc lengths (r,).

        Beyond them it keeps its shape, shifted to meet the outermost ones.
        """
        error_mm = np.interp(self.abscissa_mm, abscissa_mm, diameter_mm - self.at(abscissa_mm))
        outside = (self.abscissa_mm < abscissa_mm[0]) | (self.abscissa_mm > abscissa_mm[-1])
        together = np.concatenate([self.abscissa_mm[outside], abscissa_mm])
        values = np.concatenate([(self.diameter_mm + error_mm)[outside], diameter_mm])
        order = np.argsort(together)
        return replace(self, abscissa_mm=together[order], diameter_mm=values[order])


def expected_profile(design: Design, size: Size, anatomy: Anatomy) -> Profile:
    """Predict the diameter of the contour before deployment, and the curvature that affects the row spacing.

    The diameter is that of the landing surface, less the offset of the contour, or the free diameter if that is
    smaller.

    For a laser-cut device the curvature is left out, so its rows start as in a straight artery. In a tight bend its
    cells leave the wall, and its rows do not come as close together as those of a braid. `vstent.deployment.cells` then
    moves them.
    """
    offset_mm = design.wall_offset_um * MM_PER_UM
    diameter_mm = np.minimum(2 * (anatomy.parent.section_radius_mm - offset_mm), widest_mm(design, size))
    if not design.follows_bends:
        return Profile(anatomy.parent.axis.abscissa_mm, diameter_mm)
    across = planes(anatomy.parent.axis)
    return Profile(anatomy.parent.axis.abscissa_mm, diameter_mm, (across.abscissa_mm, across.curvature_per_mm))


def over_openings(anatomy: Anatomy, nodes_mm: Floats) -> Bools:
    """Return which points (..., 3) on a device lie over restored wall, where a neck or an ostium has none."""
    face = anatomy.parent.landing_surface.closest(nodes_mm.reshape(-1, 3))[2]
    return np.asarray(anatomy.parent.is_restored_face[face].reshape(nodes_mm.shape[:-1]))


def landed_row(design: Design, size: Size, landing: Landing) -> int:
    """Return the number of the row of nodes that lies at the landing point."""
    rows = grid(design, size).rows
    return {"proximal": 0, "center": (rows - 1) // 2, "distal": rows - 1}[landing.anchor]


def march(design: Design, size: Size, landing: Landing, profile: Profile) -> Floats:
    """Compute the arc length of every row from the row spacing that the wires impose.

    The distance from one row to the next is h(D), the row spacing at the local diameter. Row numbers are therefore the
    integral of ds / h, counted from the landing point. Where the free diameter varies along the device, D depends on
    where its rows lie, and the rows are placed repeatedly. They may lie beyond the artery, where the diameter is taken
    as that at its end.
    """
    shape, start = grid(design, size), landed_row(design, size, landing)
    free_mm, rows_mm, expected = free_diameters_mm(design, size), np.zeros(shape.rows), profile
    for done in range(1 + FLARE_ROUNDS if size.free_profile_mm else 1):
        if done:  # samples at the rows resolve a flare that is shorter than the table's step
            where_mm = np.union1d(expected.abscissa_mm, rows_mm)
            diameter_mm = np.minimum(expected.at(where_mm), np.interp(where_mm, rows_mm, free_mm))
            profile = replace(expected, abscissa_mm=where_mm, diameter_mm=diameter_mm)
        first, last = profile.abscissa_mm[[0, -1]]
        table_mm = np.concatenate([[first - BEYOND_MM], np.linspace(first, last, TABLE_ROWS), [last + BEYOND_MM]])
        per_mm = shape.row_split / profile.spacing_mm(design, size, table_mm)
        count = np.concatenate([[0.0], np.cumsum(0.5 * (per_mm[1:] + per_mm[:-1]) * np.diff(table_mm))])
        wanted = np.interp(landing.abscissa_mm, table_mm, count) + np.arange(shape.rows) - start
        rows_mm = np.interp(wanted, count, table_mm)
    return rows_mm


def grown(before_mm: Floats, after_mm: Floats, free_mm: Floats) -> tuple[Floats, Bools]:
    """Return rows (rows, columns, d) moved as far as their perimeters may grow, and which nodes that has stopped.

    A row stops at its free diameter (rows,), even in a wider artery.
    """
    allowed = np.pi * free_mm
    old, new = perimeters(before_mm), perimeters(after_mm)
    is_over = new >= allowed
    share = np.where(is_over, (allowed - old) / np.where(is_over, np.maximum(new - old, 1e-12), 1.0), 1.0)
    nodes_mm = before_mm + np.clip(share, 0.0, 1.0)[:, None, None] * (after_mm - before_mm)
    return nodes_mm, np.broadcast_to(is_over[:, None], nodes_mm.shape[:2])


@final
@dataclass(frozen=True, eq=False)
class ConstantWire(AbstractMethod):
    """Deployment method in which wires keep their length and rows do not exceed the free diameter.

    The active contour of Zhong et al. 2016 carries the device to the wall. This method adds the mechanics of the
    device:

    - Rows are as far apart as the wires require (`march`), so the length and the ends of the device are predictions.
    - A row stops growing at the free diameter.
    - Where the artery bends, crossings slide along the wall until each piece of wire has, as far as possible, its
      original length (`vstent.deployment.pieces`).
    """

    def init(self, placement: Placement) -> Opened:
        """Return the closed device, its rows where they would lie if the device filled the artery."""
        profile = expected_profile(placement.design, placement.size, placement.anatomy)
        rows_mm = march(placement.design, placement.size, placement.landing, profile)
        return Opened(placement.start(self.contour, rows_mm, placement.free_mm), rows_mm)

    def step(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device after one step of the contour; once it is open, its row positions are recomputed."""
        opened = self._stepped(placement, opened)
        if not self.terminate(opened):
            return opened
        design, size, artery_mm = placement.design, placement.size, placement.anatomy.parent.axis.length_mm
        profile = expected_profile(design, size, placement.anatomy)
        for done in range(ROUNDS):
            profile = profile.corrected(opened.abscissa_mm, perimeters(opened.contour.nodes_mm) / np.pi)
            rows_mm = march(design, size, placement.landing, profile)
            check_inside(design, size, rows_mm, artery_mm)
            if done and np.abs(rows_mm - opened.abscissa_mm).max() < SETTLED_MM:
                break
            opened = self._moved(placement, opened, rows_mm)
        return opened

    def result(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device after its crossings have moved to restore the wire lengths, with its nodes at the wall.

        Nodes of a laser-cut device keep the distance from the wall that its cells require. A LandingError is raised
        where the device extends beyond the artery.
        """
        for _ in range(LAST_STEPS):
            if opened.contour.is_terminated.all():
                break
            opened = self._stepped(placement, opened)
        design, size, rows = placement.design, placement.size, np.arange(len(opened.abscissa_mm))
        held = landed_row(design, size, placement.landing)
        laid = partial(self._between, placement, opened)
        is_opening = over_openings(placement.anatomy, opened.contour.nodes_mm) if design.joined_crowns else None
        slid = pieces.slide(design, size, opened.contour.nodes_mm, held, laid, is_opening)
        rows_mm = pieces.extrapolated(rows, opened.abscissa_mm, slid.row.mean(axis=1))
        check_inside(design, size, rows_mm, placement.anatomy.parent.axis.length_mm)
        where_mm = pieces.extrapolated(rows, opened.abscissa_mm, slid.row)
        centers_mm = placement.across.middle(where_mm.ravel()).reshape(slid.nodes_mm.shape)
        state = opened.contour.about(centers_mm, pieces.nearest(slid.row, len(rows)))
        everywhere = np.ones_like(state.is_terminated)
        if not design.follows_bends:  # the springs of its cells already limit its diameter
            on_wall_mm = laid(slid.nodes_mm.reshape(-1, 3), slid.row.ravel(), slid.column.ravel())
            state = replace(state, nodes_mm=on_wall_mm.reshape(slid.nodes_mm.shape) + slid.lift_mm)
            return Opened(self.contour.classify(state, everywhere, placement.wall), rows_mm, slid.crowns)
        state, laid_mm = self._laid(placement, replace(state, nodes_mm=slid.nodes_mm), everywhere)
        # Rows on the wall are no wider than the free device, seen along it.
        slid_mm, free_mm = state.nodes_mm, placement.free_mm
        old, new = row_diameters_mm(slid_mm), row_diameters_mm(laid_mm)
        share = np.where(new > free_mm, (free_mm - old) / np.maximum(new - old, 1e-12), 1.0)
        nodes_mm = slid_mm + np.clip(share, 0.0, 1.0)[:, None, None] * (laid_mm - slid_mm)
        middle_mm = nodes_mm.mean(axis=1, keepdims=True)
        shrunk = np.minimum(free_mm / row_diameters_mm(nodes_mm), 1.0)[:, None, None]
        return Opened(replace(state, nodes_mm=middle_mm + shrunk * (nodes_mm - middle_mm)), rows_mm)

    def _between(self, placement: Placement, opened: Opened, points_mm: Floats, row: Floats, column: Floats) -> Floats:
        """Return (n, 3) points between the nodes, put on the wall like their nearest node, in mm."""
        contour, (n, columns) = opened.contour, opened.contour.nodes_mm.shape[:2]
        rows = pieces.nearest(row, n)
        where_mm = pieces.extrapolated(np.arange(n), opened.abscissa_mm, row)
        state = contour.near(points_mm, placement.across.middle(where_mm), rows, np.rint(column).astype(int) % columns)
        # Points of rows that stopped at the free diameter stay in place unless they are outside the wall.
        is_narrow = perimeters(contour.nodes_mm) < FREELY * np.pi * placement.free_mm
        state = replace(state, is_terminated=state.is_terminated & is_narrow[rows, None])
        return self._laid(placement, state, np.ones_like(state.is_terminated))[1].reshape(-1, 3)

    def _stepped(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device after one step of the contour; a row that reaches the free diameter stops there."""
        before, after = opened.contour, self.contour.step(opened.contour, placement.wall)
        nodes_mm, is_stopped = grown(before.nodes_mm, after.nodes_mm, placement.free_mm)
        after = replace(after, nodes_mm=nodes_mm, is_terminated=after.is_terminated | is_stopped)
        return replace(opened, contour=after)

    def _moved(self, placement: Placement, opened: Opened, rows_mm: Floats) -> Opened:
        """Return the device with its rows at `rows_mm` (rows,), its shape kept and its nodes evenly spaced."""
        across, state, before_mm = placement.across, opened.contour, opened.abscissa_mm
        in_plane_mm = evenly_spaced(across.coordinates(before_mm, state.nodes_mm))
        inside_mm = np.clip(rows_mm, before_mm[0], before_mm[-1])
        nodes_mm = across.place(rows_mm, pieces.extrapolated(before_mm, in_plane_mm, inside_mm))
        near = np.rint(np.interp(rows_mm, before_mm, np.arange(len(before_mm)))).astype(int)
        centers_mm = np.broadcast_to(across.middle(rows_mm)[:, None], nodes_mm.shape)
        state = state.about(centers_mm, np.broadcast_to(near[:, None], nodes_mm.shape[:2]))
        # Only rows beyond the old ends have no measured shape: they are put to the wall now, all others in `result`.
        is_asked = np.broadcast_to((rows_mm != inside_mm)[:, None], nodes_mm.shape[:2])
        state, laid_mm = self._laid(placement, replace(state, nodes_mm=nodes_mm), is_asked)
        return Opened(replace(state, nodes_mm=grown(state.nodes_mm, laid_mm, placement.free_mm)[0]), rows_mm)

    def _laid(self, placement: Placement, state: State, is_asked: Bools) -> tuple[State, Floats]:
        """Return the contour with the nodes in `is_asked` inside the wall, and all nodes as they lie on the wall."""
        # Terminated nodes return to the wall (eq. 6, 7). Moving nodes do so only if outside or nearer than dd.
        held = state.is_terminated & is_asked
        state = self.contour.classify(state, is_asked, placement.wall)
        points_mm = state.nodes_mm.reshape(-1, 3)
        is_off = held.ravel() & (state.contact.distance_mm > self.contour.dd_mm)
        back_mm = self.contour.relocated_mm(points_mm, np.zeros_like(is_off), state.contact)
        return state, np.where(is_off[:, None], back_mm, points_mm).reshape(state.nodes_mm.shape)
