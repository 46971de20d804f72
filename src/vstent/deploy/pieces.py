"""Pieces: crossings slide along the wall until every piece of wire between two of them is as long as it was made.

In a bend, rows that lie in planes across the axis stretch the wires outside and press them together inside. Wires do
not stretch: columns come closer together outside, where rows are farther apart, and spread inside, and rows tilt. The
crossings x (coordinates on the contour, mm) are those of least

    sum over pieces of (length - length as made)^2  +  sum over crossings of (RESISTANCE |x - x of the plane rows|)^2
    +  sum over neighbours in a row of (CROWDING times how much nearer together or further apart they come)^2

by Gauss-Newton steps, each a damped least-squares problem (LSMR: Fong and Saunders 2011). The second term picks the
nearest among the many nets that wires of fixed length allow; the third keeps cells open where none exists: outside a
bend so tight that the straightened wire is still too short. Rows may tilt and bend but stay where they are in the
mean: where they lie is the business of `vstent.deploy.braid.march`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple, Self, final

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsmr

from vstent.device import Design, Grid, Size, grid, piece_length_mm
from vstent.kernels.arrays import Floats, Ints

RESISTANCE: Final = 0.03
"""How much a crossing that slides weighs against a piece of wire that stretches by as much."""
CROWDING: Final = {"braid": 0.1, "laser_cut": 0.5}
"""How much neighbours in a row that come nearer together weigh against a piece of wire that stretches by as much.

