"""The kernels of `vstent.flow.lattice.kernels.d3q19` for a GPU (numba-cuda), one thread per cell, link or group.

Arithmetic is the same; the functions of one cell, link or opening are shared. Sums have a fixed order, so that a GPU
reproduces its results to the last bit. They differ from those of a CPU in the last bits, because the compilers fuse and
reorder operations differently.

A pair of time steps is `drive`, `even_step` and `odd_step`. Walls and openings need no kernel of their own. What a cell
sends along a link stays in the cell's own place for the opposite direction, where the next step reads it. A *near* link
combines it with a population that arrives at the cell, when the next step reads it; any other link combines it with a
population that leaves the cell, before it is stored. Only `keep` also writes the population sent to the mailbox, where
the CPU has it after every odd step. After `defer` the populations are *at home*, that is, stored as on the CPU.

Import it only where a GPU is requested (`vstent.flow.lattice.gpu`).
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numba import config, cuda, njit

from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.kernels.collision import (
    collided,
    collided_screened,
    relaxed,
    rescaled,
    stress_size,
    thinned,
)
from vstent.flow.lattice.kernels.d3q19 import INFLOW, KIND, OPENING, OPPOSITE, PRESSURE, WANTED

THREADS: Final = 8 if config.ENABLE_CUDASIM else 128
"""Number of threads per block; a power of 2. Numba simulates each by a thread of the processor, which is slow."""
COLUMN: Final = np.array([0, 1, 2, 3, 4, 0, 0, 5, 6, 7, 8, 1, 2, 1, 2, 3, 4, 3, 4], np.int32)
"""(19,) column of a segment's row of places that holds the neighbour in each direction (see `packing.Layout.rows`)."""
SHIFT: Final = np.array([0, 0, 0, 0, 0, 1, -1, 0, 0, 0, 0, 1, -1, -1, 1, 1, -1, -1, 1], np.int32)
"""(19,) number of places from there to the neighbour: neighbours along z are adjacent."""
# fmt: off
(
    # The clock: the row of the boundary values that applies, and whether populations are at home.
    NOW, AT_HOME,
    # Numbers of special cells, openings, septa, links, links of walls, and groups.
    SPECIALS, OPENINGS, SEPTUM_COUNT, LINKS, WALLS, GROUPS,
    # Places among the integers: special cells, the ends of `even_step`, then the tables of `drive` and of the walls.
    SPECIAL, END_OF_LINK, OPENING_OF_END,
    BLOCKS, END_CELL, FIRST_BLOCK, COUNT, DONE,
    SEPTA, ADDRESS, SLOT, FIRST_LINK, GROUP_LINK, FIRST_MEMBER, GROUP_MEMBER,
    # Places among the singles: `Packed.link`, refill of special cells, mass lost, `Links.correction`.
    LINK, REFILL, LOST, CORRECTION,
    # Places among the doubles: answers, sums of blocks, boundary values.
    ANSWER, PARTS, IMPOSED,
) = range(30)
# fmt: on
"""Entries with which the integers begin; `gpu_tables` writes them."""
HEAD: Final = 32
"""Number of places kept for them, and for the numbers before the limits; `packing.LINE` is the same."""
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_U, _WHOLE = np.uint64, np.uint32


def _of_arrays(function: Any) -> Any:
    """Return a function of arrays for use in a kernel: numba's simulator cannot pass its arrays to compiled code."""
    return getattr(function, "py_func", function) if config.ENABLE_CUDASIM else function


def _inlined(function: Callable[..., Any]) -> Any:
    """Return a function that is compiled into the kernels that call it."""
    return function if config.ENABLE_CUDASIM else njit(forceinline=True)(function)


_between, _deferred = _of_arrays(d3q19.between), _of_arrays(d3q19.deferred)
_answer, _outlet_source = _of_arrays(d3q19.answered), _of_arrays(d3q19.outlet_source)


@_inlined
def load(f: Any, address: int) -> Any:
    """Return the population at an address; every kernel reads populations here."""
    return f[_U(address)]


