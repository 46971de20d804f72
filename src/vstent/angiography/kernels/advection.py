"""Advection and diffusion of a concentration between cells, with a time step of its own in every cell.

The scheme is the second-order upwind scheme with limited slopes (van Leer 1979, J. Comput. Phys. 32, 101) and a
predictor in time (Hancock's), with face values limited so that no cell leaves the bounds (Zhang and Shu 2010,
J. Comput. Phys. 229, 3091). Slow cells take steps that are powers of two longer than those of the fastest (local time
stepping); both sides of a face exchange the same mass. Groups of cells that hold nothing are skipped.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit, prange

VALUE, RATE, TIME, SLOPE, ALLOWANCE = 0, 1, 2, 3, 6
"""Columns of the state: concentration, predicted rate of change (1/s), time since the start of the march (s), three
differences across a cell, and the largest ratio of a face value to the concentration that leaves the bounds intact."""
LANES: Final = 16
"""Number of interleaved sets of groups that threads share: neighbouring groups, of which many are empty at once, go to
different threads."""
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
"""Constants in single precision; a plain number would make a kernel compute in double precision."""


class Mesh(NamedTuple):
    """Connections of cells and faces, both in the order of their groups; numbers from n upwards stand for openings."""

    left: Any
    """(f,) cell on the lower side of each face."""
    right: Any
    """(f,) cell on the upper side."""
    axis: Any
    """(f,) axis across the face."""
    near: Any
    """(n, 6) the only cell on the lower and on the upper side along each axis, the cell itself where there is none; -1
    in the first column where a side has several."""
    first: Any
    """(n + 1,) first entry of each cell in the following lists."""
    face: Any
    """(e,) face of each entry."""
    other: Any
    """(e,) cell on its other side."""
    side: Any
    """(e,) 2 axis for the lower side of the cell, 2 axis + 1 for the upper; ascending within a cell."""
    weight: Any
    """(e,) weight of the difference to the other cell in the slope; 0 for an opening."""
    lower_entry: Any
    """(f,) entry of each face at the cell on its lower side; of no use at an opening."""
    upper_entry: Any
    """(f,) entry at the cell on its upper side."""
    per_volume: Any
    """(n,) 1 / volume of the cells, 1/mm3."""
    conductance: Any
    """(f,) diffusive exchange per concentration difference, mm3/s."""


class Groups(NamedTuple):
    """Groups of neighbouring cells of one level, with the faces of which they hold the cell of the lower level.

    A cell of level l takes steps of 2^l base steps; groups are in the order of their levels.
    """

    level: Any
    """(g,) level of the cells and faces of each group."""
    end: Any
    """(levels,) number of groups up to each level."""
    cells: Any
    """(g + 1,) first cell of each group."""
    faces: Any
    """(g + 1,) first face."""
    touched_first: Any
    """(g + 1,) first entry of each group in `touched`."""
    touched: Any
    """Groups that the faces of a group touch, itself included; g stands for the openings."""
    beside_first: Any
    """(g + 1,) first entry of each group in `beside`."""
    beside: Any
    """Groups whose faces touch a group, itself included."""


class Held(NamedTuple):
    """What changes in a march."""

    state: Any
    """(n + o, 8) concentration and what belongs to it; openings follow the cells. The last column pads a row to half a
    cache line."""
    gains: Any
    """(e,) mass that came through the face of every entry and that the cell has not taken yet."""
    through: Any
    """(f,) mass moved to the upper side of every face in all marches."""
    is_full: Any
    """(g + 1,) whether a group holds any contrast; last, whether any enters."""
    moved: Any
    """(g,) base step in which mass last moved through the faces of a group; -1 if not in this march."""


@njit(cache=True, inline="always")
def _smaller(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers; compiled without a jump, unlike `min`."""
    return a if a < b else b


@njit(cache=True, inline="always")
def _limited(behind: Any, ahead: Any) -> Any:
    """Return the monotonized central slope of two differences."""
    sign = HALF * (math.copysign(ONE, behind) + math.copysign(ONE, ahead))
    return sign * _smaller(HALF * abs(behind + ahead), TWO * _smaller(abs(behind), abs(ahead)))


@njit(cache=True, parallel=True, nogil=True)
def drift(mesh: Any, flux: Any, result: Any) -> None:
    """Write the displacement (n, 3) of the blood of every cell along each axis, in cells per s."""
    first, face, side, per_volume = mesh.first, mesh.face, mesh.side, mesh.per_volume
    for i in prange(len(per_volume)):
        result[i, :] = ZERO
        for entry in range(first[i], first[i + 1]):
            result[i, side[entry] >> 1] += HALF * flux[face[entry]] * per_volume[i]


@njit(cache=True, inline="always")
def _at(state: Any, cell: int, now: Any) -> Any:
    """Return the concentration of a cell now."""
    return state[cell, VALUE] + (now - state[cell, TIME]) * state[cell, RATE]


@njit(cache=True, inline="always")
def _slope(mesh: Any, state: Any, cell: int, axis: int, now: Any) -> Any:
    """Return the slope along an axis of a cell with several cells on a side."""
    own, behind, ahead, is_behind, is_ahead = state[cell, VALUE], ZERO, ZERO, False, False
    for entry in range(mesh.first[cell], mesh.first[cell + 1]):
        share, side = mesh.weight[entry], mesh.side[entry]
        if side >> 1 != axis or share == ZERO:
            continue
        change = share * (_at(state, mesh.other[entry], now) - own)
        if side & 1:
            ahead += change
            is_ahead = True
        else:
            behind -= change
            is_behind = True
    return _limited(behind, ahead) if is_behind and is_ahead else behind + ahead


