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
AXIAL: Final = 6
"""Number of the last velocity along an axis; those after it are diagonal."""
LANES: Final = 8
"""Cells worked on at once: segments are read in whole multiples, so the array ends in that many spare places."""
PRESSURE, INFLOW, OUTFLOW = 0.0, 1.0, 2.0
"""What can be imposed at an opening (see `drive`)."""
SLOWLY: Final = 0.1
"""Part of the way that an outlet's pressure goes in a step pair; at once, it would chase its own answer."""
SEGMENT: Final = 128
"""Longest segment, in cells; a literal, so that the compiler sees the stride of the buffer."""

_REST, _AXIS, _DIAGONAL = np.float32(1 / 3), np.float32(1 / 18), np.float32(1 / 36)
_HALF, _ONE, _THREE_HALVES = np.float32(0.5), np.float32(1.0), np.float32(1.5)
_TWO, _THREE, _FOUR_AND_HALF = np.float32(2.0), np.float32(3.0), np.float32(4.5)
_U = np.uint64


@njit(cache=True, inline="always")
def _relax_pair(f: Any, a: int, b: int, k: int, even: float, odd: float, kept: float) -> None:
    """Give the populations a and b = opposite of a their collided values, swapped, from their even and odd parts.

    `even` is the whole even part, `odd` the equilibrium's odd part with its share of the force, `kept` how much of the
    departure from it is kept.
    """
    odd += kept * (_HALF * (f[a * SEGMENT + k] - f[b * SEGMENT + k]) - odd)
    f[a * SEGMENT + k] = even - odd
    f[b * SEGMENT + k] = even + odd


@njit(cache=True, inline="always")
def _sums(f: Any, k: int) -> tuple[Any, ...]:
    """Density deviation, momentum (3) and momentum flux xx, yy, zz, xy, xz, yz of cell k of the buffer."""
    s1, s2, s3 = (
        f[1 * SEGMENT + k] + f[2 * SEGMENT + k],
        f[3 * SEGMENT + k] + f[4 * SEGMENT + k],
        f[5 * SEGMENT + k] + f[6 * SEGMENT + k],
    )
    s4, s5 = f[7 * SEGMENT + k] + f[8 * SEGMENT + k], f[9 * SEGMENT + k] + f[10 * SEGMENT + k]
    s6, s7 = f[11 * SEGMENT + k] + f[12 * SEGMENT + k], f[13 * SEGMENT + k] + f[14 * SEGMENT + k]
    s8, s9 = f[15 * SEGMENT + k] + f[16 * SEGMENT + k], f[17 * SEGMENT + k] + f[18 * SEGMENT + k]
    d1, d2, d3 = (
        f[1 * SEGMENT + k] - f[2 * SEGMENT + k],
        f[3 * SEGMENT + k] - f[4 * SEGMENT + k],
        f[5 * SEGMENT + k] - f[6 * SEGMENT + k],
    )
    d4, d5 = f[7 * SEGMENT + k] - f[8 * SEGMENT + k], f[9 * SEGMENT + k] - f[10 * SEGMENT + k]
    d6, d7 = f[11 * SEGMENT + k] - f[12 * SEGMENT + k], f[13 * SEGMENT + k] - f[14 * SEGMENT + k]
    d8, d9 = f[15 * SEGMENT + k] - f[16 * SEGMENT + k], f[17 * SEGMENT + k] - f[18 * SEGMENT + k]
    xx, yy, zz = s1 + s4 + s5 + s6 + s7, s2 + s4 + s5 + s8 + s9, s3 + s6 + s7 + s8 + s9
    return (
        f[k] + s1 + s2 + s3 + s4 + s5 + s6 + s7 + s8 + s9,
        d1 + d4 + d5 + d6 + d7,
        d2 + d4 - d5 + d8 + d9,
        d3 + d6 - d7 + d8 - d9,
        xx,
        yy,
        zz,
        s4 - s5,
        s6 - s7,
        s8 - s9,
    )


