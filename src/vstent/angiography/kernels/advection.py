"""Advection and diffusion of a concentration between cells, with a time step of its own in every cell.

The scheme is the second-order upwind scheme with limited slopes (van Leer 1979, J. Comput. Phys. 32, 101) and a
predictor in time (Hancock's), with face values limited so that no cell leaves the bounds (Zhang and Shu 2010,
J. Comput. Phys. 229, 3091). Slow cells take steps that are powers of two longer than those of the fastest (local time
stepping); both sides of a face exchange the same mass.
"""

from typing import Any, NamedTuple

from numba import njit, prange

VALUE, RATE, TIME, SLOPE = 0, 1, 2, 3
"""Columns of the state: concentration, predicted rate of change (1/s), time since the start of the march (s), and three
differences across a cell."""


class Mesh(NamedTuple):
    """Connections of cells and faces, both in the order of their levels; numbers from n upwards stand for openings."""

    left: Any
    """(f,) cell on the lower side of each face."""
    right: Any
    """(f,) cell on the upper side."""
    axis: Any
    """(f,) axis across the face."""
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
    volume: Any
    """(n,) volume of the cells, mm3."""
    conductance: Any
    """(f,) diffusive exchange per concentration difference, mm3/s."""


class Steps(NamedTuple):
    """Time steps: a cell of level l takes steps of 2^l base steps."""

    is_slower: Any
    """(e,) whether the cell of an entry takes longer steps than the face."""
    cell_end: Any
    """(levels,) number of cells up to each level."""
    face_end: Any
    """(levels,) number of faces up to each level; the level of a face is the lower one of its cells."""
    face_level: Any
    """(f,) level of each face."""
    allowance: Any
    """(n,) largest ratio of a face value to the cell value that leaves the bounds intact."""


@njit(cache=True, inline="always")
def _limited(behind: float, ahead: float) -> float:
    """Return the monotonized central slope of two differences."""
    if behind * ahead <= 0.0:
        return 0.0
    middle = 0.5 * (behind + ahead)
    most = 2.0 * min(abs(behind), abs(ahead))
    return middle if abs(middle) < most else (most if middle > 0.0 else -most)


@njit(cache=True, parallel=True)
def drift(mesh: Any, flux: Any, result: Any) -> None:
    """Write the displacement (n, 3) of the blood of every cell along each axis, in cells per s.

    Parameters
    ----------
    mesh : Mesh
        Connections of the cells.
    flux : (f,)
        Flow rate to the upper side of every face, mm3/s.
    result : (n, 3)
        Set to the displacements.
    """
    first, face, side, volume = mesh.first, mesh.face, mesh.side, mesh.volume
    for i in prange(len(volume)):
        result[i, :] = 0.0
        for entry in range(first[i], first[i + 1]):
            result[i, side[entry] >> 1] += 0.5 * flux[face[entry]] / volume[i]


@njit(cache=True, parallel=True)
def _predict(mesh: Any, state: Any, moves: Any, count: int, now: float) -> None:
    """Find slopes and rates of the first `count` cells, which start a step now."""
    first, other, side, weight = mesh.first, mesh.other, mesh.side, mesh.weight
    for i in prange(count):
        own, rate, entry, stop = state[i, VALUE], 0.0, first[i], first[i + 1]
        for k in range(3):
            behind, ahead, is_behind, is_ahead = 0.0, 0.0, False, False
            while entry < stop and side[entry] == 2 * k:
                j, share = other[entry], weight[entry]
                if share > 0.0:
                    behind += share * (own - state[j, VALUE] - (now - state[j, TIME]) * state[j, RATE])
                    is_behind = True
                entry += 1
            while entry < stop and side[entry] == 2 * k + 1:
                j, share = other[entry], weight[entry]
                if share > 0.0:
                    ahead += share * (state[j, VALUE] + (now - state[j, TIME]) * state[j, RATE] - own)
                    is_ahead = True
                entry += 1
            slope = _limited(behind, ahead) if is_behind and is_ahead else behind + ahead
            state[i, SLOPE + k] = slope
            rate -= moves[i, k] * slope
        state[i, RATE] = rate


@njit(cache=True, parallel=True)
def _exchange(
    mesh: Any,
    steps: Any,
    state: Any,
    masses: Any,
    through: Any,
    flux: Any,
    count: int,
    now: float,
    base: float,
    upper: float,
) -> None:
    """Move mass through the first `count` faces for one step of each."""
    left, right, axis, conductance, n = mesh.left, mesh.right, mesh.axis, mesh.conductance, len(mesh.volume)
    level, allowance = steps.face_level, steps.allowance
    for f in prange(count):
        step = base * (1 << level[f])
        lower_cell, upper_cell, rate = left[f], right[f], flux[f]
        up = lower_cell if rate >= 0.0 else upper_cell
        own = state[up, VALUE]
        here = own + (now + 0.5 * step - state[up, TIME]) * state[up, RATE]
        if up < n:
            half = 0.5 if up == lower_cell else -0.5
            here += half * state[up, SLOPE + axis[f]]
            most = min(upper, own * allowance[up])
            least = max(0.0, upper - (upper - own) * allowance[up])
            here = min(max(here, least), most)
        mass = rate * here * step
        if lower_cell < n and upper_cell < n:
            mass += conductance[f] * (state[lower_cell, VALUE] - state[upper_cell, VALUE]) * step
        else:
            through[f] += mass
        masses[f, 0] = mass
        masses[f, 1] += mass


@njit(cache=True, parallel=True)
def _settle(mesh: Any, steps: Any, state: Any, masses: Any, count: int, now: float) -> None:
    """Add what came through their faces to the first `count` cells, whose step ends now."""
    first, face, side, volume = mesh.first, mesh.face, mesh.side, mesh.volume
    is_slower = steps.is_slower
    for i in prange(count):
        gain = 0.0
        for entry in range(first[i], first[i + 1]):
            f = face[entry]
            column = 1 if is_slower[entry] else 0
            gain += masses[f, column] if side[entry] & 1 == 0 else -masses[f, column]
            if is_slower[entry]:
                masses[f, 1] = 0.0
        state[i, VALUE] += gain / volume[i]
        state[i, TIME] = now


@njit(cache=True)
def march(
    mesh: Any, steps: Any, state: Any, masses: Any, through: Any, flux: Any, moves: Any, base: float, upper: float
) -> None:
    """Advance the concentration by one step of the slowest level.

    Parameters
    ----------
    mesh : Mesh
        Connections of the cells.
    steps : Steps
        Time steps.
    state : (n + o, 6)
        Concentration and what belongs to it; openings follow the cells. Changed in place.
    masses : (f, 2)
        Mass moved to the upper side of every face in its last step, and that its slower cell has not taken yet.
        Changed in place.
    through : (f,)
        Mass moved to the upper side of the faces of openings in all marches. Changed in place.
    flux : (f,)
        Flow rate to the upper side of every face, mm3/s; it balances in every cell.
    moves : (n, 3)
        Displacement of the blood, in cells per s (see `drift`).
    base : float
        Base step, s.
    upper : float
        Largest concentration of the inflow and of the cells.
    """
    top = len(steps.cell_end) - 1
    state[:, TIME] = 0.0
    for sub in range(1 << top):
        now = sub * base
        level = top
        while sub % (1 << level):
            level -= 1
        _predict(mesh, state, moves, steps.cell_end[level], now)
        _exchange(mesh, steps, state, masses, through, flux, steps.face_end[level], now, base, upper)
        level = top
        while (sub + 1) % (1 << level):
            level -= 1
        _settle(mesh, steps, state, masses, steps.cell_end[level], (sub + 1) * base)
