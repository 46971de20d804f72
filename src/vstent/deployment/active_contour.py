"""The active contour of Zhong et al. 2016: a closed tube of nodes that grows until it meets the wall (eq. 1-7)."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final, final

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from vstent.deployment.contour import normals
from vstent.deployment.wall import ON_WALL_MM, AbstractWall, Contact
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints

SAFELY: Final = 1 - 1e-9
"""Balls without a wall in them are taken smaller by this, so that rounding cannot hide a crossing."""


@final
@dataclass(frozen=True, eq=False)
class Stiffness:
    """The factored matrix I + tau K of the internal energy on a grid that is free in s and periodic in r.

    The variation of eq. (2) is K v = -a1 v_ss + a2 v_ssss - a3 v_rr + a4 v_rrrr + 2 a5 v_ssrr, grid spacing 1. K is
    block-circulant in r: after a Fourier transform in r every harmonic is a pentadiagonal matrix in s; all of them
    lie one after another in one banded Cholesky factor.
    """

    factor: Floats
    """(3, harmonics x rows) banded Cholesky factor, upper form."""
    rows: int
    """Nodes along s."""
    columns: int
    """Nodes around r."""

    @staticmethod
    @lru_cache(maxsize=8)
    def of(contour: "ActiveContour", rows: int, columns: int) -> "Stiffness":
        """Factor I + tau K once for a grid."""
        wave = 2 - 2 * np.cos(2 * np.pi * np.arange(columns // 2 + 1) / columns)
        tension, bending = _free_differences(rows, 1), _free_differences(rows, 2)
        identity = np.zeros((3, rows))
        identity[2] = 1.0
        bands = [
            (1 + contour.tau * (contour.a3 * w + contour.a4 * w**2)) * identity
            + contour.tau * (contour.a1 + 2 * contour.a5 * w) * tension
            + contour.tau * contour.a2 * bending
            for w in wave
        ]
        return Stiffness(cholesky_banded(np.concatenate(bands, axis=1)), rows, columns)

    def solve(self, right_mm: Floats) -> Floats:
        """Return v with (I + tau K) v = right, both (rows, columns, 3)."""
        waves = np.fft.rfft(right_mm, axis=1).transpose(1, 0, 2)
        flat = waves.reshape(-1, 3)
        solved = cho_solve_banded(
            (self.factor, False), np.concatenate([flat.real, flat.imag], axis=1), check_finite=False
        )
        found = (solved[:, :3] + 1j * solved[:, 3:]).reshape(waves.shape)
        return np.fft.irfft(found.transpose(1, 0, 2), n=self.columns, axis=1)


def _free_differences(rows: int, order: int) -> Floats:
    """Bands (3, rows), upper form, of D^T D for differences D of an order: energy of a curve with free ends."""
    stencil = (-1.0, 1.0) if order == 1 else (1.0, -2.0, 1.0)
    bands = np.zeros((3, rows))
    for i, left in enumerate(stencil):
        for j, right in enumerate(stencil[i:], start=i):
            bands[2 - (j - i), j : max(j, rows - order + j)] += left * right
    return bands


@final
@dataclass(frozen=True, eq=False)
class State:
    """The contour between two iterations."""

    nodes_mm: Floats
    """(rows, columns, 3) nodes."""
    centers_mm: Floats
    """(rows, columns, 3) fiducial point inside the lumen for every node: its row's center, the paper's "center"."""
    clearance_mm: Floats
    """(rows, columns) no wall is nearer to the fiducial point than this."""
    is_terminated: Bools
    """(rows, columns) nodes that no longer move."""
    contact: Contact
    """The nearest wall of every node, flattened to (rows * columns,)."""
    stiffness: Stiffness
    """I + tau K, factored."""

    def about(self, centers_mm: Floats, rows: Ints) -> "State":
        """Return the contour with other fiducial points (rows, columns, 3), each near that of a row (rows, columns).

        The clearance falls off from there no faster than one moves away.
        """
        off_mm = curves.lengths(centers_mm - self.centers_mm[rows, 0])
        return replace(self, centers_mm=centers_mm, clearance_mm=np.maximum(self.clearance_mm[rows, 0] - off_mm, 0.0))

    def near(self, points_mm: Floats, centers_mm: Floats, rows: Ints, columns: Ints) -> "State":
        """Return points (n, 3) with fiducial points (n, 3) as a contour of one column; each is near one of the nodes.

        Whether it terminated, and on what wall, is what that node, at (n,) rows and columns, did.
        """
        number = rows * self.nodes_mm.shape[1] + columns
        return replace(
            self.about(centers_mm[:, None], rows[:, None]),
            nodes_mm=points_mm[:, None],
            is_terminated=self.is_terminated[rows, columns][:, None],
            contact=Contact(*(values[number] for values in self.contact)),
        )

    @cached_property
    def terminated_fraction(self) -> float:
        """Part of the nodes that no longer move."""
        return float(self.is_terminated.mean())


@final
@dataclass(frozen=True)
class ActiveContour:
    """The paper's contour: eq. (1-7), one explicit force step and one implicit elastic step per iteration.

    The elastic weights act on differences between neighbouring nodes, without units; forces are displacements in mm
    per unit of tau. The defaults are argued from a study (``benchmarks/contour_weights.py``, an artery of lobed
    sections): from no elasticity at all to ten times this much the contour ends on the same wall; at a hundred times
    (tension 1, bending 20) it hangs in front of it, for the tension pulls a tube shut. So the weights are a tenth of
    what changes nothing. k1 below 1 aims short of the wall, so that eq. (7) is for accidents; far below, it creeps (8
    iterations at 0.05) and nodes drift together. k2 only matters close to the wall; from 0.2 on it crowds the nodes.
    See `vstent.deployment.method` for the loop.
    """

    a1: float = 0.01
    """Tension along the device, |v_s|^2."""
    a2: float = 0.02
    """Bending along the device, |v_ss|^2."""
    a3: float = 0.01
    """Tension around the device, |v_r|^2."""
    a4: float = 0.02
    """Bending around the device, |v_rr|^2."""
    a5: float = 0.01
    """Twist, |v_sr|^2; it enters eq. (2) twice."""
    k1: float = 0.8
    """Balloon: part of the distance to the wall that a node goes along the contour's normal, eq. (4)."""
    k2: float = 0.05
    """Vessel: pull straight to the wall, mm, eq. (5)."""
    tau: float = 1.0
    """Length of a step."""
    dd_mm: float = 0.03
    """Distance from the wall at which nodes terminate: the device's wire width, eq. (6, 7)."""
    terminated_goal: float = 0.99
    """Part of the nodes that must terminate."""
    iteration_limit: int = 60
    """Iterations after which the contour gives up."""

    def init(self, nodes_mm: Floats, centers_mm: Floats, clearance_mm: Floats, wall: AbstractWall) -> State:
        """Start from a contour (rows, columns, 3) with row centers (rows, 3) inside the lumen, (rows,) off the wall."""
        shape = nodes_mm.shape
        return State(
            nodes_mm,
            np.broadcast_to(centers_mm[:, None], shape),
            np.broadcast_to(clearance_mm[:, None], shape[:2]),
            np.zeros(shape[:2], dtype=bool),
            wall.contact(nodes_mm.reshape(-1, 3)),
            Stiffness.of(self, shape[0], shape[1]),
        )

    def step(self, state: State, wall: AbstractWall) -> State:
        """Move the nodes that continue, then terminate those that reach the wall or cross it."""
        force_mm = np.where(state.is_terminated[..., None], 0.0, self.force_mm(state))
        moved = state.stiffness.solve(state.nodes_mm + self.tau * force_mm)
        nodes_mm = np.where(state.is_terminated[..., None], state.nodes_mm, moved)
        return self.classify(replace(state, nodes_mm=nodes_mm), ~state.is_terminated, wall)

    def force_mm(self, state: State) -> Floats:
        """Balloon (eq. 4) plus vessel force (eq. 5), (rows, columns, 3)."""
        shape = state.nodes_mm.shape
        distance_mm = state.contact.distance_mm.reshape(shape[:2])[..., None]
        to_wall = -state.contact.inward(state.nodes_mm.reshape(-1, 3)).reshape(shape)
        return self.k1 * distance_mm * normals(state.nodes_mm) + self.k2 * to_wall

    def energy_mm2(self, state: State) -> float:
        """Energy of the contour, eq. (1): the internal energy of eq. (2) and the potential of the forces.

        Along the way to the wall, where the contour's normal points to it, eq. (4, 5) have the potential
        k1 d^2 + 2 k2 d (an iteration descends half of eq. 2, whose variation is 2 K v).
        """
        v = state.nodes_mm
        along, around = np.diff(v, axis=0), np.roll(v, -1, axis=1) - v
        bent = around - np.roll(around, 1, axis=1)
        twisted = np.roll(along, -1, axis=1) - along
        terms = (
            (self.a1, along),
            (self.a2, np.diff(along, axis=0)),
            (self.a3, around),
            (self.a4, bent),
            (2 * self.a5, twisted),
        )
        # No product of vectors: that of numpy wakes threads that then spin, and its last bits depend on how many.
        internal = sum(weight * float((d * d).sum()) for weight, d in terms)
        distance_mm = state.contact.distance_mm
        return internal + float((self.k1 * distance_mm**2 + 2 * self.k2 * distance_mm).sum())

    def classify(self, state: State, is_asked: Bools, wall: AbstractWall) -> State:
        """Sort the nodes asked about (rows, columns) into the paper's three states and relocate those that terminate.

        1. inside and further than dd from the wall: continues; 2. inside and nearer: terminates, eq. (6);
        3. outside (the segment from its row's center crosses the wall): terminates, eq. (7).
        """
        asked = is_asked.ravel()
        points_mm = state.nodes_mm.reshape(-1, 3).copy()
        found = wall.contact(points_mm[asked])
        is_outside = _is_outside(state, asked, found.distance_mm, wall)
        is_done = is_outside | (found.distance_mm <= self.dd_mm)
        relocated = self.relocated_mm(points_mm[asked], is_outside, found)
        points_mm[asked] = np.where(is_done[:, None], relocated, points_mm[asked])
        found = found._replace(distance_mm=np.where(is_done, self.dd_mm, found.distance_mm))
        contact = state.contact.replaced(asked, found)
        is_terminated = state.is_terminated.copy()
        is_terminated[is_asked] |= is_done
        nodes_mm = points_mm.reshape(state.nodes_mm.shape)
        return replace(state, nodes_mm=nodes_mm, is_terminated=is_terminated, contact=contact)

    def relocated_mm(self, points_mm: Floats, is_outside: Bools, contact: Contact) -> Floats:
        """Put points (n, 3) at dd from their closest wall points, on the lumen's side: eq. (6) inside, (7) outside."""
        away = contact.inward(points_mm)
        side = np.where(is_outside & (contact.distance_mm > ON_WALL_MM), -1.0, 1.0)
        return contact.closest_mm + self.dd_mm * side[:, None] * away

    def terminate(self, state: State) -> bool:
        """Tell whether enough nodes have terminated."""
        return state.terminated_fraction >= self.terminated_goal


def _is_outside(state: State, asked: Bools, distance_mm: Floats, wall: AbstractWall) -> Bools:
    """Tell of the nodes asked about, (n,) of all, whether the segment from their center crosses the wall.

    No wall lies within the clearance of the center nor within the distance of the node: only what is left of the
    segment between these two balls is tested, if anything is.
    """
    centers_mm, points_mm = state.centers_mm.reshape(-1, 3)[asked], state.nodes_mm.reshape(-1, 3)[asked]
    clearance_mm = SAFELY * state.clearance_mm.ravel()[asked]
    way_mm = points_mm - centers_mm
    length_mm = curves.lengths(way_mm)
    is_open = clearance_mm + SAFELY * distance_mm < length_mm
    along = (way_mm / np.maximum(length_mm, ON_WALL_MM)[:, None])[is_open]
    starts_mm = centers_mm[is_open] + clearance_mm[is_open, None] * along
    ends_mm = points_mm[is_open] - SAFELY * distance_mm[is_open, None] * along
    is_outside = np.zeros(len(points_mm), dtype=bool)
    is_outside[is_open] = wall.crosses(starts_mm, ends_mm)
    return is_outside
