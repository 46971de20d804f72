"""The arrays of a run as its kernels on a GPU read them (`kernels.gpu`): one of each type, each with many tables.

A launch takes the host some microseconds for every array among its arguments.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.kernels import d3q19, gpu as kernels
from vstent.flow.lattice.setup import Addressing, Links
from vstent.flow.lattice.state import State
from vstent.kernels.arrays import Floats, Ints

PAIRS: Final = 1024
"""Number of pairs of time steps whose boundary values are on the GPU at once."""
START: Final = (0, 1)
"""The clock before the first of them: the first row applies, and populations are at home."""
IN_PLANE: Final = (1, 2, 3, 4, 7, 8, 9, 10)
"""Directions without a component along z: those of the columns of the rows after the first."""

Name = int | str
"""A table's entry among the first integers, where kernels find its place; a word if they need none."""


@dataclass(frozen=True, eq=False)
class Layout:
    """What depends on the grid alone, so that all flows on it share it."""

    segment: Ints
    """(n,) segment of every cell."""
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
    tables: dict[Name, Ints]
    """Tables of integers: those that do not change from flow to flow."""


@dataclass(frozen=True, eq=False)
class Tables:
    """The arrays of `kernels.even_step`."""

    integers: NDArray[np.int32]
    singles: NDArray[np.float32]
    doubles: Floats
    places: dict[Name, slice]
    """Where every table is in its array."""
    refilled: Ints
    """(r,) number among the special cells of every cell of `Refill.place`."""


_LAYOUTS: WeakKeyDictionary[Addressing, Layout] = WeakKeyDictionary()
"""Layouts by memory layout, as long as that exists."""


def layout_of(state: State) -> Layout:
    """Return what all flows on the grid of a run share; it is built once for each memory layout."""
    if state.addressing not in _LAYOUTS:
        _LAYOUTS[state.addressing] = _layout(state)
    return _LAYOUTS[state.addressing]


def _layout(state: State) -> Layout:
    """Return what all flows on the grid of a run share."""
    a, links, refill = state.addressing, state.links, state.refill
    direction, place = np.divmod(links.address[:, 2], a.stride)
    cell, refilled_cell = np.searchsorted(a.place, place), np.searchsorted(a.place, refill.place)
    order = np.lexsort((direction, cell))
    slot = np.zeros(len(order), np.int32)
    slot[order] = np.arange(len(order), dtype=np.int32)
    # A near link needs a population that arrives at its cell: its wall is nearer than half-way.
    is_near = (links.weight[:, 1] != 0)[: len(slot)] & (links.path[0, : len(slot), 1] == links.address[:, 1])
    special = np.unique(np.concatenate([cell, refilled_cell]))
    ends, is_end = int(links.start[-1]), np.arange(len(slot)) < links.start[-1]
    of_cell, of_link = np.zeros((4, len(special)), np.int32), np.searchsorted(special, cell)
    for mask, is_masked in zip(of_cell[:3], (np.ones_like(is_near), is_near, is_end), strict=True):
        np.bitwise_or.at(mask, of_link[is_masked], (1 << direction[is_masked]).astype(np.int32))
    of_cell[3] = np.searchsorted(np.sort(of_link), np.arange(len(special)))
    end_of_link = np.full(len(slot), -1, np.int32)
    end_of_link[slot[:ends]] = np.arange(ends)
    opening = np.repeat(np.arange(len(links.start) - 1, dtype=np.int32), np.diff(links.start))
    at_end, end_cell = np.unique(np.stack([opening, cell[:ends]]), axis=1)
    blocks: list[tuple[int, int, int]] = []
    for k in range(len(links.start) - 1):
        first, last = np.searchsorted(at_end, (k, k + 1)).tolist()
        blocks += [(k, i, min(i + kernels.THREADS, last)) for i in range(first, last, kernels.THREADS)]
    away = a.address[1]
    rows = [a.address[0, :, 0], *(away[:, d3q19.OPPOSITE[q]] - q * a.stride for q in IN_PLANE)]
    of_block = np.array(blocks, np.int32).reshape(-1, 3)
    tables: dict[Name, Ints] = {
        "head": np.zeros(kernels.HEAD, np.int32),
        "rows": np.stack(rows, axis=1) - a.first_cell[:, None],
        kernels.END_OF_LINK: end_of_link,
        kernels.OPENING_OF_END: opening,
        kernels.BLOCKS: of_block,
        kernels.END_CELL: end_cell,
        kernels.FIRST_BLOCK: np.searchsorted(of_block[:, 0], np.arange(len(links.start))),
        kernels.COUNT: np.diff(links.start),
        kernels.DONE: np.zeros(len(links.start) - 1, np.int32),
        kernels.SEPTA: a.septa,
        kernels.ADDRESS: np.ascontiguousarray(links.address.T),  # neighbouring threads read neighbouring links
        kernels.SLOT: np.where(is_near, -1 - slot, slot)[ends:],
        kernels.FIRST_LINK: refill.groups[0],
        kernels.GROUP_LINK: refill.groups[1],
        kernels.FIRST_MEMBER: refill.groups[2],
    }
    segment = np.repeat(np.arange(len(a.length), dtype=np.int32), a.length)
    return Layout(segment, special, of_cell, np.searchsorted(special, refilled_cell), order, slot, tables)


