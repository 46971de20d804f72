"""Arrays of a run as the kernels of a GPU read them (`vstent.flow.lattice.kernels.gpu`): by cell, links packed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.setup import Addressing, Links, Refill
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
class Layout:
    """Arrays by cell and link that depend on the grid alone, so that all flows on it share them."""

    segment: Ints
    """(n,) segment of every cell."""
    rows: Ints
    """(s, 9) storage place minus cell number, the same in a whole segment, of its cells and of their neighbours in the
    directions `IN_PLANE`. Neighbours along z are in adjacent places."""
    cell: Ints
    """(w,) cells with a link or a refill, ascending."""
    of_cell: Ints
    """(4, w) of every such cell: masks of its links, near links and links of ends (bit q: direction q); first link."""
    refilled: Ints
    """(r,) number in `cell` of every cell of `Refill.place`."""
    order: Ints
    """(l,) number in `Links` of the links by cell and direction."""
    slot: Ints
    """(l,) number in this order of every link of `Links`."""
    is_near: NDArray[np.bool_]
    """(l,) whether a link of `Links` needs a population that arrives at its cell: its wall is nearer than half-way."""
    address: Ints
    """(6, l) `Links.address`, one column after the other, because neighbouring threads read neighbouring links."""
    septa: Ints
    """(2, t) `Addressing.septa`."""
    groups: tuple[Ints, Ints, Ints, Ints]
    """`Refill.groups`."""
    end_of_link: Ints
    """(l,) number of every link in this order among those of the ends, or -1."""
    opening_of_end: Ints
    """(o,) end that each of these links belongs to."""
    end_cell: Ints
    """(j,) cells at every end, one end after the other."""
    end_cell_start: Ints
    """(k + 1,) first of these cells at every end."""

    @property
    def slot_of_wall(self) -> Ints:
        """Return `slot` of the links of walls, or -1 minus it where they are near."""
        ends = len(self.opening_of_end)
        return np.where(self.is_near, -1 - self.slot, self.slot)[ends:]

    def blocks(self, threads: int) -> Ints:
        """Return end, first and last + 1 cell (b, 3) of blocks of at most `threads` of the cells at the ends."""
        rows = []
        for k in range(len(self.end_cell_start) - 1):
            first, last = (int(cell) for cell in self.end_cell_start[k : k + 2])
            rows += [(k, i, min(i + threads, last)) for i in range(first, last, threads)]
        return np.array(rows, np.int32).reshape(-1, 3)


_LAYOUTS: WeakKeyDictionary[Addressing, Layout] = WeakKeyDictionary()
"""Layouts by memory layout, as long as that exists."""


@dataclass(frozen=True, eq=False)
class Packed:
    """Arrays of a run by cell. *Special* cells are those with a link, a refill or a screen; others need no more."""

    layout: Layout
    """What all flows on the grid share."""
    code: Ints
    """(n,) segment of every cell; of a special cell, -1 minus its number."""
    special: Ints
    """(6, m) of every special cell: segment; masks of its links, near links and links of ends (bit q: direction q);
    first link; screen entry, or -1."""
    refilled: Ints
    """(r,) number among the special cells of every cell of `Refill.place`."""
    link: NDArray[np.float32]
    """(l, 2) weight and source of every link, by cell and direction. The population sent has this weight, and 1 minus
    its magnitude is the weight of the population beside it."""


def layout_of(state: State) -> Layout:
    """Return what all flows on the grid of a run share; it is built once for each memory layout."""
    if state.addressing not in _LAYOUTS:
        _LAYOUTS[state.addressing] = _layout(state.addressing, state.links, state.refill)
    return _LAYOUTS[state.addressing]


def _layout(a: Addressing, links: Links, refill: Refill) -> Layout:
    """Return what all flows with a memory layout share; links and refill are those of any of them."""
    direction, place = np.divmod(links.address[:, 2], a.stride)
    cell = np.searchsorted(a.place, place)
    order = np.lexsort((direction, cell))
    slot = np.zeros(len(order), np.int32)
    slot[order] = np.arange(len(order), dtype=np.int32)
    is_near = (links.weight[:, 1] != 0) & (links.path[0, :, 1] == links.address[:, 1])
    refilled_cell = np.searchsorted(a.place, refill.place)
    wall_cell = np.unique(np.concatenate([cell, refilled_cell]))
    ends = int(links.start[-1])
    end_of_link = np.full(len(slot), -1, np.int32)
    end_of_link[slot[:ends]] = np.arange(ends)
    opening = np.repeat(np.arange(len(links.start) - 1, dtype=np.int32), np.diff(links.start))
    at_end = np.unique(np.stack([opening, cell[:ends]]), axis=1)
    return Layout(
        np.repeat(np.arange(len(a.length), dtype=np.int32), a.length),
        rows_of(a),
        wall_cell,
        _of_cells(np.searchsorted(wall_cell, cell), 1 << direction, is_near, ends, len(wall_cell)),
        np.searchsorted(wall_cell, refilled_cell),
        order,
        slot,
        is_near,
        np.ascontiguousarray(links.address.T),
        a.septa,
        refill.groups,
        end_of_link,
        opening,
        at_end[1].astype(np.int32),
        np.searchsorted(at_end[0], np.arange(len(links.start))).astype(np.int32),
    )


def rows_of(addressing: Addressing) -> Ints:
    """Return `Layout.rows` of a memory layout."""
    away = addressing.address[1]
    columns = [addressing.address[0, :, 0]]
    columns += [away[:, d3q19.OPPOSITE[q]] - q * addressing.stride for q in IN_PLANE]
    return np.ascontiguousarray(np.stack(columns, axis=1) - addressing.first_cell[:, None], dtype=np.int32)


def _of_cells(of_link: Ints, bit: Ints, is_near: NDArray[np.bool_], ends: int, cells: int) -> Ints:
    """Return `Layout.of_cell` from the number of the cell and the bit of every link, of which the first are of ends."""
    found, is_any = np.zeros((4, cells), np.int32), np.ones(len(bit), dtype=bool)
    for row, chosen in enumerate((is_any, is_near, np.arange(len(bit)) < ends)):
        np.bitwise_or.at(found[row], of_link[chosen], bit[chosen].astype(np.int32))
    found[3] = np.searchsorted(np.sort(of_link), np.arange(cells))
    return found


def pack(state: State) -> Packed:
    """Return the arrays of a run as the kernels of a GPU read them; sources and refill are those of `state`."""
    layout, links, screened = layout_of(state), state.links, state.screen.cell
    cell = np.union1d(layout.cell, screened)
    of_wall = np.searchsorted(cell, layout.cell)
    special = np.zeros((6, len(cell)), np.int32)
    special[0], special[5] = layout.segment[cell], -1
    special[1:5, of_wall] = layout.of_cell
    special[5, np.searchsorted(cell, screened)] = np.arange(len(screened))
    code = layout.segment.copy()
    code[cell] = -1 - np.arange(len(cell), dtype=np.int32)
    link = np.stack([links.weight[layout.order, 0], links.source[layout.order]], axis=1)
    return Packed(layout, code, special, of_wall[layout.refilled].astype(np.int32), link)
