"""Slide the wire crossings of a device along the wall so that every piece of wire keeps its length.

In a bend, rows that lie in planes across the axis stretch the wires on the outer side and compress them on the inner
side. Real wires do not stretch. On the outer side, where rows are farther apart, columns move closer together. On the
inner side they spread. Rows tilt, and on average they move closer together: in a bend the wires have less room around
the device, so the device is shorter.

Crossings are moved by `vstent.kernels.net`. Its first aim is the right length of all pieces of wire. Many nets of wires
meet it, and among them it takes the one nearest to the original rows. On the outer side of a very tight bend even a
straight wire can be too short. There no net meets the aim, and a penalty keeps the cells open. On the inner side rows
come close together, until neighbouring wires touch.

Joints of a laser-cut device may also leave the wall and are moved by `vstent.deployment.cells`.
"""

from functools import cache
from typing import Final, NamedTuple

import numpy as np

from vstent.deployment import cells
from vstent.deployment.contour import bilinear, normals
from vstent.deployment.crowns import NO_CROWNS, Crowns, Split, free_crowns, split
from vstent.devices.design import Braid, Design, LaserCut, Size, piece_length_mm
from vstent.devices.formulas import Grid, free_diameters_mm, grid, row_spacing_mm
from vstent.kernels import net
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

RESISTANCE: Final = 0.01
"""Weight of a crossing that leaves its row, relative to an equal stretch of a piece of wire, without unit."""
CROWDING: Final = 0.1
"""Weight of neighbours in a row that approach each other, relative to an equal stretch of a piece of wire.

It is the smallest value that keeps every cell open in tight siphons.
"""
STIFFNESS: Final = 0.1
"""Weight of a change in the bending of a wire, relative to an equal stretch of a piece of wire."""
JAMMED: Final = np.sqrt(3)
"""Smallest distance between neighbouring wires of one hand, in wire diameters, as a wire of the other hand passes
between them (Peirce 1937, The geometry of cloth structure, J. Text. Inst. 28:T45: plain weave of round threads)."""
DESCENT: Final = net.Descent(steps=8, gain=0.03, tolerance=0.2)
"""Stopping criteria of the iteration that moves the crossings."""


class Slid(NamedTuple):
    """A contour after its crossings have moved."""

    nodes_mm: Floats
    """(rows, columns, 3) nodes, in mm."""
    row: Floats
    """(rows, columns) fractional row of the original contour at which each node lies."""
    column: Floats
    """(rows, columns) fractional column of the original contour at which each node lies."""
    lift_mm: Floats
    """(rows, columns, 3) displacement of each node from the wall into the lumen, in mm; not included in `nodes_mm`."""
    crowns: Crowns = NO_CROWNS
    """Free crowns of an open-cell device."""


