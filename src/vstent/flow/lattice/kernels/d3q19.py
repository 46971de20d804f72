"""D3Q19 lattice-Boltzmann kernels on a sparse set of cells: in place, in rows, in single precision.

Storage: the rest weight w is subtracted from each population, and all are stored in one flat array. Population q of
storage place i is at q * stride + i. Storage places exist for blood cells *and* for their solid neighbours, row by row
along z. A *segment* is a run of blood cells along z. It and each of its 18 neighbouring runs are contiguous, so that
one address per segment and direction suffices, and eight or sixteen cells are processed at once
(`vstent.flow.lattice.kernels.lanes`).

Update in place (AA pattern; Bailey, Myre, Walsh, Lilja and Saar 2009, ICPP, 550): in an even step a cell reads its own
populations and writes each collided one to the place of its opposite. In an odd step it reads the populations where its
neighbours have written them, and writes to the same places. After an odd step every population is *at home*, that is,
stored at its own cell and direction.

A link from a blood cell to a solid neighbour uses the storage place of this neighbour as its *mailbox*. The population
that a wall or an opening returns is written there before an odd step, and the outgoing one is read from there after it.

Population 0 is the rest population. The others are numbered in opposite pairs (1, 2), (3, 4), ... (17, 18).
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
    relaxed,
    rescaled,
    resist,
    stress_size,
    thinned,
)
from vstent.flow.lattice.kernels.lanes import COUNT, fetch, gather, load, scatter, starts
from vstent.kernels.arrays import Floats, Ints
from vstent.kernels.directions import VELOCITIES

WEIGHTS: Final = np.where((squares := (VELOCITIES**2).sum(axis=1)) == 0, 1 / 3, np.where(squares == 1, 1 / 18, 1 / 36))
"""(19,) weights of the populations at rest."""
OPPOSITE: Final = np.array([0] + [q + 1 if q % 2 else q - 1 for q in range(1, 19)], dtype=np.int32)
"""(19,) number of the opposite direction."""
SOUND: Final = 3**-0.5
"""Speed of sound of the lattice, in cells per time step."""
AXIAL: Final = 6
"""Number of the last direction along an axis; those after it are diagonal."""
PRESSURE, INFLOW, OUTFLOW = 0.0, 1.0, 2.0
"""Boundary conditions of an opening (see `drive`)."""
KIND, WANTED, MEMORY, RATE, NORMAL, AREA, DENSITY = 0, 1, 2, 3, 4, 7, 8
"""Columns of an opening: its condition, the density deviation or speed imposed, the remembered mean density and its
rate of change, the first of three of the outward normal, the area in cell faces, and the present density."""
OPENING: Final = 9
"""Number of columns of an opening."""
OWN_DENSITIES: Final = (MEMORY, DENSITY)
"""Columns that hold densities which an opening updates itself."""
SLOWLY: Final = 0.1
"""Under-relaxation factor of an outlet's density per step pair. Without it the density would react to its own
effect."""
SEGMENT: Final = 128
"""Maximum length of a segment, in cells."""
LINK_WORK, SCREENED_WORK = 0.06, 2.0
"""Run time of a link, and of a vector in a segment with screened cells, relative to that of a vector without."""
ENTRY: Final = 7
"""Number of values per screen cell (see `resist`): unit normal (3) and resistance (4)."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_ROOT_THREE: Final = float(np.sqrt(3.0))
"""Inverse speed of sound of the lattice."""
_U = np.uint64
_WIDE = SEGMENT + COUNT
"""Length of a work array for one segment and a vector beyond it."""
_AHEAD: Final = 4 * COUNT
"""Distance, in cells, at which populations are loaded into the cache ahead of their collision."""
_KINDS: Final = 3
"""Number of stages of a step. Stage 0: cells collide. Stage 1: links return what the cells of their band and of the
adjacent bands have sent. Stage 2: septa exchange populations that the links of their band and the next have read."""
_AFTER: Final = (0, 1, 2)
"""Number of following bands that must have collided before each stage of a band."""
_BEFORE: Final = (0, 1, 1)
"""Number of preceding bands that must have collided before each stage of a band."""
_STEP: Final = 2
"""Number of bands on either side that must have finished a step before a band begins the next."""