@_inlined
def _integer(integers: Any, at: int) -> Any:
    """Return an entry of the integers."""
    return integers[_U(at)]


@_inlined
def store(f: Any, address: int, population: Any) -> None:
    """Write the population at an address; every kernel writes populations here."""
    f[_U(address)] = population


@_inlined
def _cell(cell: int, integers: Any, code_at: int) -> tuple[int, int, int, int, int, int, int]:
    """Return segment, link masks (all, near, ends), first link, screen entry and number of a special cell.

    Links and entry are given by their places among the singles. A cell without them has no links, entry -1 and
    number -1.
    """
    code = _integer(integers, code_at + cell)
    if code >= 0:
        return code, 0, 0, 0, 0, -1, -1
    w = -1 - code
    at, m = integers[SPECIAL] + w, integers[SPECIALS]
    return (
        _integer(integers, at),
        _integer(integers, at + m),
        _integer(integers, at + 2 * m),
        _integer(integers, at + 3 * m),
        _integer(integers, at + 4 * m),
        _integer(integers, at + 5 * m),
        w,
    )


@_inlined
def _place(integers: Any, s: int, cell: int) -> int:
    """Return the storage place of a cell of segment `s`."""
    place: int = _integer(integers, HEAD + 9 * s) + cell
    return place


@_inlined
def _neighbour(q: int, integers: Any, s: int, cell: int) -> int:
    """Return the storage place of the neighbour in direction `q` of a cell of segment `s`."""
    place: int = _integer(integers, HEAD + 9 * s + COLUMN[q]) + cell + SHIFT[q]
    return place


@_inlined
def _own(q: int, stride: int, place: int) -> Any:
    """Return the address of population `q` of a cell at home; addresses have 32 bits."""
    return _WHOLE(q * stride + place)


@_inlined
def _away(q: int, stride: int, integers: Any, s: int, cell: int, links: int) -> Any:
    """Return the address of population `q` of a cell in an odd step: at the neighbour, or at home behind a link."""
    p = OPPOSITE[q]
    if links & (1 << p):
        return _own(q, stride, _place(integers, s, cell))
    return _WHOLE(p * stride + _neighbour(p, integers, s, cell))


@_inlined
def _homes(stride: int, place: int) -> tuple[Any, ...]:
    """Return the addresses (19) of a cell's populations in an even step."""
    return (
        _own(0, stride, place),
        _own(1, stride, place),
        _own(2, stride, place),
        _own(3, stride, place),
        _own(4, stride, place),
        _own(5, stride, place),
        _own(6, stride, place),
        _own(7, stride, place),
        _own(8, stride, place),
        _own(9, stride, place),
        _own(10, stride, place),
        _own(11, stride, place),
        _own(12, stride, place),
        _own(13, stride, place),
        _own(14, stride, place),
        _own(15, stride, place),
        _own(16, stride, place),
        _own(17, stride, place),
        _own(18, stride, place),
    )


@_inlined
def _aways(stride: int, integers: Any, s: int, cell: int, links: int) -> tuple[Any, ...]:
    """Return the addresses (19) of a cell's populations in an odd step."""
    return (
        _own(0, stride, _place(integers, s, cell)),
        _away(1, stride, integers, s, cell, links),
        _away(2, stride, integers, s, cell, links),
        _away(3, stride, integers, s, cell, links),
        _away(4, stride, integers, s, cell, links),
        _away(5, stride, integers, s, cell, links),
        _away(6, stride, integers, s, cell, links),
        _away(7, stride, integers, s, cell, links),
        _away(8, stride, integers, s, cell, links),
        _away(9, stride, integers, s, cell, links),
        _away(10, stride, integers, s, cell, links),
        _away(11, stride, integers, s, cell, links),
        _away(12, stride, integers, s, cell, links),
        _away(13, stride, integers, s, cell, links),
        _away(14, stride, integers, s, cell, links),
        _away(15, stride, integers, s, cell, links),
        _away(16, stride, integers, s, cell, links),
        _away(17, stride, integers, s, cell, links),
        _away(18, stride, integers, s, cell, links),
    )


