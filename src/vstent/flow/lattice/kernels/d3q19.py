"""D3Q19 lattice-Boltzmann kernels on a sparse set of cells: in place, in rows, in single precision.

Storage. Populations are shifted by their rest weights (f - w) and lie in one flat array: population q of storage place
i is at q * stride + i. Storage places are the fluid cells *and* their solid neighbours, row by row along z, so that a
*segment* (a run of fluid cells along z) and each of its 18 neighbouring runs are contiguous: one address per segment
and population replaces one per cell, and eight or sixteen are worked on at once (`vstent.flow.lattice.kernels.lanes`).

Update in place (the AA pattern; Bailey, Myre, Walsh, Lilja and Saar 2009, ICPP, 550). Even step: a cell reads its own
populations and writes the collided ones back, each at the place of its opposite. Odd step: it reads where its
neighbours have left them and writes to the same places. After an odd step every population is at home again.

A link that leaves the fluid ends at a solid neighbour, whose storage place serves as the link's mailbox: what a wall or
an opening sends back is put there (before an odd step) or taken from there (after it).

Populations are numbered 0 rest, then in opposite pairs (1, 2), (3, 4), ... (17, 18).
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from vstent.flow.lattice.kernels.collision import (
    collided,
    collided_screened,
    rates,
    relaxed_pair,
    rescaled,
    resist,
    stress_size,
    thinned,
)
from vstent.flow.lattice.kernels.lanes import COUNT, gather, load, starts, store, upto
from vstent.kernels.arrays import Floats, Ints
from vstent.kernels.directions import VELOCITIES

WEIGHTS: Final = np.where((squares := (VELOCITIES**2).sum(axis=1)) == 0, 1 / 3, np.where(squares == 1, 1 / 18, 1 / 36))
"""(19,) rest weights."""
OPPOSITE: Final = np.array([0] + [q + 1 if q % 2 else q - 1 for q in range(1, 19)], dtype=np.int32)
"""(19,) number of the opposite velocity."""
SOUND: Final = 3**-0.5
"""Speed of the lattice's sound, in cells per time step."""
AXIAL: Final = 6
"""Number of the last velocity along an axis; those after it are diagonal."""
PRESSURE, INFLOW, OUTFLOW = 0.0, 1.0, 2.0
"""What can be imposed at an opening (see `drive`)."""
OWN_DENSITIES: Final = (2, 8)
"""Columns of an opening that are densities of its own (see `drive`)."""
SLOWLY: Final = 0.1
"""Part of the way that an outlet's pressure goes in a step pair; at once, it would chase its own answer."""
SEGMENT: Final = 128
"""Longest segment, in cells."""
LINK_WORK, SCREENED_WORK = 0.06, 2.0
"""Time that a link takes, and a vector of a segment with screened cells, over that of a vector without."""
ENTRY: Final = 7
"""Numbers that say what a cell of a screen resists (see `resist`): the unit normal and four of the resistance."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_ROOT_THREE: Final = float(np.sqrt(3.0))
_U = np.uint64
_WIDE = SEGMENT + COUNT
_KINDS: Final = 3
"""Stages of a step: cells collide; links send back what these and the bands beside have sent; septa exchange what links
of their band and the next have read."""
_AFTER: Final = (0, 1, 2)
"""Bands after a band that have to have collided before each stage can be done to it."""
_BEFORE: Final = (0, 1, 1)
"""Bands before it that have to."""
_STEP: Final = 2
"""The same, before and after, for it to begin the next step."""


@njit(cache=True, inline="always")
def even_part(q: int, density: float, ux: float, uy: float, uz: float) -> float:
    """Even part of the equilibrium of population q over its weight (see `vstent.flow.lattice.kernels.collision`)."""
    cx, cy, cz = VELOCITIES[q, 0], VELOCITIES[q, 1], VELOCITIES[q, 2]
    along = cx * ux + cy * uy + cz * uz
    beside = (1 - cx * cx) * ux * ux + (1 - cy * cy) * uy * uy + (1 - cz * cz) * uz * uz
    part = 0.5 if q == 0 else -1.5 if q <= AXIAL else 1.5
    return density + 4.5 * along * along - 1.5 * (ux * ux + uy * uy + uz * uz) + part * beside


@njit(cache=True, fastmath=True, error_model="numpy")
def _thin(f: Any, start: Any, n: int, time: float, law: Any, times: Any) -> None:
    """Relaxation times of a segment of n cells whose blood thins with the shear rate, from the stress they hold."""
    for k in range(0, n, COUNT):
        store(times, k, stress_size(gather(f, start, k)))
    for k in range(n):
        times[k] = thinned(times[k], time, law)


@njit(cache=True, forceinline=True, error_model="numpy")
def _relax_pair(pair: int, f: Any, start: Any, k: int, cells: int, parts: Any) -> None:
    """Relax the populations of a pair of opposite velocities (see `_relax`)."""
    here, opposite = start[2 * pair - 1] + k, start[2 * pair] + k
    a, b = load(f, here), load(f, opposite)
    new_a, new_b = relaxed_pair(a, b, parts[0][pair], parts[1][pair - 1], parts[2])
    store(f, here, upto(cells, new_a, a))
    store(f, opposite, upto(cells, new_b, b))


@njit(cache=True, forceinline=True, error_model="numpy")
def _relax(f: Any, start: Any, k: int, cells: int, parts: Any) -> None:
    """Relax a segment's cells from k on, as many as Lanes hold but no more than `cells`, by what `collided` returns.

    Populations are read a second time for it, pair by pair: a processor's registers hold neither all of them nor all
    that they become, and what lies in the cache anyway need not be put aside besides.
    """
    _relax_pair(1, f, start, k, cells, parts)
    _relax_pair(2, f, start, k, cells, parts)
    _relax_pair(3, f, start, k, cells, parts)
    _relax_pair(4, f, start, k, cells, parts)
    _relax_pair(5, f, start, k, cells, parts)
    _relax_pair(6, f, start, k, cells, parts)
    _relax_pair(7, f, start, k, cells, parts)
    _relax_pair(8, f, start, k, cells, parts)
    _relax_pair(9, f, start, k, cells, parts)
    store(f, start[0] + k, upto(cells, parts[0][0], load(f, start[0] + k)))


@njit(cache=True, forceinline=True, error_model="numpy")
def _collide(f: Any, start: Any, k: int, cells: int, settings: Any) -> None:
    """Collide a segment's cells from k on, as many as Lanes hold but no more than `cells`."""
    times, limit, odd_rate = settings
    parts = collided(gather(f, start, k), load(times, k), limit, odd_rate)
    _relax(f, start, k, cells, parts)