@njit(cache=True, inline="always")
def _relax(
    f: Any,
    k: int,
    density: float,
    ux: float,
    uy: float,
    uz: float,
    xx: float,
    yy: float,
    zz: float,
    xy: float,
    xz: float,
    yz: float,
    fx: float,
    fy: float,
    fz: float,
    kept: float,
) -> None:
    """Write the 19 collided populations from density, velocity, second moments (u u and stress) and force."""
    isotropic = density - _THREE_HALVES * (xx + yy + zz)
    wx, wy, wz = _THREE_HALVES * ux * ux, _THREE_HALVES * uy * uy, _THREE_HALVES * uz * uz
    f[k] = _REST * (isotropic + _REST * (wx + wy + wz))
    a2, d2, a1, d1 = _AXIS * _FOUR_AND_HALF, _DIAGONAL * _FOUR_AND_HALF, _AXIS * _THREE, _DIAGONAL * _THREE
    ax, ay, az = ux + fx, uy + fy, uz + fz
    _relax_pair(f, 1, 2, k, _AXIS * (isotropic - wy - wz) + a2 * xx, a1 * ax, kept)
    _relax_pair(f, 3, 4, k, _AXIS * (isotropic - wx - wz) + a2 * yy, a1 * ay, kept)
    _relax_pair(f, 5, 6, k, _AXIS * (isotropic - wx - wy) + a2 * zz, a1 * az, kept)
    in_xy, in_xz, in_yz = _DIAGONAL * (isotropic + wz), _DIAGONAL * (isotropic + wy), _DIAGONAL * (isotropic + wx)
    _relax_pair(f, 7, 8, k, in_xy + d2 * (xx + yy + xy + xy), d1 * (ax + ay), kept)
    _relax_pair(f, 9, 10, k, in_xy + d2 * (xx + yy - xy - xy), d1 * (ax - ay), kept)
    _relax_pair(f, 11, 12, k, in_xz + d2 * (xx + zz + xz + xz), d1 * (ax + az), kept)
    _relax_pair(f, 13, 14, k, in_xz + d2 * (xx + zz - xz - xz), d1 * (ax - az), kept)
    _relax_pair(f, 15, 16, k, in_yz + d2 * (yy + zz + yz + yz), d1 * (ay + az), kept)
    _relax_pair(f, 17, 18, k, in_yz + d2 * (yy + zz - yz - yz), d1 * (ay - az), kept)


@njit(cache=True, inline="always")
def _even(q: int, density: float, ux: float, uy: float, uz: float) -> float:
    """Even part of the equilibrium of population q over its weight (see `_collide`)."""
    cx, cy, cz = VELOCITIES[q, 0], VELOCITIES[q, 1], VELOCITIES[q, 2]
    along = cx * ux + cy * uy + cz * uz
    beside = (1 - cx * cx) * ux * ux + (1 - cy * cy) * uy * uy + (1 - cz * cz) * uz * uz
    part = 0.5 if q == 0 else -1.5 if q <= AXIAL else 1.5
    return density + 4.5 * along * along - 1.5 * (ux * ux + uy * uy + uz * uz) + part * beside


@njit(cache=True, inline="always", error_model="numpy")
def _kept(ux: float, uy: float, uz: float, time: float, limit: float) -> float:
    """Part of the stress kept: by the blood's relaxation time, or that of blood at the largest cell Reynolds number."""
    return _ONE - _ONE / max(time, _HALF + _THREE / limit * np.sqrt(ux * ux + uy * uy + uz * uz))