@_inlined
def _loaded(f: Any, at: tuple[int, ...]) -> tuple[Any, ...]:
    """Return the populations (19) at addresses (19)."""
    return (
        load(f, at[0]),
        load(f, at[1]),
        load(f, at[2]),
        load(f, at[3]),
        load(f, at[4]),
        load(f, at[5]),
        load(f, at[6]),
        load(f, at[7]),
        load(f, at[8]),
        load(f, at[9]),
        load(f, at[10]),
        load(f, at[11]),
        load(f, at[12]),
        load(f, at[13]),
        load(f, at[14]),
        load(f, at[15]),
        load(f, at[16]),
        load(f, at[17]),
        load(f, at[18]),
    )


@_inlined
def _stored(f: Any, at: tuple[int, ...], new: tuple[Any, ...]) -> None:
    """Write populations (19) to addresses (19)."""
    store(f, at[0], new[0])
    store(f, at[1], new[1])
    store(f, at[2], new[2])
    store(f, at[3], new[3])
    store(f, at[4], new[4])
    store(f, at[5], new[5])
    store(f, at[6], new[6])
    store(f, at[7], new[7])
    store(f, at[8], new[8])
    store(f, at[9], new[9])
    store(f, at[10], new[10])
    store(f, at[11], new[11])
    store(f, at[12], new[12])
    store(f, at[13], new[13])
    store(f, at[14], new[14])
    store(f, at[15], new[15])
    store(f, at[16], new[16])
    store(f, at[17], new[17])
    store(f, at[18], new[18])


@_inlined
def _stored_away(f: Any, stride: int, integers: Any, s: int, cell: int, links: int, new: tuple[Any, ...]) -> None:
    """Write populations (19) to the addresses of an odd step.

    Addresses are computed again, because registers that hold them would be too few for the collision.
    """
    store(f, _own(0, stride, _place(integers, s, cell)), new[0])
    store(f, _away(1, stride, integers, s, cell, links), new[1])
    store(f, _away(2, stride, integers, s, cell, links), new[2])
    store(f, _away(3, stride, integers, s, cell, links), new[3])
    store(f, _away(4, stride, integers, s, cell, links), new[4])
    store(f, _away(5, stride, integers, s, cell, links), new[5])
    store(f, _away(6, stride, integers, s, cell, links), new[6])
    store(f, _away(7, stride, integers, s, cell, links), new[7])
    store(f, _away(8, stride, integers, s, cell, links), new[8])
    store(f, _away(9, stride, integers, s, cell, links), new[9])
    store(f, _away(10, stride, integers, s, cell, links), new[10])
    store(f, _away(11, stride, integers, s, cell, links), new[11])
    store(f, _away(12, stride, integers, s, cell, links), new[12])
    store(f, _away(13, stride, integers, s, cell, links), new[13])
    store(f, _away(14, stride, integers, s, cell, links), new[14])
    store(f, _away(15, stride, integers, s, cell, links), new[15])
    store(f, _away(16, stride, integers, s, cell, links), new[16])
    store(f, _away(17, stride, integers, s, cell, links), new[17])
    store(f, _away(18, stride, integers, s, cell, links), new[18])


@_inlined
def _link(q: int, links: int, first: int) -> int:
    """Return where the weight of a cell's link in direction `q` is, before its source; `first`: that of the first."""
    return first + 2 * cuda.popc(links & ((1 << q) - 1))


@_inlined
def _returned(q: int, sent: Any, beside: Any, which: int, links: int, first: int, singles: Any) -> Any:
    """Return what the link in direction `q` returns for the population sent, or `sent` where it is not in `which`."""
    if not which & (1 << q):
        return sent
    n = _link(q, links, first)
    weight = singles[_U(n)]
    return weight * sent + (_ONE - abs(weight)) * beside + singles[_U(n + 1)]


