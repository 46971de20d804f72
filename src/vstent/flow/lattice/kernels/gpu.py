"""The kernels of `vstent.flow.lattice.kernels.d3q19` for a GPU (numba-cuda), one thread per cell, link or group.

Storage, steps and arithmetic are the same; the functions of one cell or opening are shared. Sums have a fixed order, so
that a GPU reproduces its results to the last bit. They differ from those of a CPU in the last bits, because the
compilers fuse and reorder operations differently.

Import it only where a GPU is requested (`vstent.flow.lattice.gpu`).
"""

from typing import Any, Final

import numpy as np
from numba import cuda, njit

from vstent.flow.lattice.kernels.collision import collided, collided_screened, relaxed, stress_size, thinned
from vstent.flow.lattice.kernels.d3q19 import (
    INFLOW,
    OUTFLOW,
    balance_group,
    between,
    defer_link,
    inflow_speed,
    outlet_density,
    outlet_source,
    velocity_at,
)

THREADS: Final = 128
"""Number of threads per block."""
_U = np.uint64


@njit(forceinline=True)
def _held(f: Any, address: Any, s: int, k: int) -> tuple[Any, ...]:
    """Return the populations (19) of cell `k` of segment `s` from the addresses of this step."""
    return (
        f[_U(address[s, 0] + k)],
        f[_U(address[s, 1] + k)],
        f[_U(address[s, 2] + k)],
        f[_U(address[s, 3] + k)],
        f[_U(address[s, 4] + k)],
        f[_U(address[s, 5] + k)],
        f[_U(address[s, 6] + k)],
        f[_U(address[s, 7] + k)],
        f[_U(address[s, 8] + k)],
        f[_U(address[s, 9] + k)],
        f[_U(address[s, 10] + k)],
        f[_U(address[s, 11] + k)],
        f[_U(address[s, 12] + k)],
        f[_U(address[s, 13] + k)],
        f[_U(address[s, 14] + k)],
        f[_U(address[s, 15] + k)],
        f[_U(address[s, 16] + k)],
        f[_U(address[s, 17] + k)],
        f[_U(address[s, 18] + k)],
    )


@njit(forceinline=True)
def _entry_of(s: int, k: int, screen_start: Any, screen_place: Any) -> int:
    """Return the screen entry of cell `k` of segment `s`, -1 where there is none."""
    for e in range(screen_start[s], screen_start[s + 1]):
        if screen_place[e] == k:
            return e
    return -1


@cuda.jit(cache=True)
def update(
    f: Any,
    address: Any,
    segment: Any,
    first_cell: Any,
    time: float,
    law: Any,
    limit: Any,
    odd_rate: float,
    screen_start: Any,
    screen_place: Any,
    screen: Any,
) -> None:
    """Collide and stream every cell once (see `d3q19.update`).

    Parameters
    ----------
    segment : (cells,) int32
        Segment of every cell.
    first_cell : (segments,) int32
        First cell of every segment.
    """
    cell = cuda.grid(1)
    if cell >= segment.size:
        return
    s = segment[cell]
    k = cell - first_cell[s]
    held = _held(f, address, s, k)
    if law[0] > 0:
        time = thinned(stress_size(held), time, law)
    e = _entry_of(s, k, screen_start, screen_place)
    if e < 0:
        even, odd, half_kept = collided(held, time, limit[s], odd_rate)
    else:
        normal = screen[e, 0], screen[e, 1], screen[e, 2]
        entry = screen[e, 3], screen[e, 4], screen[e, 5], screen[e, 6]
        even, odd, half_kept = collided_screened(held, time, limit[s], odd_rate, normal, entry)
    new = relaxed(held, even, odd, half_kept)
    for q in range(19):
        f[_U(address[s, q] + k)] = new[q]


@cuda.jit(cache=True)
def reflect(f: Any, path: Any, weight: Any, source: Any, place: Any, refill: Any) -> None:
    """Return populations at walls and ends, and add the refill (see `d3q19.update`)."""
    k = cuda.grid(1)
    if k < source.size:
        first, second, target = _U(path[k, 0]), _U(path[k, 1]), _U(path[k, 2])
        f[target] = weight[k, 0] * f[first] + weight[k, 1] * f[second] + source[k]
    if k < refill.size:
        f[_U(place[k])] += refill[k]


