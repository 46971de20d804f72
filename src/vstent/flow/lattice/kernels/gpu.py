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
from vstent.flow.lattice.kernels.d3q19 import INFLOW, OPPOSITE, OUTFLOW

THREADS: Final = 8 if config.ENABLE_CUDASIM else 128
"""Number of threads per block; a power of 2. Numba simulates each by a thread of the processor, which is slow."""
COLUMN: Final = np.array([0, 1, 2, 3, 4, 0, 0, 5, 6, 7, 8, 1, 2, 1, 2, 3, 4, 3, 4], np.int32)
"""(19,) column of a segment's row of places that holds the neighbour in each direction (see `packing.Packed.rows`)."""
SHIFT: Final = np.array([0, 0, 0, 0, 0, 1, -1, 0, 0, 0, 0, 1, -1, -1, 1, 1, -1, -1, 1], np.int32)
"""(19,) number of places from there to the neighbour: neighbours along z are adjacent."""
NOW, AT_HOME = 0, 1
"""Entries of the device's clock: the row of the boundary values that applies, and whether populations are at home."""
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_U, _WHOLE = np.uint64, np.uint32


def _of_arrays(function: Any) -> Any:
    """Return a function of arrays for use in a kernel: numba's simulator cannot pass its arrays to compiled code."""
    return getattr(function, "py_func", function) if config.ENABLE_CUDASIM else function


def _inlined(function: Callable[..., Any]) -> Any:
    """Return a function that is compiled into the kernels that call it."""
    return function if config.ENABLE_CUDASIM else njit(forceinline=True)(function)


_balance_group, _between, _deferred = (_of_arrays(one) for one in (d3q19.balance_group, d3q19.between, d3q19.deferred))
_inflow_speed, _outlet_density = _of_arrays(d3q19.inflow_speed), _of_arrays(d3q19.outlet_density)
_outlet_source = _of_arrays(d3q19.outlet_source)


@_inlined
def load(f: Any, address: int) -> Any:
    """Return the population at an address; every kernel reads populations here."""
    return f[_U(address)]


@_inlined
def store(f: Any, address: int, population: Any) -> None:
    """Write the population at an address; every kernel writes populations here."""
    f[_U(address)] = population


@_inlined
def _cell(cell: int, cells: Any, special: Any) -> tuple[int, int, int, int, int, int, int]:
    """Return segment, link masks (all, near, ends), first link, screen entry and number of a special cell.

    A cell without links and screen has no links, entry -1 and number -1.
    """
    code = cells[0][cell]
    if code >= 0:
        return code, 0, 0, 0, 0, -1, -1
    w = -1 - code
    return special[0, w], special[1, w], special[2, w], special[3, w], special[4, w], special[5, w], w


@_inlined
def _neighbour(q: int, rows: Any, s: int, cell: int) -> int:
    """Return the storage place of the neighbour in direction `q` of a cell of segment `s`."""
    place: int = rows[s, COLUMN[q]] + cell + SHIFT[q]
    return place


@_inlined
def _own(q: int, stride: int, place: int) -> Any:
    """Return the address of population `q` of a cell at home; addresses have 32 bits."""
    return _WHOLE(q * stride + place)