@njit(cache=True, forceinline=True, error_model="numpy")
def _collide_screened(f: Any, start: Any, k: int, cells: int, settings: Any, resistance: Any) -> None:
    """Do what `_collide` does, where there are cells of a screen among them."""
    times, limit, odd_rate = settings
    normal = load(resistance, k), load(resistance, k + _WIDE), load(resistance, k + 2 * _WIDE)
    linear = load(resistance, k + 3 * _WIDE), load(resistance, k + 4 * _WIDE)
    entry = *linear, load(resistance, k + 5 * _WIDE), load(resistance, k + 6 * _WIDE)
    parts = collided_screened(gather(f, start, k), load(times, k), limit, odd_rate, normal, entry)
    _relax(f, start, k, cells, parts)


@njit(cache=True, fastmath=True, error_model="numpy")
def _collide_across(f: Any, start: Any, s: int, cells: int, settings: Any, screen: Any, scratch: Any) -> None:
    """Collide the cells of segment s, which a screen crosses.

    Free and screened cells have a loop each: with both in one, a compiler keeps too little of either in registers.
    """
    screen_start, screen_place, entry = screen
    resistance, marked, _ = scratch
    for e in range(screen_start[s], screen_start[s + 1]):
        marked[screen_place[e] // COUNT] = True
        for k in range(ENTRY):
            resistance[k * _WIDE + screen_place[e]] = entry[e, k]
    for k in range(0, cells, COUNT):
        if not marked[k // COUNT]:
            _collide(f, start, k, cells - k, settings)
    for k in range(0, cells, COUNT):
        if marked[k // COUNT]:
            _collide_screened(f, start, k, cells - k, settings, resistance)
    for e in range(screen_start[s], screen_start[s + 1]):
        marked[screen_place[e] // COUNT] = False
        for k in range(ENTRY):
            resistance[k * _WIDE + screen_place[e]] = _ZERO


@njit(cache=True, fastmath=True, error_model="numpy")
def _update_some(
    f: Any, address: Any, length: Any, relaxation: Any, screen: Any, scratch: Any, begin: int, end: int
) -> None:
    """Do what `update` does to the segments from `begin` on, before `end`."""
    time, law, limit, odd_rate = relaxation
    times = scratch[2]
    for s in range(begin, end):
        cells, start = length[s], starts(address, s)
        if law[0] > 0.0:
            _thin(f, start, cells, time, law, times)
        settings = times, limit[s], odd_rate
        if screen[0][s] < screen[0][s + 1]:
            _collide_across(f, start, s, cells, settings, screen, scratch)
        else:
            whole = cells // COUNT * COUNT
            for k in range(0, whole, COUNT):
                _collide(f, start, k, COUNT, settings)
            if whole < cells:
                _collide(f, start, whole, cells - whole, settings)


@njit(cache=True, fastmath=True, forceinline=True)
def _reflect(f: Any, path: Any, weight: Any, source: Any, k: int) -> None:
    """Send back what crosses link k: a weighted sum of two and a source."""
    link = _U(k)
    first, second, target = _U(path[link, 0]), _U(path[link, 1]), _U(path[link, 2])
    f[target] = weight[link, 0] * f[first] + weight[link, 1] * f[second] + source[link]


@njit(cache=True)
def _swap(f: Any, septa: Any, k: int) -> None:
    """Exchange what two blood cells send each other through septum k."""
    first, second = _U(septa[0, k]), _U(septa[1, k])
    kept = f[first]
    f[first] = f[second]
    f[second] = kept


@njit(cache=True, fastmath=True, error_model="numpy")
def _do(stage: int, band: int, f: Any, cells: Any, links: Any, bands: Any, scratch: Any) -> None:
    """Do a stage of the steps to a band (see `_KINDS`)."""
    address, length, relaxation, screen = cells
    path, weight, source, of_ends, place, refill, septa = links
    step, kind = stage // _KINDS, stage % _KINDS
    here, beyond = bands[band], bands[band + 1]
    if kind == 0:
        _update_some(f, address[step], length, relaxation, screen, scratch, here[0], beyond[0])
        for w in range(here[1], beyond[1]):
            f[_U(place[w])] += refill[w]
    elif kind == 1:
        for k in range(here[2], beyond[2]):
            _reflect(f, path[step], weight, source, k)
        for n in range(here[3], beyond[3]):
            _reflect(f, path[step], weight, source, of_ends[n])
    else:
        for k in range(here[4], beyond[4]):
            _swap(f, septa, k)


@njit(cache=True)
def _of_itself(stage: int, first: int, last: int, count: int) -> tuple[int, int]:
    """First band, and the one after the last, to which a share can do a stage without waiting for the others."""
    step, kind = stage // _KINDS, stage % _KINDS
    before, after = _STEP * step + _BEFORE[kind], _STEP * step + _AFTER[kind]
    return first + (before if first > 0 else 0), last - (after if last < count else 0)


@njit(cache=True)
def _scratch(time: float) -> tuple[Any, ...]:
    """Return what one thread's collisions need: see `_collide_across` and `_thin`."""
    resistance, marked = np.zeros(ENTRY * _WIDE, np.float32), np.zeros(_WIDE // COUNT + 1, np.bool_)
    return resistance, marked, np.full(_WIDE, time)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def update(f: Any, cells: Any, links: Any, bands: Any, shares: Any) -> None:
    """Make a step, or an even one and the odd one after it: collide and stream all cells, and send back at the walls.

    Both steps sweep over the bands together, the second so far behind the first that it needs nothing still to come:
    it finds the populations, and the links' too, in the processor's cache, and memory is read once for both (time
    skewing; Wonnacott 2002, Int. J. Parallel Program. 30, 181). Only bands at the ends of a thread's share wait for the
    other threads.

    Parameters
    ----------
    f : (19 * stride + COUNT,) float32 populations, in place; up to COUNT - 1 places beyond a segment they may be read
        and written again as they were: between the storage places of two bands lie as many that are no cell's.
    cells : a tuple of

        - (steps, segments, 19) int32, where the populations of each segment begin: its own in an even step, its
          neighbours' in an odd one;
        - (segments,) int32 cells of each segment, at most SEGMENT;
        - the relaxation: float32 time of the stress, at high shear; (4,) float32 what blood at rest has more of it, the
          time by which shear rates count, and the exponents a and (n - 1) / a of Carreau and Yasuda's law, the first
          being 0 where the viscosity is the same everywhere; (segments,) float32 largest cell Reynolds number, speed
          over viscosity: faster blood is made that thick; float32 relaxation rate of the odd part;
        - the screen: (segments + 1,) int32 first entry of every segment; (e,) int32 place within the segment; (e,
          ENTRY) float32 unit normal and resistance (see `resist`).
    links : a tuple of (steps, l, 3) two places read and the one written (see `paths`); (l, 2) float32 weights; (l,)
        float32 sources; (o,) int32 those of the links that are no wall's; (w,) int32 rest populations to which (w,)
        float32 is added; (2, t) int32 addresses of populations that a wall half-way between two cells exchanges.
    bands : (bands + 1, 5) first segment, rest population, link of a wall, other link and septum of every band, and of
        what would follow the last. What leaves a cell stays in its band or goes to one beside it; septa lie between
        their band and the next.
    shares : (threads + 1,) first band of every thread's share, and the number of bands (see `share`).
    """
    address, length, relaxation, screen = cells  # threads cannot be given tuples of tuples
    threads, count, steps = len(shares) - 1, len(bands) - 1, len(address)
    stages = _KINDS * steps
    for chunk in prange(threads):
        scratch, first, last = _scratch(relaxation[0]), shares[chunk], shares[chunk + 1]
        for front in range(first, last + _STEP * steps):
            for stage in range(stages):
                band = front - _STEP * (stage // _KINDS) - _AFTER[stage % _KINDS]
                begin, end = _of_itself(stage, first, last, count)
                if begin <= band < end:
                    _do(stage, band, f, (address, length, relaxation, screen), links, bands, scratch)
    for stage in range(1, stages if threads > 1 else 1):
        if stage % _KINDS == 2 and bands[-1, 4] == 0:
            continue
        for chunk in prange(threads):
            scratch, first, last = _scratch(relaxation[0]), shares[chunk], shares[chunk + 1]
            begin, end = _of_itself(stage, first, last, count)
            for band in range(first, last):
                if not begin <= band < end:
                    _do(stage, band, f, (address, length, relaxation, screen), links, bands, scratch)


def share(length: Ints, screen_start: Ints, bands: Ints, threads: int) -> Ints:
    """Give every thread bands that keep it busy as long as the others: the `shares` of `update`."""
    vectors = -(-length // COUNT) * np.where(np.diff(screen_start) > 0, SCREENED_WORK, 1.0)
    done = np.r_[0.0, np.cumsum(vectors)][bands[:, 0]] + LINK_WORK * (bands[:, 2] - bands[0, 2] + bands[:, 3])
    wanted = done[-1] * np.arange(threads + 1) / threads
    return np.abs(done[:, None] - wanted).argmin(axis=0).astype(np.int32)


def undivided(segments: int, links: int = 0) -> tuple[Ints, Ints]:
    """Return the `bands` and `shares` of `update` where there is a single band, with so many links of walls."""
    return np.array([[0, 0, 0, 0, 0], [segments, 0, links, 0, 0]], np.int32), np.array([0, 1], np.int32)


NO_LINKS: Final = (
    np.zeros((2, 0, 3), np.int32),
    np.zeros((0, 2), np.float32),
    np.zeros(0, np.float32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros(0, np.float32),
    np.zeros((2, 0), np.int32),
)
"""What `update` takes for links where there are none."""


def no_screen(segments: int) -> tuple[Ints, Ints, NDArray[np.float32]]:
    """Return what `update` takes for the screen where there is none."""
    return np.zeros(segments + 1, np.int32), np.zeros(0, np.int32), np.zeros((0, ENTRY), np.float32)


def addresses(place: Ints, behind: Sequence[Ints], stride: int) -> Ints:
    """Where populations of segments begin (2, s, 19), in an even and in an odd step.

    Parameters
    ----------
    place : (s,) storage place of every segment's first cell; behind : 19 of (s,), that of the cell each comes from.
    """
    own = place[:, None] + stride * np.arange(19)
    neighbours = np.stack([OPPOSITE[q] * stride + behind[q] for q in range(19)], axis=1)
    return np.stack([own, neighbours]).astype(np.int32)


def paths(address: Ints, weight: Floats) -> tuple[Ints, NDArray[np.float32]]:
    """Prepare `update` for links whose reflection needs at most two populations.

    Parameters
    ----------
    address : (links, 6) places of, after an even step: what leaves along the link (a), what left the cell behind (b),
        what leaves against the link (c), the mailbox (d); then (see `defer`) what left the second cell behind (e) and
        what leaves the cell behind against the link (g). After an odd step a and d, b and c, e and g change roles.
    weight : (links, 3) of a, b and c; b's or c's is zero.

    Returns
    -------
    The paths (2, links, 3) after an even and after an odd step, and their weights (links, 2).
    """
    needs_c = weight[:, 2] != 0
    after_even = np.where(needs_c[:, None], address[:, (0, 2, 3)], address[:, (0, 1, 3)])
    after_odd = np.where(needs_c[:, None], address[:, (3, 1, 0)], address[:, (3, 2, 0)])
    both = np.column_stack([weight[:, 0], np.where(needs_c, weight[:, 2], weight[:, 1])])
    return np.ascontiguousarray([after_even, after_odd]), both.astype(np.float32)


@njit(cache=True, fastmath=True, forceinline=True)
def defer_link(k: int, f: Any, address: Any, correction: Any, source: Any, lost: Any, part: float) -> None:
    """Do what `defer` does to its link k."""
    a, b, c = _U(address[k, 3]), _U(address[k, 2]), _U(address[k, 1])
    e, g = _U(address[k, 5]), _U(address[k, 4])
    lost[k] = f[a] - f[_U(address[k, 0])]
    wanted = correction[k, 0] * f[a] + correction[k, 1] * f[b] + correction[k, 2] * f[c]
    wanted += correction[k, 3] * f[e] + correction[k, 4] * f[g]
    source[k] += part * (wanted - source[k])


@njit(cache=True, parallel=True, fastmath=True)
def defer(f: Any, address: Any, correction: Any, source: Any, lost: Any, part: float) -> None:
    """Move the walls' sources towards the difference between quadratic and linear interpolation (populations at home).

    Quadratic reflection itself can be unstable; as a correction that lags behind it is not, and the steady state is the
    same (deferred correction, Khosla and Rubin 1974, Comput. Fluids 2, 207).

    Parameters
    ----------
    address : (links, 6) as in `paths`; correction : (links, 5) float32 weights of a, b, c, e and g.
    lost : (links,) float32, set to what each link loses.
    """
    for k in prange(len(address)):
        defer_link(k, f, address, correction, source, lost, part)


@njit(cache=True, forceinline=True)
def balance_group(g: int, lost: Any, groups: Any, refill: Any, part: float) -> None:
    """Do what `balance` does to its group g."""
    link_start, link, member_start, member = groups
    total = 0.0
    for k in range(link_start[g], link_start[g + 1]):
        total += float(lost[link[k]])
    share = total / (member_start[g + 1] - member_start[g])
    for m in range(member_start[g], member_start[g + 1]):
        w = member[m]
        refill[w] += part * (share - refill[w])


@njit(cache=True, parallel=True)
def balance(lost: Any, groups: Any, refill: Any, part: float) -> None:
    """Move the refill (w,) towards what the interpolated walls lose, spread over groups of wall cells.

    Parameters
    ----------
    lost : (links,) what each link of the walls loses (see `defer`).
    groups : (g + 1,) first link of every group, and (links,) the links, group by group; then the same of wall cells.
    """
    for g in prange(len(groups[0]) - 1):
        balance_group(g, lost, groups, refill, part)


@njit(cache=True, parallel=True)
def moments(f: Any, stride: int, places: Any) -> Any:
    """Density deviation and momentum (n, 4) of the storage `places` (n,), all populations being at home."""
    result = np.zeros((len(places), 4))
    for i in prange(len(places)):
        for q in range(19):
            population = float(f[q * stride + places[i]])
            result[i, 0] += population
            for axis in range(3):
                result[i, 1 + axis] += VELOCITIES[q, axis] * population
    return result


@njit(cache=True, parallel=True)
def set_equilibrium(f: Any, stride: int, places: Any, density: Any, velocity: Any) -> None:
    """Fill the populations of `places` (n,) with the equilibrium of density deviation (n,) and velocity (n, 3)."""
    for i in prange(len(places)):
        ux, uy, uz = velocity[i, 0], velocity[i, 1], velocity[i, 2]
        for q in range(19):
            along = VELOCITIES[q, 0] * ux + VELOCITIES[q, 1] * uy + VELOCITIES[q, 2] * uz
            f[q * stride + places[i]] = WEIGHTS[q] * (even_part(q, density[i], ux, uy, uz) + 3.0 * along)


@njit(cache=True, parallel=True, error_model="numpy")
def rescale(f: Any, stride: int, places: Any, links: Any, stretch: float, stress: float) -> None:
    """Go on at `places` (n,) in time steps `stretch` times as long, all populations being at home (see `rescaled`).

    What `links` (l, 6), addresses as in `paths`, have let through lies in their mailboxes still: so much more of it.
    """
    through = np.zeros(len(links), np.float32)
    for k in prange(len(links)):
        through[k] = f[links[k, 3]] - f[links[k, 0]]
    for i in prange(len(places)):
        held = np.zeros(19, np.float32)
        for q in range(19):
            held[q] = f[q * stride + places[i]]
        new = rescaled(held, stretch, stress)
        for q in range(19):
            f[OPPOSITE[q] * stride + places[i]] = new[q]
    for k in prange(len(links)):
        f[links[k, 3]] = f[links[k, 0]] + stretch * through[k]


@njit(cache=True)
def relaxation_times(f: Any, stride: int, places: Any, time: float, law: Any) -> Any:
    """Relaxation times (n,) of blood that thins, at storage `places` (n,), all populations being at home."""
    result = np.zeros(len(places), np.float32)
    held = np.zeros(19, np.float32)
    for i in range(len(places)):
        for q in range(19):
            held[q] = f[q * stride + places[i]]
        result[i] = thinned(stress_size(held), time, law)
    return result


@njit(cache=True)
def resisted(velocity: Any, entries: Any, times: Any, odd_rate: float) -> Any:
    """Half-force velocity (e, 3) of screened cells from their momentum (e, 3) and entries (e, ENTRY) (see `resist`).

    And from their relaxation times (e,).
    """
    result = np.zeros_like(velocity)
    for e in range(len(entries)):
        normal, entry = entries[e, :3], entries[e, 3:]
        u, _ = resist(normal, entry, (velocity[e, 0], velocity[e, 1], velocity[e, 2]), rates(times[e], odd_rate))
        result[e, 0], result[e, 1], result[e, 2] = u
    return result


@njit(cache=True, inline="always")
def velocity_at(f: Any, stride: int, place: int) -> tuple[float, float, float]:
    """Momentum of the populations of a storage place, all being at home."""
    ux = uy = uz = 0.0
    for q in range(1, 19):
        population = f[q * stride + place]
        ux += VELOCITIES[q, 0] * population
        uy += VELOCITIES[q, 1] * population
        uz += VELOCITIES[q, 2] * population
    return ux, uy, uz


@njit(cache=True, forceinline=True)
def inflow_speed(opening: Any, density: float) -> float:
    """Speed that inflow answers a mean density with; `opening` (9,) as in `drive`, what it remembers changes."""
    # Against a high resistance the flow itself waits for the mean: forget faster the higher the pressure.
    resistance = abs(density) / max(abs(opening[1]), 1e-6)
    rate = min(1.0, opening[3] * (1.0 + resistance / _ROOT_THREE))
    opening[2] += rate * (density - opening[2])
    speed: float = opening[1] - (density - opening[2]) / _ROOT_THREE
    return speed


@njit(cache=True, forceinline=True)
def outlet_density(opening: Any, flow: float) -> float:
    """Density deviation that an outlet answers a flow through it with; what `opening` (9,) remembers changes."""
    excess = flow / opening[7] - opening[1]
    opening[2] += opening[3] * excess
    opening[8] += SLOWLY * (opening[2] + _ROOT_THREE * excess - opening[8])
    density: float = opening[8]
    return density


@njit(cache=True, forceinline=True)
def outlet_source(velocity: Any, q: int, opening: Any, density: float) -> float:
    """What an outlet (9,) of this density deviation sends back along velocity q into a cell, from its momentum (3)."""
    ux, uy, uz = velocity
    inward = max(0.0, -(ux * opening[4] + uy * opening[5] + uz * opening[6]))
    return 2.0 * WEIGHTS[q] * even_part(q, density - 1.5 * inward * inward, ux, uy, uz)


@njit(cache=True, forceinline=True)
def between(shape: Any, n: int, moment: Any) -> tuple[float, float]:
    """Shape of link n between two moments of a cycle (see `drive`)."""
    now, following, part = int(moment[0]), int(moment[1]), moment[2]
    first, second = shape[now, n], shape[following, n]
    return first[0] + part * (second[0] - first[0]), first[1] + part * (second[1] - first[1])


@njit(cache=True)
def _density(f: Any, stride: int, places: Any) -> float:
    """Mean density deviation at places, one after the other where they are the same."""
    total, held = 0.0, 0.0
    for n in range(len(places)):
        if n == 0 or places[n] != places[n - 1]:
            held = 0.0
            for q in range(19):
                held += f[q * stride + places[n]]
        total += held
    return total / len(places)


@njit(cache=True)
def outflow(f: Any, address: Any) -> float:
    """Flow out through the links `address` (l, 6), all populations being at home."""
    total = 0.0
    for k in range(len(address)):
        total += float(f[address[k, 3]]) - float(f[address[k, 0]])
    return total


@njit(cache=True)
def drive(f: Any, stride: int, openings: Any, links: Any, moment: Any, source: Any) -> None:
    """Set what every opening sends back during the next two steps (all populations being at home).

    Parameters
    ----------
    openings : (k, 9) what is imposed (`PRESSURE`, `INFLOW` or `OUTFLOW`), the density deviation or speed wanted, the
        remembered mean density, its rate of change, the outward normal (3), the area in cells, the density imposed.
    links : (k + 1,) first link of every opening in what follows; (l, 6) addresses as in `paths`; (l,) storage place of
        each link's cell; (l,) its direction; (m, l, 2) its shape at m moments of a cycle: what inflow sends back
        through it, over its speed and over its speed squared; of what an outlet imposes, how much more its density is
        there than the outlet's.
    moment : (3,) the two of them between which these steps lie, and which part of the way.
    source : (l,).

    Inflow: half-way reflection off a moving wall (Ladd 1994, J. Fluid Mech. 271, 285), so the flow is exact. It
    lets sound out: a density above the remembered mean is answered by the wave that leaves (Poinsot and Lele 1992,
    J. Comput. Phys. 101, 104). Pressure: anti-reflection (Ginzburg, Verhaeghe and d'Humieres 2008, Commun.
    Comput. Phys. 3, 427, sec. 5.2). Where blood comes back through an outlet it is the total pressure that is
    imposed, which bounds the energy that enters. Outflow: the pressure that answers the excess of speed as the wave
    that leaves would, about a mean that moves until no excess is left.
    """
    start, address, place, direction, shape = links
    for k in range(len(openings)):
        opening, first, last = openings[k], start[k], start[k + 1]
        if opening[0] == INFLOW:
            speed = inflow_speed(opening, _density(f, stride, place[first:last]))
            for n in range(first, last):
                linear, squared = between(shape, n, moment)
                source[n] = (linear + squared * speed) * speed
            continue
        density = opening[1]
        if opening[0] == OUTFLOW:
            density = outlet_density(opening, outflow(f, address[first:last]))
        velocity = 0.0, 0.0, 0.0
        for n in range(first, last):
            if n == first or place[n] != place[n - 1]:  # a cell's links follow each other
                velocity = velocity_at(f, stride, place[n])
            source[n] = outlet_source(velocity, direction[n], opening, density + between(shape, n, moment)[0])