@cuda.jit(cache=True)
def swap(f: Any, pairs: Any) -> None:
    """Exchange the populations at addresses pairs[0] and pairs[1] (see `d3q19.update`)."""
    k = cuda.grid(1)
    if k < pairs.shape[1]:
        first, second = _U(pairs[0, k]), _U(pairs[1, k])
        kept = f[first]
        f[first] = f[second]
        f[second] = kept


@cuda.jit(cache=True)
def defer(f: Any, address: Any, correction: Any, source: Any, lost: Any, part: float) -> None:
    """Move the sources of wall links towards higher-order interpolation (see `d3q19.defer`)."""
    k = cuda.grid(1)
    if k < source.size:
        defer_link(k, f, address, correction, source, lost, part)


@cuda.jit(cache=True)
def balance(lost: Any, groups: Any, refill: Any, part: float) -> None:
    """Move the refill towards the mass lost at the walls, one thread per group of wall cells (see `d3q19.balance`)."""
    g = cuda.grid(1)
    if g + 1 < groups[0].size:
        balance_group(g, lost, groups, refill, part)


@cuda.jit(cache=True)
def moments(f: Any, stride: int, place: Any, result: Any) -> None:
    """Write density deviation and momentum (n, 4) float32 at storage places (n,); populations must be at home."""
    i = cuda.grid(1)
    if i >= place.size:
        return
    density = 0.0
    for q in range(19):
        density += float(f[_U(q * stride + place[i])])
    result[i, 0] = density
    result[i, 1], result[i, 2], result[i, 3] = velocity_at(f, stride, place[i])


@njit(forceinline=True)
def _sum(parts: Any) -> float:
    """Return the sum of the partial sums of a block's threads, in fixed order; to be called by one thread."""
    total = 0.0
    for t in range(THREADS):
        total += parts[t]
    return total


@cuda.jit(cache=True)
def outflow(f: Any, start: Any, address: Any, result: Any) -> None:
    """Write the flow rate (k,) out of every opening, one block each (see `d3q19.outflow`)."""
    k, t = cuda.blockIdx.x, cuda.threadIdx.x
    parts = cuda.shared.array(THREADS, np.float64)
    total = 0.0
    for n in range(start[k] + t, start[k + 1], THREADS):
        total += float(f[_U(address[n, 3])]) - float(f[_U(address[n, 0])])
    parts[t] = total
    cuda.syncthreads()
    if t == 0:
        result[k] = _sum(parts)


@cuda.jit(cache=True)
def drive(
    f: Any,
    stride: int,
    openings: Any,
    links: Any,
    source: Any,
    wanted: Any,
    moments: Any,
    pair: int,
) -> None:
    """Set what every opening returns during the next two steps, one block each (see `d3q19.drive`).

    Parameters
    ----------
    wanted : (pairs, k)
        Speed or density imposed at every opening.
    moments : (pairs, 3)
        Moments of the cycle (see `d3q19.drive`).
    pair : int
        Row of these arrays that applies.
    """
    start, address, place, direction, shape = links
    k, t = cuda.blockIdx.x, cuda.threadIdx.x
    opening, first, last = openings[k], start[k], start[k + 1]
    kind = opening[0]
    parts = cuda.shared.array(THREADS, np.float64)
    total = 0.0
    if kind == INFLOW:
        for n in range(first + t, last, THREADS):
            for q in range(19):
                total += float(f[_U(q * stride + place[n])])
    elif kind == OUTFLOW:
        for n in range(first + t, last, THREADS):
            total += float(f[_U(address[n, 3])]) - float(f[_U(address[n, 0])])
    parts[t] = total
    cuda.syncthreads()
    if t == 0:
        total = _sum(parts)
        opening[1] = wanted[pair, k]
        if kind == INFLOW:
            parts[0] = inflow_speed(opening, total / (last - first))
        elif kind == OUTFLOW:
            parts[0] = outlet_density(opening, total)
        else:
            parts[0] = opening[1]
    cuda.syncthreads()
    answer = parts[0]
    for n in range(first + t, last, THREADS):
        linear, squared = between(shape, n, moments[pair])
        if kind == INFLOW:
            source[n] = (linear + squared * answer) * answer
        else:
            velocity = velocity_at(f, stride, place[n])
            source[n] = outlet_source(velocity, direction[n], opening, answer + linear)