def slide(
    design: Design, size: Size, nodes_mm: Floats, held: int, laid: cells.Laid, is_opening: Bools | None = None
) -> Slid:
    """Move the crossings of a device along its contour until the pieces of wire have their length.

    Nodes (rows, columns, 3) between crossings move with them, and the mean position of the row `held` stays the same.
    For laser-cut devices, `laid` puts points between nodes on the wall, and free crowns of open cells may leave the
    artery where `is_opening` (rows, columns), over a neck or an ostium.
    """
    shape = grid(design, size)
    middle_mm = nodes_mm.mean(axis=1)
    before = nodes_mm[:1] - (middle_mm[1] - middle_mm[0])  # one more row at each end, because tilted ends reach beyond
    behind = nodes_mm[-1:] + (middle_mm[-1] - middle_mm[-2])
    continued_mm = np.concatenate([before, nodes_mm, behind])
    along_mm = np.gradient(continued_mm, axis=0)
    around_mm = 0.5 * (np.roll(continued_mm, -1, axis=1) - np.roll(continued_mm, 1, axis=1))
    spacing_mm = np.array([np.median(np.linalg.norm(side, axis=2)) for side in (along_mm, around_mm)])
    chart = np.concatenate([continued_mm, along_mm / spacing_mm[0], around_mm / spacing_mm[1]], axis=2)
    bulge_mm2 = _bulge_mm2(nodes_mm[:: shape.row_split, :: shape.column_split])
    crossings = _lattice(shape)._replace(chart=chart, spacing=spacing_mm, bulge=bulge_mm2)
    length_mm, held_line, crowns = piece_length_mm(design, size), held / shape.row_split, NO_CROWNS
    if isinstance(design, LaserCut):

        def on_wall(points_mm: Floats, row: Floats, column: Floats) -> Floats:
            return laid(points_mm, row - 1, column)

        free_mm = free_diameters_mm(design, size)[:: shape.row_split]
        width_mm = free_mm * np.sin(2 * np.pi / design.n_columns)
        joint_mm = 2 * design.strut_width_um * MM_PER_UM  # two struts, side by side
        divided = None
        if design.joined_crowns:
            is_free = free_crowns(design, shape)[crossings.line, crossings.column // shape.column_split]
            over = np.zeros_like(is_free) if is_opening is None else is_opening[crossings.row - 1, crossings.column]
            divided = split(crossings, is_free, over)
        moves_mm = cells.relax(crossings, length_mm, width_mm, joint_mm, held_line, on_wall, divided)
        if divided is not None:
            moves_mm, crowns = _parted(crossings, divided, moves_mm, on_wall, shape)
    else:
        assert isinstance(design, Braid)
        # The wires of a short cell are nearly perpendicular to the axis: its length is the distance between them.
        mean_mm = sum(count * diameter_um for count, diameter_um in design.wires) / design.n_wires * MM_PER_UM
        shortest_mm = min(JAMMED * mean_mm, 2 * float(row_spacing_mm(design, size, size.free_diameter_mm)))
        weights = net.Weights(length_mm, RESISTANCE, CROWDING, STIFFNESS, round(held_line), shortest_mm)
        moves_mm = np.pad(net.slide(crossings, weights, DESCENT), ((0, 0), (0, 1)))
    rows, columns, off_mm = (_spread(moves, crossings, shape) for moves in (moves_mm / [*spacing_mm, 1.0]).T)
    row, column = np.arange(shape.rows)[:, None] + rows - rows[held].mean(), np.arange(shape.columns) + columns
    lift_mm = -off_mm[..., None] * bilinear(normals(continued_mm), row + 1, column)
    return Slid(bilinear(continued_mm, row + 1, column), row, column, lift_mm, crowns)


def _parted(
    crossings: net.Net, divided: Split, moves_mm: Floats, on_wall: cells.Laid, shape: Grid
) -> tuple[Floats, Crowns]:
    """Return the moves (c, 3) of the crossings, in mm, and the free crowns relative to them."""
    crown = divided.crown
    mean_mm = 0.5 * (moves_mm[crown[0]] + moves_mm[crown[1]])
    mean_mm[:, 2] = np.maximum(mean_mm[:, 2], 0.0)  # the contour of the device stays in the artery
    at_mm = cells.positions_mm(crossings, mean_mm, on_wall)
    tips_mm = cells.positions_mm(divided.net, moves_mm, on_wall)
    line, column = crossings.line, crossings.column // shape.column_split
    shift_mm = np.zeros((2, shape.lattice_rows, shape.lattice_columns, 3))
    shift_mm[:, line, column] = tips_mm[crown] - at_mm
    is_over_opening = np.zeros(shift_mm.shape[1:3], dtype=bool)
    is_over_opening[line, column] = divided.is_over_opening[crown[0]]
    return mean_mm, Crowns(shift_mm, is_over_opening)


def _bulge_mm2(nodes_mm: Floats) -> Floats:
    """Return the mean excess (rows,) of the squared arc over the squared chord between columns, in mm2."""
    # An arc exceeds its chord by 8/3 h^2 / chord, h being its height. Four points in a row give h.
    ahead = np.roll(nodes_mm, -1, axis=1)
    bend_mm = nodes_mm + ahead - np.roll(nodes_mm, 1, axis=1) - np.roll(ahead, -1, axis=1)
    return 16 / 3 * ((bend_mm / 16) ** 2).sum(axis=2).mean(axis=1)


@cache
def _lattice(shape: Grid) -> net.Net:
    """Return the crossings of a grid, without chart: they lie where lattice row and column are both even or both odd.

    Their rows are those of a contour with one more row at each end.
    """
    rows, columns = shape.lattice_rows, shape.lattice_columns
    line, column = np.nonzero(np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0)
    number = np.full((rows, columns), -1)
    number[line, column] = np.arange(len(line))
    first, beside = np.flatnonzero(line < rows - 1), number[line, (column + 2) % columns]
    ends = [[first, number[line[first] + 1, (column[first] + hand) % columns]] for hand in (1, -1)]
    # Pieces are ordered by row so that a loop over them reads neighbouring memory.
    both = np.array(ends).transpose(1, 2, 0).reshape(2, -1)
    inner = np.flatnonzero((line > 0) & (line < rows - 1))
    ways = [
        [number[line[inner] + way, (column[inner] + way * hand) % columns] for way in (-1, 0, 1)] for hand in (1, -1)
    ]
    bends = np.array(ways).transpose(1, 2, 0).reshape(3, -1)
    near = np.flatnonzero(line < rows - 2)
    gaps = np.stack([near, number[line[near] + 2, column[near]]])
    none, row, column = np.zeros(0), line * shape.row_split + 1, column * shape.column_split
    numbers = {"line": line, "beside": beside, "ends": both, "bends": bends, "gaps": gaps}
    short = {name: values.astype(np.uint32, order="C") for name, values in numbers.items()}
    return net.Net(chart=none, row=row, column=column, spacing=none, bulge=none, **short)


def extrapolated(known: Floats | Ints, values: Floats, wanted: Floats) -> Floats:
    """Return values (..., d) at `wanted` (...), linear between those (n, d) at increasing places, and beyond."""
    i = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, len(known) - 2)
    share = (wanted - known[i]) / (known[i + 1] - known[i])
    share = share.reshape(share.shape + (1,) * (values.ndim - 1))
    return (1 - share) * values[i] + share * values[i + 1]


def nearest(row: Floats, rows: int) -> Ints:
    """Return the row of nodes nearest to each fractional row."""
    return np.clip(np.rint(row), 0, rows - 1).astype(int)


def _spread(values: Floats, crossings: net.Net, shape: Grid) -> Floats:
    """Return values (rows, columns) at all nodes from those at crossings (c,), bilinear, pore centers by their mean."""
    known = np.zeros((2, shape.lattice_rows, shape.lattice_columns))
    known[:, crossings.line, crossings.column // shape.column_split] = values, np.ones_like(values)
    beside = np.roll(known, 1, axis=2) + np.roll(known, -1, axis=2)
    beside[:, 1:] += known[:, :-1]
    beside[:, :-1] += known[:, 1:]
    lattice = np.where(known[1] > 0, known[0], beside[0] / np.maximum(beside[1], 1.0))
    row = np.arange(shape.rows)[:, None] / shape.row_split
    column = np.arange(shape.columns)[None] / shape.column_split
    return bilinear(lattice[..., None], *np.broadcast_arrays(row, column))[..., 0]
