"""The arrays of a run as its kernels on a GPU take them: one of each type, each with many tables (`kernels.gpu`).

A launch takes the host some microseconds for every array among its arguments.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.kernels import gpu as kernels
from vstent.flow.lattice.packing import Packed, joined
from vstent.flow.lattice.scales import ODD_RATE
from vstent.flow.lattice.setup import Links
from vstent.flow.lattice.state import State
from vstent.kernels.arrays import Floats, Ints

PAIRS: Final = 1024
"""Number of pairs of time steps whose boundary values are on the GPU at once."""
START: Final = (0, 1)
"""The clock before the first of them: the first row applies, and populations are at home."""


@dataclass(frozen=True, eq=False)
class Numbers:
    """What the kernels need beside `Packed`."""

    single: NDArray[np.float32]
    """(6,) relaxation time at high shear rate, Carreau-Yasuda law (4), relaxation rate of the odd part."""
    limit: NDArray[np.float32]
    """(s,) `State.limit`."""
    refill: NDArray[np.float32]
    """(m,) what is added to the rest population of every special cell."""
    entry: NDArray[np.float32]
    """(e, d3q19.ENTRY) screen entries."""
    correction: NDArray[np.float32]
    """(5, w) `Links.correction` of the walls."""
    openings: Floats
    """(k, d3q19.OPENING) `Links.openings`."""
    start: Ints
    """(k + 1,) `Links.start`."""


@dataclass(frozen=True, eq=False)
class Tables:
    """The arrays of `kernels.even_step`, and where some of their tables are."""

    integers: NDArray[np.int32]
    singles: NDArray[np.float32]
    doubles: Floats
    code_at: int
    """Place among the integers where the codes of cells begin."""
    blocks: int
    """Number of blocks of `kernels.drive`."""
    number: slice
    """Place among the singles of `Numbers.single`."""
    link: slice
    """Place of `Packed.link`."""
    refill: slice
    """Place of `Numbers.refill`."""
    entry: slice
    """Place of `Numbers.entry`."""
    correction: slice
    """Place of `Numbers.correction`."""
    opening: slice
    """Place among the doubles of `Numbers.openings`."""
    imposed: slice
    """Place of the boundary values (PAIRS, k + 3)."""


def numbers_of(state: State, packed: Packed) -> Numbers:
    """Return the numbers of a run."""
    refill = np.zeros(packed.special.shape[1], np.float32)
    refill[packed.refilled] = state.refill.refill
    links = state.links
    correction = correction_of(links)
    return Numbers(single_of(state), state.limit, refill, state.screen.entry, correction, links.openings, links.start)


def correction_of(links: Links) -> NDArray[np.float32]:
    """Return `Numbers.correction` of the links of a run."""
    return links.correction[links.start[-1] :].T


def single_of(state: State) -> NDArray[np.float32]:
    """Return `Numbers.single` of a run."""
    return np.array([state.scales.relaxation_steps, *state.scales.thinning, ODD_RATE], np.float32)


def tables(packed: Packed, numbers: Numbers) -> Tables:
    """Return the arrays of `kernels.even_step`."""
    ends, blocks = len(numbers.openings), packed.layout.blocks(kernels.THREADS)
    correction, lost = numbers.correction, np.zeros(numbers.correction.shape[1])
    singles, (number, _, link, refill, entry, wall, mass) = joined(
        (numbers.single, numbers.limit, packed.link, numbers.refill, numbers.entry, correction, lost), np.float32
    )
    doubles, (opening, answer, part, imposed) = joined(
        (numbers.openings, np.zeros(ends), np.zeros(len(blocks)), np.zeros((PAIRS, ends + 3))), np.float64
    )
    head = {
        kernels.NOW: START[0],
        kernels.AT_HOME: START[1],
        kernels.SPECIALS: packed.special.shape[1],
        kernels.LINK: link.start,
        kernels.REFILL: refill.start,
        kernels.OPENINGS: ends,
        kernels.ANSWER: answer.start,
        kernels.PARTS: part.start,
        kernels.IMPOSED: imposed.start,
        kernels.SEPTUM_COUNT: packed.layout.septa.shape[1],
        kernels.LINKS: len(packed.link),
        kernels.WALLS: len(lost),
        kernels.GROUPS: len(packed.layout.groups[0]) - 1,
        kernels.LOST: mass.start,
        kernels.CORRECTION: wall.start,
    }
    integers, code_at = _integers(head, packed, _placed(packed.special, link, entry), blocks, numbers.start)
    return Tables(integers, singles, doubles, code_at, len(blocks), number, link, refill, entry, wall, opening, imposed)


def _placed(special: Ints, link: slice, entry: slice) -> Ints:
    """Return `Packed.special` with the places of first link and screen entry among the singles."""
    placed = special.copy()
    placed[4] = link.start + 2 * special[4]
    placed[5] = np.where(special[5] < 0, -1, entry.start + d3q19.ENTRY * special[5])
    return placed


def _integers(head: dict[int, int], packed: Packed, special: Ints, blocks: Ints, start: Ints) -> tuple[Any, int]:
    """Return the integers, of which `head` are the first, and where the codes begin."""
    layout = packed.layout
    first_link, group_link, first_member, member = layout.groups
    named = {
        kernels.SPECIAL: special,
        kernels.END_OF_LINK: layout.end_of_link,
        kernels.OPENING_OF_END: layout.opening_of_end,
        kernels.BLOCKS: blocks,
        kernels.END_CELL: layout.end_cell,
        kernels.FIRST_BLOCK: np.searchsorted(blocks[:, 0], np.arange(len(start))),
        kernels.COUNT: np.diff(start),
        kernels.DONE: np.zeros(len(start) - 1),
        kernels.SEPTA: layout.septa,
        kernels.ADDRESS: layout.address,
        kernels.SLOT: layout.slot_of_wall,
        kernels.FIRST_LINK: first_link,
        kernels.GROUP_LINK: group_link,
        kernels.FIRST_MEMBER: first_member,
        kernels.GROUP_MEMBER: packed.refilled[member],
    }
    whole, (_, _, code, *places) = joined((np.zeros(kernels.HEAD), layout.rows, packed.code, *named.values()), np.int32)
    for entry, place in (head | dict(zip(named, (place.start for place in places), strict=True))).items():
        whole[entry] = place
    return whole, code.start
