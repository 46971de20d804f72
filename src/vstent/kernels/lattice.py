"""D3Q19 lattice-Boltzmann kernels on a sparse set of cells: in place, in rows, in single precision.

Storage. Populations are shifted by their rest weights (f - w) and lie in one flat array: population q of storage place
i is at q * stride + i. Storage places are the fluid cells *and* their solid neighbours, row by row along z, so that a
*segment* (a run of fluid cells along z) and each of its 18 neighbouring runs are contiguous: one address per segment
and population replaces one per cell, and every loop is a plain vector loop.

Update in place (the AA pattern; Bailey, Myre, Walsh, Lilja and Saar 2009, ICPP, 550). Even step: a cell reads its own
populations and writes the collided ones back, each at the place of its opposite. Odd step: it reads where its
neighbours have left them and writes to the same places. After an odd step every population is at home again.

A link that leaves the fluid ends at a solid neighbour, whose storage place serves as the link's mailbox: `reflect` puts
there (before an odd step) or takes from there (after it) what a wall or an opening sends back.

Populations are numbered 0 rest, then in opposite pairs (1, 2), (3, 4), ... (17, 18).
"""

from typing import Any, Final

import numpy as np
from numba import njit, prange

from vstent.kernels.arrays import Ints

VELOCITIES: Final[Ints] = np.array(
    [[0, 0, 0]]
    + [[s * (axis == k) for k in range(3)] for axis in range(3) for s in (1, -1)]
    + [
        [s * a for a in pair]
        for pair in ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1))
        for s in (1, -1)
    ],
    dtype=np.int32,
)
"""(19, 3) lattice velocities."""
WEIGHTS: Final = np.where((squares := (VELOCITIES**2).sum(axis=1)) == 0, 1 / 3, np.where(squares == 1, 1 / 18, 1 / 36))
"""(19,) rest weights."""
OPPOSITE: Final = np.array([0] + [q + 1 if q % 2 else q - 1 for q in range(1, 19)], dtype=np.int32)
"""(19,) number of the opposite velocity."""
LANES: Final = 8
"""Cells worked on at once: segments are read in whole multiples, so the array ends in that many spare places."""
SEGMENT: Final = 128
"""Longest segment, in cells; a literal, so that the compiler sees the stride of the buffer."""

_REST, _AXIS, _DIAGONAL = np.float32(1 / 3), np.float32(1 / 18), np.float32(1 / 36)
_HALF, _ONE, _THREE_HALVES = np.float32(0.5), np.float32(1.0), np.float32(1.5)
_THREE, _FOUR_AND_HALF, _NINE = np.float32(3.0), np.float32(4.5), np.float32(9.0)
_U = np.uint64


@njit(inline="always")
def _relax_pair(f: Any, a: int, b: int, k: int, cu: float, isotropic: float, w: float, even: float, odd: float) -> None:
    """Relax the populations a and b = opposite of a towards equilibrium, each part at its own rate, and swap them."""
    fa, fb = f[a * SEGMENT + k], f[b * SEGMENT + k]
    change_even = even * (_HALF * (fa + fb) - w * (isotropic + _FOUR_AND_HALF * cu * cu))
    change_odd = odd * (_HALF * (fa - fb) - w * _THREE * cu)
    f[a * SEGMENT + k] = fb - change_even + change_odd
    f[b * SEGMENT + k] = fa - change_even - change_odd