The least that keeps every cell open in tight siphons; cells whose struts are joined resist more than wires that cross.
"""
STEPS: Final = 5
"""Gauss-Newton steps at most."""
GAIN: Final = 0.02
"""Less gained by a step, relative, ends them."""
TOLERANCE: Final = 3e-3
"""Of every least-squares problem."""
SHORTEST_STEP: Final = 0.1
"""A step that does not help is halved down to this."""


class Slid(NamedTuple):
    """A contour whose crossings have slid."""

    nodes_mm: Floats
    """(rows, columns, 3) nodes."""
    row: Floats
    """(rows, columns) where on the old contour every node lies, in rows."""


def slide(design: Design, size: Size, nodes_mm: Floats) -> Slid:
    """Let the crossings of a device slide on its contour (rows, columns, 3); nodes between them go along."""
    shape = grid(design, size)
    continued_mm = _continued(nodes_mm)
    net = _relaxed(_Net.on(continued_mm, shape, piece_length_mm(design, size), CROWDING[design.kind]))
    row = np.arange(shape.rows)[:, None] + _spread(net.shift_rows, net, shape)
    column = np.arange(shape.columns) + _spread(net.shift_columns, net, shape)
    return Slid(_bilinear(continued_mm, row + 1, column), row)


def _continued(nodes_mm: Floats) -> Floats:
    """Put one more row before and behind a contour, shaped as its end: a tilted end reaches a little beyond it."""
    middle_mm = nodes_mm.mean(axis=1)
    before = nodes_mm[:1] - (middle_mm[1] - middle_mm[0])
    behind = nodes_mm[-1:] + (middle_mm[-1] - middle_mm[-2])
    return np.concatenate([before, nodes_mm, behind])


def extrapolated(known: Floats | Ints, values: Floats, wanted: Floats) -> Floats:
    """Linear interpolation of values (n,) at increasing places (n,), going on in a straight line beyond the ends."""
    i = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, len(known) - 2)
    share = (wanted - known[i]) / (known[i + 1] - known[i])
    return (1 - share) * values[i] + share * values[i + 1]


@final
@dataclass(frozen=True, eq=False)
class _Net:
    """Crossings on a contour, and the pieces of wire between them."""

    chart: Floats
    """(rows + 2, columns, 9) the continued contour they slide on: nodes, derivatives by row and by column."""
    line: Ints
    """(c,) lattice row of every crossing."""
    beside: Ints
    """(c,) next crossing in the same row."""
    row: Ints
    """(c,) row of the continued contour on which every crossing lay before it slid."""
    column: Ints
    """(c,) node column."""
    ends: Ints
    """(2, p) crossings at the two ends of every piece."""
    length_mm: float
    """Length of a piece as made."""
    crowding: float
    """The device's weight of CROWDING."""
    spacing_mm: tuple[float, ...]
    """Median distance of neighbouring node rows and node columns."""
    slid_mm: Floats
    """(2 c,) how far every crossing has slid, along rows first, then along columns."""

    @classmethod
    def on(cls, nodes_mm: Floats, shape: Grid, length_mm: float, crowding: float) -> Self:
        """Put the crossings of a continued contour where lattice rows and columns of one parity meet."""
        rows, columns = shape.lattice_rows, shape.lattice_columns
        i, j = np.nonzero(np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0)
        number = np.full((rows, columns), -1)
        number[i, j] = np.arange(len(i))
        first, beside = np.flatnonzero(i < rows - 1), number[i, (j + 2) % columns]
        ends = [[first, number[i[first] + 1, (j[first] + hand) % columns]] for hand in (1, -1)]
        row, column = i * shape.row_split + 1, j * shape.column_split
        along_mm = np.gradient(nodes_mm, axis=0)
        around_mm = 0.5 * (np.roll(nodes_mm, -1, axis=1) - np.roll(nodes_mm, 1, axis=1))
        spacing_mm = tuple(float(np.median(np.linalg.norm(side, axis=2))) for side in (along_mm, around_mm))
        chart = np.concatenate([nodes_mm, along_mm / spacing_mm[0], around_mm / spacing_mm[1]], axis=2)
        return cls(
            chart,
            i,
            beside,
            row,
            column,
            np.concatenate(ends, axis=1),
            length_mm,
            crowding,
            spacing_mm,
            np.zeros(2 * len(i)),
        )

    @property
    def shift_rows(self) -> Floats:
        """(c,) how far every crossing has slid along the device, in node rows."""
        return self.slid_mm[: len(self.row)] / self.spacing_mm[0]

    @property
    def shift_columns(self) -> Floats:
        """(c,) how far every crossing has slid round the device, in node columns."""
        return self.slid_mm[len(self.row) :] / self.spacing_mm[1]

    @cached_property
    def _places(self) -> Floats:
        """Points of the crossings and their derivatives by how far they slide along rows and columns, (3, c, 3)."""
        found = _bilinear(self.chart, self.row + self.shift_rows, self.column + self.shift_columns)
        return found.reshape(-1, 3, 3).transpose(1, 0, 2)

    @cached_property
    def _pieces(self) -> tuple[Floats, Floats]:
        """Unit directions (p, 3) of the pieces and by how much they are too long (p,)."""
        first, last = self.ends
        vector = self._places[0][last] - self._places[0][first]
        length = np.linalg.norm(vector, axis=1)
        return vector / length[:, None], length - self.length_mm

    @property
    def excess_mm(self) -> Floats:
        """(p,) by how much every piece is longer than it was made."""
        return self._pieces[1]

    @cached_property
    def cost_mm2(self) -> float:
        """What the crossings minimise."""
        around_mm = self.slid_mm[len(self.row) :]
        nearer_mm = around_mm[self.beside] - around_mm
        terms = (1.0, self.excess_mm), (RESISTANCE, self.slid_mm), (self.crowding, nearer_mm)
        return float(sum(weight**2 * np.vdot(values, values) for weight, values in terms))

    def jacobian(self) -> csr_array:
        """Derivatives by the sliding (p + rows + c, 2 c): lengths of pieces, means of rows, how neighbours part."""
        (first, last), (direction, _) = self.ends, self._pieces
        crossings, each = len(self.row), np.arange(self.ends.shape[1])
        values = [
            sign * np.einsum("pk,pk->p", direction, tangent[end])
            for sign, end in ((1, last), (-1, first))
            for tangent in self._places[1:]
        ]
        where = [end + half for end in (last, first) for half in (0, crossings)]
        count, number = np.bincount(self.line), np.arange(crossings)
        crowded = np.full(crossings, self.crowding)
        entries = np.concatenate([*values, 1 / np.sqrt(count[self.line]), crowded, -crowded])
        means = len(each) + self.line
        neighbours = len(each) + len(count) + number
        rows = np.concatenate([np.tile(each, 4), means, neighbours, neighbours])
        columns = np.concatenate([*where, number, crossings + self.beside, crossings + number])
        return csr_array((entries, (rows, columns)), shape=(neighbours[-1] + 1, 2 * crossings))

    def moved(self, slid_mm: Floats) -> Self:
        """Return the net slid so far (2 c,), its rows kept where they are in the mean."""
        along = slid_mm[: len(self.row)]
        mean_mm = np.bincount(self.line, along) / np.bincount(self.line)
        return replace(self, slid_mm=np.concatenate([along - mean_mm[self.line], slid_mm[len(self.row) :]]))


