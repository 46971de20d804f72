"""Exchange of populations between a grid and a finer one inside it, and the mass that crosses their interface.

Populations of both grids must be at home (see `vstent.flow.lattice.kernels.d3q19`).
"""

from typing import Any, Final

import numpy as np
from numba import njit, prange

from vstent.flow.lattice.kernels.collision import carried, stress_size, thinned
from vstent.flow.lattice.kernels.d3q19 import OPPOSITE
from vstent.kernels.directions import VELOCITIES

_HALF = np.float32(0.5)
_AXES: Final = VELOCITIES.astype(np.float32)


@njit(cache=True, forceinline=True, error_model="numpy")
def carry_cell(i: int, f: Any, stride: int, stencil: Any, into: Any, numbers: Any, held: Any) -> None:
    """Apply `carry` to target cell `i`; `held` (19,) is a work array."""
    start, place, weight = stencil
    g, new_stride, new_place, limit = into
    ratio, time, law, odd_rate, new_odd_rate = numbers
    held[:] = np.float32(0.0)
    xx = yy = zz = xy = xz = yz = np.float32(0.0)
    for e in range(start[i], start[i + 1]):
        at, even, odd = place[e], weight[e, 0], weight[e, 1]
        held[0] += even * f[at]
        x = y = z = np.float32(0.0)
        for q in range(1, 19, 2):
            first, second = f[q * stride + at], f[(q + 1) * stride + at]
            total, difference = _HALF * even * (first + second), _HALF * odd * (first - second)
            held[q] += total + difference
            held[q + 1] += total - difference
            x += _AXES[q, 0] * (first - second)
            y += _AXES[q, 1] * (first - second)
            z += _AXES[q, 2] * (first - second)
        xx, yy, zz = xx + even * x * x, yy + even * y * y, zz + even * z * z
        xy, xz, yz = xy + even * x * y, xz + even * x * z, yz + even * y * z
    if law[0] > 0.0:
        time = np.float32(thinned(stress_size(held), time, law))
    new_time = _HALF + (time - _HALF) / ratio
    new = carried(held, (xx, yy, zz, xy, xz, yz), ratio, (time, limit[i], odd_rate), (new_time, limit[i], new_odd_rate))
    for q in range(19):
        g[OPPOSITE[q] * new_stride + new_place[i]] = new[q]


@njit(cache=True, parallel=True, error_model="numpy")
def carry(f: Any, stride: int, stencil: Any, into: Any, numbers: Any) -> None:
    """Set populations of a grid by interpolation from those of another (see `collision.carried`).

    Parameters
    ----------
    f, stride : populations of the source and distance between two of a cell.
    stencil : tuple; (n + 1,) int32 first entry of every target cell, (e,) int32 storage place of a source cell, and
        (e, 2) float32 its weight for the even and for the odd part of the populations.
    into : tuple; populations and stride of the target, (n,) int32 storage place of every target cell, and (n,) float32
        largest grid Reynolds number there.
    numbers : tuple of float32; ratio of the spacing of the target to that of the source, relaxation time of the source,
        its (4,) Carreau-Yasuda law, and relaxation rates of the odd part on the source and on the target.
    """
    start, place, weight = stencil  # numba's threads take no nested tuples
    g, new_stride, new_place, limit = into
    ratio, time, law, odd_rate, new_odd_rate = numbers
    for i in prange(len(new_place)):
        held = np.zeros(19, np.float32)
        of_cell, of_flow = (g, new_stride, new_place, limit), (ratio, time, law, odd_rate, new_odd_rate)
        carry_cell(i, f, stride, (start, place, weight), of_cell, of_flow, held)


@njit(cache=True, parallel=True)
def add_crossed(f: Any, first: int, start: Any, part: float, crossed: Any) -> None:
    """Add `part` of the mass that crossed a border in the last pair of steps to `crossed` (g,) of every group.

    Group g holds the links from `start[g]` to `start[g + 1]`; what crossed along them in both steps is stored in `f`
    from address `first` on (see `setup.Links`).
    """
    for g in prange(len(crossed)):
        total = 0.0
        for k in range(start[g], start[g + 1]):
            total += float(f[first + k]) + float(f[first + start[-1] + k])
        crossed[g] += part * total


@njit(cache=True)
def take(f: Any, place: Any, group: Any, share: Any, lack: Any) -> None:
    """Take a mass `lack` (g,) from the cells of every group, whose rest populations are stored at `place` (c,).

    `group` (c,) are the groups of the cells, and `share` (c,) their parts in what the group gives.
    """
    for c in range(len(place)):
        f[place[c]] -= np.float32(share[c] * lack[group[c]])
