"""Exchange of populations between a grid and a finer one inside it, and the mass that crosses their interface.

Populations of both grids must be at home (see `vstent.flow.lattice.kernels.d3q19`).
"""

from typing import Any, Final

import numpy as np
from numba import njit, prange

from vstent.flow.lattice.kernels import lanes
from vstent.flow.lattice.kernels.collision import carried, moments_of, stress_size, thinned
from vstent.flow.lattice.kernels.d3q19 import OPPOSITE
from vstent.kernels.directions import VELOCITIES

_HALF = np.float32(0.5)
_AXES: Final = VELOCITIES.astype(np.float32)
_EVEN: Final = 16
"""Number of values per cell that are interpolated with the weights of the even part: those before the odd part."""
_VALUES: Final = 2 * _EVEN
"""Number of values per cell: rest population, half sums of pairs (9), products u u (6), half differences (9), zeros."""
_CHUNK: Final = 256
"""Number of target cells for which a thread uses the same scratch memory."""
_STARTS: Final = tuple(range(0, _EVEN, lanes.COUNT))
"""First of the values in each vector register that holds those of either part."""
_ACROSS: Final = tuple(range(0, _VALUES * lanes.COUNT, lanes.COUNT))
"""First of these values of as many cells as a vector register holds."""
LACK_PART: Final = 0.15
"""Under-relaxation factor with which the mass returned to the coarser level follows what crossed."""
PUSH_PART: Final = 0.05
"""Part of the momentum still missing at a border that is added in each exchange."""
MOST_PUSHED: Final = 0.03
"""Largest momentum that is added at a border, over that of the cells that are set."""


@njit(cache=True, forceinline=True, error_model="numpy")
def _split(f: Any, stride: int, at: int, values: Any) -> None:
    """Write the `_VALUES` of the cell with storage place `at`."""
    x = y = z = np.float32(0.0)
    values[0] = f[at]
    for k in range(9):
        q = 2 * k + 1
        first, second = f[q * stride + at], f[(q + 1) * stride + at]
        values[1 + k], values[_EVEN + k] = _HALF * (first + second), _HALF * (first - second)
        x += _AXES[q, 0] * (first - second)
        y += _AXES[q, 1] * (first - second)
        z += _AXES[q, 2] * (first - second)
    values[10], values[11], values[12] = x * x, y * y, z * z
    values[13], values[14], values[15] = x * y, x * z, y * z


def _plus_one(total: Any, weight: float, values: Any) -> Any:
    """Return one Lanes plus the product of a weight and another one, both in tuples."""
    return (total[0] + weight * values[0],)


def _plus_two(total: Any, weight: float, values: Any) -> Any:
    """Return two Lanes plus the products of a weight and two others, in tuples."""
    return total[0] + weight * values[0], total[1] + weight * values[1]


_plus: Final = njit(cache=True, forceinline=True)(_plus_one if len(_STARTS) == 1 else _plus_two)


@njit(cache=True, forceinline=True, error_model="numpy")
def converted(held: Any, squares: Any, time: Any, limit: Any, numbers: Any) -> tuple[Any, ...]:
    """Return populations as on a grid of another spacing (see `collision.carried`).

    `time` is the relaxation time of the source; `numbers` are those of `carry` without it and its law.
    """
    ratio, odd_rate, new_odd_rate = numbers
    new_time = _HALF + (time - _HALF) / ratio
    return carried(held, squares, ratio, (time, limit, odd_rate), (new_time, limit, new_odd_rate))