@_inlined
def _away(q: int, stride: int, rows: Any, s: int, cell: int, links: int) -> Any:
    """Return the address of population `q` of a cell in an odd step: at the neighbour, or at home behind a link."""
    p = OPPOSITE[q]
    if links & (1 << p):
        return _own(q, stride, rows[s, 0] + cell)
    return _WHOLE(p * stride + _neighbour(p, rows, s, cell))


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
def _aways(stride: int, rows: Any, s: int, cell: int, links: int) -> tuple[Any, ...]:
    """Return the addresses (19) of a cell's populations in an odd step."""
    return (
        _own(0, stride, rows[s, 0] + cell),
        _away(1, stride, rows, s, cell, links),
        _away(2, stride, rows, s, cell, links),
        _away(3, stride, rows, s, cell, links),
        _away(4, stride, rows, s, cell, links),
        _away(5, stride, rows, s, cell, links),
        _away(6, stride, rows, s, cell, links),
        _away(7, stride, rows, s, cell, links),
        _away(8, stride, rows, s, cell, links),
        _away(9, stride, rows, s, cell, links),
        _away(10, stride, rows, s, cell, links),
        _away(11, stride, rows, s, cell, links),
        _away(12, stride, rows, s, cell, links),
        _away(13, stride, rows, s, cell, links),
        _away(14, stride, rows, s, cell, links),
        _away(15, stride, rows, s, cell, links),
        _away(16, stride, rows, s, cell, links),
        _away(17, stride, rows, s, cell, links),
        _away(18, stride, rows, s, cell, links),
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
def _stored_away(f: Any, stride: int, rows: Any, s: int, cell: int, links: int, new: tuple[Any, ...]) -> None:
    """Write populations (19) to the addresses of an odd step.

    Addresses are computed again, because registers that hold them would be too few for the collision.
    """
    store(f, _own(0, stride, rows[s, 0] + cell), new[0])
    store(f, _away(1, stride, rows, s, cell, links), new[1])
    store(f, _away(2, stride, rows, s, cell, links), new[2])
    store(f, _away(3, stride, rows, s, cell, links), new[3])
    store(f, _away(4, stride, rows, s, cell, links), new[4])
    store(f, _away(5, stride, rows, s, cell, links), new[5])
    store(f, _away(6, stride, rows, s, cell, links), new[6])
    store(f, _away(7, stride, rows, s, cell, links), new[7])
    store(f, _away(8, stride, rows, s, cell, links), new[8])
    store(f, _away(9, stride, rows, s, cell, links), new[9])
    store(f, _away(10, stride, rows, s, cell, links), new[10])
    store(f, _away(11, stride, rows, s, cell, links), new[11])
    store(f, _away(12, stride, rows, s, cell, links), new[12])
    store(f, _away(13, stride, rows, s, cell, links), new[13])
    store(f, _away(14, stride, rows, s, cell, links), new[14])
    store(f, _away(15, stride, rows, s, cell, links), new[15])
    store(f, _away(16, stride, rows, s, cell, links), new[16])
    store(f, _away(17, stride, rows, s, cell, links), new[17])
    store(f, _away(18, stride, rows, s, cell, links), new[18])


@_inlined
def _number(q: int, links: int, first: int) -> int:
    """Return the number of a cell's link in direction `q`; its links are numbered by direction from `first` on."""
    return first + cuda.popc(links & ((1 << q) - 1))


@_inlined
def _returned(q: int, sent: Any, beside: Any, which: int, links: int, first: int, link: Any) -> Any:
    """Return what the link in direction `q` returns for the population sent, or `sent` where it is not in `which`."""
    if not which & (1 << q):
        return sent
    n = _number(q, links, first)
    weight = link[n, 0]
    return weight * sent + (_ONE - abs(weight)) * beside + link[n, 1]


@_inlined
def _returned_pair(q: int, a: Any, b: Any, which: int, links: int, first: int, link: Any) -> tuple[Any, Any]:
    """Return populations `q` and `q` + 1 after the links of this pair of opposite directions (see `_reflected`)."""
    return (
        _returned(q + 1, a, b, which, links, first, link),
        _returned(q, b, a, which, links, first, link),
    )


@_inlined
def _reflected(f: tuple[Any, ...], which: int, links: int, first: int, link: Any) -> tuple[Any, ...]:
    """Return the populations (19) of a cell after the links in the mask `which`.

    What was sent along a link is in the place of the opposite direction.
    """
    return (
        f[0],
        *_returned_pair(1, f[1], f[2], which, links, first, link),
        *_returned_pair(3, f[3], f[4], which, links, first, link),
        *_returned_pair(5, f[5], f[6], which, links, first, link),
        *_returned_pair(7, f[7], f[8], which, links, first, link),
        *_returned_pair(9, f[9], f[10], which, links, first, link),
        *_returned_pair(11, f[11], f[12], which, links, first, link),
        *_returned_pair(13, f[13], f[14], which, links, first, link),
        *_returned_pair(15, f[15], f[16], which, links, first, link),
        *_returned_pair(17, f[17], f[18], which, links, first, link),
    )


@_inlined
def _present(f: Any, cell: int, cells: Any, walls: Any, clock: Any) -> tuple[Any, ...]:
    """Return the populations (19) of a cell between two pairs of steps, whether they are at home or not."""
    s, links, near, _, first, _, _ = _cell(cell, cells, walls[0])
    held = _loaded(f, _homes(cells[3], cells[1][s, 0] + cell))
    if near and not clock[AT_HOME]:
        held = _reflected(held, near, links, first, walls[1])
    return held


@_inlined
def _collided(held: tuple[Any, ...], limit: Any, number: Any, e: int, screen: Any) -> tuple[Any, ...]:
    """Return the collided populations (19), each in the place of its opposite; `e` is the screen entry or -1."""
    time, odd_rate = number[0], number[5]
    law = number[1], number[2], number[3], number[4]
    if law[0] > _ZERO:
        time = thinned(stress_size(held), time, law)
    if e < 0:
        even, odd, half_kept = collided(held, time, limit, odd_rate)
    else:
        normal = screen[e, 0], screen[e, 1], screen[e, 2]
        entry = screen[e, 3], screen[e, 4], screen[e, 5], screen[e, 6]
        even, odd, half_kept = collided_screened(held, time, limit, odd_rate, normal, entry)
    return relaxed(held, even, odd, half_kept)


@_inlined
def _left(new: tuple[Any, ...], far: int, links: int, first: int, w: int, walls: Any) -> tuple[Any, ...]:
    """Return the populations (19) to be stored: after the links in the mask `far`, with the refill of special cells."""
    if far:
        new = _reflected(new, far, links, first, walls[1])
    rest = new[0]
    if w >= 0:
        rest += walls[2][w]
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
def _open(held: tuple[Any, ...], ends: int, links: int, first: int, link: Any, opening: Any) -> None:
    """Set the sources of a cell's links in the mask `ends` (see `d3q19.drive`)."""
    of_link, of_end, shape, openings, answer, imposed, clock = opening
    velocity = _velocity(held)
    row = clock[NOW]
    k_end = answer.size
    moment = imposed[row, k_end], imposed[row, k_end + 1], imposed[row, k_end + 2]
    for q in range(1, 19):
        if ends & (1 << q):
            n = _number(q, links, first)
            end = of_link[n]
            k = of_end[end]
            linear, squared = _between(shape, end, moment)
            if openings[k, 0] == INFLOW:
                link[n, 1] = (linear + squared * answer[k]) * answer[k]
            else:
                link[n, 1] = _outlet_source(velocity, q, openings[k], answer[k] + linear)


@cuda.jit(cache=True)
def even_step(f: Any, cells: Any, walls: Any, screen: Any, number: Any, opening: Any) -> None:
    """Make an even step: every cell collides and stores its populations at home, each in the place of its opposite.

    Parameters
    ----------
    f : (19 * stride,) float32
        Populations, changed in place.
    cells : tuple
        `Packed.code`, `Packed.rows`, `Packed.limit` and the stride.
    walls : tuple
        `Packed.special`, `Packed.link` and `Packed.refill`.
    screen : (e, d3q19.ENTRY) float32
        Screen entries (see `collision.resist`).
    number : (6,) float32
        Relaxation time at high shear rate, Carreau-Yasuda law (4), relaxation rate of the odd part (see
        `d3q19.update`).
    opening : tuple
        `Packed.end_of_link`, `Packed.opening_of_end`, `Links.shape`, `Links.openings`, the answer (k,) of every opening
        from `drive`, its boundary values (rows, k + 3), and the clock.
    """
    cell = cuda.grid(1)
    if cell >= cells[0].size:
        return
    s, links, near, ends, first, e, w = _cell(cell, cells, walls[0])
    at = _homes(cells[3], cells[1][s, 0] + cell)
    held = _loaded(f, at)
    if near and not opening[6][AT_HOME]:
        held = _reflected(held, near, links, first, walls[1])
    if ends:
        _open(held, ends, links, first, walls[1], opening)
    new = _collided(held, cells[2][s], number, e, screen)
    _stored(f, at, _left(new, links & ~near, links, first, w, walls))


@cuda.jit(cache=True)
def odd_step(f: Any, cells: Any, walls: Any, screen: Any, number: Any, clock: Any, keep: int) -> None:
    """Make an odd step: every cell reads what its neighbours have sent, collides, and stores it in the same places.

    Parameters
    ----------
    f, cells, walls, screen, number
        As in `even_step`.
    clock : (2,) int32
        Moved to the next pair of steps.
    keep : int
        Whether what is sent along links is also written to the mailboxes: 0 at the openings only, 1 everywhere.
    """
    cell = cuda.grid(1)
    if cell == 0:
        clock[NOW] += 1
        clock[AT_HOME] = 0
    if cell >= cells[0].size:
        return
    s, links, near, ends, first, e, w = _cell(cell, cells, walls[0])
    stride, rows = cells[3], cells[1]
    held = _loaded(f, _aways(stride, rows, s, cell, links))
    if near:
        held = _reflected(held, near, links, first, walls[1])
    new = _collided(held, cells[2][s], number, e, screen)
    if links:
        _send(f, new, links if keep else ends, stride, rows, s, cell)
    _stored_away(f, stride, rows, s, cell, links, _left(new, links & ~near, links, first, w, walls))


@_inlined
def _send_one(f: Any, q: int, population: Any, which: int, stride: int, rows: Any, s: int, cell: int) -> None:
    """Write what is sent along the link in direction `q` to its mailbox, if it is in the mask `which`."""
    if which & (1 << q):
        store(f, q * stride + _neighbour(q, rows, s, cell), population)


@_inlined
def _send(f: Any, new: tuple[Any, ...], which: int, stride: int, rows: Any, s: int, cell: int) -> None:
    """Write what is sent along the links in the mask `which` to their mailboxes."""
    _send_one(f, 1, new[2], which, stride, rows, s, cell)
    _send_one(f, 2, new[1], which, stride, rows, s, cell)
    _send_one(f, 3, new[4], which, stride, rows, s, cell)
    _send_one(f, 4, new[3], which, stride, rows, s, cell)
    _send_one(f, 5, new[6], which, stride, rows, s, cell)
    _send_one(f, 6, new[5], which, stride, rows, s, cell)
    _send_one(f, 7, new[8], which, stride, rows, s, cell)
    _send_one(f, 8, new[7], which, stride, rows, s, cell)
    _send_one(f, 9, new[10], which, stride, rows, s, cell)
    _send_one(f, 10, new[9], which, stride, rows, s, cell)
    _send_one(f, 11, new[12], which, stride, rows, s, cell)
    _send_one(f, 12, new[11], which, stride, rows, s, cell)
    _send_one(f, 13, new[14], which, stride, rows, s, cell)
    _send_one(f, 14, new[13], which, stride, rows, s, cell)
    _send_one(f, 15, new[16], which, stride, rows, s, cell)
    _send_one(f, 16, new[15], which, stride, rows, s, cell)
    _send_one(f, 17, new[18], which, stride, rows, s, cell)
    _send_one(f, 18, new[17], which, stride, rows, s, cell)


@cuda.jit(cache=True)
def swap(f: Any, pairs: Any) -> None:
    """Exchange the populations at addresses pairs[0] and pairs[1] (see `d3q19.update`)."""
    k = cuda.grid(1)
    if k < pairs.shape[1]:
        first, second = load(f, pairs[0, k]), load(f, pairs[1, k])
        store(f, pairs[0, k], second)
        store(f, pairs[1, k], first)


@cuda.jit(cache=True)
def defer(f: Any, address: Any, correction: Any, slots: Any, lost: Any, clock: Any, part: float) -> None:
    """Bring the populations of wall links home, and move their sources towards higher-order interpolation.

    The last odd step must have kept them. Where `part` is 0 the sources stay as they are.

    Parameters
    ----------
    f, address, correction, lost, part
        As in `d3q19.defer`.
    slots : tuple
        (links,) int32 number of each link in `Packed.link`, or -1 minus this number for a near link; `Packed.link`.
    clock : (2,) int32
        As in `odd_step`.
    """
    k = cuda.grid(1)
    slot, link = slots
    if k >= slot.size:
        return
    n, home, sent = slot[k], address[k, 0], load(f, address[k, 3])
    if n < 0:
        n = -1 - n
        if not clock[AT_HOME]:
            weight = link[n, 0]
            store(f, home, weight * sent + (_ONE - abs(weight)) * load(f, address[k, 2]) + link[n, 1])
    lost[k] = sent - load(f, home)
    link[n, 1] += part * (_deferred(k, f, address, correction) - link[n, 1])


@cuda.jit(cache=True)
def balance(lost: Any, groups: Any, refill: Any, clock: Any, part: float) -> None:
    """Move the refill towards the mass lost at the walls, one thread per group of wall cells (see `d3q19.balance`).

    It follows `defer`; populations are at home from here on.
    """
    g = cuda.grid(1)
    if g == 0:
        clock[AT_HOME] = 1
    if g + 1 < groups[0].size:
        _balance_group(g, lost, groups, refill, part)


@cuda.jit(cache=True)
def moments(f: Any, cells: Any, walls: Any, clock: Any, density: Any, velocity: Any) -> None:
    """Write density deviation (n,) and momentum (n, 3) of every cell."""
    cell = cuda.grid(1)
    if cell < density.size:
        held = _present(f, cell, cells, walls, clock)
        density[cell] = _density(held)
        velocity[cell, 0], velocity[cell, 1], velocity[cell, 2] = _velocity(held)


@cuda.jit(cache=True)
def times(f: Any, cells: Any, walls: Any, clock: Any, cell: Any, number: Any, result: Any) -> None:
    """Write relaxation times (e,) of shear-thinning blood in cells (e,) (see `d3q19.relaxation_times`)."""
    e = cuda.grid(1)
    if e < result.size:
        law = number[1], number[2], number[3], number[4]
        result[e] = thinned(stress_size(_present(f, cell[e], cells, walls, clock)), number[0], law)


@cuda.jit(cache=True)
def sent(f: Any, address: Any, through: Any) -> None:
    """Write the flow (l,) through every link; populations must be at home."""
    k = cuda.grid(1)
    if k < through.size:
        through[k] = load(f, address[k, 3]) - load(f, address[k, 0])


@cuda.jit(cache=True)
def resend(f: Any, address: Any, through: Any, stretch: float) -> None:
    """Write mailboxes such that the flow through every link is `stretch` times `through` (see `d3q19.rescale`)."""
    k = cuda.grid(1)
    if k < through.size:
        store(f, address[k, 3], load(f, address[k, 0]) + stretch * through[k])


@cuda.jit(cache=True)
def rescale(f: Any, cells: Any, walls: Any, stretch: float, stress: float) -> None:
    """Convert the populations to time steps `stretch` times as long; they must be at home (see `d3q19.rescale`)."""
    cell = cuda.grid(1)
    if cell < cells[0].size:
        s = _cell(cell, cells, walls[0])[0]
        at = _homes(cells[3], cells[1][s, 0] + cell)
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
def _of_opening(f: Any, cell: int, k: int, cells: Any, walls: Any, ends: Any, clock: Any, is_flow: bool) -> float:
    """Return a cell's part of the flow rate out of opening `k`, or of the sum of density over its links."""
    of_link, of_end = ends
    s, links, _, mask, first, _, _ = _cell(cell, cells, walls[0])
    stride, rows = cells[3], cells[1]
    density, total = 0.0, 0.0
    if not is_flow:
        density = _density(_present(f, cell, cells, walls, clock))
    for q in range(1, 19):
        if mask & (1 << q) and of_end[of_link[_number(q, links, first)]] == k:
            if is_flow:
                out = load(f, q * stride + _neighbour(q, rows, s, cell))
                back = load(f, _own(OPPOSITE[q], stride, rows[s, 0] + cell))
                total += float(out) - float(back)
            else:
                total += density
    return total


@cuda.jit(cache=True)
def outflow(f: Any, cells: Any, walls: Any, clock: Any, ends: Any, end_cell: Any, start: Any, result: Any) -> None:
    """Write the flow rate (k,) out of every opening, one block each (see `d3q19.outflow`).

    Parameters
    ----------
    f, cells, walls, clock
        As in `odd_step`.
    ends : tuple
        `Packed.end_of_link` and `Packed.opening_of_end`.
    end_cell, start
        `Packed.end_cell` and `Packed.end_cell_start`.
    """
    k, t = cuda.blockIdx.x, cuda.threadIdx.x
    parts = cuda.shared.array(THREADS, np.float64)
    total = 0.0
    for i in range(start[k] + t, start[k + 1], THREADS):
        total += _of_opening(f, end_cell[i], k, cells, walls, ends, clock, True)
    parts[t] = total
    total = _sum(parts, t)
    if t == 0:
        result[k] = total


@cuda.jit(cache=True)
def drive(f: Any, cells: Any, walls: Any, opening: Any, blocks: Any, end_cell: Any, sums: Any) -> None:
    """Set the speed or density of every opening during the next two steps (see `d3q19.drive`).

    Every block sums over some cells of one opening. The last block of an opening that is done adds these sums, always
    in the same order.

    Parameters
    ----------
    f, cells, walls, opening
        As in `even_step`.
    blocks : (b, 3) int32
        `Packed.blocks`.
    end_cell : (j,) int32
        `Packed.end_cell`.
    sums : tuple
        (b,) sum of every block; (k,) int32 number of blocks done, 0 before and after; (k + 1,) first block of every
        opening; (k,) number of links of every opening.
    """
    of_link, of_end, _, openings, answer, imposed, clock = opening
    part, done, first_block, count = sums
    b, t = cuda.blockIdx.x, cuda.threadIdx.x
    k, i = blocks[b, 0], blocks[b, 1] + t
    kind = openings[k, 0]
    parts, is_last = cuda.shared.array(THREADS, np.float64), cuda.shared.array(1, np.int32)
    total = 0.0
    if i < blocks[b, 2] and kind in (INFLOW, OUTFLOW):
        total = _of_opening(f, end_cell[i], k, cells, walls, (of_link, of_end), clock, kind == OUTFLOW)
    parts[t] = total
    total = _sum(parts, t)
    if t == 0:
        part[b] = total
        cuda.threadfence()
        is_last[0] = cuda.atomic.add(done, k, 1) == first_block[k + 1] - first_block[k] - 1
    cuda.syncthreads()
    if not is_last[0]:
        return
    cuda.threadfence()
    total = 0.0
    for other in range(first_block[k] + t, first_block[k + 1], THREADS):
        total += part[other]
    parts[t] = total
    total = _sum(parts, t)
    if t == 0:
        done[k] = 0
        openings[k, 1] = imposed[clock[NOW], k]
        if kind == INFLOW:
            answer[k] = _inflow_speed(openings[k], total / count[k])
        elif kind == OUTFLOW:
            answer[k] = _outlet_density(openings[k], total)
        else:
            answer[k] = openings[k, 1]