@njit(cache=True, fastmath=True)
def _collide(f: Any, n: int, even_rate: Any, odd_rate: Any) -> None:
    """Collide n cells of the buffer f (19 * SEGMENT), each at its own rates (n,), and swap opposite populations.

    Two relaxation times (Ginzburg, Verhaeghe and d'Humieres 2008, Commun. Comput. Phys. 3, 427), with the equilibrium
    of incompressible flow (He and Luo 1997, J. Stat. Phys. 88, 927, eq. 20): its steady state is divergence-free.
    """
    for k in range(n):
        d1, d2, d3 = (
            f[1 * SEGMENT + k] - f[2 * SEGMENT + k],
            f[3 * SEGMENT + k] - f[4 * SEGMENT + k],
            f[5 * SEGMENT + k] - f[6 * SEGMENT + k],
        )
        d4, d5 = f[7 * SEGMENT + k] - f[8 * SEGMENT + k], f[9 * SEGMENT + k] - f[10 * SEGMENT + k]
        d6, d7 = f[11 * SEGMENT + k] - f[12 * SEGMENT + k], f[13 * SEGMENT + k] - f[14 * SEGMENT + k]
        d8, d9 = f[15 * SEGMENT + k] - f[16 * SEGMENT + k], f[17 * SEGMENT + k] - f[18 * SEGMENT + k]
        density = f[k]
        for q in range(1, 19):
            density += f[q * SEGMENT + k]
        ux, uy, uz = d1 + d4 + d5 + d6 + d7, d2 + d4 - d5 + d8 + d9, d3 + d6 - d7 + d8 - d9
        even, odd = even_rate[k], odd_rate[k]
        isotropic = density - _THREE_HALVES * (ux * ux + uy * uy + uz * uz)
        f[k] -= even * (f[k] - _REST * isotropic)
        _relax_pair(f, 1, 2, k, ux, isotropic, _AXIS, even, odd)
        _relax_pair(f, 3, 4, k, uy, isotropic, _AXIS, even, odd)
        _relax_pair(f, 5, 6, k, uz, isotropic, _AXIS, even, odd)
        _relax_pair(f, 7, 8, k, ux + uy, isotropic, _DIAGONAL, even, odd)
        _relax_pair(f, 9, 10, k, ux - uy, isotropic, _DIAGONAL, even, odd)
        _relax_pair(f, 11, 12, k, ux + uz, isotropic, _DIAGONAL, even, odd)
        _relax_pair(f, 13, 14, k, ux - uz, isotropic, _DIAGONAL, even, odd)
        _relax_pair(f, 15, 16, k, uy + uz, isotropic, _DIAGONAL, even, odd)
        _relax_pair(f, 17, 18, k, uy - uz, isotropic, _DIAGONAL, even, odd)


@njit(inline="always")
def _relax_forced_pair(
    f: Any,
    a: int,
    b: int,
    k: int,
    cu: float,
    cf: float,
    isotropic: float,
    work: float,
    w: float,
    even: float,
    odd: float,
) -> None:
    """As `_relax_pair`, with a body force: the source factors 1 - rate / 2 belong to the half-force velocity."""
    fa, fb = f[a * SEGMENT + k], f[b * SEGMENT + k]
    source_even = (_ONE - _HALF * even) * w * (_NINE * cu * cf - _THREE * work)
    source_odd = (_ONE - _HALF * odd) * w * _THREE * cf
    change_even = even * (_HALF * (fa + fb) - w * (isotropic + _FOUR_AND_HALF * cu * cu)) - source_even
    change_odd = odd * (_HALF * (fa - fb) - w * _THREE * cu) - source_odd
    f[a * SEGMENT + k] = fb - change_even + change_odd
    f[b * SEGMENT + k] = fa - change_even - change_odd


@njit(cache=True, inline="always")
def _resist(entry: Any, ux: float, uy: float, uz: float) -> tuple[float, float, float]:
    """Half-force velocity u behind a screen, from the velocity u* without it: u = u* + F(u) / 2.

    `entry` holds the unit normal (3), the linear resistance along it and across it, and the quadratic one along it, all
    per cell and time step: F = -(across u_t + (along + quadratic |u_n|) u_n n). Solved exactly: no stability limit.
    """
    nx, ny, nz, along, across, quadratic = entry[0], entry[1], entry[2], entry[3], entry[4], entry[5]
    normal = ux * nx + uy * ny + uz * nz
    linear = _ONE + _HALF * along
    kept_normal = (
        normal * np.float32(2.0) / (linear + np.sqrt(linear * linear + np.float32(2.0) * quadratic * abs(normal)))
    )
    kept = _ONE / (_ONE + _HALF * across)
    extra = kept_normal - kept * normal
    return kept * ux + extra * nx, kept * uy + extra * ny, kept * uz + extra * nz


