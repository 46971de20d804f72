"""Result of a lattice-Boltzmann run in SI units: the last check or a time average, with the wall shear stress."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.deployment.struts import thickness_mm
from vstent.flow import domain as domains
from vstent.flow.case import FlowField, Level, Phase
from vstent.flow.ends import outflows
from vstent.flow.engines import Outcome
from vstent.flow.indices import neck_diameter_mm
from vstent.flow.lattice.levels import WIDTH, further_levels
from vstent.flow.lattice.setup import CELL_REYNOLDS
from vstent.flow.lattice.state import NECK_INFLOW, Snapshot, State, trusted
from vstent.flow.lattice.stepping import read_here, snapshot
from vstent.flow.wall_stress import mean_shear_Pa, wall_stress
from vstent.kernels.arrays import Floats, Ints
from vstent.kernels.directions import VELOCITIES

FEWEST_ACROSS_NECK: Final = 25
"""Number of cells across a neck with a screen below which a flow says so. 13, 21, 27 and 38 cells give Silk over a neck
of 2.7 mm 37, 16, 9 and 4 % more neck inflow and 37, 21, 13 and 7 % more velocity in the sac than wires as walls."""


@dataclass(frozen=True, eq=False)
class Reading:
    """A flow in SI units."""

    velocity_m_s: Floats
    """(n, 3) velocity of every cell."""
    pressure_Pa: Floats
    """(n,) pressure of every cell."""
    wall_shear_stress_Pa: Floats
    """(v, 3) wall shear stress at every vertex of the lumen."""
    wall_pressure_Pa: Floats
    """(v,) pressure at every vertex of the lumen."""
    inlets_mL_s: Floats
    """(i,) flow rate into every inlet; 0 on a level without openings."""
    outlets_mL_s: Floats
    """(k,) flow rate out of every outlet; 0 likewise, and where no cell of the grid reaches it."""
    mean_speed_m_s: Floats | None = None
    """(n,) time-averaged speed of an unsteady flow; None for a steady one."""
    mean_shear_Pa: Floats | None = None
    """(v,) time-averaged magnitude of its wall shear stress; None for a steady one."""
    neck_inflow_mL_s: float | None = None
    """Time average of the neck inflow of an unsteady flow; None for a steady one."""


def read(state: State, snapshots: Sequence[Snapshot]) -> Reading:
    """Return the mean of snapshots of one level in SI units, with the wall shear stress."""
    domain = state.domain
    velocity_m_s = _mean(snapshots, (one.velocity_m_s for one in snapshots))
    pressure_Pa = _mean(snapshots, (one.pressure_Pa for one in snapshots))
    stress_Pa, wall_pressure_Pa = wall_stress(
        domain, velocity_m_s, pressure_Pa, lumen=state.case.vessel.lumen, blood=state.case.blood
    )
    outflow_mL_s = np.zeros(len(state.case.vessel.openings))
    outflow_mL_s[state.links.patch - 1] = _mean(snapshots, (one.outflow_mL_s for one in snapshots))
    backwards_mL_s, outlets_mL_s = state.case.vessel.of_inlets_and_outlets(outflow_mL_s)
    return Reading(velocity_m_s, pressure_Pa, stress_Pa, wall_pressure_Pa, -backwards_mL_s, outlets_mL_s)


def read_moving(state: State, snapshots: Sequence[Snapshot]) -> Reading:
    """Return the mean of the snapshots of an unsteady flow, with the time averages of speed, shear and neck inflow.

    These cannot be computed from the mean velocity field.
    """
    flow, case = read(state, snapshots), state.case
    speed_m_s = _mean(snapshots, (one.speed_m_s for one in snapshots))
    shear_Pa = mean_shear_Pa(state.domain, flow.velocity_m_s, speed_m_s, lumen=case.vessel.lumen, blood=case.blood)
    checks = sum(one.checks for one in snapshots)
    inflow_mL_s = float(np.array(state.history)[-checks:, NECK_INFLOW:].mean(axis=0).sum())
    return replace(flow, mean_speed_m_s=speed_m_s, mean_shear_Pa=shear_Pa, neck_inflow_mL_s=inflow_mL_s)


def _mean(snapshots: Sequence[Snapshot], values: Iterable[Floats | NDArray[np.float32]]) -> Floats:
    """Return the mean of one value per snapshot, weighted by the number of checks of each."""
    share = np.array([one.checks for one in snapshots]) / sum(one.checks for one in snapshots)
    return np.asarray(sum(part * value for part, value in zip(share, values, strict=True)))


def joined(state: State, flows: Sequence[Reading]) -> Reading:
    """Return the flow of the coarsest level with the values at the wall of the finest one at every vertex.

    A vertex belongs to a finer level where the cells from which its stress is computed lie inside the border.
    """
    wall, result = state.case.vessel.lumen, flows[0]
    for coarse, fine, flow in zip(state.levels, state.levels[1:], flows[1:], strict=False):
        is_fine = trusted(coarse, fine, wall.vertices_mm - fine.domain.cell_size_mm * wall.vertex_normals)
        for name in ("wall_shear_stress_Pa", "wall_pressure_Pa", "mean_shear_Pa"):
            values = getattr(flow, name)
            if values is not None:
                chosen = np.where(is_fine if values.ndim == 1 else is_fine[:, None], values, getattr(result, name))
                result = replace(result, **{name: chosen})
    return replace(result, neck_inflow_mL_s=flows[len(state.kept) - 1].neck_inflow_mL_s)


def field_of(
    state: State, flows: Sequence[Reading], outcome: Outcome, left: float, advice: str, phases: tuple[Phase, ...] = ()
) -> FlowField:
    """Return the flow field of a run from the flow on the levels kept, and on finer ones for the values at the wall."""
    vessel, flow, finest = state.case.vessel, joined(state, flows), state.at_wires
    section_Pa = domains.section_pressure_Pa(vessel, state.domain, flow.pressure_Pa)
    inlet_Pa, outlet_Pa = vessel.of_inlets_and_outlets(section_Pa)
    levels = tuple(
        Level.of(level.domain, one.velocity_m_s, one.pressure_Pa, one.mean_speed_m_s)
        for level, one in zip(state.kept, flows, strict=False)
    )
    common_Pa = 0.0
    if state.case.resistances:
        ends, inflow_mL_s = state.case.resistances, np.array([state.case.inflow_mL_s])
        common_Pa = float(outflows(ends, inflow_mL_s, np.nan_to_num(outlet_Pa)[None])[1][0])
    updates = sum(WIDTH**depth * len(level.domain.cells) for depth, level in enumerate(state.levels))
    return FlowField(
        levels=levels,
        wall=vessel.lumen,
        wall_shear_stress_Pa=flow.wall_shear_stress_Pa,
        wall_pressure_Pa=flow.wall_pressure_Pa,
        inlets_mL_s=flow.inlets_mL_s,
        outlets_mL_s=flow.outlets_mL_s,
        inlet_pressure_Pa=inlet_Pa,
        outlet_pressure_Pa=outlet_Pa,
        blood=state.case.blood,
        is_converged=outcome.is_converged,
        unsettled_fraction=left,
        advice=advice + _remarks(state, levels, phases),
        residual=np.array(outcome.residual),
        steps=state.steps * WIDTH ** (len(state.levels) - 1),
        seconds=outcome.seconds,
        updates_per_s=updates * state.steps / state.loop_seconds,
        phases=phases,
        wire_force_N=None if domains.wires_of(state.case, finest.domain.cell_size_mm) is None else force_N(finest),
        mean_shear_Pa=flow.mean_shear_Pa,
        common_pressure_Pa=common_Pa,
        neck_inflow_mL_s=neck_mL_s(state) if flow.neck_inflow_mL_s is None else flow.neck_inflow_mL_s,
    )


def neck_mL_s(state: State, check: int = -1) -> float | None:
    """Return the neck inflow at a check where levels that are not kept are finer there; else None."""
    return None if state.levels == state.kept else float(state.history[check][NECK_INFLOW:].sum())


def _remarks(state: State, levels: Sequence[Level], phases: Sequence[Phase]) -> str:
    """Return sentences on wires, levels, GPU, and on where the grid is too coarse for the vessel or for the flow."""
    case, finest, remarks = state.case, state.at_wires.domain, ""
    wires = domains.wires_of(case, finest.cell_size_mm)
    if wires is not None:
        remarks += (
            f" The wires are walls, {thickness_mm(wires) / finest.cell_size_mm:.2g} cells thick; {finest.closed_gaps} "
            "cells in gaps narrower than a cell are closed."
        )
    elif case.has_screen and case.ostium is not None:
        across = neck_diameter_mm(case.ostium) / finest.cell_size_mm
        if across < FEWEST_ACROSS_NECK:
            remarks += (
                f" Under-resolved neck: it has {across:.0f} cells across. With fewer than {FEWEST_ACROSS_NECK} behind "
                "a dense braid, neck inflow and sac velocity are up to a third too high: use a grid spacing of "
                f"{across / FEWEST_ACROSS_NECK * finest.cell_size_mm:.2g} mm, or leave it open."
            )
    if len(state.levels) > 1:
        sizes = ", ".join(f"{one.domain.cell_size_mm:.3g} mm ({len(one.domain.cells):,} cells)" for one in state.levels)
        remarks += f" The grid spacing is {sizes}, from the whole vessel to the finest level."
    if state.device is not None:
        remarks += f" Time steps were launched on the GPU {state.device.how}."
    size_mm = state.kept[-1].domain.cell_size_mm
    size_mm /= WIDTH ** further_levels(case, size_mm)
    remarks += domains.too_narrow(case, size_mm) + domains.unreached(case.vessel, state.domain)
    for number, (level, own) in enumerate(zip(state.kept, levels, strict=True)):
        moments_m_s = [phase.velocity_m_s[number] for phase in phases] or [own.velocity_m_s]
        speed_m_s = np.max([np.linalg.norm(one, axis=1) for one in moments_m_s], axis=0)
        counts = np.repeat(level.limit, level.addressing.length) == CELL_REYNOLDS
        if level.interface is not None:
            counts[level.interface.inner[1]] = False
        remarks += domains.too_fast(level.domain, np.where(counts, speed_m_s, 0.0), case.blood, CELL_REYNOLDS)
    return remarks


def force_N(state: State) -> Floats:
    """Return the force (3,) of the blood on the wires that are walls."""
    state.fetch()
    links = state.links
    momentum = exchanged(state.populations, links.address[links.of_wires], links.wire_direction)
    return momentum.sum(axis=0) * _newton(state)


def forces_N(state: State) -> tuple[Floats, Floats]:
    """Return cells (m, 3), mm, of a level, and the force (m, 3) of their blood on wires beside them and on a screen."""
    state.fetch()
    links, a, screen = state.links, state.addressing, state.screen
    address = links.address[links.of_wires]
    on_walls = exchanged(state.populations, address, links.wire_direction)
    on_screen = 2.0 * (read_here(state)[1] - snapshot(state).velocity)[screen.cell]
    cells = np.r_[np.searchsorted(a.place, address[:, 2] % a.stride), screen.cell]
    return state.domain.centers_mm[cells], np.concatenate([on_walls, on_screen]) * _newton(state)


def _newton(state: State) -> float:
    """Return the force, N, of the momentum of 1 per step in lattice units."""
    scales = state.scales
    return scales.blood.density_kg_m3 * scales.cell_m**4 / scales.step_s**2


def exchanged(populations: NDArray[np.float32], address: Ints, direction: Ints) -> Floats:
    """Return the momentum (l, 3) that walls take up per step, in lattice units, from links with addresses (l, 6).

    Populations must be at home.

    References
    ----------
    Ladd 1994, J. Fluid Mech. 271, 285.
    """
    sent, returned = (populations[address[:, k]].astype(np.float64) for k in (3, 0))
    return np.asarray((sent + returned)[:, None] * VELOCITIES[direction])
