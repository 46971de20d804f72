"""Flow rates between the cells of a computed flow, balanced in every cell: what carries the contrast."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from vstent.angiography.balance import Balancer
from vstent.errors import FlowError
from vstent.flow import domain as domains
from vstent.flow.case import FlowCase, FlowField, Level
from vstent.flow.sampling import uniform
from vstent.geometry.surface import Surface
from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints, freeze, unique_rows

MM3_PER_ML: Final = 1e3
"""Cubic millimeters in a milliliter."""
ALONG_AXES: Final = (1, 3, 5)
"""Numbers of the lattice directions along +x, +y and +z."""


@dataclass(frozen=True, eq=False)
class Network:
    """Cells of blood and the flow rates through the faces between them, at one moment or at several of a cycle.

    Faces to an opening have a number from n upwards on that side: n + k for opening k.
    """

    cells: Ints
    """(n, 3) grid coordinates, in cells of the flow; of a block of cells, its first."""
    width: Ints
    """(n,) edge of each cell or block, in cells of the flow."""
    spacing_mm: float
    """Edge of a cell of the flow."""
    points_mm: Floats
    """(n, 3) center of the blood in each cell, LPS."""
    volume_mm3: Floats
    """(n,) volume of blood in each cell."""
    left: Ints
    """(f,) cell on the lower side of each face."""
    right: Ints
    """(f,) cell on the upper side."""
    axis: Ints
    """(f,) axis across each face: 0, 1 or 2."""
    flux_mm3_s: Floats
    """(p, f) flow rate to the upper side, for every stored moment."""
    time_s: Floats
    """(p,) moments, from 0; only 0 for a steady flow."""
    period_s: float
    """Length of a cycle; inf for a steady flow."""
    openings: int
    """Number of openings, inlets first."""
    inlets: int
    """Number of inlets."""
    correction_fraction: float
    """Root mean square of the change that balances the flow rates, relative to theirs."""

    def __post_init__(self) -> None:
        n = len(self.cells)
        freeze(self, "cells", np.int32, (n, 3))
        freeze(self, "width", np.int32, (n,))
        freeze(self, "points_mm", np.float64, (n, 3))
        freeze(self, "volume_mm3", np.float64, (n,))
        freeze(self, "left right", np.int32, (len(self.left),))
        freeze(self, "axis", np.int8, (len(self.left),))
        freeze(self, "time_s", np.float64, (-1,))
        freeze(self, "flux_mm3_s", np.float64, (len(self.time_s), len(self.left)))

    @property
    def edge_mm(self) -> Floats:
        """Edge (n,) of a cube with the volume of blood of each cell."""
        edge_mm: Floats = np.cbrt(self.volume_mm3)
        return edge_mm

    @property
    def area_mm2(self) -> Floats:
        """Area (f,) of every face: the square of the narrower of its two cells."""
        width = np.r_[self.width, np.full(self.openings, np.iinfo(np.int32).max)]
        return np.square(np.minimum(width[self.left], width[self.right]) * self.spacing_mm)

    @cached_property
    def outflow_per_s(self) -> Floats:
        """Flow rate (n,) out of each cell, at most over the cycle, divided by its volume."""
        n = len(self.cells)
        most = np.zeros(n)
        for flux in self.flux_mm3_s:
            leaves = np.bincount(self.left, np.maximum(flux, 0), n + self.openings)
            leaves += np.bincount(self.right, np.maximum(-flux, 0), n + self.openings)
            most = np.maximum(most, leaves[:n])
        return most / self.volume_mm3

    @property
    def at_openings(self) -> tuple[Ints, Ints, Floats]:
        """Faces (b,) of openings, the opening (b,) of each, and the sign (b,) of a flow out of the vessel."""
        n = len(self.cells)
        faces = np.flatnonzero((self.left >= n) | (self.right >= n))
        leaves = self.right[faces] >= n
        return faces, np.where(leaves, self.right[faces], self.left[faces]) - n, np.where(leaves, 1.0, -1.0)

    def through_mL_s(self) -> Floats:
        """Return the flow rate (p, o) out of the vessel through every opening, negative into it."""
        faces, opening, sign = self.at_openings
        rows = [np.bincount(opening, sign * flux[faces], self.openings) for flux in self.flux_mm3_s]
        return np.array(rows) / MM3_PER_ML

    def merged(self, chosen: Bools) -> "Network":
        """Return the network with blocks of 2 x 2 x 2 of the chosen cells (n,); its flow rates balance too.

        Cells of a block that is not chosen as a whole stay as they are.
        """
        n, wide = len(self.cells), 2 * self.width[:, None]
        block, of_block = unique_rows(np.c_[self.cells // wide * wide, wide])
        stays = np.zeros(len(block), dtype=bool)
        stays[of_block[~chosen]] = True
        whole = ~stays[of_block]
        corner = np.where(whole[:, None], self.cells // wide * wide, self.cells)
        found, label = unique_rows(np.c_[corner, np.where(whole, wide[:, 0], self.width)])
        count, label = len(found), np.r_[label, len(found) + np.arange(self.openings)]
        left, right = label[self.left].astype(np.int64), label[self.right].astype(np.int64)
        between = left != right
        key = (left[between] * (count + self.openings) + right[between]) * 3 + self.axis[between]
        kept, place = np.unique(key, return_inverse=True)
        flux = [np.bincount(place.ravel(), one[between], len(kept)) for one in self.flux_mm3_s]
        volume_mm3 = np.bincount(label[:n], self.volume_mm3, count)
        points = [np.bincount(label[:n], self.volume_mm3 * x, count) / volume_mm3 for x in self.points_mm.T]
        return replace(
            self,
            cells=found[:, :3],
            width=found[:, 3],
            points_mm=np.stack(points, axis=1),
            volume_mm3=volume_mm3.astype(np.float64),
            left=kept // 3 // (count + self.openings),
            right=kept // 3 % (count + self.openings),
            axis=kept % 3,
            flux_mm3_s=np.array(flux),
        )

    def within(self, chosen: Bools) -> "Network":
        """Return the network of some cells (n,); what leaves them leaves through one opening."""
        n = int(chosen.sum())
        number = np.full(len(chosen) + self.openings, n, dtype=np.int64)
        number[: len(chosen)][chosen] = np.arange(n)
        kept = (number[self.left] < n) | (number[self.right] < n)
        return replace(self.taken(chosen, kept, number), openings=1, inlets=0)

    def taken(self, cells: Ints | Bools, faces: Ints | Bools, number: Ints) -> "Network":
        """Return the network of some cells and faces, in their order, given the new number (n + openings,) of each."""
        return replace(
            self,
            cells=self.cells[cells],
            width=self.width[cells],
            points_mm=self.points_mm[cells],
            volume_mm3=self.volume_mm3[cells],
            left=number[self.left[faces]],
            right=number[self.right[faces]],
            axis=self.axis[faces],
            flux_mm3_s=self.flux_mm3_s[:, faces],
        )


def network(case: FlowCase, field: FlowField) -> Network:
    """Return the balanced flow rates between the cells of a flow.

    The flow rate through a face is the mean velocity of its two cells times its area. Walls are closed, also walls
    thinner than a cell. The openings carry the flow rates of the result. The smallest change (least squares) that
    balances every cell is added, because the contrast would otherwise exceed its bounds.
    """
    field = uniform(field)
    grid, n_inlets = field.finest, len(case.vessel.inlets)
    surface, face_patch, _ = domains.extend(case.vessel)
    neighbour = grid.neighbours()
    is_open = neighbour >= 0
    is_open[domains.septa(surface, neighbour, grid)] = False
    left, axis = np.nonzero(is_open[:, ALONG_AXES])
    right = neighbour[left, 2 * axis + 1]
    mouths = _mouths(case, grid, neighbour, surface, face_patch)
    part = triangles.joined(np.stack([left, right], axis=1), len(grid.cells))
    kept = np.isin(part, part[mouths[mouths[:, 3] < n_inlets, 0]])
    if not kept.any():
        raise FlowError("no cell of the flow lies at an inlet, so no contrast can enter: compute the flow again")
    number, between = np.cumsum(kept) - 1, kept[left] & kept[right]
    left, right, axis = number[left[between]], number[right[between]], axis[between]
    open_cell, open_axis, sign, opening = mouths[kept[mouths[:, 0]]].T
    open_cell = number[open_cell]
    cells, h = grid.cells[kept], grid.cell_size_mm
    n, solve, guess = len(cells), Balancer(cells, left, right), None
    rows, change, size = [], 0.0, 0.0
    for moment in field.moments():
        velocity = moment.finest.velocity_m_s[kept]
        inner = 0.5 * (velocity[left, axis] + velocity[right, axis]) * h**2 * MM3_PER_ML
        # An outlet that no cell reaches carries nothing; the others take the inflow.
        is_reached = np.isin(n_inlets + np.arange(len(moment.outlets_mL_s)), opening)
        outlets_mL_s = np.where(is_reached, moment.outlets_mL_s, 0.0)
        through_mL_s = np.r_[-moment.inlets_mL_s, outlets_mL_s * (moment.inflow_mL_s / outlets_mL_s.sum())]
        out = _outflow(sign * velocity[open_cell, open_axis], opening, through_mL_s)
        fixed, guess = solve(inner, -np.bincount(open_cell, out, n).astype(np.float64), guess)
        change, size = change + ((fixed - inner) ** 2).sum(), size + (inner**2).sum()
        rows.append(np.r_[fixed, sign * out])
    beyond = n + opening
    return Network(
        cells=cells,
        width=np.ones(n, dtype=np.int32),
        spacing_mm=h,
        points_mm=grid.centers_mm[kept],
        volume_mm3=np.full(n, h**3),
        left=np.r_[left, np.where(sign > 0, open_cell, beyond)],
        right=np.r_[right, np.where(sign > 0, beyond, open_cell)],
        axis=np.r_[axis, open_axis],
        flux_mm3_s=np.array(rows),
        time_s=np.array([phase.time_s for phase in field.phases] or [0.0]),
        period_s=period_s(field),
        openings=len(case.vessel.openings),
        inlets=n_inlets,
        correction_fraction=float(np.sqrt(change / size)),
    )


def _outflow(out: Floats, opening: Ints, through_mL_s: Floats) -> Floats:
    """Return the flow rate (b,) out of faces, as their speed out has it and in total as each opening has it."""
    rates = np.zeros(len(out))
    for k, total in enumerate(through_mL_s):
        own = opening == k
        part = np.maximum(np.sign(total) * out[own], 0.0)
        if own.any():
            rates[own] = MM3_PER_ML * total * (part / part.sum() if part.sum() > 0 else 1 / own.sum())
    return rates


def _mouths(case: FlowCase, grid: Level, neighbour: Ints, surface: Surface, face_patch: Ints) -> Ints:
    """Return cell, axis, sign of the way out and opening (b, 4) of the faces at openings."""
    cell, direction = np.nonzero(neighbour[:, 1:7] < 0)
    axis, sign = direction // 2, 1 - 2 * (direction % 2)
    middle = grid.centers_mm[cell]
    middle[np.arange(len(cell)), axis] += 0.5 * sign * grid.cell_size_mm
    near = np.zeros(len(cell), dtype=bool)
    for mouth in case.vessel.openings:
        near |= (middle - mouth.center_mm) @ mouth.normal > -grid.cell_size_mm
    cell, axis, sign, middle = cell[near], axis[near], sign[near], middle[near]
    patch = face_patch[surface.closest(middle)[2]]
    is_mouth = patch > 0
    return np.stack([cell, axis, sign, patch - 1], axis=1)[is_mouth]


def period_s(field: FlowField) -> float:
    """Return the length of the cycle of a pulsatile flow, inf for a steady one."""
    if len(field.phases) < 2:
        return float("inf")
    return (field.phases[1].time_s - field.phases[0].time_s) * len(field.phases)