@njit(cache=True, parallel=True)
def _predict(mesh: Any, groups: Any, held: Any, moves: Any, count: int, now: Any) -> None:
    """Find slopes and rates in the first `count` groups, whose cells start a step now."""
    near, state = mesh.near, held.state
    for lane in prange(LANES):
        for group in range(lane, count, LANES):
            if not held.is_full[group]:
                continue
            for i in range(groups.cells[group], groups.cells[group + 1]):
                own, rate = state[i, VALUE], ZERO
                for axis in range(3):
                    if near[i, 0] < 0:
                        slope = _slope(mesh, state, i, axis, now)
                    else:
                        lower, upper = near[i, 2 * axis], near[i, 2 * axis + 1]
                        behind, ahead = own - _at(state, lower, now), _at(state, upper, now) - own
                        slope = behind + ahead if lower == i or upper == i else _limited(behind, ahead)
                    state[i, SLOPE + axis] = slope
                    rate -= moves[i, axis] * slope
                state[i, RATE] = rate


@njit(cache=True)
def _is_touched(groups: Any, held: Any, group: int) -> bool:
    """Return whether the faces of a group touch a group that is not empty."""
    for k in range(groups.touched_first[group], groups.touched_first[group + 1]):
        if held.is_full[groups.touched[k]]:
            return True
    return False


@njit(cache=True)
def _is_moved(groups: Any, held: Any, group: int, since: int) -> bool:
    """Return whether mass moved through a face of the cells of a group in or after a base step."""
    for k in range(groups.beside_first[group], groups.beside_first[group + 1]):
        if held.moved[groups.beside[k]] >= since:
            return True
    return False


@njit(cache=True, parallel=True)
def _exchange(mesh: Any, groups: Any, held: Any, flux: Any, count: int, substep: int, base: float, upper: Any) -> None:
    """Move mass through the faces of the first `count` groups, for one step of each, from a base step onwards."""
    left, right, axis, conductance, n = mesh.left, mesh.right, mesh.axis, mesh.conductance, len(mesh.per_volume)
    state, gains, through, moved = held.state, held.gains, held.through, held.moved
    for lane in prange(LANES):
        for group in range(lane, count, LANES):
            if not _is_touched(groups, held, group):
                continue
            moved[group] = substep
            step = np.float32(base * (1 << groups.level[group]))
            middle = np.float32(base * substep) + HALF * step
            for f in range(groups.faces[group], groups.faces[group + 1]):
                lower_cell, upper_cell, rate = left[f], right[f], flux[f]
                up = lower_cell if rate >= ZERO else upper_cell
                own = state[up, VALUE]
                here = _at(state, up, middle)
                if up < n:
                    here += (HALF if up == lower_cell else -HALF) * state[up, SLOPE + axis[f]]
                    # No cell leaves its bounds where the face values stay between these (Zhang and Shu).
                    least = max(ZERO, upper - (upper - own) * state[up, ALLOWANCE])
                    most = min(upper, own * state[up, ALLOWANCE])
                    here = min(max(here, least), most)
                mass = rate * here * step
                if lower_cell < n and upper_cell < n:
                    mass += conductance[f] * (state[lower_cell, VALUE] - state[upper_cell, VALUE]) * step
                through[f] += mass
                if lower_cell < n:
                    gains[mesh.lower_entry[f]] -= mass
                if upper_cell < n:
                    gains[mesh.upper_entry[f]] += mass


@njit(cache=True, parallel=True)
def _settle(mesh: Any, groups: Any, held: Any, count: int, substep: int, base: float, empty: Any) -> None:
    """Add what came through their faces to the first `count` groups, whose step ends with a base step."""
    first, per_volume = mesh.first, mesh.per_volume
    state, gains, is_full, now = held.state, held.gains, held.is_full, np.float32(base * (substep + 1))
    for lane in prange(LANES):
        for group in range(lane, count, LANES):
            if not _is_moved(groups, held, group, substep + 1 - (1 << groups.level[group])):
                continue
            largest = ZERO
            for i in range(groups.cells[group], groups.cells[group + 1]):
                gain = ZERO
                for entry in range(first[i], first[i + 1]):
                    gain += gains[entry]
                    gains[entry] = ZERO
                state[i, VALUE] += gain * per_volume[i]
                state[i, TIME] = now
                largest = max(largest, state[i, VALUE])
            is_full[group] = largest > empty
            if largest <= empty:
                for i in range(groups.cells[group], groups.cells[group + 1]):
                    state[i, RATE] = state[i, SLOPE] = state[i, SLOPE + 1] = state[i, SLOPE + 2] = ZERO


@njit(cache=True, nogil=True)
def march(mesh: Any, groups: Any, held: Any, flux: Any, moves: Any, base: float, upper: Any, empty: Any) -> None:
    """Advance the concentration by one step of the slowest level, of 2^top base steps in s.

    The flow rates (f,) in mm3/s balance in every cell; `moves` (n, 3) is the displacement of the blood (see `drift`).
    `upper` is the largest concentration of the inflow and of the cells, `empty` that of a group that is skipped.
    """
    top = len(groups.end) - 1
    held.state[:, TIME] = ZERO
    held.moved[:] = -1
    for substep in range(1 << top):
        level = top
        while substep % (1 << level):
            level -= 1
        _predict(mesh, groups, held, moves, groups.end[level], np.float32(base * substep))
        _exchange(mesh, groups, held, flux, groups.end[level], substep, base, upper)
        level = top
        while (substep + 1) % (1 << level):
            level -= 1
        _settle(mesh, groups, held, groups.end[level], substep, base, empty)