@_inlined
def _returned_pair(q: int, a: Any, b: Any, which: int, links: int, first: int, singles: Any) -> tuple[Any, Any]:
    """Return populations `q` and `q` + 1 after the links of this pair of opposite directions (see `_reflected`)."""
    return (
        _returned(q + 1, a, b, which, links, first, singles),
        _returned(q, b, a, which, links, first, singles),
    )


@_inlined
def _reflected(f: tuple[Any, ...], which: int, links: int, first: int, singles: Any) -> tuple[Any, ...]:
    """Return the populations (19) of a cell after the links in the mask `which`.

    What was sent along a link is in the place of the opposite direction.
    """
    return (
        f[0],
        *_returned_pair(1, f[1], f[2], which, links, first, singles),
        *_returned_pair(3, f[3], f[4], which, links, first, singles),
        *_returned_pair(5, f[5], f[6], which, links, first, singles),
        *_returned_pair(7, f[7], f[8], which, links, first, singles),
        *_returned_pair(9, f[9], f[10], which, links, first, singles),
        *_returned_pair(11, f[11], f[12], which, links, first, singles),
        *_returned_pair(13, f[13], f[14], which, links, first, singles),
        *_returned_pair(15, f[15], f[16], which, links, first, singles),
        *_returned_pair(17, f[17], f[18], which, links, first, singles),
    )


@_inlined
def _present(f: Any, integers: Any, singles: Any, stride: int, code_at: int, cell: int) -> tuple[Any, ...]:
    """Return the populations (19) of a cell between two pairs of steps, whether they are at home or not."""
    s, links, near, _, first, _, _ = _cell(cell, integers, code_at)
    held = _loaded(f, _homes(stride, _place(integers, s, cell)))
    if near and not integers[AT_HOME]:
        held = _reflected(held, near, links, first, singles)
    return held


@_inlined
def _collided(held: tuple[Any, ...], singles: Any, s: int, e: int) -> tuple[Any, ...]:
    """Return the collided populations (19) of a cell of segment `s`, each in the place of its opposite.

    `e` is the place of its screen entry, or -1.
    """
    time, odd_rate, limit = singles[0], singles[5], singles[_U(HEAD + s)]
    law = singles[1], singles[2], singles[3], singles[4]
    if law[0] > _ZERO:
        time = thinned(stress_size(held), time, law)
    if e < 0:
        even, odd, half_kept = collided(held, time, limit, odd_rate)
    else:
        normal = singles[e], singles[e + 1], singles[e + 2]
        entry = singles[e + 3], singles[e + 4], singles[e + 5], singles[e + 6]
        even, odd, half_kept = collided_screened(held, time, limit, odd_rate, normal, entry)
    return relaxed(held, even, odd, half_kept)


@_inlined
def _left(
    new: tuple[Any, ...], far: int, links: int, first: int, w: int, integers: Any, singles: Any
) -> tuple[Any, ...]:
    """Return the populations (19) to be stored: after the links in the mask `far`, with the refill of special cells."""
    if far:
        new = _reflected(new, far, links, first, singles)
    rest = new[0]
    if w >= 0:
        rest += singles[_U(integers[REFILL] + w)]
    return rest, *new[1:]


@_inlined
def _velocity(f: tuple[Any, ...]) -> tuple[float, float, float]:
    """Return the momentum (3) of populations (19) in double precision."""
    d1, d2, d3 = float(f[1]) - float(f[2]), float(f[3]) - float(f[4]), float(f[5]) - float(f[6])
    d4, d5, d6 = float(f[7]) - float(f[8]), float(f[9]) - float(f[10]), float(f[11]) - float(f[12])
    d7, d8, d9 = float(f[13]) - float(f[14]), float(f[15]) - float(f[16]), float(f[17]) - float(f[18])
    return d1 + d4 + d5 + d6 + d7, d2 + d4 - d5 + d8 + d9, d3 + d6 - d7 + d8 - d9


