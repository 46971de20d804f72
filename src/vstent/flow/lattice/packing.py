"""Arrays of a run as the kernels of a GPU read them (`vstent.flow.lattice.kernels.gpu`): by cell, links packed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.screen import ScreenEntries
from vstent.flow.lattice.setup import Addressing, Links
from vstent.flow.lattice.state import State
from vstent.kernels.arrays import Ints

LINE: Final = 32
"""Number of entries of 32 bits in a line of the GPU's memory."""
IN_PLANE: Final = (1, 2, 3, 4, 7, 8, 9, 10)
"""Directions without a component along z: those of the columns of `Packed.rows` after the first."""


def joined(tables: Sequence[NDArray[Any]], dtype: type) -> tuple[NDArray[Any], list[slice]]:
    """Return tables in one array, and where each is; every table begins on a line of the GPU's memory."""
    lengths = np.array([-(-table.size // LINE) * LINE for table in tables])
    starts = np.cumsum(lengths) - lengths
    places = [slice(int(start), int(start) + table.size) for start, table in zip(starts, tables, strict=True)]
    whole: NDArray[Any] = np.zeros(max(1, int(lengths.sum())), dtype)
    for place, table in zip(places, tables, strict=True):
        whole[place] = table.ravel()
    return whole, places


@dataclass(frozen=True, eq=False)
class Packed:
    """Arrays of a run by cell. *Special* cells are those with a link, a refill or a screen; others need no more."""

    code: Ints
    """(n,) segment of every cell; of a special cell, -1 minus its number."""
    rows: Ints
    """(s, 9) storage place minus cell number, the same in a whole segment, of its cells and of their neighbours in the
    directions `IN_PLANE`. Neighbours along z are in adjacent places."""
    special: Ints
    """(6, m) of every special cell: segment; masks of its links, near links and links of ends (bit q: direction q);
    first link; screen entry, or -1."""
    refilled: Ints
    """(w,) number among the special cells of every cell of `Refill.place`."""
    link: NDArray[np.float32]
    """(l, 2) weight and source of every link, by cell and direction. The population sent has this weight, and 1 minus
    its magnitude is the weight of the population beside it."""
    slot: Ints
    """(l,) number in `link` of every link of `Links`."""
    is_near: NDArray[np.bool_]
    """(l,) whether a link of `Links` needs a population that arrives at its cell: its wall is nearer than half-way."""
    end_of_link: Ints
    """(l,) number of every link in `link` among those of the ends, or -1."""
    opening_of_end: Ints
    """(o,) end that each of these links belongs to."""
    end_cell: Ints
    """(j,) cells at every end, one end after the other."""
    end_cell_start: Ints
    """(k + 1,) first of these cells at every end."""

    def blocks(self, threads: int) -> Ints:
        """Return end, first and last + 1 cell (b, 3) of blocks of at most `threads` of the cells at the ends."""
        rows = []
        for k in range(len(self.end_cell_start) - 1):
            first, last = (int(cell) for cell in self.end_cell_start[k : k + 2])
            rows += [(k, i, min(i + threads, last)) for i in range(first, last, threads)]
        return np.array(rows, np.int32).reshape(-1, 3)


def rows_of(addressing: Addressing) -> Ints:
    """Return `Packed.rows` of a memory layout."""
    away = addressing.address[1]
    columns = [addressing.address[0, :, 0]]
    columns += [away[:, d3q19.OPPOSITE[q]] - q * addressing.stride for q in IN_PLANE]
    return np.ascontiguousarray(np.stack(columns, axis=1) - addressing.first_cell[:, None], dtype=np.int32)


def pack(state: State) -> Packed:
    """Return the arrays of a run as the kernels of a GPU read them; sources and refill are those of `state`."""
    a, links = state.addressing, state.links
    direction, place = np.divmod(links.address[:, 2], a.stride)
    cell = np.searchsorted(a.place, place)
    order = np.lexsort((direction, cell))
    slot = np.zeros(len(order), np.int32)
    slot[order] = np.arange(len(order), dtype=np.int32)
    is_near = (links.weight[:, 1] != 0) & (links.path[0, :, 1] == links.address[:, 1])
    refilled_cell = np.searchsorted(a.place, state.refill.place)
    special_cell = np.unique(np.concatenate([cell, refilled_cell, state.screen.cell]))
    code = np.repeat(np.arange(len(a.length), dtype=np.int32), a.length)
    special = _special(special_cell, cell, direction, is_near, links, state.screen)
    special[0] = code[special_cell]
    code[special_cell] = -1 - np.arange(len(special_cell), dtype=np.int32)
    ends = int(links.start[-1])
    end_of_link = np.full(len(slot), -1, np.int32)
    end_of_link[slot[:ends]] = np.arange(ends)
    opening = np.repeat(np.arange(len(links.start) - 1, dtype=np.int32), np.diff(links.start))
    at_end = np.unique(np.stack([opening, cell[:ends]]), axis=1)
    return Packed(
        code,
        rows_of(a),
        special,
        np.searchsorted(special_cell, refilled_cell).astype(np.int32),
        np.stack([links.weight[order, 0], links.source[order]], axis=1),
        slot,
        is_near,
        end_of_link,
        opening,
        at_end[1].astype(np.int32),
        np.searchsorted(at_end[0], np.arange(len(links.start))).astype(np.int32),
    )


def _special(
    special_cell: Ints,
    cell: Ints,
    direction: Ints,
    is_near: NDArray[np.bool_],
    links: Links,
    screen: ScreenEntries,
) -> Ints:
    """Return `Packed.special` without its segments."""
    of_link, bit = np.searchsorted(special_cell, cell), 1 << direction
    is_end = np.arange(len(cell)) < links.start[-1]
    special = np.zeros((6, len(special_cell)), np.int32)
    for row, chosen in ((1, slice(None)), (2, is_near), (3, is_end)):
        np.bitwise_or.at(special[row], of_link[chosen], bit[chosen].astype(np.int32))
    special[4] = np.searchsorted(np.sort(of_link), np.arange(len(special_cell)))
    special[5] = -1
    special[5, np.searchsorted(special_cell, screen.cell)] = np.arange(len(screen.cell))
    return special
