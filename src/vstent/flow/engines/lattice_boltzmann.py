"""The embedded engine: sparse lattice-Boltzmann, D3Q19, single precision, regularised, interpolated walls."""

from collections import deque
from dataclasses import dataclass, field
from time import perf_counter

import numba
import numpy as np
from numpy.typing import NDArray

from vstent.flow import domain as domains
from vstent.flow import sampling
from vstent.flow.engines import AbstractEngine, Outcome
from vstent.flow.engines.lattice_setup import (
    CELL_REYNOLDS_AT_END,
    ODD_RATE,
    Addressing,
    Links,
    Refill,
    Scales,
    ScreenEntries,
    address,
    build_links,
    build_refill,
    build_screen,
    in_extensions,
)
from vstent.flow.types import FlowCase, FlowField
from vstent.flow.wall_stress import wall_stress
from vstent.kernels import lattice, lattice_sampling, voxels
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M_PER_MM

CHECK_DIAMETERS = 0.5
"""Flow time between checks, in inlet diameters over mean inlet speed."""
LEAST_CHECKS = 24
"""The limit of time steps leaves room for at least this many checks: fewer cannot tell whether the flow has settled."""
CHECKS_AGREEING = 3
"""Checks that must agree: a quantity that swings passes its end by chance."""
CHECKS_AVERAGED = 8
"""Checks whose mean is the result where the flow does not settle."""
DEFER_PAIRS = 8
"""Step pairs between updates of what is deferred."""
DEFER_PART = 0.15
"""Part of the way that each update goes."""


@dataclass(frozen=True, eq=False)
class Probe:
    """Where the monitored quantities are read."""

    cells: Ints
    """Cells of the sac, or of the whole lumen where there is no sac."""
    ostium_points: Floats
    """(p, 3) points on the ostium, grid units."""
    ostium_area_mm2: Floats
    """(p, 3) area vectors there."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The flow at a check, in lattice units."""

    velocity: NDArray[np.float32]
    """(n, 3) of every cell."""
    density: NDArray[np.float32]
    """(n,) deviation of every cell."""
    outflow: Floats
    """(k,) through every opening."""


@dataclass(eq=False)
class State:
    """A run under way; the populations change in place."""

    case: FlowCase
    """What is computed."""
    domain: domains.Domain
    """The grid."""
    addressing: Addressing
    """The storage."""
    scales: Scales
    """Lattice units."""
    links: Links
    """What walls and openings send back."""
    screen: ScreenEntries
    """Resistance of the stent by segment."""
    probe: Probe
    """Monitored quantities."""
    refill: Refill
    """What the walls lose."""
    limit: NDArray[np.float32]
    """(s,) largest cell Reynolds number in every segment."""
    populations: NDArray[np.float32]
    """(19 * stride + LANES,) shifted populations."""
    steps_per_check: int
    """Time steps between checks, even."""
    steps: int = 0
    """Time steps made."""
    history: list[Floats] = field(default_factory=list)
    """Monitored quantities at every check."""
    snapshots: deque[Snapshot] = field(default_factory=lambda: deque(maxlen=CHECKS_AVERAGED))
    """The flow at the last checks."""
    loop_seconds: float = 0.0
    """Time spent in the time steps."""