@_inlined
def _density(f: tuple[Any, ...]) -> float:
    """Return the density deviation of populations (19) in double precision."""
    total = float(f[0])
    for q in range(1, 19):
        total += float(f[q])
    return total


@_inlined
def _open(
    held: tuple[Any, ...], ends: int, links: int, first: int, integers: Any, singles: Any, doubles: Any, shape: Any
) -> None:
    """Set the sources of a cell's links in the mask `ends` (see `d3q19.drive`)."""
    velocity = _velocity(held)
    openings, answer = integers[OPENINGS], integers[ANSWER]
    now = integers[IMPOSED] + integers[NOW] * (openings + 3) + openings
    moment = doubles[now], doubles[now + 1], doubles[now + 2]
    for q in range(1, 19):
        if ends & (1 << q):
            n = _link(q, links, first)
            end = _end(n, integers)
            k = integers[integers[OPENING_OF_END] + end]
            linear, squared = _between(shape, end, moment)
            if doubles[OPENING * k + KIND] == INFLOW:
                singles[n + 1] = (linear + squared * doubles[answer + k]) * doubles[answer + k]
            else:
                opening = doubles[OPENING * k : OPENING * (k + 1)]
                singles[n + 1] = _outlet_source(velocity, q, opening, doubles[answer + k] + linear)


@_inlined
def _end(n: int, integers: Any) -> int:
    """Return the number, among the links of the ends, of the link at a place of the singles."""
    end: int = integers[integers[END_OF_LINK] + ((n - integers[LINK]) >> 1)]
    return end


@cuda.jit(cache=True)
def even_step(
    f: Any, integers: Any, singles: Any, doubles: Any, shape: Any, stride: int, cells: int, code_at: int
) -> None:
    """Make an even step: every cell collides and stores its populations at home, each in the place of its opposite.

    A launch takes the host some microseconds for every array, so tables share one array of each type.

    Shapes: `f` (19 * stride,), `shape` (m, o, 2).
    """
    cell = cuda.grid(1)
    if cell >= cells:
        return
    s, links, near, ends, first, e, w = _cell(cell, integers, code_at)
    at = _homes(stride, _place(integers, s, cell))
    held = _loaded(f, at)
    if near and not integers[AT_HOME]:
        held = _reflected(held, near, links, first, singles)
    if ends:
        _open(held, ends, links, first, integers, singles, doubles, shape)
    new = _collided(held, singles, s, e)
    _stored(f, at, _left(new, links & ~near, links, first, w, integers, singles))


@cuda.jit(cache=True)
def odd_step(f: Any, integers: Any, singles: Any, stride: int, cells: int, code_at: int, keep: int) -> None:
    """Make an odd step: every cell reads what its neighbours have sent, collides, and stores it in the same places.

    The clock moves to the next pair of steps.
    """
    cell = cuda.grid(1)
    if cell == 0:
        integers[NOW] += 1
        integers[AT_HOME] = 0
    if cell >= cells:
        return
    s, links, near, ends, first, e, w = _cell(cell, integers, code_at)
    held = _loaded(f, _aways(stride, integers, s, cell, links))
    if near:
        held = _reflected(held, near, links, first, singles)
    new = _collided(held, singles, s, e)
    if links:
        _send(f, new, links if keep else ends, stride, integers, s, cell)
    left = _left(new, links & ~near, links, first, w, integers, singles)
    _stored_away(f, stride, integers, s, cell, links, left)


@_inlined
def _send_one(f: Any, q: int, population: Any, which: int, stride: int, integers: Any, s: int, cell: int) -> None:
    """Write what is sent along the link in direction `q` to its mailbox, if it is in the mask `which`."""
    if which & (1 << q):
        store(f, q * stride + _neighbour(q, integers, s, cell), population)