@njit(cache=True, fastmath=True)
def _collide_screened(f: Any, g: Any, n: int, even_rate: Any, odd_rate: Any, place: Any, entries: Any) -> None:
    """As `_collide`, where the cells `place` of the segment carry the resistances `entries` (see `_resist`).

    The force of Guo, Zheng and Shi 2002 (Phys. Rev. E 65, 046308, eq. 19 and 20), split over the two rates. `g` is a
    buffer (7 * SEGMENT) for density, velocity and force.
    """
    for k in range(n):
        d1, d2, d3 = (
            f[1 * SEGMENT + k] - f[2 * SEGMENT + k],
            f[3 * SEGMENT + k] - f[4 * SEGMENT + k],
            f[5 * SEGMENT + k] - f[6 * SEGMENT + k],
        )
        d4, d5 = f[7 * SEGMENT + k] - f[8 * SEGMENT + k], f[9 * SEGMENT + k] - f[10 * SEGMENT + k]
        d6, d7 = f[11 * SEGMENT + k] - f[12 * SEGMENT + k], f[13 * SEGMENT + k] - f[14 * SEGMENT + k]
        d8, d9 = f[15 * SEGMENT + k] - f[16 * SEGMENT + k], f[17 * SEGMENT + k] - f[18 * SEGMENT + k]
        density = f[k]
        for q in range(1, 19):
            density += f[q * SEGMENT + k]
        g[k] = density
        g[1 * SEGMENT + k] = d1 + d4 + d5 + d6 + d7
        g[2 * SEGMENT + k] = d2 + d4 - d5 + d8 + d9
        g[3 * SEGMENT + k] = d3 + d6 - d7 + d8 - d9
        g[4 * SEGMENT + k] = g[5 * SEGMENT + k] = g[6 * SEGMENT + k] = np.float32(0.0)
    for e in range(len(place)):
        k = place[e]
        ux, uy, uz = g[SEGMENT + k], g[2 * SEGMENT + k], g[3 * SEGMENT + k]
        vx, vy, vz = _resist(entries[e], ux, uy, uz)
        g[SEGMENT + k], g[2 * SEGMENT + k], g[3 * SEGMENT + k] = vx, vy, vz
        g[4 * SEGMENT + k], g[5 * SEGMENT + k], g[6 * SEGMENT + k] = (
            np.float32(2.0) * (vx - ux),
            np.float32(2.0) * (vy - uy),
            np.float32(2.0) * (vz - uz),
        )
    for k in range(n):
        ux, uy, uz = g[SEGMENT + k], g[2 * SEGMENT + k], g[3 * SEGMENT + k]
        fx, fy, fz = g[4 * SEGMENT + k], g[5 * SEGMENT + k], g[6 * SEGMENT + k]
        even, odd = even_rate[k], odd_rate[k]
        work = ux * fx + uy * fy + uz * fz
        isotropic = g[k] - _THREE_HALVES * (ux * ux + uy * uy + uz * uz)
        f[k] += even * (_REST * isotropic - f[k]) - (_ONE - _HALF * even) * _THREE * _REST * work
        _relax_forced_pair(f, 1, 2, k, ux, fx, isotropic, work, _AXIS, even, odd)
        _relax_forced_pair(f, 3, 4, k, uy, fy, isotropic, work, _AXIS, even, odd)
        _relax_forced_pair(f, 5, 6, k, uz, fz, isotropic, work, _AXIS, even, odd)
        _relax_forced_pair(f, 7, 8, k, ux + uy, fx + fy, isotropic, work, _DIAGONAL, even, odd)
        _relax_forced_pair(f, 9, 10, k, ux - uy, fx - fy, isotropic, work, _DIAGONAL, even, odd)
        _relax_forced_pair(f, 11, 12, k, ux + uz, fx + fz, isotropic, work, _DIAGONAL, even, odd)
        _relax_forced_pair(f, 13, 14, k, ux - uz, fx - fz, isotropic, work, _DIAGONAL, even, odd)
        _relax_forced_pair(f, 15, 16, k, uy + uz, fy + fz, isotropic, work, _DIAGONAL, even, odd)
        _relax_forced_pair(f, 17, 18, k, uy - uz, fy - fz, isotropic, work, _DIAGONAL, even, odd)


