"""The kernels of `d3q19` and `exchange` for a GPU (numba-cuda), one thread per cell, link or group.

Arithmetic is the same; the functions of one cell, link or opening are shared. Sums have a fixed order, so that a GPU
reproduces its results to the last bit. They differ from those of a CPU in the last bits, because the compilers fuse and
reorder operations differently.

A pair of time steps is `drive`, `even_step` and `odd_step`. Walls and openings need no kernel of their own. What a cell
sends along a link stays in the cell's own place for the opposite direction, where the next step reads it. A *near* link
combines it with a population that arrives at the cell, when the next step reads it; any other link combines it with a
population that leaves the cell, before it is stored. Only `keep` also writes the population sent to the mailbox, where
the CPU has it after every odd step. After `defer` the populations are *at home*, that is, stored as on the CPU. Where
levels exchange them, they must be.

Import it only where a GPU is requested (`vstent.flow.lattice.gpu`).
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numba import config, cuda, njit

from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.kernels.collision import collided, collided_screened, relaxed, rescaled, stress_size, thinned
from vstent.flow.lattice.kernels.d3q19 import INFLOW, KIND, OPENING, OPPOSITE, PRESSURE, WANTED
from vstent.flow.lattice.kernels.exchange import answered, converted, density_of
from vstent.kernels.directions import VELOCITIES

THREADS: Final = 8 if config.ENABLE_CUDASIM else 128
"""Number of threads per block; a power of 2. Numba simulates each by a thread of the processor, which is slow."""
COLUMN: Final = np.array([0, 1, 2, 3, 4, 0, 0, 5, 6, 7, 8, 1, 2, 1, 2, 3, 4, 3, 4], np.int32)
"""(19,) column of the rows (segments, 9) that holds the neighbour in each direction. A row holds storage place minus
cell number, the same in a whole segment, of its cells and of their neighbours without a component along z."""
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
    # Places among the singles: weights and sources of links, refill of special cells, mass lost, `Links.correction`.
    LINK, REFILL, LOST, CORRECTION,
    # Places among the doubles: answers, sums of blocks, boundary values.
    ANSWER, PARTS, IMPOSED,
) = range(30)
# fmt: on
"""Entries with which the integers begin; `gpu_tables` writes them."""
LINE: Final = 32
"""Number of entries of 32 bits in a line of the memory. Every table begins on one; the limits are on the second."""
HEAD: Final = LINE
"""Number of places kept for these entries."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_U, _WHOLE = np.uint64, np.uint32


def _inlined(function: Callable[..., Any]) -> Any:
    """Return a function that is compiled into the kernels that call it."""
    return function if config.ENABLE_CUDASIM else njit(forceinline=True)(function)


def _of_arrays(function: Any) -> Any:
    """Return a function of arrays for use in a kernel: numba's simulator cannot pass its arrays to compiled code."""
    return getattr(function, "py_func", function) if config.ENABLE_CUDASIM else function


_answer, _balance, _between, _deferred, _outlet_source = (
    _of_arrays(function)
    for function in (d3q19.answered, d3q19.balance_group, d3q19.between, d3q19.deferred, d3q19.outlet_source)
)


def _unrolled(arguments: str, entry: str, numbers: range = range(19)) -> Any:
    """Return a function with the tuple of `entry` for every direction q and its opposite p.

    It is written out because a tuple indexed by a variable is kept in memory instead of registers.
    """
    entries = "".join(entry.format(q=q, p=OPPOSITE[q]) + ", " for q in numbers)
    return _inlined(eval(f"lambda {arguments}: ({entries})", globals()))


@_inlined
def load(array: Any, place: int) -> Any:
    """Return an entry of an array; every kernel reads populations here."""
    return array[_U(place)]


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
    code = load(integers, code_at + cell)
    if code >= 0:
        return code, 0, 0, 0, 0, -1, -1
    w = -1 - code
    return *_special(integers, integers[SPECIAL] + w, integers[SPECIALS]), w


_special = _unrolled("integers, at, specials", "load(integers, at + {q} * specials)", range(6))


@_inlined
def _place(q: int, integers: Any, s: int, cell: int) -> int:
    """Return the storage place of the neighbour in direction `q` of a cell of segment `s`; 0: of the cell itself."""
    place: int = load(integers, HEAD + 9 * s + COLUMN[q]) + cell + SHIFT[q]
    return place


@_inlined
def _own(q: int, stride: int, place: int) -> Any:
    """Return the address of population `q` of a cell at home; addresses have 32 bits."""
    return _WHOLE(q * stride + place)