@njit(cache=True, forceinline=True, error_model="numpy")
def _joined(v: Any) -> tuple[Any, ...]:
    """Return the 19 populations of what `_split` writes."""
    first = v[0], v[1] + v[16], v[1] - v[16], v[2] + v[17], v[2] - v[17], v[3] + v[18], v[3] - v[18]
    second = v[4] + v[19], v[4] - v[19], v[5] + v[20], v[5] - v[20], v[6] + v[21], v[6] - v[21]
    third = v[7] + v[22], v[7] - v[22], v[8] + v[23], v[8] - v[23], v[9] + v[24], v[9] - v[24]
    return first + second + third


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def carry(f: Any, stride: int, stencil: Any, push: Any, into: Any, numbers: Any) -> None:
    """Set populations of a grid by interpolation from those of another (see `collision.carried`).

    Parameters
    ----------
    f, stride : populations of the source and distance between two of a cell.
    stencil : tuple; (c,) int32 storage places of the source cells read, (n + 1,) int32 first entry of every target
        cell, (e,) int32 number of a source cell, (e, 2) float32 its weight for the even and for the odd part of the
        populations, (n,) int32 group of every target cell, and (n, 3) float32 its part in the momentum of
        its group.
    push : (g,) momentum added to the cells of every group.
    into : tuple; populations and stride of the target, (n,) int32 storage place of every target cell, and (n,) float32
        largest grid Reynolds number there.
    numbers : tuple of float32; ratio of the spacing of the target to that of the source, relaxation time of the source,
        its (4,) Carreau-Yasuda law, and relaxation rates of the odd part on the source and on the target.
    """
    place, start, cell, weight, group, part = stencil
    g, new_stride, new_place, limit = into
    ratio, time, law, odd_rate, new_odd_rate = numbers
    read = np.zeros((len(place) + 1) * _VALUES, np.float32)
    for c in prange(len(place)):
        _split(f, stride, place[c], read[c * _VALUES : (c + 1) * _VALUES])
    for chunk in prange((len(new_place) + _CHUNK - 1) // _CHUNK):
        values, across = np.zeros(_VALUES, np.float32), np.zeros(_VALUES * lanes.COUNT, np.float32)
        limits, times = np.zeros(lanes.COUNT, np.float32), np.full(lanes.COUNT, time, np.float32)
        for begin in range(_CHUNK * chunk, min(_CHUNK * chunk + _CHUNK, len(new_place)), lanes.COUNT):
            cells = min(lanes.COUNT, len(new_place) - begin)
            for j in range(cells):
                i = begin + j
                limits[j] = limit[i]
                even = odd = lanes.gather(read, _STARTS, len(place) * _VALUES)  # zeros
                for e in range(start[i], start[i + 1]):
                    at = cell[e] * _VALUES
                    even = _plus(even, weight[e, 0], lanes.gather(read, _STARTS, at))
                    odd = _plus(odd, weight[e, 1], lanes.gather(read, _STARTS, at + _EVEN))
                lanes.scatter(values, _STARTS, 0, even, lanes.COUNT)
                lanes.scatter(values, _STARTS, _EVEN, odd, lanes.COUNT)
                x, y, z = part[i]
                for k in range(9):
                    c = _AXES[2 * k + 1]
                    along = push[group[i]] * (c[0] * x + c[1] * y + c[2] * z) / (6.0 if k < 3 else 12.0)
                    values[_EVEN + k] += np.float32(along)
                for k in range(_VALUES):
                    across[k * lanes.COUNT + j] = values[k]
            moved = lanes.gather(across, _ACROSS, 0)
            held = _joined(moved)
            if law[0] > 0.0:
                lanes.scatter(times, (0,), 0, (stress_size(held),), lanes.COUNT)
                for j in range(cells):
                    times[j] = thinned(times[j], time, law)
            own = lanes.load(times, 0), lanes.load(limits, 0)
            new = converted(held, moved[10:16], *own, (ratio, odd_rate, new_odd_rate))
            lanes.scatter(across, _ACROSS[:19], 0, new, lanes.COUNT)
            for q in range(19):
                for j in range(cells):
                    g[OPPOSITE[q] * new_stride + new_place[begin + j]] = across[q * lanes.COUNT + j]


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


@njit(cache=True, forceinline=True, error_model="numpy")
def density_of(held: Any, part: Any) -> tuple[Any, Any]:
    """Return the density deviation of a cell with these populations on a grid of another spacing, and its speed.

    `part` is that of the correction in shear flow (see `collision.carried`); 0 on the same grid.
    """
    density, u, flux = moments_of(held)
    squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    return density + part * (flux[0] + flux[1] + flux[2] - squared - density), lanes.root(squared)


@njit(cache=True)
def jumps(f: Any, stride: int, g: Any, new_stride: int, overlap: Any, part: Any, groups: int) -> Any:
    """Return the sums (g, 2) over groups: density of a grid less that of the finer one in the same cells, and speed.

    Parameters
    ----------
    f, stride, g, new_stride : populations and strides of both grids.
    overlap : tuple; (m,) storage places of coarser cells, (m, 8) of the finer ones in each, and (m,) their groups.
    part : float32; that of the correction in `density_of`.
    """
    place, finer, group = overlap
    result = np.zeros((groups, 2))
    for c in range(len(place)):
        difference, speed = density_of(f[place[c] :: stride], part)
        for n in range(finer.shape[1]):
            difference -= density_of(g[finer[c, n] :: new_stride], np.float32(0.0))[0] / np.float32(finer.shape[1])
        result[group[c], 0] += difference
        result[group[c], 1] += speed
    return result


@njit(cache=True, forceinline=True)
def answered(crossed: float, jump: float, speed: float, held: Any, cells: Any) -> tuple[float, float, float]:
    """Return what a group lacks, and its momentum on the finer and on the coarser grid, from those before (3).

    `crossed` is the mass that crossed the border on the finer grid and not on the coarser one, `jump` and `speed` are
    from `jumps`. `cells` (2) are set on either grid for each coarser cell there; a jump of the density d accelerates
    them by d / 3.
    """
    lack, down, up = held
    most_down, most_up = MOST_PUSHED * cells[0] * speed, MOST_PUSHED * cells[1] * speed
    down = min(max(down + PUSH_PART * (cells[0] * jump / 3.0), -most_down), most_down)
    up = min(max(up + PUSH_PART * crossed, -most_up), most_up)
    return lack + LACK_PART * (crossed - lack), down, up


@njit(cache=True)
def answer(crossed: Any, jump: Any, lack: Any, push: Any, cells: Any) -> None:
    """Set what every group lacks (g,) and its momentum (2, g), and `crossed` (g,) to 0; `jump` (g, 2): of `jumps`."""
    for g in range(len(lack)):
        held = lack[g], push[0, g], push[1, g]
        lack[g], push[0, g], push[1, g] = answered(crossed[g], jump[g, 0], jump[g, 1], held, cells)
        crossed[g] = 0.0


@njit(cache=True)
def take(f: Any, place: Any, group: Any, share: Any, lack: Any) -> None:
    """Take a mass `lack` (g,) from the cells of every group, whose rest populations are stored at `place` (c,).

    `group` (c,) are the groups of the cells, and `share` (c,) their parts in what the group gives.
    """
    for c in range(len(place)):
        f[place[c]] -= np.float32(share[c] * lack[group[c]])