@_inlined
def _send(f: Any, new: tuple[Any, ...], which: int, stride: int, integers: Any, s: int, cell: int) -> None:
    """Write what is sent along the links in the mask `which` to their mailboxes."""
    _send_one(f, 1, new[2], which, stride, integers, s, cell)
    _send_one(f, 2, new[1], which, stride, integers, s, cell)
    _send_one(f, 3, new[4], which, stride, integers, s, cell)
    _send_one(f, 4, new[3], which, stride, integers, s, cell)
    _send_one(f, 5, new[6], which, stride, integers, s, cell)
    _send_one(f, 6, new[5], which, stride, integers, s, cell)
    _send_one(f, 7, new[8], which, stride, integers, s, cell)
    _send_one(f, 8, new[7], which, stride, integers, s, cell)
    _send_one(f, 9, new[10], which, stride, integers, s, cell)
    _send_one(f, 10, new[9], which, stride, integers, s, cell)
    _send_one(f, 11, new[12], which, stride, integers, s, cell)
    _send_one(f, 12, new[11], which, stride, integers, s, cell)
    _send_one(f, 13, new[14], which, stride, integers, s, cell)
    _send_one(f, 14, new[13], which, stride, integers, s, cell)
    _send_one(f, 15, new[16], which, stride, integers, s, cell)
    _send_one(f, 16, new[15], which, stride, integers, s, cell)
    _send_one(f, 17, new[18], which, stride, integers, s, cell)
    _send_one(f, 18, new[17], which, stride, integers, s, cell)


@cuda.jit(cache=True)
def swap(f: Any, integers: Any) -> None:
    """Exchange the populations at septa (see `d3q19.update`); integers as in `even_step`."""
    k, count = cuda.grid(1), integers[SEPTUM_COUNT]
    if k < count:
        at = integers[SEPTA] + k
        one, other = _integer(integers, at), _integer(integers, at + count)
        first, second = load(f, one), load(f, other)
        store(f, one, second)
        store(f, other, first)


@_inlined
def _at_link(column: int, k: int, integers: Any) -> int:
    """Return an entry of `Links.address` for link `k`."""
    address: int = _integer(integers, integers[ADDRESS] + column * integers[LINKS] + k)
    return address


@cuda.jit(cache=True)
def defer(f: Any, integers: Any, singles: Any, part: float) -> None:
    """Bring the populations of wall links home, and move their sources towards higher-order interpolation.

    The last odd step must have kept them. Where `part` is 0 the sources stay as they are.

    Parameters
    ----------
    f, part : as in `d3q19.defer`.
    integers, singles : as in `even_step`. Further integers: `Links.address` (6, l), and the number of each link of the
        walls in `Packed.link`, or -1 minus this number for a near link. Further singles: the mass lost (walls,), and
        `Links.correction` of the walls (5, walls).
    """
    w, walls = cuda.grid(1), integers[WALLS]
    if w >= walls:
        return
    number, k = _integer(integers, integers[SLOT] + w), integers[LINKS] - walls + w
    home, sent = _at_link(0, k, integers), load(f, _at_link(3, k, integers))
    is_near = number < 0
    n = integers[LINK] + 2 * (-1 - number if is_near else number)
    if is_near and not integers[AT_HOME]:
        weight = singles[n]
        beside = load(f, _at_link(2, k, integers))
        store(f, home, weight * sent + (_ONE - abs(weight)) * beside + singles[n + 1])
    singles[integers[LOST] + w] = sent - load(f, home)
    held = (
        sent,
        load(f, _at_link(2, k, integers)),
        load(f, _at_link(1, k, integers)),
        load(f, _at_link(5, k, integers)),
        load(f, _at_link(4, k, integers)),
    )
    at = integers[CORRECTION] + w
    weights = (
        singles[at],
        singles[at + walls],
        singles[at + 2 * walls],
        singles[at + 3 * walls],
        singles[at + 4 * walls],
    )
    singles[n + 1] += part * (_deferred(held, weights) - singles[n + 1])