@_inlined
def _away(q: int, stride: int, integers: Any, s: int, cell: int, links: int) -> Any:
    """Return the address of population `q` of a cell in an odd step: at the neighbour, or at home behind a link."""
    p = OPPOSITE[q]
    if q == 0 or links & (1 << p):
        return _own(q, stride, _place(0, integers, s, cell))
    return _own(p, stride, _place(p, integers, s, cell))


_homes = _unrolled("stride, place", "_own({q}, stride, place)")
_aways = _unrolled("stride, integers, s, cell, links", "_away({q}, stride, integers, s, cell, links)")
_loaded = _unrolled("f, at", "load(f, at[{q}])")
_stored = _unrolled("f, at, new", "store(f, at[{q}], new[{q}])")
_stored_swapped = _unrolled("f, at, new", "store(f, at[{q}], new[{p}])")
# Addresses are computed again, because registers that hold them would be too few for the collision.
_stored_away = _unrolled(
    "f, stride, integers, s, cell, links, new", "store(f, _away({q}, stride, integers, s, cell, links), new[{q}])"
)


@_inlined
def _link(q: int, links: int, first: int) -> int:
    """Return where the weight of a cell's link in direction `q` is, before its source; `first`: that of the first."""
    return first + 2 * cuda.popc(links & ((1 << q) - 1))


@_inlined
def _mixed(n: int, sent: Any, beside: Any, singles: Any) -> Any:
    """Return what the link with its weight at `n` returns for the population sent."""
    weight = load(singles, n)
    return weight * sent + (_ONE - abs(weight)) * beside + load(singles, n + 1)


@_inlined
def _returned(q: int, sent: Any, beside: Any, which: int, links: int, first: int, singles: Any) -> Any:
    """Return what the link in direction `q` returns for the population sent, or `sent` where it is not in `which`."""
    if q == 0 or not which & (1 << q):
        return sent
    return _mixed(_link(q, links, first), sent, beside, singles)


# The populations (19) of a cell after the links in the mask `which`. What was sent along a link is in the place of the
# opposite direction.
_reflected = _unrolled(
    "f, which, links, first, singles", "_returned({p}, f[{q}], f[{p}], which, links, first, singles)"
)


@_inlined
def _present(f: Any, integers: Any, singles: Any, stride: int, code_at: int, cell: int) -> tuple[Any, ...]:
    """Return the populations (19) of a cell between two pairs of steps, whether they are at home or not."""
    s, links, near, _, first, _, _ = _cell(cell, integers, code_at)
    held: tuple[Any, ...] = _loaded(f, _homes(stride, _place(0, integers, s, cell)))
    if near and not integers[AT_HOME]:
        held = _reflected(held, near, links, first, singles)
    return held


