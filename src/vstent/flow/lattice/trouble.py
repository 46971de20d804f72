"""Likely cause of a diverged lattice-Boltzmann run, from its last valid check."""

import numpy as np

from vstent.flow.lattice.setup import CELL_REYNOLDS, CELL_REYNOLDS_AT_END
from vstent.flow.lattice.state import Snapshot, State
from vstent.kernels.arrays import Floats
from vstent.units import place

FAST = 0.4
"""Speed in cells per time step above which the time step is reported as too long: it is close to the speed of sound."""


def trouble(state: State) -> str:
    """Return one sentence: when the run diverged, where the flow was fastest, the likely cause and what to do."""
    good = [one for one in state.snapshots if not one.is_lost]
    when_ms = 1e3 * state.time_s
    if not good:
        return (
            f"the flow diverged within the first {when_ms:.3g} ms, because the time step is too long for its "
            "speed: use half the lattice speed or half the grid spacing"
        )
    last = good[-1]
    speed = np.linalg.norm(last.velocity, axis=1)
    fastest = int(speed.argmax())
    behind = next(k for k, one in enumerate(reversed(state.snapshots)) if one is last)
    good_ms = when_ms - 1e3 * behind * state.check_s
    return (
        f"the flow diverged between {good_ms:.3g} and {when_ms:.3g} ms; the fastest blood before was "
        f"{speed[fastest] * last.scales.speed_m_s:.2g} m/s at {place(state.domain.centers_mm[fastest])}: "
        + _cause(state, last, speed, fastest)
    )


def _cause(state: State, last: Snapshot, speed: Floats, fastest: int) -> str:
    """Return the likely cause and what to do about it."""
    if speed[fastest] > FAST:
        return (
            f"the time step is too long ({speed[fastest]:.2g} cells per step): use half the lattice speed "
            f"({state.case.numerics.lattice_speed:.3g})"
        )
    outlets = [(k, one) for k, one in enumerate(state.case.vessel.openings) if not one.is_inlet]
    coming_back = [one.role for k, one in outlets if _backflow(state, last, k) > FAST * speed[fastest]]
    if coming_back:
        role = coming_back[0]
        return f"blood flows back through {role}: cut the vessel further away, or split the outflow by Murray's law"
    otherwise = "" if state.close_up is None else ", or switch off the refinement in the sac (--refine-sac)"
    cell_reynolds = speed[fastest] / last.scales.viscosity
    return (
        f"the grid is too coarse (grid Reynolds number {cell_reynolds:.0f}; the viscosity is raised above "
        f"{CELL_REYNOLDS:.0f}, and above {CELL_REYNOLDS_AT_END:.0f} beyond the openings): use a grid spacing "
        f"of {0.7 * state.domain.cell_size_mm:.2g} mm{otherwise}"
    )


def _backflow(state: State, last: Snapshot, k: int) -> float:
    """Return the highest speed, in cells per step, of blood that enters through opening `k`."""
    cell = state.domain.link_cell[state.domain.link_patch == k + 1]
    return float(-(last.velocity[cell] @ state.case.vessel.openings[k].normal).min()) if len(cell) else 0.0