def _relaxed(net: _Net) -> _Net:
    for _ in range(STEPS):
        jacobian = net.jacobian()
        target = np.zeros(jacobian.shape[0])
        pieces = slice(len(net.excess_mm))
        target[pieces] = (jacobian @ net.slid_mm)[pieces] - net.excess_mm
        wanted_mm = lsmr(jacobian, target, damp=RESISTANCE, atol=TOLERANCE, btol=TOLERANCE, maxiter=60)[0]
        better = _better(net, wanted_mm)
        if better is None:
            break
        gain = 1 - better.cost_mm2 / max(net.cost_mm2, 1e-300)
        net = better
        if gain < GAIN:
            break
    return net


def _better(net: _Net, wanted_mm: Floats) -> _Net | None:
    """Go towards the place wanted, half as far as long as that does not help; None where nothing helps."""
    share = 1.0
    while share > SHORTEST_STEP:
        tried = net.moved(net.slid_mm + share * (wanted_mm - net.slid_mm))
        if tried.cost_mm2 < net.cost_mm2:
            return tried
        share *= 0.5
    return None


def _spread(values: Floats, net: _Net, shape: Grid) -> Floats:
    """Values (rows, columns) at every node from those at the crossings (c,).

    A pore's middle gets the mean of the crossings round it; nodes between rows and columns of the lattice get what is
    linear between them.
    """
    known = np.zeros((2, shape.lattice_rows, shape.lattice_columns))
    known[:, net.line, net.column // shape.column_split] = values, np.ones_like(values)
    beside = np.roll(known, 1, axis=2) + np.roll(known, -1, axis=2)
    beside[:, 1:] += known[:, :-1]
    beside[:, :-1] += known[:, 1:]
    lattice = np.where(known[1] > 0, known[0], beside[0] / np.maximum(beside[1], 1.0))
    row = np.arange(shape.rows)[:, None] / shape.row_split
    column = np.arange(shape.columns)[None] / shape.column_split
    return _bilinear(lattice[..., None], *np.broadcast_arrays(row, column))[..., 0]


def _bilinear(grid_values: Floats, row: Floats, column: Floats) -> Floats:
    """Values (..., d) of a grid (n, m, d), periodic in its columns; beyond the rows it goes on in straight lines."""
    n, m = grid_values.shape[:2]
    i = np.clip(np.floor(row).astype(int), 0, n - 2)
    j = np.floor(column).astype(int)
    down, right = (row - i)[..., None], (column - j)[..., None]
    j, beyond = j % m, (j + 1) % m
    above = (1 - right) * grid_values[i, j] + right * grid_values[i, beyond]
    below = (1 - right) * grid_values[i + 1, j] + right * grid_values[i + 1, beyond]
    return (1 - down) * above + down * below