@_inlined
def _collided(held: tuple[Any, ...], singles: Any, s: int, e: int) -> tuple[Any, ...]:
    """Return the collided populations (19) of a cell, each in the place of its opposite; `e`: its entry, or -1."""
    time, odd_rate, limit = singles[0], singles[5], load(singles, LINE + s)
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
def _left(new: Any, far: int, links: int, first: int, w: int, integers: Any, singles: Any) -> tuple[Any, ...]:
    """Return the populations (19) to be stored: after the links in the mask `far`, with the refill of special cells."""
    if far:
        new = _reflected(new, far, links, first, singles)
    rest = new[0]
    if w >= 0:
        rest += load(singles, integers[REFILL] + w)
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
def _open(held: Any, ends: int, links: int, first: int, integers: Any, singles: Any, doubles: Any, shape: Any) -> None:
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
    """
    cell = cuda.grid(1)
    if cell >= cells:
        return
    s, links, near, ends, first, e, w = _cell(cell, integers, code_at)
    at = _homes(stride, _place(0, integers, s, cell))
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
        store(f, q * stride + _place(q, integers, s, cell), population)


_send = _unrolled(
    "f, new, which, stride, integers, s, cell",
    "_send_one(f, {q}, new[{p}], which, stride, integers, s, cell)",
    range(1, 19),
)


@cuda.jit(cache=True)
def swap(f: Any, integers: Any) -> None:
    """Exchange the populations at septa (see `d3q19.update`); integers as in `even_step`."""
    k, count = cuda.grid(1), integers[SEPTUM_COUNT]
    if k < count:
        at = integers[SEPTA] + k
        one, other = load(integers, at), load(integers, at + count)
        first, second = load(f, one), load(f, other)
        store(f, one, second)
        store(f, other, first)


@_inlined
def _at_link(column: int, k: int, integers: Any) -> int:
    """Return an entry of `Links.address` for link `k`."""
    address: int = load(integers, integers[ADDRESS] + column * integers[LINKS] + k)
    return address


_correction = _unrolled("singles, at, walls", "singles[at + {q} * walls]", range(5))


@cuda.jit(cache=True)
def defer(f: Any, integers: Any, singles: Any, part: float) -> None:
    """Bring the populations of wall links home, and move their sources as `d3q19.defer` does; not where `part` is 0.

    The last odd step must have kept them.
    """
    w, walls = cuda.grid(1), integers[WALLS]
    if w >= walls:
        return
    number, k = load(integers, integers[SLOT] + w), integers[LINKS] - walls + w
    home, sent, beside = _at_link(0, k, integers), load(f, _at_link(3, k, integers)), load(f, _at_link(2, k, integers))
    is_near = number < 0
    n = integers[LINK] + 2 * (-1 - number if is_near else number)
    if is_near and not integers[AT_HOME]:
        store(f, home, _mixed(n, sent, beside, singles))
    singles[integers[LOST] + w] = sent - load(f, home)
    behind, further, back = _at_link(1, k, integers), _at_link(5, k, integers), _at_link(4, k, integers)
    held = sent, beside, load(f, behind), load(f, further), load(f, back)
    singles[n + 1] += part * (_deferred(held, _correction(singles, integers[CORRECTION] + w, walls)) - singles[n + 1])


@cuda.jit(cache=True)
def balance(integers: Any, singles: Any, part: float) -> None:
    """Move the refill towards the mass lost at the walls, one thread per group of wall cells (see `d3q19.balance`).

    It follows `defer`; populations are at home from here on, which the clock keeps. Members of the groups are numbers
    of special cells.
    """
    g = cuda.grid(1)
    if g == 0:
        integers[AT_HOME] = 1
    if g < integers[GROUPS] and part != 0:
        of_links = integers[integers[FIRST_LINK] :], integers[integers[GROUP_LINK] :]
        groups = *of_links, integers[integers[FIRST_MEMBER] :], integers[integers[GROUP_MEMBER] :]
        _balance(g, singles[integers[LOST] :], groups, singles[integers[REFILL] :], part)


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
    """Write the flow (l,) through the first links; populations must be at home. Integers as in `even_step`."""
    k = cuda.grid(1)
    if k < through.size:
        through[k] = float(load(f, _at_link(3, k, integers))) - float(load(f, _at_link(0, k, integers)))


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
        at = _homes(stride, _place(0, integers, _cell(cell, integers, code_at)[0], cell))
        _stored_swapped(f, at, rescaled(_loaded(f, at), stretch, stress))


@_inlined
def _sum(parts: Any, t: int, part: float) -> float:
    """Return the sum of the parts of a block's threads, in fixed order; every thread must call it."""
    parts[t] = part
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
    f: Any, integers: Any, singles: Any, stride: int, code_at: int, cell: int, k: int, kind: float
) -> float:
    """Return a cell's part of the flow rate out of opening `k`; of an inflow, of the sum of density over its links."""
    s, links, _, mask, first, _, _ = _cell(cell, integers, code_at)
    opening_at = integers[OPENING_OF_END]
    density, total = 0.0, 0.0
    if kind == INFLOW:
        density = _density(_present(f, integers, singles, stride, code_at, cell))
    for q in range(1, 19):
        if mask & (1 << q) and integers[opening_at + _end(_link(q, links, first), integers)] == k:
            if kind == INFLOW:
                total += density
            else:
                out = load(f, q * stride + _place(q, integers, s, cell))
                back = load(f, _own(OPPOSITE[q], stride, _place(0, integers, s, cell)))
                total += float(out) - float(back)
    return total


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
    opening, part = doubles[OPENING * k : OPENING * (k + 1)], integers[PARTS]
    parts, is_last = cuda.shared.array(THREADS, np.float64), cuda.shared.array(1, np.int32)
    total = 0.0
    if i < end and opening[KIND] != PRESSURE:  # its answer depends on nothing
        cell = integers[integers[END_CELL] + i]
        total = _of_opening(f, integers, singles, stride, code_at, cell, k, opening[KIND])
    total = _sum(parts, t, total)
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
    total = _sum(parts, t, total)
    if t == 0:
        integers[integers[DONE] + k] = 0
        opening[WANTED] = doubles[integers[IMPOSED] + integers[NOW] * (integers[OPENINGS] + 3) + k]
        if opening[KIND] == INFLOW:
            total /= integers[integers[COUNT] + k]
        doubles[integers[ANSWER] + k] = _answer(opening, total)


_PUSH: Final = (3 * d3q19.WEIGHTS[:, None] * VELOCITIES).astype(np.float32)
"""(19, 3) what momentum adds to the populations of a cell."""
_zeros = _unrolled("zero", "zero")
_plus = _unrolled("total, same, other, f", "total[{q}] + same * f[{q}] + other * f[{p}]")
_pushed = _unrolled("f, x, y, z", "f[{q}] + (_PUSH[{q}, 0] * x + _PUSH[{q}, 1] * y + _PUSH[{q}, 2] * z)")