@njit(cache=True, fastmath=True, error_model="numpy")
def _thin(f: Any, n: int, time: float, law: Any, times: Any) -> None:
    """Relaxation times of n cells whose blood thins with the shear rate, from the stress that they hold.

    Strain rate = 1.5 / time of the second moments' departure from equilibrium (Boyd, Buick and Green 2006, J. Phys. A
    39, 14241, eq. 9), which depends on the time sought: three rounds from blood at rest.
    """
    for k in range(n):
        _, ux, uy, uz, pxx, pyy, pzz, pxy, pxz, pyz = _sums(f, k)
        qxx, qyy, qzz = pxx - ux * ux, pyy - uy * uy, pzz - uz * uz
        trace = (qxx + qyy + qzz) * _REST
        qxx, qyy, qzz = qxx - trace, qyy - trace, qzz - trace
        qxy, qxz, qyz = pxy - ux * uy, pxz - ux * uz, pyz - uy * uz
        size = np.sqrt(_TWO * (qxx * qxx + qyy * qyy + qzz * qzz + _TWO * (qxy * qxy + qxz * qxz + qyz * qyz)))
        found = time + law[0]
        for _ in range(3):
            rate = _THREE_HALVES * size / found
            found = time + law[0] * (_ONE + (law[1] * rate) ** law[2]) ** law[3]
        times[k] = found


@njit(cache=True, fastmath=True, error_model="numpy")
def _collide(f: Any, n: int, times: Any, limit: float, odd_rate: float) -> None:
    """Collide n cells of the buffer f (19 * SEGMENT) and swap opposite populations.

    Regularised: of the even part only the stress survives (Latt and Chopard 2006, Math. Comput. Simul. 72:165, eq 12),
    without its trace, which only carries sound. The odd part has its own rate (Ginzburg, Verhaeghe and d'Humieres 2008,
    Commun. Comput. Phys. 3, 427). Equilibrium of incompressible flow (He and Luo 1997, J. Stat. Phys. 88, 927, eq. 20):
    the steady state is free of divergence, whatever the lattice speed. Its fourth moments are those that its second
    ones ask for, <xxyy> = density / 9 + (ux ux + uy uy) / 3 (Bauer and Ruede 2018, arXiv:1803.04937, sec. 3): the usual
    one of D3Q19 lacks uz uz / 6 there, which makes a round jet a cross.
    """
    kept_odd, zero = _ONE - odd_rate, np.float32(0.0)
    for k in range(n):
        density, ux, uy, uz, pxx, pyy, pzz, pxy, pxz, pyz = _sums(f, k)
        keep = _kept(ux, uy, uz, times[k], limit)
        qxx, qyy, qzz = pxx - ux * ux, pyy - uy * uy, pzz - uz * uz
        trace = (qxx + qyy + qzz) * _REST
        _relax(
            f,
            k,
            density,
            ux,
            uy,
            uz,
            ux * ux + keep * (qxx - trace),
            uy * uy + keep * (qyy - trace),
            uz * uz + keep * (qzz - trace),
            ux * uy + keep * (pxy - ux * uy),
            ux * uz + keep * (pxz - ux * uz),
            uy * uz + keep * (pyz - uy * uz),
            zero,
            zero,
            zero,
            kept_odd,
        )


@njit(cache=True, inline="always", error_model="numpy")
def _resist(entry: Any, ux: float, uy: float, uz: float) -> tuple[float, float, float]:
    """Half-force velocity u inside a screen, from the velocity u* without it: u = u* + F(u) / 2.

    `entry` holds the unit normal (3), the linear resistance along it and across it, and the quadratic one along it, all
    per cell and time step: F = -(across u_t + (along + quadratic |u_n|) u_n n). Solved exactly: no stability limit.
    """
    nx, ny, nz, along, across, quadratic = entry[0], entry[1], entry[2], entry[3], entry[4], entry[5]
    normal = ux * nx + uy * ny + uz * nz
    linear = _ONE + _HALF * along
    root = np.sqrt(linear * linear + _TWO * quadratic * abs(normal))
    kept = _ONE / (_ONE + _HALF * across)
    extra = _TWO * normal / (linear + root) - kept * normal
    return kept * ux + extra * nx, kept * uy + extra * ny, kept * uz + extra * nz