@njit(cache=True, inline="always")
def even_part(q: int, density: float, ux: float, uy: float, uz: float) -> float:
    """Return the even part of the equilibrium of population `q`, divided by its weight (see `collision`)."""
    cx, cy, cz = VELOCITIES[q, 0], VELOCITIES[q, 1], VELOCITIES[q, 2]
    along = cx * ux + cy * uy + cz * uz
    beside = (1 - cx * cx) * ux * ux + (1 - cy * cy) * uy * uy + (1 - cz * cz) * uz * uz
    part = 0.5 if q == 0 else -1.5 if q <= AXIAL else 1.5
    return density + 4.5 * along * along - 1.5 * (ux * ux + uy * uy + uz * uz) + part * beside


@njit(cache=True, fastmath=True, error_model="numpy")
def _thin(f: Any, start: Any, n: int, time: float, law: Any, times: Any) -> None:
    """Write the relaxation times of a segment of n cells of shear-thinning blood, from the stress they hold."""
    for k in range(0, n, COUNT):
        scatter(times, (0,), k, (stress_size(gather(f, start, k)),), COUNT)
    for k in range(n):
        times[k] = thinned(times[k], time, law)


@njit(cache=True, forceinline=True, error_model="numpy")
def _collide(f: Any, start: Any, k: int, cells: int, settings: Any) -> None:
    """Collide the cells of a segment from `k` on, a vector but no more than `cells`."""
    times, limit, odd_rate = settings
    old = gather(f, start, k)
    fetch(f, start, k + _AHEAD)
    even, odd, half_kept = collided(old, load(times, k), limit, odd_rate)
    scatter(f, start, k, relaxed(old, even, odd, half_kept), cells)


@njit(cache=True, forceinline=True, error_model="numpy")
def _collide_screened(f: Any, start: Any, k: int, cells: int, settings: Any, resistance: Any) -> None:
    """Collide a vector of cells of which some lie in a screen."""
    times, limit, odd_rate = settings
    normal = load(resistance, k), load(resistance, k + _WIDE), load(resistance, k + 2 * _WIDE)
    linear = load(resistance, k + 3 * _WIDE), load(resistance, k + 4 * _WIDE)
    entry = *linear, load(resistance, k + 5 * _WIDE), load(resistance, k + 6 * _WIDE)
    old = gather(f, start, k)
    even, odd, half_kept = collided_screened(old, load(times, k), limit, odd_rate, normal, entry)
    scatter(f, start, k, relaxed(old, even, odd, half_kept), cells)


