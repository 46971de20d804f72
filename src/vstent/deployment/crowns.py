"""Free crowns of open-cell devices: joints of a net that are split in two, and what holds their tips.

Where a crown is joined, the ring of struts below it and the ring above share one joint. A free crown is two joints: the
tip of the ring below and the tip of the ring above. Nothing joins them, so they can move apart, and each continues the
line of the struts that lead to it. Inside a bend a tip therefore lifts off the wall into the lumen. Outside a bend the
wall holds it; over a neck, where there is no wall, it points into the sac.
"""

from typing import NamedTuple

import numpy as np

from vstent.devices.design import LaserCut
from vstent.devices.formulas import Grid
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.net import Net


class Crowns(NamedTuple):
    """Free crowns of a deployed device, relative to the nodes of its contour on which they would be joined."""

    shift_mm: Floats
    """(2, lattice rows, lattice columns, 3) displacement of the crowns of the rings below and above, in mm."""
    is_over_opening: Bools
    """(lattice rows, lattice columns) free crowns over a neck or an ostium, where no wall holds them."""


def shifts_mm(crowns: Crowns | None) -> Floats:
    """Return the displacements of free crowns (2, lattice rows, lattice columns, 3), in mm; empty without any."""
    return np.zeros((2, 0, 0, 3)) if crowns is None else crowns.shift_mm


class Split(NamedTuple):
    """Net of an open-cell device: one joint for each joined and two for each free crown."""

    net: Net
    """Net of the joints."""
    crossing: Ints
    """(j,) crossing of the closed lattice at which every joint lies."""
    crown: Ints
    """(2, c) joint on every crossing for the ring below and the ring above; the same joint where crowns are joined."""
    is_free: Bools
    """(j,) joints that are free crowns."""
    pairs: Ints
    """(2, k) joints at both ends of the width and the height of every cell."""
    pair_weight: Floats
    """(k,) weight of the spring of each width or height: the share of its crowns that are there."""
    pair_line: Ints
    """(k,) row of joints whose free width a pair belongs to."""
    is_width: Bools
    """(k,) pairs that are widths."""
    rings: Ints
    """(3, r) consecutive joints around a ring."""
    tips: Ints
    """(3, t) joint before, joint and free tip on a line of struts."""


def free_crowns(design: LaserCut, shape: Grid) -> Bools:
    """Return where on the lattice crowns are free."""
    found = np.zeros((shape.lattice_rows, shape.lattice_columns), dtype=bool)
    for row in range(1, shape.lattice_rows - 1):
        columns = np.arange(row % 2, shape.lattice_columns, 2)
        found[row, columns] = [not design.is_joined(row - 1, crown) for crown in range(len(columns))]
    return found


def split(net: Net, is_crossing_free: Bools) -> Split:
    """Split the joints of a closed net at its free crowns.

    Parameters
    ----------
    net : net of the closed lattice, with c crossings.
    is_crossing_free : (c,); crossings at which crowns are free.

    Returns the net with one joint for each joined and two for each free crown.
    """
    copies = 1 + is_crossing_free.astype(int)
    crossing = np.repeat(np.arange(len(copies)), copies)
    below = np.cumsum(copies) - copies
    crown = np.stack([below, below + is_crossing_free])
    is_second = np.arange(len(crossing)) > below[crossing]
    beside = net.beside.astype(int)
    first, second = net.ends.astype(int)
    on_line = net._replace(
        row=net.row[crossing],
        column=net.column[crossing],
        line=net.line[crossing],
        beside=np.where(is_second, crown[1][beside[crossing]], crown[0][beside[crossing]]),
        ends=np.stack([crown[1][first], crown[0][second]]),
        bends=_bends(net, crown, ~is_crossing_free),
    )
    pairs, weight, line, is_width = _pairs(net, crown, is_crossing_free)
    tips = _tips(net, crown, is_crossing_free)
    return Split(
        on_line, crossing, crown, is_crossing_free[crossing], pairs, weight, line, is_width, _rings(net, crown), tips
    )


def _bends(net: Net, crown: Ints, is_joined: Bools) -> Ints:
    """Return triples (3, b) of joints on lines of struts through joined crowns, none of them with a free tip."""
    before, here, after = net.bends.astype(int)
    through = is_joined[before] & is_joined[here] & is_joined[after]
    return crown[0][np.stack([before, here, after])[:, through]]


def _tips(net: Net, crown: Ints, is_crossing_free: Bools) -> Ints:
    """Return triples (3, t): joint before, joined crown, and free tip that continues the line of struts."""
    before, here, after = net.bends.astype(int)
    found = []
    for base, tip, side in ((before, after, 0), (after, before, 1)):
        is_tip = ~is_crossing_free[here] & is_crossing_free[tip]
        # A tip after its base is a crown of the ring below the row of the tip, and the other way round.
        found.append(np.stack([crown[1 - side][base], crown[0][here], crown[side][tip]])[:, is_tip])
    return np.concatenate(found, axis=1)


def _pairs(net: Net, crown: Ints, is_crossing_free: Bools) -> tuple[Ints, Floats, Ints, Bools]:
    """Return the joints of all widths and heights (2, k), their weights, lines and whether they are widths (k,)."""
    line, last = net.line.astype(int), int(net.line.max())
    beside, here = net.beside.astype(int), np.arange(len(line))
    widths, weights, lines = [], [], []
    for side, is_there in ((0, line > 0), (1, line < last)):
        of_ring = here[is_there]
        widths.append(np.stack([crown[side][of_ring], crown[side][beside[of_ring]]]))
        weights.append(np.where((line[of_ring] > 0) & (line[of_ring] < last), np.sqrt(0.5), 1.0))
        lines.append(line[of_ring])
    stride = net.chart.shape[1]
    key = line * stride + net.column
    ahead = np.searchsorted(key, key + 2 * stride)
    lower = here[line < last - 1]
    upper = ahead[lower]
    right, left = _between(net, lower)
    weights.append(np.sqrt(1 - 0.5 * (is_crossing_free[right] + is_crossing_free[left].astype(float))))
    heights = np.stack([crown[1][lower], crown[0][upper]])
    is_width = np.repeat([True, False], [sum(map(len, lines)), len(lower)])
    pairs = np.concatenate([*widths, heights], axis=1)
    return pairs, np.concatenate(weights), np.concatenate([*lines, line[lower] + 1]), is_width


def _between(net: Net, lower: Ints) -> tuple[Ints, Ints]:
    """Return the crossings right and left (k,) of cells whose lower crossings are given (k,)."""
    first, second = net.ends.astype(int)
    order = np.argsort(first, kind="stable")
    at = np.searchsorted(first[order], lower)
    return second[order[at]], second[order[at + 1]]


def _rings(net: Net, crown: Ints) -> Ints:
    """Return consecutive joints (3, r) around every ring, at its lower and upper crowns."""
    beside = net.beside.astype(int)
    before = np.zeros_like(beside)
    before[beside] = np.arange(len(beside))
    here = np.arange(len(beside))
    found = [crown[side][np.stack([before, here, beside])] for side in (0, 1)]
    return np.unique(np.concatenate(found, axis=1), axis=1)