def correction_of(links: Links) -> NDArray[np.float32]:
    """Return the table of `Links.correction` of the walls (5, w)."""
    return links.correction[links.start[-1] :].T


def rates_of(state: State) -> NDArray[np.float32]:
    """Return relaxation time at high shear rate, Carreau-Yasuda law (4) and relaxation rate of the odd part (6,)."""
    return np.array([state.scales.relaxation_steps, *state.scales.thinning, state.scales.odd_rate], np.float32)


def tables_of(state: State) -> Tables:
    """Return the arrays of a run.

    *Special* cells are those with a link, a refill or a screen; others need no more than their segment. Of a special
    cell: segment, masks of its links, near links and links of ends, place of its first link, place of its screen entry,
    or -1. Of a link, by cell and direction: weight of the population sent, where 1 minus the magnitude of this is that
    of the population beside it, and source.
    """
    layout, links, screened = layout_of(state), state.links, state.screen.cell
    cell = np.union1d(layout.cell, screened)
    of_wall = np.searchsorted(cell, layout.cell)
    refilled = of_wall[layout.refilled].astype(np.int32)
    refill = np.zeros(len(cell), np.float32)
    refill[refilled] = state.refill.refill
    correction, ends = correction_of(links), len(links.openings)
    singles, places = joined(
        {
            "rates": rates_of(state),
            "limit": state.limit,
            kernels.LINK: np.stack([links.weight[layout.order, 0], links.source[layout.order]], axis=1),
            kernels.REFILL: refill,
            "entries": state.screen.entry,
            kernels.CORRECTION: correction,
            kernels.LOST: np.zeros(correction.shape[1]),
        },
        np.float32,
    )
    doubles, of_doubles = joined(
        {
            "openings": links.openings,
            kernels.ANSWER: np.zeros(ends),
            kernels.PARTS: np.zeros(len(layout.tables[kernels.BLOCKS])),
            kernels.IMPOSED: np.zeros((PAIRS, ends + 3)),
        },
        np.float64,
    )
    special = np.zeros((6, len(cell)), np.int32)
    special[0], special[5] = layout.segment[cell], -1
    special[1:5, of_wall] = layout.of_cell
    special[4] = places[kernels.LINK].start + 2 * special[4]
    entries = places["entries"].start + d3q19.ENTRY * np.arange(len(screened))
    special[5, np.searchsorted(cell, screened)] = entries
    code = layout.segment.copy()
    code[cell] = -1 - np.arange(len(cell), dtype=np.int32)
    members = refilled[state.refill.groups[3]]
    of_run: dict[Name, Ints] = {"code": code, kernels.SPECIAL: special, kernels.GROUP_MEMBER: members}
    integers, of_integers = joined(layout.tables | of_run, np.int32)
    places |= of_doubles | of_integers
    head = {name: place.start for name, place in places.items() if isinstance(name, int)} | {
        kernels.NOW: START[0],
        kernels.AT_HOME: START[1],
        kernels.SPECIALS: len(cell),
        kernels.OPENINGS: ends,
        kernels.SEPTUM_COUNT: state.addressing.septa.shape[1],
        kernels.LINKS: len(links.address),
        kernels.WALLS: correction.shape[1],
        kernels.GROUPS: len(state.refill.groups[0]) - 1,
    }
    integers[list(head)] = list(head.values())
    return Tables(integers, singles, doubles, places, refilled)


def joined(tables: Mapping[Name, NDArray[Any]], dtype: type) -> tuple[NDArray[Any], dict[Name, slice]]:
    """Return tables in one array, and where each is; every table begins on a line of the GPU's memory."""
    lengths = np.array([-(-table.size // kernels.LINE) * kernels.LINE for table in tables.values()])
    starts = np.cumsum(lengths) - lengths
    whole: NDArray[Any] = np.zeros(max(1, int(lengths.sum())), dtype)
    places: dict[Name, slice] = {}
    for start, (name, table) in zip(starts.tolist(), tables.items(), strict=True):
        places[name] = slice(start, start + table.size)
        whole[places[name]] = table.ravel()
    return whole, places