@cuda.jit(cache=True)
def take(f: Any, place: Any, group: Any, share: Any, held: Any) -> None:
    """Take the mass that groups lack from cells beside the border (see `exchange.take`)."""
    c = cuda.grid(1)
    if c < place.size:
        at = load(place, c)
        store(f, at, load(f, at) - np.float32(share[c] * held[0, group[c]]))


@cuda.jit(cache=True)
def add_crossed(f: Any, address: Any, passed: Any, sign: int) -> None:
    """Add what passes at links (l,) of borders in a step, from addresses (2, l); `sign`: 1 if it is even, else -1."""
    k = cuda.grid(1)
    if k < passed.size:
        passed[k] += sign * float(load(f, address[0, k]) - load(f, address[1, k]))


@cuda.jit(cache=True)
def jumps(f: Any, stride: int, g: Any, new_stride: int, place: Any, finer: Any, part: float, found: Any) -> None:
    """Write jump and speed (2, m) of the cells between (see `exchange.jumps`)."""
    c = cuda.grid(1)
    if c < place.size:
        jump, speed = density_of(_loaded(f, _homes(stride, load(place, c))), part)
        for n in range(finer.shape[0]):
            density, _ = density_of(_loaded(g, _homes(new_stride, finer[n, c])), _ZERO)
            jump -= density / np.float32(finer.shape[0])
        found[0, c], found[1, c] = jump, speed


@_inlined
def _taken(values: Any, first: int, last: int, parts: Any, t: int) -> float:
    """Return the sum of some values, which become 0; every thread of a block must call it."""
    total = 0.0
    for k in range(first + t, last, THREADS):
        total += values[k]
        values[k] = 0.0
    result: float = _sum(parts, t, total)
    return result


@cuda.jit(cache=True)
def answer(first: Any, passed: Any, passed_finer: Any, found: Any, held: Any, cells: Any, part: float) -> None:
    """Set what groups lack and their momentum, from what passed on both grids and from `jumps`; one block per group.

    `first` (3, g + 1) are the first link of every group on the finer and on the coarser grid, and its first cell
    between. `part` is the volume of a finer cell over that of a coarser one.
    """
    g, t = cuda.blockIdx.x, cuda.threadIdx.x
    parts = cuda.shared.array(THREADS, np.float64)
    crossed = part * _taken(passed_finer, first[0, g], first[0, g + 1], parts, t)
    crossed -= _taken(passed, first[1, g], first[1, g + 1], parts, t)
    jump = _taken(found[0], first[2, g], first[2, g + 1], parts, t)
    speed = _taken(found[1], first[2, g], first[2, g + 1], parts, t)
    if t == 0:
        lack, down, up = answered(crossed, jump, speed, (held[0, g], held[1, g], held[2, g]), cells)
        held[0, g], held[1, g], held[2, g] = lack, down, up


@cuda.jit(cache=True)
def carry(
    f: Any, stride: int, rates: Any, g: Any, new_stride: int, new_rates: Any, cells: Any, parts: Any, push: Any
) -> None:
    """Set populations of a grid by interpolation from those of another (see `exchange.carry`).

    The first three arguments are populations, stride and singles of the source, the next three those of the target, and
    the following two are from `on_gpu.stencil_of`.
    """
    i = cuda.grid(1)
    if i >= cells.shape[1]:
        return
    total, (xx, yy, zz, xy, xz, yz) = _zeros(_ZERO), (_ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO)
    for e in range(cells[2, i]):
        even, odd, read = parts[5 + 2 * e, i], parts[6 + 2 * e, i], _loaded(f, _homes(stride, cells[3 + e, i]))
        total = _plus(total, _HALF * (even + odd), _HALF * (even - odd), read)
        u, v, w = _velocity(read)
        x, y, z = np.float32(u), np.float32(v), np.float32(w)
        xx, yy, zz = xx + even * (x * x), yy + even * (y * y), zz + even * (z * z)
        xy, xz, yz = xy + even * (x * y), xz + even * (x * z), yz + even * (y * z)
    more = np.float32(push[cells[1, i]])
    pushed = _pushed(total, more * parts[1, i], more * parts[2, i], more * parts[3, i])
    time, law = rates[0], (rates[1], rates[2], rates[3], rates[4])
    if law[0] > _ZERO:
        time = np.float32(thinned(stress_size(pushed), time, law))
    new = converted(pushed, (xx, yy, zz, xy, xz, yz), time, parts[0, i], (parts[4, i], rates[5], new_rates[5]))
    _stored_swapped(g, _homes(new_stride, cells[0, i]), new)