@dataclass(frozen=True)
class LatticeBoltzmann(AbstractEngine[State]):
    """Sparse D3Q19 in single precision with shifted populations, two relaxation times and interpolated walls."""

    cell_size_mm: float
    """Edge of a cell."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Build grid, storage and coefficients; begin at rest or from a field on any grid."""
        domain = domains.build(case.vessel, self.cell_size_mm)
        is_end = in_extensions(case, domain)
        addressing = address(domain, is_end)
        scales = _scales(case, self.cell_size_mm, start)
        populations = np.zeros(19 * addressing.stride + lattice.LANES, dtype=np.float32)
        state = State(
            case,
            domain,
            addressing,
            scales,
            build_links(case, domain, addressing, scales),
            build_screen(case, domain, addressing, scales),
            _probe(case, domain),
            build_refill(domain, addressing),
            np.where(is_end, CELL_REYNOLDS_AT_END, np.inf)[addressing.first_cell].astype(np.float32),
            populations,
            _steps_per_check(case, scales),
        )
        if start is not None:
            _begin_from(state, start)
        return state

    def step(self, state: State) -> State:
        """Make the time steps to the next check and read the monitored quantities."""
        began = perf_counter()
        _advance(state)
        state.loop_seconds += perf_counter() - began
        state.snapshots.append(_snapshot(state))
        state.history.append(_monitor(state, state.snapshots[-1]))
        return state

    def terminate(self, state: State) -> float:
        """Fraction that the monitored quantities have left to go, the worst of the last checks."""
        history = np.array(state.history)
        return max(fraction_left(history[: len(history) - k]) for k in range(min(CHECKS_AGREEING, len(history))))

    def max_checks(self, state: State) -> int:
        """Checks within the limit of time steps."""
        return max(4, state.case.settings.max_steps // state.steps_per_check)

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return to SI units and find the wall stress."""
        return _field(state, outcome)


def _scales(case: FlowCase, cell_size_mm: float, start: FlowField | None) -> Scales:
    """Choose the time step so that the fastest blood moves `lattice_speed` cells a step."""
    if start is not None:
        peak_m_s = 1.1 * float(start.speed_m_s.max())
    else:
        narrowest_mm2 = min(case.vessel.inlet.area_mm2, sum(outlet.area_mm2 for outlet in case.vessel.outlets))
        peak_m_s = 3.0 * case.inflow_mL_s / narrowest_mm2
    cell_m = cell_size_mm * M_PER_MM
    return Scales(cell_m, case.settings.lattice_speed * cell_m / peak_m_s, case.blood)


def _steps_per_check(case: FlowCase, scales: Scales) -> int:
    inlet = case.vessel.inlet
    speed_m_s = case.inflow_mL_s / inlet.area_mm2
    steps = CHECK_DIAMETERS * inlet.diameter_mm * M_PER_MM / speed_m_s / scales.step_s
    return 2 * max(1, round(0.5 * min(steps, case.settings.max_steps / LEAST_CHECKS)))


def _probe(case: FlowCase, domain: domains.Domain) -> Probe:
    if case.sac is None or case.ostium is None:
        return Probe(np.arange(len(domain.cells), dtype=np.int32), np.zeros((0, 3)), np.zeros((0, 3)))
    cells = domains.cells_inside(case.sac, domain.centers_mm, domain.cell_size_mm)
    points_mm, area_mm2 = sampling.surface_samples(case.ostium, domain.cell_size_mm)
    return Probe(cells, (points_mm - domain.origin_mm) / domain.cell_size_mm, area_mm2)


def _begin_from(state: State, start: FlowField) -> None:
    velocity, pressure = sampling.values_at(start, state.domain.centers_mm)
    lattice.set_equilibrium(
        state.populations,
        state.addressing.stride,
        state.addressing.place,
        pressure / state.scales.pressure_Pa,
        velocity / state.scales.speed_m_s,
    )
    inlet = state.links
    inlet.openings[0, 2] = lattice.moments(
        state.populations, state.addressing.stride, inlet.place[inlet.start[0] : inlet.start[1]]
    )[:, 0].mean()


def _advance(state: State) -> None:
    """Make the time steps to the next check, in pairs."""
    f, links, refill = state.populations, state.links, state.refill
    a, screen = state.addressing, state.screen
    threads = numba.get_num_threads()
    relaxation = np.float32(state.scales.relaxation_steps), state.limit, np.float32(ODD_RATE)
    opening_source, wall = links.source[: links.start[-1]], slice(links.start[-1], None)
    for pair in range(state.steps_per_check // 2):
        lattice.drive(
            f,
            a.stride,
            links.openings,
            links.start,
            links.address,
            links.place,
            links.direction,
            links.shape,
            opening_source,
        )
        for address_of, is_even in ((a.even_address, True), (a.odd_address, False)):
            lattice.update(
                f,
                address_of,
                a.length,
                *relaxation,
                screen.start,
                screen.place,
                screen.entry,
                threads,
            )
            lattice.reflect(f, links.address, links.weight, links.source, refill.place, refill.refill, is_even)
            lattice.swap(f, *a.swap_address)
        if pair % DEFER_PAIRS == 0:
            part = np.float32(DEFER_PART)
            lattice.defer(f, links.address[wall], links.correction[wall], links.source[wall], part)
            lattice.balance(f, links.address[wall], refill.link_group, refill.count, refill.member, refill.refill, part)
    state.steps += state.steps_per_check


def _snapshot(state: State) -> Snapshot:
    moment = lattice.moments(state.populations, state.addressing.stride, state.addressing.place).astype(np.float32)
    velocity = np.ascontiguousarray(moment[:, 1:])
    if len(state.screen.cell):
        velocity[state.screen.cell] = lattice.resisted(velocity[state.screen.cell], state.screen.entry)
    links = state.links
    ends = range(len(links.start) - 1)
    outflow = [lattice.outflow(state.populations, links.address[links.start[k] : links.start[k + 1]]) for k in ends]
    return Snapshot(velocity, moment[:, 0], np.array(outflow))


def _monitor(state: State, now: Snapshot) -> Floats:
    """Mean speed of the sac, pressure and mean speed of the vessel, neck inflow: what convergence is judged by."""
    speed = np.linalg.norm(now.velocity, axis=1)
    inlet = state.domain.link_cell[state.domain.link_patch == 1]
    values = [speed[state.probe.cells].mean(), now.density[inlet].mean(), speed.mean()]
    if len(state.probe.ostium_points):
        index = voxels.index_of(state.domain.cells)
        through = lattice_sampling.interpolate(index, now.velocity.astype(float), state.probe.ostium_points, True)
        values.append(float(np.maximum(np.einsum("ij,ij->i", through, state.probe.ostium_area_mm2), 0.0).sum()))
    return np.array(values, dtype=float)


def fraction_left(history: Floats) -> float:
    """Largest fraction that any column of a history (checks, quantities) has left to go; nan when one is not finite.

    The last quarter of the checks is compared with the quarter before: if the change goes on shrinking as it does from
    each quarter to the next, a geometric series is left.
    """
    if not np.isfinite(history[-1]).all():
        return float("nan")
    window = len(history) // 4
    if window < 3:
        return float("inf")
    means = [history[len(history) - (k + 1) * window : len(history) - k * window].mean(axis=0) for k in range(3)]
    scale = np.maximum(np.abs(history[-1]), 1e-12)
    change, before = np.abs(means[0] - means[1]), np.abs(means[1] - means[2])
    shrinking = np.clip(change / np.maximum(before, 1e-30), 0.3, 0.9)
    return float((change / scale * shrinking / (1 - shrinking)).max())


def _field(state: State, outcome: Outcome) -> FlowField:
    scales, domain, vessel = state.scales, state.domain, state.case.vessel
    kept = [state.snapshots[-1]] if outcome.is_converged else list(state.snapshots)
    velocity_m_s = np.mean([one.velocity for one in kept], axis=0, dtype=float) * scales.speed_m_s
    pressure_Pa = np.mean([one.density for one in kept], axis=0, dtype=float) * scales.pressure_Pa
    out_mL_s = np.mean([one.outflow for one in kept], axis=0) * scales.flow_mL_s
    stress_Pa, wall_pressure_Pa = wall_stress(
        index=voxels.index_of(domain.cells),
        origin_mm=domain.origin_mm,
        cell_size_mm=domain.cell_size_mm,
        velocity_m_s=velocity_m_s,
        pressure_Pa=pressure_Pa,
        lumen=vessel.lumen,
        closed=domain.surface,
        blood=state.case.blood,
    )
    section_Pa = np.array([_section_pressure_Pa(state, pressure_Pa, k) for k in range(len(vessel.openings))])
    return FlowField(
        cells=domain.cells,
        origin_mm=domain.origin_mm,
        cell_size_mm=domain.cell_size_mm,
        velocity_m_s=velocity_m_s,
        pressure_Pa=pressure_Pa,
        wall=vessel.lumen,
        wall_shear_stress_Pa=stress_Pa,
        wall_pressure_Pa=wall_pressure_Pa,
        inlet_mL_s=-out_mL_s[0],
        outlets_mL_s=out_mL_s[1:],
        inlet_pressure_Pa=section_Pa[0],
        outlet_pressure_Pa=section_Pa[1:],
        blood=state.case.blood,
        is_converged=outcome.is_converged,
        advice=_advice(state, outcome),
        residual=np.array(outcome.residual),
        steps=state.steps,
        seconds=outcome.seconds,
        updates_per_s=len(domain.cells) * state.steps / state.loop_seconds,
    )


def _advice(state: State, outcome: Outcome) -> str:
    if outcome.is_converged:
        return "The flow has settled."
    last = np.array(state.history[-CHECKS_AVERAGED:])
    swing = float((np.ptp(last, axis=0) / np.maximum(np.abs(last.mean(axis=0)), 1e-12)).max())
    span_ms = 1e3 * len(last) * state.steps_per_check * state.scales.step_s
    return (
        f"The flow has not settled in {state.steps} time steps and may be unsteady by nature: these are means over its "
        f"last {span_ms:.0f} ms, in which what is monitored ranged over up to {100 * swing:.0f} % of its mean."
    )


def _section_pressure_Pa(state: State, pressure_Pa: Floats, k: int) -> float:
    """Mean pressure of the cells on the plane of opening k itself, not of its extension's end."""
    opening = state.case.vessel.openings[k]
    offset = state.domain.centers_mm - opening.center_mm
    along = offset @ opening.normal
    near = (np.abs(along) < state.domain.cell_size_mm) & (np.linalg.norm(offset, axis=1) < 0.75 * opening.diameter_mm)
    return float(pressure_Pa[near].mean()) if near.any() else float("nan")