@cuda.jit(cache=True)
def balance(integers: Any, singles: Any, part: float) -> None:
    """Move the refill towards the mass lost at the walls, one thread per group of wall cells (see `d3q19.balance`).

    It follows `defer`; populations are at home from here on, which the clock keeps.

    Parameters
    ----------
    integers, singles : as in `defer`. Further integers: `Refill.groups`, whose cells are numbers of special cells.
    part : as in `d3q19.balance`.
    """
    g = cuda.grid(1)
    if g == 0:
        integers[AT_HOME] = 1
    if g >= integers[GROUPS]:
        return
    links, members = integers[FIRST_LINK] + g, integers[FIRST_MEMBER] + g
    total = 0.0
    for i in range(_integer(integers, links), _integer(integers, links + 1)):
        total += float(singles[_U(integers[LOST] + _integer(integers, integers[GROUP_LINK] + i))])
    first, last = _integer(integers, members), _integer(integers, members + 1)
    share = total / (last - first)
    for i in range(first, last):
        n = _U(integers[REFILL] + _integer(integers, integers[GROUP_MEMBER] + i))
        singles[n] += part * (share - singles[n])


@cuda.jit(cache=True)
def moments(f: Any, integers: Any, singles: Any, stride: int, code_at: int, density: Any, velocity: Any) -> None:
    """Write density deviation (n,) and momentum (n, 3) of every cell."""
    cell = cuda.grid(1)
    if cell < density.size:
        held = _present(f, integers, singles, stride, code_at, cell)
        density[cell] = _density(held)
        velocity[cell, 0], velocity[cell, 1], velocity[cell, 2] = _velocity(held)


@cuda.jit(cache=True)
def times(f: Any, integers: Any, singles: Any, stride: int, code_at: int, cell: Any, result: Any) -> None:
    """Write relaxation times (e,) of shear-thinning blood in cells (e,) (see `d3q19.relaxation_times`)."""
    e = cuda.grid(1)
    if e < result.size:
        law = singles[1], singles[2], singles[3], singles[4]
        held = _present(f, integers, singles, stride, code_at, cell[e])
        result[e] = thinned(stress_size(held), singles[0], law)


@cuda.jit(cache=True)
def sent(f: Any, integers: Any, through: Any) -> None:
    """Write the flow (l,) through every link; populations must be at home. Integers as in `defer`."""
    k = cuda.grid(1)
    if k < integers[LINKS]:
        through[k] = load(f, _at_link(3, k, integers)) - load(f, _at_link(0, k, integers))


@cuda.jit(cache=True)
def resend(f: Any, integers: Any, through: Any, stretch: float) -> None:
    """Write mailboxes such that the flow through every link is `stretch` times `through` (see `d3q19.rescale`)."""
    k = cuda.grid(1)
    if k < integers[LINKS]:
        store(f, _at_link(3, k, integers), load(f, _at_link(0, k, integers)) + stretch * through[k])


@cuda.jit(cache=True)
def rescale(f: Any, integers: Any, stride: int, cells: int, code_at: int, stretch: float, stress: float) -> None:
    """Convert the populations to time steps `stretch` times as long; they must be at home (see `d3q19.rescale`)."""
    cell = cuda.grid(1)
    if cell < cells:
        at = _homes(stride, _place(integers, _cell(cell, integers, code_at)[0], cell))
        new = rescaled(_loaded(f, at), stretch, stress)
        _stored(f, at, _unswapped(new))


