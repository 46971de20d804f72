"""Pieces: crossings slide along the wall until every piece of wire between two of them is as long as it was made.

In a bend, rows that lie in planes across the axis stretch the wires outside and press them together inside. Wires do
not stretch: columns come closer together outside, where rows are farther apart, and spread inside, rows tilt, and all
of them move nearer together: what a bend takes from the wires' room round the device, its length gives. The crossings
are those of `vstent.kernels.net`: pieces of wire of the right length first, then the nearest among the many nets that
allow it, with cells kept open where none does: outside a bend so tight that the straightened wire is still too short.
Joints of a laser-cut device are those of `vstent.deployment.cells`: they may leave the wall.
"""

from functools import cache
from typing import Final, NamedTuple

import numpy as np

from vstent.deployment import cells
from vstent.deployment.contour import normals
from vstent.devices.design import Design, LaserCut, Size, piece_length_mm
from vstent.devices.formulas import Grid, grid
from vstent.kernels import net
from vstent.kernels.arrays import Floats, Ints

RESISTANCE: Final = 0.01
"""How much a crossing that slides out of its row weighs against a piece of wire that stretches by as much."""
CROWDING: Final = 0.1
"""How much neighbours in a row that come nearer together weigh against a piece of wire that stretches by as much.

The least that keeps every cell open in tight siphons.
"""
STIFFNESS: Final = 0.1
"""How much a wire that bends otherwise weighs against a piece of wire that stretches by as much."""
DESCENT: Final = net.Descent(steps=8, gain=0.03, tolerance=0.2)
"""When the crossings have gone far enough."""


class Slid(NamedTuple):
    """A contour whose crossings have slid."""

    nodes_mm: Floats
    """(rows, columns, 3) nodes."""
    row: Floats
    """(rows, columns) where on the old contour every node lies, in rows."""
    column: Floats
    """(rows, columns) and in columns."""
    lift_mm: Floats
    """(rows, columns, 3) by how much, and where to, nodes leave the wall."""


def slide(design: Design, size: Size, nodes_mm: Floats, held: int, laid: cells.Laid) -> Slid:
    """Let the crossings of a device slide on its contour (rows, columns, 3); nodes between them go along.

    In the mean, row number `held` of the nodes stays where it is. `laid` puts points from between the contour's nodes
    on to the wall: joints of a laser-cut device heed it.
    """
    shape = grid(design, size)
    continued_mm = _continued(nodes_mm)
    along_mm = np.gradient(continued_mm, axis=0)
    around_mm = 0.5 * (np.roll(continued_mm, -1, axis=1) - np.roll(continued_mm, 1, axis=1))
    spacing_mm = np.array([np.median(np.linalg.norm(side, axis=2)) for side in (along_mm, around_mm)])
    chart = np.concatenate([continued_mm, along_mm / spacing_mm[0], around_mm / spacing_mm[1]], axis=2)
    lattice = _lattice(shape)
    pieces = net.Net(
        chart,
        lattice.row + 1,
        lattice.column,
        lattice.line,
        lattice.beside,
        lattice.ends,
        spacing_mm,
        _bulge_mm2(nodes_mm[:: shape.row_split, :: shape.column_split]),
        lattice.bends,
    )
    length_mm, held_line = piece_length_mm(design, size), held / shape.row_split
    if isinstance(design, LaserCut):
        width_mm = size.free_diameter_mm * np.sin(2 * np.pi / design.n_columns)
        moves_mm = cells.relax(pieces, length_mm, width_mm, held_line, lambda p, row, column: laid(p, row - 1, column))
    else:
        weights = net.Weights(length_mm, RESISTANCE, CROWDING, STIFFNESS, round(held_line))
        moves_mm = np.pad(net.slide(pieces, weights, DESCENT), ((0, 0), (0, 1)))
    rows, columns, off_mm = (_spread(moves, lattice, shape) for moves in (moves_mm / [*spacing_mm, 1.0]).T)
    row, column = np.arange(shape.rows)[:, None] + rows - rows[held].mean(), np.arange(shape.columns) + columns
    lift_mm = -off_mm[..., None] * _bilinear(normals(continued_mm), row + 1, column)
    return Slid(_bilinear(continued_mm, row + 1, column), row, column, lift_mm)


def _bulge_mm2(nodes_mm: Floats) -> Floats:
    """By how much (rows,) the wall's arc from column to column exceeds its chord, both squared, in the mean.

    An arc exceeds its chord by 8/3 of the squared height over it; four points in a row show the height.
    """
    ahead = np.roll(nodes_mm, -1, axis=1)
    bend_mm = nodes_mm + ahead - np.roll(nodes_mm, 1, axis=1) - np.roll(ahead, -1, axis=1)
    return 16 / 3 * ((bend_mm / 16) ** 2).sum(axis=2).mean(axis=1)


class _Lattice(NamedTuple):
    """Crossings of a device and the pieces of wire between them."""

    line: Ints
    """(c,) lattice row of every crossing."""
    row: Ints
    """(c,) and its row of nodes."""
    column: Ints
    """(c,) and its column of nodes."""
    beside: Ints
    """(c,) next crossing in the same row."""
    ends: Ints
    """(2, p) crossings at the two ends of every piece."""
    bends: Ints
    """(3, b) every three crossings that follow on each other on a wire."""


@cache
def _lattice(shape: Grid) -> _Lattice:
    """Crossings lie where lattice rows and columns of one parity meet."""
    rows, columns = shape.lattice_rows, shape.lattice_columns
    line, column = np.nonzero(np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0)
    number = np.full((rows, columns), -1)
    number[line, column] = np.arange(len(line))
    first, beside = np.flatnonzero(line < rows - 1), number[line, (column + 2) % columns]
    ends = [[first, number[line[first] + 1, (column[first] + hand) % columns]] for hand in (1, -1)]
    # Pieces of one row after the other: what a loop over them reads lies close together.
    both = np.array(ends).transpose(1, 2, 0).reshape(2, -1)
    inner = np.flatnonzero((line > 0) & (line < rows - 1))
    ways = [
        [number[line[inner] + way, (column[inner] + way * hand) % columns] for way in (-1, 0, 1)] for hand in (1, -1)
    ]
    bends = np.array(ways).transpose(1, 2, 0).reshape(3, -1)
    row, column = line * shape.row_split, column * shape.column_split
    numbers = [values.astype(np.uint32, order="C") for values in (line, beside, both, bends)]
    return _Lattice(numbers[0], row, column, *numbers[1:])


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


def _spread(values: Floats, crossings: _Lattice, shape: Grid) -> Floats:
    """Values (rows, columns) at every node from those at the crossings (c,).

    A pore's middle gets the mean of the crossings round it; nodes between rows and columns of the lattice get what is
    linear between them.
    """
    known = np.zeros((2, shape.lattice_rows, shape.lattice_columns))
    known[:, crossings.line, crossings.column // shape.column_split] = values, np.ones_like(values)
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