@njit(cache=True, fastmath=True, error_model="numpy")
def _collide_screened(
    f: Any, g: Any, n: int, times: Any, limit: float, odd_rate: float, place: Any, entries: Any
) -> None:
    """As `_collide`, where the cells `place` of the segment carry the resistances `entries` (see `_resist`).

    The force of Guo, Zheng and Shi 2002 (Phys. Rev. E 65, 046308, eq. 19 and 20): velocity with half the force, and the
    force's first and second moment with the factors 1 - rate / 2. `g` is a buffer (6 * SEGMENT) for velocity and force.
    """
    kept_odd, half_odd = _ONE - odd_rate, (_ONE - _HALF * odd_rate) / odd_rate
    for k in range(n):
        _, ux, uy, uz, _, _, _, _, _, _ = _sums(f, k)
        g[k], g[SEGMENT + k], g[2 * SEGMENT + k] = ux, uy, uz
        g[3 * SEGMENT + k] = g[4 * SEGMENT + k] = g[5 * SEGMENT + k] = np.float32(0.0)
    for e in range(len(place)):
        k = place[e]
        ux, uy, uz = g[k], g[SEGMENT + k], g[2 * SEGMENT + k]
        vx, vy, vz = _resist(entries[e], ux, uy, uz)
        g[k], g[SEGMENT + k], g[2 * SEGMENT + k] = vx, vy, vz
        g[3 * SEGMENT + k], g[4 * SEGMENT + k], g[5 * SEGMENT + k] = (
            _TWO * (vx - ux),
            _TWO * (vy - uy),
            _TWO * (vz - uz),
        )
    for k in range(n):
        density, _, _, _, pxx, pyy, pzz, pxy, pxz, pyz = _sums(f, k)
        ux, uy, uz = g[k], g[SEGMENT + k], g[2 * SEGMENT + k]
        fx, fy, fz = g[3 * SEGMENT + k], g[4 * SEGMENT + k], g[5 * SEGMENT + k]
        keep = _kept(ux, uy, uz, times[k], limit)
        half = _HALF + _HALF * keep
        qxx, qyy, qzz = pxx - ux * ux, pyy - uy * uy, pzz - uz * uz
        trace = (qxx + qyy + qzz) * _REST
        _relax(
            f,
            k,
            density,
            ux,
            uy,
            uz,
            ux * ux + keep * (qxx - trace) + half * _TWO * ux * fx,
            uy * uy + keep * (qyy - trace) + half * _TWO * uy * fy,
            uz * uz + keep * (qzz - trace) + half * _TWO * uz * fz,
            ux * uy + keep * (pxy - ux * uy) + half * (ux * fy + uy * fx),
            ux * uz + keep * (pxz - ux * uz) + half * (ux * fz + uz * fx),
            uy * uz + keep * (pyz - uy * uz) + half * (uy * fz + uz * fy),
            half_odd * fx,
            half_odd * fy,
            half_odd * fz,
            kept_odd,
        )


# Plain loops over unsigned places become vectors; cut into lanes by hand they were six times slower.
@njit(cache=True, fastmath=True, inline="always")
def _load(f: Any, address: Any, n: int, buffer: Any) -> None:
    for q in range(19):
        source, target = _U(address[q]), _U(q * SEGMENT)
        for k in range(_U(n)):
            buffer[target + k] = f[source + k]