@_inlined
def _unswapped(new: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return populations (19) that are in the places of their opposites in their own places."""
    first = new[0], new[2], new[1], new[4], new[3], new[6], new[5], new[8], new[7], new[10], new[9]
    return *first, new[12], new[11], new[14], new[13], new[16], new[15], new[18], new[17]


@_inlined
def _sum(parts: Any, t: int) -> float:
    """Return the sum of a value of each of a block's threads, in fixed order; every thread must call it."""
    cuda.syncthreads()
    half = THREADS // 2
    while half > 0:
        if t < half:
            parts[t] += parts[t + half]
        cuda.syncthreads()
        half //= 2
    total: float = parts[0]
    cuda.syncthreads()
    return total


@_inlined
def _of_opening(
    f: Any, integers: Any, singles: Any, stride: int, code_at: int, cell: int, k: int, is_flow: bool
) -> float:
    """Return a cell's part of the flow rate out of opening `k`, or of the sum of density over its links."""
    s, links, _, mask, first, _, _ = _cell(cell, integers, code_at)
    opening_at = integers[OPENING_OF_END]
    density, total = 0.0, 0.0
    if not is_flow:
        density = _density(_present(f, integers, singles, stride, code_at, cell))
    for q in range(1, 19):
        if mask & (1 << q) and integers[opening_at + _end(_link(q, links, first), integers)] == k:
            if is_flow:
                out = load(f, q * stride + _neighbour(q, integers, s, cell))
                back = load(f, _own(OPPOSITE[q], stride, _place(integers, s, cell)))
                total += float(out) - float(back)
            else:
                total += density
    return total


@cuda.jit(cache=True)
def outflow(
    f: Any, integers: Any, singles: Any, stride: int, code_at: int, end_cell: Any, start: Any, result: Any
) -> None:
    """Write the flow rate (k,) out of every opening, one block each (see `d3q19.outflow`).

    Parameters
    ----------
    f, integers, singles, stride, code_at : as in `even_step`.
    end_cell, start : `Layout.end_cell` and `Layout.end_cell_start`.
    """
    k, t = cuda.blockIdx.x, cuda.threadIdx.x
    parts = cuda.shared.array(THREADS, np.float64)
    total = 0.0
    for i in range(start[k] + t, start[k + 1], THREADS):
        total += _of_opening(f, integers, singles, stride, code_at, end_cell[i], k, True)
    parts[t] = total
    total = _sum(parts, t)
    if t == 0:
        result[k] = total


@cuda.jit(cache=True)
def drive(f: Any, integers: Any, singles: Any, doubles: Any, stride: int, code_at: int) -> None:
    """Set the speed or density of every opening during the next two steps (see `d3q19.drive`).

    Every block sums over some cells of one opening. The last block of an opening that is done adds these sums, always
    in the same order.
    """
    b, t = cuda.blockIdx.x, cuda.threadIdx.x
    block = integers[BLOCKS] + 3 * b
    k, i, end = integers[block], integers[block + 1] + t, integers[block + 2]
    first, last = integers[integers[FIRST_BLOCK] + k], integers[integers[FIRST_BLOCK] + k + 1]
    kind, part = doubles[OPENING * k + KIND], integers[PARTS]
    parts, is_last = cuda.shared.array(THREADS, np.float64), cuda.shared.array(1, np.int32)
    total = 0.0
    if i < end and kind != PRESSURE:  # its answer depends on nothing
        cell = integers[integers[END_CELL] + i]
        total = _of_opening(f, integers, singles, stride, code_at, cell, k, kind != INFLOW)
    parts[t] = total
    total = _sum(parts, t)
    if t == 0:
        doubles[part + b] = total
        cuda.threadfence()
        is_last[0] = cuda.atomic.add(integers, integers[DONE] + k, 1) == last - first - 1
    cuda.syncthreads()
    if not is_last[0]:
        return
    cuda.threadfence()
    total = 0.0
    for other in range(first + t, last, THREADS):
        total += doubles[part + other]
    parts[t] = total
    total = _sum(parts, t)
    if t == 0:
        integers[integers[DONE] + k] = 0
        _answered(k, total, integers, doubles)


@_inlined
def _answered(k: int, total: float, integers: Any, doubles: Any) -> None:
    """Write the answer of opening `k` to the flow rate out of it or the sum of density over its links."""
    opening, answer = doubles[OPENING * k : OPENING * (k + 1)], integers[ANSWER] + k
    opening[WANTED] = doubles[integers[IMPOSED] + integers[NOW] * (integers[OPENINGS] + 3) + k]
    if opening[KIND] == INFLOW:
        total /= integers[integers[COUNT] + k]
    doubles[answer] = _answer(opening, total)
