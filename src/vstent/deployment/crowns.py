"""Free crowns of open-cell devices: joints of a net that are split in two, and what holds their tips.

Where a crown is joined, the ring of struts below it and the ring above share one joint. A free crown is two joints: the
tip of the ring below and the tip of the ring above. Nothing joins them, so they can move apart, and each continues the
line of the struts that lead to it. Inside a bend a tip therefore lifts off the wall into the lumen. Outside a bend the
wall holds it; over a neck, where there is no wall, it points into the sac.
"""

from typing import Final, NamedTuple

import numpy as np

from vstent.devices.design import Design, LaserCut
from vstent.devices.formulas import Grid
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.net import Net


class Crowns(NamedTuple):
    """Free crowns of a deployed device, relative to the nodes of its contour on which they would be joined."""

    shift_mm: Floats
    """(2, lattice rows, lattice columns, 3) displacement of the crowns of the rings below and above, in mm."""
    is_over_opening: Bools
    """(lattice rows, lattice columns) free crowns over a neck or an ostium, where no wall holds them."""


NO_CROWNS: Final = Crowns(np.zeros((2, 0, 0, 3)), np.zeros((0, 0), dtype=bool))
"""Crowns of a device that has none that are free."""


class Split(NamedTuple):
    """Net of an open-cell device: one joint for each joined and two for each free crown."""

    net: Net
    """Net of the joints."""
    crown: Ints
    """(2, c) joint on every crossing for the ring below and the ring above; the same joint where crowns are joined."""
    is_free: Bools
    """(j,) joints that are free crowns."""
    is_over_opening: Bools
    """(j,) free crowns over a neck or an ostium, where no wall holds them."""
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


def free_crowns(design: Design, shape: Grid) -> Bools:
    """Return where on the lattice crowns are free; nowhere on a device that has no crowns or joins all of them."""
    found = np.zeros((shape.lattice_rows, shape.lattice_columns), dtype=bool)
    if isinstance(design, LaserCut) and design.joined_crowns:
        for row in range(1, shape.lattice_rows - 1):
            columns = np.arange(row % 2, shape.lattice_columns, 2)
            found[row, columns] = [not design.is_joined(row - 1, crown) for crown in range(len(columns))]
    return found


def around_rings(beside: Ints) -> Ints:
    """Return the joint before, every joint, and the one after it (3, c) on a ring, from those after it (c,)."""
    before, here = np.zeros_like(beside), np.arange(len(beside))
    before[beside] = here
    return np.stack([before, here, beside])


def split(net: Net, is_free: Bools, is_opening: Bools) -> Split:
    """Split the joints of a closed net at its free crowns: one joint for each joined and two for each free crown.

    Of its c crossings, `is_free` (c,) have free crowns, and `is_opening` (c,) lie over a neck or an ostium.
    """
    copies = 1 + is_free.astype(int)
    crossing = np.repeat(np.arange(len(copies)), copies)
    below = np.cumsum(copies) - copies
    crown = np.stack([below, below + is_free])
    is_second = np.arange(len(crossing)) > below[crossing]
    beside, (first, second) = net.beside.astype(int), net.ends.astype(int)
    before, here, after = net.bends.astype(int)
    is_straight = ~(is_free[before] | is_free[here] | is_free[after])
    joints = net._replace(
        row=net.row[crossing],
        column=net.column[crossing],
        line=net.line[crossing],
        beside=np.where(is_second, crown[1][beside[crossing]], crown[0][beside[crossing]]),
        ends=np.stack([crown[1][first], crown[0][second]]),
        bends=crown[0][np.stack([before, here, after])[:, is_straight]],
    )
    tips = []
    for base, tip, side in ((before, after, 0), (after, before, 1)):
        is_tip = ~is_free[here] & is_free[tip]
        # A tip after its base is a crown of the ring below the row of the tip, and the other way round.
        tips.append(np.stack([crown[1 - side][base], crown[0][here], crown[side][tip]])[:, is_tip])
    rings = np.concatenate([crown[side][around_rings(beside)] for side in (0, 1)], axis=1)
    return Split(
        joints,
        crown,
        is_free[crossing],
        (is_free & is_opening)[crossing],
        *_pairs(net, crown, is_free),
        np.unique(rings, axis=1),
        np.concatenate(tips, axis=1),
    )


def _pairs(net: Net, crown: Ints, is_free: Bools) -> tuple[Ints, Floats, Ints, Bools]:
    """Return the joints of all widths and heights (2, k), their weights, lines and whether they are widths (k,)."""
    line, last = net.line.astype(int), int(net.line.max())
    beside, here = net.beside.astype(int), np.arange(len(line))
    pairs, weights, lines = [], [], []
    for side, is_there in ((0, line > 0), (1, line < last)):
        of_ring = here[is_there]
        pairs.append(np.stack([crown[side][of_ring], crown[side][beside[of_ring]]]))
        weights.append(np.where((line[of_ring] > 0) & (line[of_ring] < last), np.sqrt(0.5), 1.0))
        lines.append(line[of_ring])
    lower, upper = net.gaps.astype(int)
    pairs.append(np.stack([crown[1][lower], crown[0][upper]]))
    # The crossings right and left of each cell are at the ends of the struts that leave its lower crossing.
    first, second = net.ends.astype(int)
    order = np.argsort(first, kind="stable")
    at = np.searchsorted(first[order], lower)
    right, left = second[order[at]], second[order[at + 1]]
    weights.append(np.sqrt(1 - 0.5 * (is_free[right] + is_free[left].astype(float))))
    is_width = np.repeat([True, False], [sum(map(len, lines)), len(lower)])
    return np.concatenate(pairs, axis=1), np.concatenate(weights), np.concatenate([*lines, line[lower] + 1]), is_width