@njit(cache=True, fastmath=True, inline="always")
def _load(f: Any, address: Any, n: int, buffer: Any) -> None:
    for q in range(19):
        source, target = _U(address[q]), _U(q * SEGMENT)
        for _ in range((n + LANES - 1) // LANES):
            for k in range(_U(LANES)):
                buffer[target + k] = f[source + k]
            source += _U(LANES)
            target += _U(LANES)


@njit(cache=True, fastmath=True, inline="always")
def _store(buffer: Any, address: Any, n: int, f: Any) -> None:
    full = n // LANES
    rest = _U(n - full * LANES)
    for q in range(19):
        source, target = _U(q * SEGMENT), _U(address[q])
        for _ in range(full):
            for k in range(_U(LANES)):
                f[target + k] = buffer[source + k]
            source += _U(LANES)
            target += _U(LANES)
        for k in range(rest):
            f[target + k] = buffer[source + k]


@njit(cache=True, parallel=True, fastmath=True)
def update(
    f: Any,
    address: Any,
    length: Any,
    first: Any,
    rate: Any,
    screen_start: Any,
    screen_place: Any,
    screen: Any,
    threads: int,
) -> None:
    """Collide and stream every segment once.

    Parameters
    ----------
    f : (19 * stride + LANES,) float32 populations, in place.
    address : (segments, 19) int32, where the populations of each segment begin: its own in an even step, its
        neighbours' in an odd one.
    length, first : (segments,) int32 cells of each segment, at most SEGMENT, and the number of the first.
    rate : (2, cells + LANES) float32 relaxation rates of the even and the odd part.
    screen_start : (segments + 1,) int32 first screen entry of every segment.
    screen_place, screen : (e,) int32 place within the segment and (e, 6) float32 resistance (see `_resist`).
    threads : number of chunks.
    """
    n = length.size
    for chunk in prange(threads):
        buffer = np.zeros(19 * SEGMENT, np.float32)
        extra = np.zeros(7 * SEGMENT, np.float32)
        for s in range(n * chunk // threads, n * (chunk + 1) // threads):
            _load(f, address[s], length[s], buffer)
            lanes = (length[s] + LANES - 1) // LANES * LANES
            even, odd = rate[0, first[s] : first[s] + lanes], rate[1, first[s] : first[s] + lanes]
            begin, end = screen_start[s], screen_start[s + 1]
            if begin == end:
                _collide(buffer, lanes, even, odd)
            else:
                _collide_screened(buffer, extra, lanes, even, odd, screen_place[begin:end], screen[begin:end])
            _store(buffer, address[s], length[s], f)


@njit(cache=True, parallel=True, fastmath=True)
def reflect(f: Any, address: Any, weight: Any, source: Any, after_even: bool) -> None:
    """Send back what crosses a wall or an opening: a weighted sum of three populations, and a source.

    Parameters
    ----------
    address : (links, 4) int32 places a, b, c, d of, after an even step: what leaves along the link, what left the cell
        behind, what leaves against the link, the mailbox. After an odd step the four stand in reverse order.
    weight : (links, 3) float32; source : (links,) float32.
    """
    for k in prange(len(address)):
        a, b, c, d = _U(address[k, 0]), _U(address[k, 1]), _U(address[k, 2]), _U(address[k, 3])
        if after_even:
            f[d] = weight[k, 0] * f[a] + weight[k, 1] * f[b] + weight[k, 2] * f[c] + source[k]
        else:
            f[a] = weight[k, 0] * f[d] + weight[k, 1] * f[c] + weight[k, 2] * f[b] + source[k]


@njit(cache=True)
def swap(f: Any, first: Any, second: Any) -> None:
    """Exchange the populations at addresses `first` and `second` (s,): a wall half-way between two blood cells."""
    for k in range(len(first)):
        kept = f[first[k]]
        f[first[k]] = f[second[k]]
        f[second[k]] = kept


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
        square = ux * ux + uy * uy + uz * uz
        for q in range(19):
            cu = VELOCITIES[q, 0] * ux + VELOCITIES[q, 1] * uy + VELOCITIES[q, 2] * uz
            f[q * stride + places[i]] = WEIGHTS[q] * (density[i] + 3.0 * cu + 4.5 * cu * cu - 1.5 * square)


@njit(cache=True)
def resisted(velocity: Any, entries: Any) -> Any:
    """Half-force velocity (e, 3) of screened cells from their momentum (e, 3) and entries (e, 6) (see `_resist`)."""
    result = np.zeros_like(velocity)
    for e in range(len(entries)):
        result[e, 0], result[e, 1], result[e, 2] = _resist(entries[e], velocity[e, 0], velocity[e, 1], velocity[e, 2])
    return result


@njit(cache=True, inline="always")
def _velocity(f: Any, stride: int, place: int) -> tuple[float, float, float]:
    ux = uy = uz = 0.0
    for q in range(1, 19):
        population = f[q * stride + place]
        ux += VELOCITIES[q, 0] * population
        uy += VELOCITIES[q, 1] * population
        uz += VELOCITIES[q, 2] * population
    return ux, uy, uz


@njit(cache=True)
def _density(f: Any, stride: int, places: Any) -> float:
    total = 0.0
    for n in range(len(places)):
        for q in range(19):
            total += f[q * stride + places[n]]
    return total / len(places)


@njit(cache=True)
def drive(f: Any, stride: int, openings: Any, start: Any, place: Any, direction: Any, shape: Any, source: Any) -> None:
    """Set what every opening sends back during the next two steps (all populations being at home).

    Parameters
    ----------
    openings : (k, 7) whether flow is imposed (1) or pressure (0), the inflow speed or density deviation wanted, the
        remembered mean density, its rate of forgetting, the outward normal (3).
    start : (k + 1,) first link of every opening in `place`, `direction`, `shape` and `source` (l,).
    shape : what unit inflow speed sends back through each link.

    Imposed flow: half-way reflection off a moving wall (Ladd 1994, J. Fluid Mech. 271, 285), so the flow is exact. It
    lets sound out: a density above the remembered mean is answered by the wave that leaves (Poinsot and Lele 1992,
    J. Comput. Phys. 101, 104). Imposed pressure: anti-reflection (Ginzburg, Verhaeghe and d'Humieres 2008, Commun.
    Comput. Phys. 3, 427, sec. 5.2). Where blood comes back through an outlet it is the total pressure that is
    imposed, which bounds the energy that enters.
    """
    for k in range(len(openings)):
        first, last = start[k], start[k + 1]
        if openings[k, 0] == 1.0:
            excess = _density(f, stride, place[first:last]) - openings[k, 2]
            openings[k, 2] += openings[k, 3] * excess
            speed = openings[k, 1] - excess / np.sqrt(3.0)
            for n in range(first, last):
                source[n] = shape[n] * speed
            continue
        for n in range(first, last):
            q = direction[n]
            ux, uy, uz = _velocity(f, stride, place[n])
            along = VELOCITIES[q, 0] * ux + VELOCITIES[q, 1] * uy + VELOCITIES[q, 2] * uz
            inward = max(0.0, -(ux * openings[k, 4] + uy * openings[k, 5] + uz * openings[k, 6]))
            density = openings[k, 1] - 1.5 * inward * inward
            source[n] = 2.0 * WEIGHTS[q] * (density + 4.5 * along * along - 1.5 * (ux * ux + uy * uy + uz * uz))


@njit(cache=True)
def outflow(f: Any, address: Any) -> float:
    """Flow out through the links `address` (l, 4), all populations being at home."""
    total = 0.0
    for k in range(len(address)):
        total += float(f[address[k, 3]]) - float(f[address[k, 0]])
    return total