@njit(cache=True, fastmath=True, error_model="numpy")
def _collide_across(f: Any, start: Any, s: int, cells: int, settings: Any, screen: Any, scratch: Any) -> None:
    """Collide the cells of a segment `s` that a screen crosses.

    Free and screened vectors have separate loops: in a common one the compiler keeps too few values in registers.
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
    """Collide the segments from `begin` to before `end`."""
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
    """Write the population that link `k` returns: a weighted sum of two populations and a source."""
    link = _U(k)
    first, second, target = _U(path[link, 0]), _U(path[link, 1]), _U(path[link, 2])
    f[target] = weight[link, 0] * f[first] + weight[link, 1] * f[second] + source[link]


@njit(cache=True, fastmath=True, error_model="numpy")
def _do(stage: int, band: int, f: Any, cells: Any, links: Any, bands: Any, scratch: Any) -> None:
    """Apply a stage of a step to a band (see `_KINDS`)."""
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
            first, second = _U(septa[0, k]), _U(septa[1, k])
            through = f[first]
            f[first] = f[second]
            f[second] = through


@njit(cache=True)
def _of_itself(stage: int, first: int, last: int, count: int) -> tuple[int, int]:
    """Return the first band, and one after the last, on which a thread can do a stage without waiting for others."""
    step, kind = stage // _KINDS, stage % _KINDS
    before, after = _STEP * step + _BEFORE[kind], _STEP * step + _AFTER[kind]
    return first + (before if first > 0 else 0), last - (after if last < count else 0)


@njit(cache=True)
def _scratch(time: float) -> tuple[Any, ...]:
    """Return the work arrays of one thread (see `_collide_across` and `_thin`)."""
    resistance, marked = np.zeros(ENTRY * _WIDE, np.float32), np.zeros(_WIDE // COUNT + 1, np.bool_)
    return resistance, marked, np.full(_WIDE, time)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def update(f: Any, cells: Any, links: Any, bands: Any, shares: Any) -> None:
    """Make one time step, or an even and an odd one: collide and stream all cells, and reflect at walls and ends.

    Both steps sweep over the bands together. The second follows the first at a distance at which all its input is
    ready, so that populations are read from memory once for both and are found in the cache the second time. Only bands
    at the ends of a thread's share wait for other threads.

    Parameters
    ----------
    f : (19 * stride + COUNT,) float32; populations. Up to COUNT - 1 values beyond a segment are read without effect.
    cells : tuple
        - (steps, segments, 19) int32: address of the first population of each segment and direction, in an even step
          its own, in an odd step its neighbours'.
        - (segments,) int32: number of cells of each segment, at most SEGMENT.
        - Relaxation: float32 relaxation time of the stress at high shear rate; (4,) float32 Carreau-Yasuda law, which
          holds the additional relaxation time at rest (0: Newtonian), the time constant, and the exponents a and
          (n - 1) / a; (segments,) float32 largest grid Reynolds number, speed divided by viscosity, above which the
          viscosity is raised; float32 relaxation rate of the odd part.
        - Screen: (segments + 1,) int32 first entry of every segment; (e,) int32 position within the segment; (e, ENTRY)
          float32 unit normal and resistance (see `resist`).
    links : tuple; (steps, l, 3) addresses of two populations read and one written (see `paths`), (l, 2) float32
        weights, (l,) float32 sources, (o,) int32 links of the ends, (w,) int32 addresses of rest populations and (w,)
        float32 values added to them, and (2, t) int32 addresses of populations exchanged at septa, that is, at a wall
        between two blood cells.
    bands : (bands + 1, 5) int32; first segment, rest population, wall link, end link and septum of every band, and one
        past the last. What leaves a cell stays in its band or enters an adjacent one. Septa lie between their band and
        the next.
    shares : (threads + 1,) int32; first band of every thread, and the number of bands (see `share`).

    References
    ----------
    Wonnacott 2002, Int. J. Parallel Program. 30, 181: time skewing.
    """
    address, length, relaxation, screen = cells  # nested tuples cannot be passed to numba's threads
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
    """Return the `shares` of `update` with which all threads have about the same work."""
    vectors = -(-length // COUNT) * np.where(np.diff(screen_start) > 0, SCREENED_WORK, 1.0)
    done = np.r_[0.0, np.cumsum(vectors)][bands[:, 0]] + LINK_WORK * (bands[:, 2] - bands[0, 2] + bands[:, 3])
    wanted = done[-1] * np.arange(threads + 1) / threads
    return np.abs(done[:, None] - wanted).argmin(axis=0).astype(np.int32)


def undivided(segments: int, links: int = 0) -> tuple[Ints, Ints]:
    """Return the `bands` and `shares` of `update` for a single band with `links` wall links."""
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
"""The `links` of `update` where there are none."""


def no_screen(segments: int) -> tuple[Ints, Ints, NDArray[np.float32]]:
    """Return the screen of `update` where there is none."""
    return np.zeros(segments + 1, np.int32), np.zeros(0, np.int32), np.zeros((0, ENTRY), np.float32)


def addresses(place: Ints, behind: Sequence[Ints], stride: int) -> Ints:
    """Return the addresses (2, s, 19) of the first populations of segments, in an even and an odd step."""
    own = place[:, None] + stride * np.arange(19)
    neighbours = np.stack([OPPOSITE[q] * stride + behind[q] for q in range(19)], axis=1)
    return np.stack([own, neighbours]).astype(np.int32)


def paths(address: Ints, weight: Floats) -> tuple[Ints, NDArray[np.float32]]:
    """Return the addresses and weights with which `update` reflects at links.

    The addresses (l, 6) are, after an even step, those of the populations that leave along the link (a), left the cell
    behind (b), leave against the link (c), and of the mailbox (d); for `defer`, of those that left the second cell
    behind (e) and leave the cell behind against the link (g). After an odd step a and d, b and c, e and g change roles.
    Of the weights (l, 3) of a, b and c, that of b or of c is zero.

    Returned are the addresses (2, l, 3) read (two) and written (one), after an even and after an odd step, and the
    weights (l, 2) of the two populations read.
    """
    needs_c = weight[:, 2] != 0
    after_even = np.where(needs_c[:, None], address[:, (0, 2, 3)], address[:, (0, 1, 3)])
    after_odd = np.where(needs_c[:, None], address[:, (3, 1, 0)], address[:, (3, 2, 0)])
    both = np.column_stack([weight[:, 0], np.where(needs_c, weight[:, 2], weight[:, 1])])
    return np.ascontiguousarray([after_even, after_odd]), both.astype(np.float32)


@njit(cache=True, fastmath=True, forceinline=True)
def deferred(held: Any, weight: Any) -> Any:
    """Return the source of a link with which it interpolates at higher order (see `defer`).

    Both arguments are tuples: the populations a, b, c, e and g, and their weights.
    """
    wanted = weight[0] * held[0] + weight[1] * held[1] + weight[2] * held[2]
    return wanted + weight[3] * held[3] + weight[4] * held[4]


@njit(cache=True, parallel=True, fastmath=True)
def defer(f: Any, address: Any, correction: Any, source: Any, lost: Any, part: float) -> None:
    """Move the sources of wall links towards the difference between higher-order and linear interpolation.

    Higher-order bounce-back can be unstable. As a lagged correction it is stable, with the same steady state. Call it
    when populations are at home.

    Addresses (links, 6) are those of `paths`, weights (links, 5) those of a, b, c, e and g; `lost` (links,) is set to
    the mass that each link loses, and `part` is the under-relaxation factor.

    References
    ----------
    Khosla and Rubin 1974, Comput. Fluids 2, 207: deferred correction.
    """
    for k in prange(len(address)):
        a, b, c = _U(address[k, 3]), _U(address[k, 2]), _U(address[k, 1])
        e, g = _U(address[k, 5]), _U(address[k, 4])
        lost[k] = f[a] - f[_U(address[k, 0])]
        weight = correction[k, 0], correction[k, 1], correction[k, 2], correction[k, 3], correction[k, 4]
        source[k] += part * (deferred((f[a], f[b], f[c], f[e], f[g]), weight) - source[k])


@njit(cache=True, forceinline=True)
def balance_group(g: int, lost: Any, groups: Any, refill: Any, part: float) -> None:
    """Apply `balance` to group `g`."""
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
    """Move the refill of wall cells towards the mass lost at interpolated walls, averaged over groups of cells.

    `lost` (links,) is the mass that each wall link loses (see `defer`), `refill` (w,) the mass added to every wall cell
    per step, and `part` the under-relaxation factor. Groups are (g + 1,) first link of each, (links,) links sorted by
    group, and the same two arrays for wall cells.
    """
    for g in prange(len(groups[0]) - 1):
        balance_group(g, lost, groups, refill, part)


@njit(cache=True, forceinline=True)
def _read_cell(f: Any, stride: int, place: int, moment: Any) -> None:
    """Write density deviation and momentum (4,) at a storage place; populations must be at home."""
    moment[:] = 0.0
    for q in range(19):
        population = float(f[q * stride + place])
        moment[0] += population
        for axis in range(3):
            moment[1 + axis] += VELOCITIES[q, axis] * population


@njit(cache=True, parallel=True)
def moments(f: Any, stride: int, places: Any) -> Any:
    """Return density deviation and momentum (n, 4) at storage `places` (n,); populations must be at home."""
    result = np.zeros((len(places), 4))
    for i in prange(len(places)):
        _read_cell(f, stride, places[i], result[i])
    return result


@njit(cache=True, parallel=True)
def set_equilibrium(f: Any, stride: int, places: Any, density: Any, velocity: Any) -> None:
    """Set the populations of `places` (n,) to the equilibrium of density deviation (n,) and velocity (n, 3)."""
    for i in prange(len(places)):
        ux, uy, uz = velocity[i, 0], velocity[i, 1], velocity[i, 2]
        for q in range(19):
            along = VELOCITIES[q, 0] * ux + VELOCITIES[q, 1] * uy + VELOCITIES[q, 2] * uz
            f[q * stride + places[i]] = WEIGHTS[q] * (even_part(q, density[i], ux, uy, uz) + 3.0 * along)


@njit(cache=True, parallel=True, error_model="numpy")
def rescale(f: Any, stride: int, places: Any, links: Any, stretch: float, stress: float) -> None:
    """Convert the populations at `places` (n,) to time steps `stretch` times as long (see `collision.rescaled`).

    Populations must be at home. The flow that `links` (l, 6), addresses as in `paths`, have let through is still in
    their mailboxes and is multiplied by `stretch`.
    """
    through = np.zeros(len(links), np.float32)
    for k in prange(len(links)):
        through[k] = f[links[k, 3]] - f[links[k, 0]]
    for i in prange(len(places)):
        new = rescaled(f[places[i] :: stride], stretch, stress)
        for q in range(19):
            f[OPPOSITE[q] * stride + places[i]] = new[q]
    for k in prange(len(links)):
        f[links[k, 3]] = f[links[k, 0]] + stretch * through[k]


@njit(cache=True)
def relaxation_times(f: Any, stride: int, places: Any, time: float, law: Any) -> Any:
    """Return relaxation times (n,) of shear-thinning blood at storage `places` (n,); populations must be at home."""
    result = np.zeros(len(places), np.float32)
    for i in range(len(places)):
        result[i] = thinned(stress_size(f[places[i] :: stride]), time, law)
    return result


@njit(cache=True)
def resisted(velocity: Any, entries: Any, times: Any, odd_rate: float) -> Any:
    """Return the half-force velocity (e, 3) of cells in a screen from that without the force."""
    result = np.zeros_like(velocity)
    for e in range(len(entries)):
        normal, entry = entries[e, :3], entries[e, 3:]
        u, _ = resist(normal, entry, (velocity[e, 0], velocity[e, 1], velocity[e, 2]), rates(times[e], odd_rate))
        result[e, 0], result[e, 1], result[e, 2] = u
    return result


@njit(cache=True, forceinline=True)
def answered(opening: Any, measured: float) -> float:
    """Return the speed of an inflow, or the density deviation of an outlet, during the next two steps (see `drive`).

    It depends on the opening's condition only here. The opening's own densities change in place. Measured are the mean
    density deviation at an inflow, and the flow rate out of any other opening, in cells per time step.
    """
    answer: float = opening[WANTED]
    if opening[KIND] == INFLOW:
        # With a high resistance downstream the flow would rise only as fast as the mean density follows: update faster.
        resistance = abs(measured) / max(abs(opening[WANTED]), 1e-6)
        rate = min(1.0, opening[RATE] * (1.0 + resistance / _ROOT_THREE))
        opening[MEMORY] += rate * (measured - opening[MEMORY])
        answer = opening[WANTED] - (measured - opening[MEMORY]) / _ROOT_THREE
    elif opening[KIND] == OUTFLOW:
        excess = measured / opening[AREA] - opening[WANTED]
        opening[MEMORY] += opening[RATE] * excess
        opening[DENSITY] += SLOWLY * (opening[MEMORY] + _ROOT_THREE * excess - opening[DENSITY])
        answer = opening[DENSITY]
    return answer


@njit(cache=True, forceinline=True)
def outlet_source(velocity: Any, q: int, opening: Any, density: float) -> float:
    """Return what an outlet of this density deviation sends along direction `q` into a cell with this velocity (3)."""
    ux, uy, uz = velocity
    inward = max(0.0, -(ux * opening[NORMAL] + uy * opening[NORMAL + 1] + uz * opening[NORMAL + 2]))
    return 2.0 * WEIGHTS[q] * even_part(q, density - 1.5 * inward * inward, ux, uy, uz)


@njit(cache=True, forceinline=True)
def between(shape: Any, n: int, moment: Any) -> tuple[float, float]:
    """Return the profile coefficients of link `n` between two moments of a cycle (see `drive`)."""
    now, following, part = int(moment[0]), int(moment[1]), moment[2]
    first, second = shape[now, n], shape[following, n]
    return first[0] + part * (second[0] - first[0]), first[1] + part * (second[1] - first[1])


@njit(cache=True, parallel=True)
def _at_ends(f: Any, stride: int, start: Any, places: Any) -> Any:
    """Return density deviation and momentum (l, 4) of cells, in the row of the first link of a cell at its opening."""
    result = np.zeros((len(places), 4))
    for n in prange(len(places)):
        if n == 0 or places[n] != places[n - 1]:  # links of a cell are consecutive
            _read_cell(f, stride, places[n], result[n])
    for first in start:
        if first < len(places):
            _read_cell(f, stride, places[first], result[first])
    return result


@njit(cache=True)
def outflow(f: Any, address: Any) -> float:
    """Return the flow rate out through links with addresses (l, 6); populations must be at home."""
    total = 0.0
    for k in range(len(address)):
        total += float(f[address[k, 3]]) - float(f[address[k, 0]])
    return total


@njit(cache=True)
def drive(f: Any, stride: int, openings: Any, links: Any, moment: Any, source: Any) -> None:
    """Set what every opening returns during the next two steps; populations must be at home.

    Inflow: half-way bounce-back at a moving wall, so that the flow rate is exact. Sound can leave: a density above the
    remembered mean is answered with the outgoing wave.

    Pressure: anti-bounce-back. Where blood flows back through an outlet, the total pressure is imposed; this bounds the
    energy that enters.

    Outflow: the density answers an excess of speed like an outgoing wave would, about a mean that changes until there
    is no excess.

    References
    ----------
    Ladd 1994, J. Fluid Mech. 271, 285: moving wall.
    Poinsot and Lele 1992, J. Comput. Phys. 101, 104: outgoing waves.
    Ginzburg, Verhaeghe and d'Humieres 2008, Commun. Comput. Phys. 3, 427, sec. 5.2: anti-bounce-back.
    """
    start, address, place, direction, shape = links
    held = _at_ends(f, stride, start, place)
    for k in range(len(openings)):
        opening, first, last = openings[k], start[k], start[k + 1]
        if opening[KIND] == INFLOW:
            total, density = 0.0, 0.0
            for n in range(first, last):
                if n == first or place[n] != place[n - 1]:
                    density = held[n, 0]
                total += density
            speed = answered(opening, total / (last - first))
            for n in range(first, last):
                linear, squared = between(shape, n, moment)
                source[n] = (linear + squared * speed) * speed
            continue
        density = answered(opening, outflow(f, address[first:last]) if opening[KIND] != PRESSURE else 0.0)
        velocity = 0.0, 0.0, 0.0
        for n in range(first, last):
            if n == first or place[n] != place[n - 1]:
                velocity = held[n, 1], held[n, 2], held[n, 3]
            source[n] = outlet_source(velocity, direction[n], opening, density + between(shape, n, moment)[0])