@njit(cache=True, fastmath=True, inline="always")
def _store(buffer: Any, address: Any, n: int, f: Any) -> None:
    for q in range(19):
        source, target = _U(q * SEGMENT), _U(address[q])
        for k in range(_U(n)):
            f[target + k] = buffer[source + k]


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def update(
    f: Any,
    address: Any,
    length: Any,
    time: float,
    law: Any,
    limit: Any,
    odd_rate: float,
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
    length : (segments,) int32 cells of each segment, at most SEGMENT.
    time : float32 relaxation time of the stress, at high shear.
    law : (4,) float32 what blood at rest has more of it, the time by which shear rates count, and the exponents a and
        (n - 1) / a of Carreau and Yasuda's law; the first is 0 where the viscosity is the same everywhere.
    limit : (segments,) float32 largest cell Reynolds number, speed over viscosity: faster blood is made that thick.
    odd_rate : float32 relaxation rate of the odd part.
    screen_start : (segments + 1,) int32 first screen entry of every segment.
    screen_place, screen : (e,) int32 place within the segment and (e, 6) float32 resistance (see `_resist`).
    threads : number of chunks.
    """
    n = length.size
    for chunk in prange(threads):
        buffer = np.zeros(19 * SEGMENT, np.float32)
        extra = np.zeros(6 * SEGMENT, np.float32)
        times = np.full(SEGMENT, time)
        for s in range(n * chunk // threads, n * (chunk + 1) // threads):
            lanes = (length[s] + LANES - 1) // LANES * LANES
            _load(f, address[s], lanes, buffer)
            if law[0] > 0.0:
                _thin(buffer, lanes, time, law, times)
            begin, end = screen_start[s], screen_start[s + 1]
            if begin == end:
                _collide(buffer, lanes, times, limit[s], odd_rate)
            else:
                _collide_screened(
                    buffer, extra, lanes, times, limit[s], odd_rate, screen_place[begin:end], screen[begin:end]
                )
            _store(buffer, address[s], length[s], f)


@njit(cache=True, parallel=True, fastmath=True)
def reflect(f: Any, address: Any, weight: Any, source: Any, place: Any, refill: Any, after_even: bool) -> None:
    """Send back what crosses a wall or an opening: a weighted sum of three populations, and a source.

    Parameters
    ----------
    address : (links, 6) int32 places of, after an even step: what leaves along the link (a), what left the cell behind
        (b), what leaves against the link (c), the mailbox (d); then (see `defer`) what left the second cell behind (e)
        and what leaves the cell behind against the link (g). After an odd step a and d, b and c, e and g change roles.
    weight : (links, 3) float32; source : (links,) float32.
    place, refill : (w,) int32 and float32: what is added to the rest populations of these places.
    """
    for k in prange(len(address)):
        a, b, c, d = _U(address[k, 0]), _U(address[k, 1]), _U(address[k, 2]), _U(address[k, 3])
        if after_even:
            f[d] = weight[k, 0] * f[a] + weight[k, 1] * f[b] + weight[k, 2] * f[c] + source[k]
        else:
            f[a] = weight[k, 0] * f[d] + weight[k, 1] * f[c] + weight[k, 2] * f[b] + source[k]
    for w in prange(len(place)):
        f[_U(place[w])] += refill[w]


@njit(cache=True, parallel=True, fastmath=True)
def defer(f: Any, address: Any, correction: Any, source: Any, part: float) -> None:
    """Move the walls' sources towards the difference between quadratic and linear interpolation (populations at home).

    Quadratic reflection itself can be unstable; as a correction that lags behind it is not, and the steady state is the
    same (deferred correction, Khosla and Rubin 1974, Comput. Fluids 2, 207).

    Parameters
    ----------
    address : (links, 6) as in `reflect`; correction : (links, 5) float32 weights of a, b, c, e and g.
    """
    for k in prange(len(address)):
        a, b, c = _U(address[k, 3]), _U(address[k, 2]), _U(address[k, 1])
        e, g = _U(address[k, 5]), _U(address[k, 4])
        wanted = correction[k, 0] * f[a] + correction[k, 1] * f[b] + correction[k, 2] * f[c]
        wanted += correction[k, 3] * f[e] + correction[k, 4] * f[g]
        source[k] += part * (wanted - source[k])


@njit(cache=True)
def balance(f: Any, address: Any, group: Any, count: Any, member: Any, refill: Any, part: float) -> None:
    """Move the refill towards what the interpolated walls lose, spread over groups of wall cells (populations at home).

    Parameters
    ----------
    address : (links, 6) of the walls; group : (links,) group of each link's cell.
    count : (groups,) wall cells of each group; member : (w,) group of each wall cell; refill : (w,).
    """
    lost = np.zeros(len(count))
    for k in range(len(address)):
        lost[group[k]] += float(f[address[k, 3]]) - float(f[address[k, 0]])
    for w in range(len(member)):
        refill[w] += part * (lost[member[w]] / count[member[w]] - refill[w])


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
        for q in range(19):
            along = VELOCITIES[q, 0] * ux + VELOCITIES[q, 1] * uy + VELOCITIES[q, 2] * uz
            f[q * stride + places[i]] = WEIGHTS[q] * (_even(q, density[i], ux, uy, uz) + 3.0 * along)


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
def outflow(f: Any, address: Any) -> float:
    """Flow out through the links `address` (l, 6), all populations being at home."""
    total = 0.0
    for k in range(len(address)):
        total += float(f[address[k, 3]]) - float(f[address[k, 0]])
    return total


@njit(cache=True)
def drive(
    f: Any,
    stride: int,
    openings: Any,
    start: Any,
    address: Any,
    place: Any,
    direction: Any,
    shape: Any,
    source: Any,
) -> None:
    """Set what every opening sends back during the next two steps (all populations being at home).

    Parameters
    ----------
    openings : (k, 9) what is imposed (`PRESSURE`, `INFLOW` or `OUTFLOW`), the density deviation or speed wanted, the
        remembered mean density, its rate of change, the outward normal (3), the area in cells, the density imposed.
    start : (k + 1,) first link of every opening in what follows.
    address : (l, 6) as in `reflect`; place : (l,) storage place of each link's cell; direction, source : (l,).
    shape : (l, 2) what inflow sends back through each link, over its speed and over its speed squared.

    Inflow: half-way reflection off a moving wall (Ladd 1994, J. Fluid Mech. 271, 285), so the flow is exact. It
    lets sound out: a density above the remembered mean is answered by the wave that leaves (Poinsot and Lele 1992,
    J. Comput. Phys. 101, 104). Pressure: anti-reflection (Ginzburg, Verhaeghe and d'Humieres 2008, Commun.
    Comput. Phys. 3, 427, sec. 5.2). Where blood comes back through an outlet it is the total pressure that is
    imposed, which bounds the energy that enters. Outflow: the pressure that answers the excess of speed as the wave
    that leaves would, about a mean that moves until no excess is left.
    """
    for k in range(len(openings)):
        first, last = start[k], start[k + 1]
        density = openings[k, 1]
        if openings[k, 0] == INFLOW:
            density = _density(f, stride, place[first:last])
            # Against a high resistance the flow itself waits for the mean: forget faster the higher the pressure.
            resistance = abs(density) / max(abs(openings[k, 1]), 1e-6)
            rate = min(1.0, openings[k, 3] * (1.0 + resistance / np.sqrt(3.0)))
            openings[k, 2] += rate * (density - openings[k, 2])
            speed = openings[k, 1] - (density - openings[k, 2]) / np.sqrt(3.0)
            for n in range(first, last):
                source[n] = (shape[n, 0] + shape[n, 1] * speed) * speed
            continue
        if openings[k, 0] == OUTFLOW:
            excess = outflow(f, address[first:last]) / openings[k, 7] - openings[k, 1]
            openings[k, 2] += openings[k, 3] * excess
            openings[k, 8] += SLOWLY * (openings[k, 2] + np.sqrt(3.0) * excess - openings[k, 8])
            density = openings[k, 8]
        for n in range(first, last):
            q = direction[n]
            ux, uy, uz = _velocity(f, stride, place[n])
            inward = max(0.0, -(ux * openings[k, 4] + uy * openings[k, 5] + uz * openings[k, 6]))
            source[n] = 2.0 * WEIGHTS[q] * _even(q, density - 1.5 * inward * inward, ux, uy, uz)
