"""Build a lattice-Boltzmann run and advance it from check to check."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any, Final
from weakref import WeakKeyDictionary

import numba
import numpy as np
from numpy.typing import NDArray

from vstent.flow import domain as domains, sampling
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.ends import outflows
from vstent.flow.lattice.gpu import require_gpu, told
from vstent.flow.lattice.kernels import d3q19, exchange
from vstent.flow.lattice.kernels.warm import keep_flow
from vstent.flow.lattice.levels import (
    CARRIED_CELLS,
    OF_SHEAR,
    WIDTH,
    Interface,
    Stencil,
    beside_walls,
    refined,
    sizes_mm,
    wire_levels,
)
from vstent.flow.lattice.scales import Scales, odd_rate
from vstent.flow.lattice.screen import build_screen
from vstent.flow.lattice.setup import Grid, Refill, address, behind, build_links, thickest
from vstent.flow.lattice.state import DEFER_PAIRS, DEFER_PART, Snapshot, State, speeds
from vstent.geometry.vessel import Vessel
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import M_PER_MM

SLICE_UPDATES: Final = 2e8
"""Number of cell updates between two looks at the clock: a few seconds on one core."""
GPU_SLICE_UPDATES: Final = 2e9
"""The same on a GPU: some tenths of a second."""

FOLLOWED: Final = 0.5
"""Part by which the flow through resistances follows the pressure at a check of a steady flow: a sudden change of the
flow changes the pressure, because blood is accelerated."""

LEARNED: Final = 2
"""Number of harmonics of a pulse for which the delay of an outlet is corrected: cycles that correct more converge
slowly."""

_GRIDS: WeakKeyDictionary[Vessel, dict[tuple[Any, ...], list[tuple[Grid, Interface | None]]]] = WeakKeyDictionary()
"""Grids by grid spacing, refined part and resolved wires, as long as the vessel exists."""


def build(
    case: FlowCase, cell_size_mm: float, check_s: float, pace: Ints, *, start: FlowField | None, kept: int
) -> State:
    """Set up a run: grids, memory layout, walls, openings, screen and initial flow.

    `cell_size_mm` is the spacing in the sac (see `levels.sizes_mm`). `check_s` is the time between checks and `pace`
    (m,) the even numbers of time steps of the coarsest level from each to the next, repeated cyclically. The last
    `kept` checks are kept. Without a `start` the run begins at rest; a pulse begins with the last phase of `start`, if
    it has phases.
    """
    if case.numerics.device_gpu:
        require_gpu()
    keep_flow()
    if start is not None and case.waveform is not None and start.phases:
        begun: FlowField | None = start.at_phase(start.phases[-1])
    else:
        begun = start
    grids = _grids(case, cell_size_mm)
    finest, last = grids[case.numerics.coarser_levels + wire_levels(case, cell_size_mm)]
    if last is not None and domains.wires_of(case, finest.domain.cell_size_mm):
        case = beside_walls(case, finest.domain.centers_mm[last.is_trusted])
    levels = [_level(case, grid, check_s, WIDTH**depth * pace, begun, kept) for depth, (grid, _) in enumerate(grids)]
    state = levels[0]
    for coarse, fine, (_, between) in zip(levels[:-1], levels[1:], grids[1:], strict=True):
        coarse.finer, coarse.interface, fine.history = fine, between, state.history
    if case.resistances:
        _ask(state, answered_mL_s(state, _before_Pa(state, start)))
    return state


def _level(case: FlowCase, grid: Grid, check_s: float, pace: Ints, start: FlowField | None, kept: int) -> State:
    """Set up one level of a run."""
    domain, addressing = grid.domain, grid.addressing
    scales = Scales(domain.cell_size_mm * M_PER_MM, check_s / int(pace[0]), case.blood)
    scales = replace(scales, odd_rate=odd_rate(scales.relaxation_steps))
    links = build_links(case, grid, scales)
    if domains.wires_of(case, domain.cell_size_mm):
        case = beside_walls(case, domain.centers_mm)
    screen = build_screen(case, domain, addressing, scales)
    place, groups = grid.groups
    slots = 2 * sum(len(one.cell) for one in grid.crossings)
    f, stride = np.zeros(behind(addressing) + slots, dtype=np.float32), addressing.stride
    if start is not None:
        velocity_m_s, pressure_Pa = sampling.values_at(start, domain.centers_mm)
        density, velocity = pressure_Pa / scales.pressure_Pa, velocity_m_s / scales.speed_m_s
        d3q19.set_equilibrium(f, stride, addressing.place, density, velocity)
        for k in np.flatnonzero(links.is_inflow):
            moments = d3q19.moments(f, stride, links.place[links.start[k] : links.start[k + 1]])
            links.openings[k, d3q19.MEMORY] = moments[:, 0].mean()
    return State(
        case=case,
        domain=domain,
        addressing=addressing,
        scales=scales,
        built=(links, screen),
        links=links,
        screen=screen,
        refill=Refill(place, groups, np.zeros(len(groups[1]), np.float32), np.zeros(len(place), np.float32)),
        bands=grid.bands,
        limit=grid.limit[addressing.first_cell],
        populations=f,
        pace=pace,
        check_s=check_s,
        snapshots=deque(maxlen=kept),
    )


def _before_Pa(state: State, start: FlowField | None) -> Floats:
    """Return the pressure (m, k) at the outlets at the checks of a cycle of the flow before, 0 where there is none."""
    vessel, count = state.case.vessel, len(state.pace)
    if start is None:
        return np.zeros((count, len(vessel.outlets)))
    if len(start.phases) != count:
        return np.tile(np.nan_to_num(start.outlet_pressure_Pa), (count, 1))
    sections_Pa = [domains.section_pressure_Pa(vessel, start.levels[0], one.pressure_Pa[0]) for one in start.phases]
    return np.asarray(np.nan_to_num(sections_Pa)[:, len(vessel.inlets) :], dtype=np.float64)


def prepare(case: FlowCase, cell_size_mm: float) -> None:
    """Build the grids, and the distances from the wall that a result needs, for later flows on them."""
    for grid, _ in _grids(case, cell_size_mm):
        _ = grid.bands, grid.groups, grid.domain.index, grid.domain.depth_mm


def _grids(case: FlowCase, cell_size_mm: float) -> list[tuple[Grid, Interface | None]]:
    """Return the grids of a case, coarse to fine, each with its coupling to the next coarser one.

    Flows in the same vessel with the same walls share them. Of those with walls the last is kept.
    """
    built = _GRIDS.setdefault(case.vessel, {})
    sizes = sizes_mm(case, cell_size_mm)
    coarsest_mm, finest_mm = sizes[0], sizes[-1]
    are_walls = domains.wires_of(case, finest_mm) is not None
    part = (case.sac, case.numerics.refine, case.is_split_given) if len(sizes) > 1 else None
    key = sizes, part, case.solids if are_walls else ()
    if key not in built:
        for others in [other for other in built if other[2] and are_walls]:  # of another device, or tile of it
            del built[others]
        domain = domains.build(case.vessel, coarsest_mm, wires=domains.wires_of(case, coarsest_mm))
        limit = thickest(case, domain)
        grids: list[tuple[Grid, Interface | None]] = [(Grid(domain, limit, address(domain, limit)), None)]
        while len(grids) < len(sizes):
            try:
                coarse, fine, between = refined(case, grids[-1][0], cell_size_mm)
            except domains.CoarseGridError:
                if len(grids) <= case.numerics.coarser_levels + wire_levels(case, cell_size_mm):
                    raise
                break  # the rest of a narrow branch is too short
            grids[-1:] = (coarse, grids[-1][1]), (fine, between)
        built[key] = grids
    return [(grid, between and between.anew()) for grid, between in built[key]]


def place_screen(state: State, case: FlowCase) -> None:
    """Exchange the screen of a run for that of a case; the flow does not change."""
    for level in state.levels:
        level.fetch()
        level.device = None
        entries = build_screen(case, level.domain, level.addressing, level.scales)
        level.case, level.screen, level.built = case, entries, (level.built[0], entries)


def twin(state: State) -> State:
    """Return a second run with the same flow, which goes its own way."""
    state.fetch()
    changing = {name: getattr(state.links, name).copy() for name in ("source", "openings", "course")}
    links = replace(state.links, **changing)
    refill = replace(state.refill, lost=state.refill.lost.copy(), refill=state.refill.refill.copy())
    other = replace(
        state,
        built=(links, state.screen),
        links=links,
        refill=refill,
        populations=state.populations.copy(),
        snapshots=state.snapshots.copy(),
        history=list(state.history),
        device=None,
    )
    if state.finer is not None and state.interface is not None:
        between = state.interface
        other.interface = between.twin()
        other.finer = twin(state.finer)
        for level in other.finer.levels:
            level.history = other.history
    return other


def step(state: State) -> None:
    """Make time steps for a few seconds, at most up to the next check, and record the flow at a check.

    A GPU goes on with the next time steps while the host evaluates the check, unless a result may need its populations.
    """
    began, state.begun_s = perf_counter() if state.begun_s is None else state.begun_s, None
    advance(state, _slice_steps(state))
    state.loop_seconds += perf_counter() - began
    if state.since_check == state.steps_per_check:
        with np.errstate(over="ignore", invalid="ignore"):  # divergence is reported as an error, not as a warning
            now = snapshots(state)
            for level, of_level in zip(state.kept, now, strict=False):
                level.snapshots.append(of_level)
            state.history.append(np.zeros(0))
            state.since_check = 0
            if state.case.resistances and len(state.history) % len(state.pace) == 0:
                _follow(state)
            _keep_pace(state)
            are_walls = any(len(level.links.of_wires) for level in state.levels)
            if state.device is not None and state.levels == state.kept and not are_walls:
                with told():
                    if state.device.begin(*_pairs(state, _slice_steps(state))):
                        state.begun_s = perf_counter()
            state.history[-1] = monitored(state, now)


def answered_mL_s(state: State, pressure_Pa: Floats) -> Floats:
    """Return the flow rates (m, k) through resistances at the checks of a cycle, from the pressures (m, k) there.

    In a steady flow there is a single check.
    """
    case, time_s = state.case, _cycle_s(state)
    return outflows(case.resistances, case.inflow_mL_s * case.inflow_factor(time_s), pressure_Pa, float(time_s[-1]))[0]


def at_outlets_Pa(state: State) -> Floats:
    """Return the pressure (m, k) at the outlets at the last check of a steady flow, or at those of the last cycle."""
    vessel, last = state.case.vessel, list(state.snapshots)[-len(state.pace) :]
    sections_Pa = [domains.section_pressure_Pa(vessel, state.domain, one.pressure_Pa.astype(float)) for one in last]
    return np.asarray(np.nan_to_num(sections_Pa)[:, len(vessel.inlets) :], dtype=np.float64)


def _cycle_s(state: State) -> Floats:
    """Return the times (m,) of the checks in a cycle."""
    return np.asarray(state.check_s * (1 + np.arange(len(state.pace))), dtype=np.float64)


def _follow(state: State) -> None:
    """Adjust the flow through resistances at the outlets to the pressures at the last checks.

    In a pulsatile flow the low harmonics of what the outlets let through less than asked for are added: an outlet
    follows a changing flow rate with a delay.
    """
    flow_mL_s, asked_mL_s = answered_mL_s(state, at_outlets_Pa(state)), _asked_mL_s(state)
    if state.case.waveform is None:
        _ask(state, asked_mL_s + FOLLOWED * (flow_mL_s - asked_mL_s))
        return
    is_set, outlet, _ = of_outlets(state)
    through_mL_s = np.array([one.outflow_mL_s[is_set] for one in list(state.snapshots)[-len(asked_mL_s) :]])
    missed = np.fft.rfft(asked_mL_s[:, outlet] - through_mL_s, axis=0)
    missed[0] = missed[LEARNED + 1 :] = 0.0
    flow_mL_s[:, outlet] += np.fft.irfft(missed, len(asked_mL_s), axis=0)
    _ask(state, asked_mL_s + state.case.followed(flow_mL_s - asked_mL_s))


def _asked_mL_s(state: State) -> Floats:
    """Return the flow rates (m, k) that are imposed at the outlets at the checks of a cycle."""
    result = _usual_mL_s(state)
    is_set, outlet, speed_mL_s = of_outlets(state)
    course = state.built[0].course
    result[:, outlet] += course[:: len(course) // len(result), is_set] * speed_mL_s
    return result


def _ask(state: State, flow_mL_s: Floats) -> None:
    """Impose flow rates (m, k) at the outlets at the checks of a cycle; the widest takes the rest."""
    links, built = state.links, state.built[0]
    is_set, outlet, speed_mL_s = of_outlets(state)
    speed = (flow_mL_s - _usual_mL_s(state))[:, outlet] / speed_mL_s
    finer = len(built.course) // len(speed)
    part = (np.arange(len(built.course)) % finer / finer)[:, None]
    before, after = np.repeat(speed, finer, axis=0), np.repeat(np.roll(speed, -1, axis=0), finer, axis=0)
    built.course[:, is_set] = before + part * (after - before)
    if links is not built:
        links.course[:] = state.scales.step_s * int(state.pace[0]) / state.check_s * built.course


def _usual_mL_s(state: State) -> Floats:
    """Return the flow rates (m, k) at the outlets without `Links.course`: they follow the waveform."""
    means_mL_s = [end.mean_mL_s for end in state.case.resistances]
    return np.outer(state.case.inflow_factor(_cycle_s(state)), means_mL_s)


def of_outlets(state: State) -> tuple[Bools, Ints, Floats]:
    """Return which ends have a flow rate imposed, their outlets (o,), and the flow rate (o,) of a speed of 1.

    The speed is that of `Links.course` before the time step changes.
    """
    is_set = state.links.openings[:, d3q19.KIND] == d3q19.OUTFLOW
    outlet = state.links.patch[is_set] - 1 - len(state.case.vessel.inlets)
    area_mm2 = np.array([state.case.vessel.outlets[k].area_mm2 for k in outlet])
    return is_set, outlet, area_mm2 * state.scales.cell_m * int(state.pace[0]) / state.check_s


def _keep_pace(state: State) -> None:
    """Switch to the time step until the next check and rescale the populations so that the flow is the same."""
    last, following = (int(state.pace[(len(state.history) + k) % len(state.pace)]) for k in (-1, 0))
    if last == following:
        return
    before, stretch = [level.scales.relaxation_steps for level in state.levels], last / following
    take_pace(state)
    for level, relaxation_steps in zip(state.levels, before, strict=True):
        stress, a = stretch * level.scales.relaxation_steps / relaxation_steps, level.addressing
        if level.device is not None:
            with told():
                level.device.rescale(level, stretch, stress)
            continue
        factors = np.float32(stretch), np.float32(stress)
        d3q19.rescale(level.populations, a.stride, a.place, level.links.address, *factors)
        level.links.openings[:, d3q19.OWN_DENSITIES] *= stretch**2
        _settle(level, 1.0)


def take_pace(state: State) -> None:
    """Set links and screens for the time step until the next check; populations and openings do not change."""
    for level in state.levels:
        stretch = int(level.pace[0]) / level.steps_per_check
        level.scales = replace(level.scales, step_s=level.check_s / level.steps_per_check)
        links, screen = level.built
        level.links, level.screen = links.stretched(stretch), screen.stretched(stretch)


def _slice_steps(state: State) -> int:
    """Return the even number of time steps to the next look at the clock or to the next check."""
    updates = GPU_SLICE_UPDATES if state.case.numerics.device_gpu else SLICE_UPDATES
    cells = sum(WIDTH**depth * len(level.domain.cells) for depth, level in enumerate(state.levels))
    steps = 2 * max(1, round(updates / cells / 2))
    return min(steps, state.steps_per_check - state.since_check)


def advance(state: State, steps: int) -> None:
    """Make an even number of time steps."""
    pairs = _pairs(state, steps)
    if state.case.numerics.device_gpu:
        with told():
            from vstent.flow.lattice.on_gpu import Device

            for level in reversed(state.levels):
                level.device = level.device or Device(level)
            state.device.advance(*pairs)
    else:
        _advance_here(state, *pairs)
    state.steps += steps
    state.since_check += steps


def _pairs(state: State, steps: int) -> tuple[Floats, Floats, int]:
    """Return the boundary values of the next time steps, and the number of their first pair since the last check."""
    return *imposed(state, state.since_check + 1 + np.arange(0, steps, 2)), state.since_check // 2


def imposed(state: State, steps: Floats | Ints) -> tuple[Floats, Floats]:
    """Return the boundary values at time steps (t,) since the last check."""
    links = state.links
    count = len(links.course)
    checks = len(state.history) + steps / state.steps_per_check
    finer = max(1, count // len(state.pace))
    now, part = np.divmod((checks - 1) * finer, 1)  # the first moment is the first check
    moments = np.column_stack([now % count, (now + 1) % count, part])
    before, after = (links.course[moments[:, k].astype(int)] for k in range(2))
    factor = state.case.inflow_factor(state.check_s * checks)
    return factor[:, None] * links.wanted + before + part[:, None] * (after - before), moments


def _advance_here(state: State, wanted: Floats, moments: Floats, first_pair: int) -> None:
    """Make pairs of time steps on the CPU; `first_pair` is the number of the first since the last check."""
    f, links, make_pair = state.populations, state.links, _pairs_here(state)
    of_openings = links.start, links.address, links.place, links.direction, links.shape
    opening_source = links.source[: links.start[-1]]
    for pair in range(len(wanted)):
        links.openings[:, d3q19.WANTED] = wanted[pair]
        d3q19.drive(f, state.addressing.stride, links.openings, of_openings, moments[pair], opening_source)
        make_pair(first_pair + pair)


def _pairs_here(state: State) -> Callable[[int], None]:
    """Return a function that makes the pair of time steps of a number since the last check, on all levels."""
    f, links, refill, scales = state.populations, state.links, state.refill, state.scales
    a, screen = state.addressing, state.screen
    shares = d3q19.share(a.length, screen.start, state.bands, numba.get_num_threads())
    relaxation = np.float32(scales.relaxation_steps), scales.thinning, state.limit, np.float32(scales.odd_rate)
    cells = a.address, a.length, relaxation, (screen.start, screen.place, screen.entry)
    back = links.path, links.weight, links.source, links.by_layer, refill.place, refill.refill, a.septa
    finer, between = state.finer, state.interface
    make_finer = None if finer is None else _pairs_here(finer)

    def make_pair(number: int) -> None:
        if between is not None:
            exchange.take(f, between.beside, between.group, between.share, between.lack)
        d3q19.update(f, cells, back, state.bands, shares)
        if number % DEFER_PAIRS == 0:
            _settle(state, DEFER_PART)
        if finer is None or between is None or make_finer is None:
            return
        border = between.border[1]
        for half in range(WIDTH):
            make_finer(WIDTH * number + half)
            exchange.add_crossed(finer.populations, border.first, border.start, 1 / WIDTH**3, between.crossed)
        _couple(state, finer, between)

    return make_pair


def _couple(coarse: State, fine: State, between: Interface) -> None:
    """Couple two levels after a pair of steps of the coarser one and two pairs of the finer one."""
    exchange.add_crossed(coarse.populations, between.border[0].first, between.border[0].start, -1.0, between.crossed)
    of_grids = coarse.populations, coarse.addressing.stride, fine.populations, fine.addressing.stride
    jump = exchange.jumps(*of_grids, between.between, OF_SHEAR, len(between.lack))
    exchange.answer(between.crossed, jump, between.lack, between.push, CARRIED_CELLS)
    _carry(fine, coarse, between.up, between.push[1], WIDTH)
    _carry(coarse, fine, between.down, between.push[0], 1 / WIDTH)


def _carry(source: State, target: State, along: Stencil, push: Floats, ratio: float) -> None:
    """Set the populations of the target cells of a stencil (see `exchange.carry`)."""
    scales, rates = source.scales, (np.float32(source.scales.odd_rate), np.float32(target.scales.odd_rate))
    numbers = np.float32(ratio), np.float32(scales.relaxation_steps), scales.thinning, *rates
    into = target.populations, target.addressing.stride, along.target, along.limit
    read = along.place, along.start, along.cell, along.weight, along.group, along.share
    exchange.carry(source.populations, source.addressing.stride, read, push, into, numbers)


def _settle(state: State, part: float) -> None:
    """Update the deferred wall correction and the mass balance, with the under-relaxation factor `part`."""
    links, refill, share = state.links, state.refill, np.float32(part)
    wall = slice(links.start[-1], len(links.address))
    of_walls = links.address[wall], links.correction[wall], links.source[wall]
    d3q19.defer(state.populations, *of_walls, refill.lost, share)
    d3q19.balance(refill.lost, refill.groups, refill.refill, share)


def snapshots(state: State) -> list[Snapshot]:
    """Return the present flow on all levels; a cell that has finer ones has their mean."""
    now = [snapshot(level) for level in state.levels]
    for coarse, level, fine in reversed(list(zip(now[:-1], state.levels[:-1], now[1:], strict=True))):
        assert level.interface is not None
        finer, cell = level.interface.inner
        count = np.bincount(cell, minlength=len(coarse.density))
        covered = np.flatnonzero(count)
        for values, of_finer, most in (
            (coarse.density[:, None], fine.density[:, None], count[covered]),
            (coarse.velocity, fine.velocity, WIDTH**3),  # blood at rest in walls counts
        ):
            for column, of_column in zip(values.T, of_finer.T, strict=True):
                column[covered] = np.bincount(cell, of_column[finer], len(count))[covered] / most
    return now


def snapshot(state: State) -> Snapshot:
    """Return the present flow; in a screen the velocity includes half of its force."""
    density, velocity, outflow = read_here(state) if state.device is None else state.device.read()
    cells, a = state.screen.cell, state.addressing
    if len(cells):
        time, law = np.float32(state.scales.relaxation_steps), state.scales.thinning
        if law[0] == 0:
            times = np.full(len(cells), time)
        elif state.device is None:
            times = d3q19.relaxation_times(state.populations, a.stride, a.place[cells], time, law)
        else:
            times = state.device.read_times()
        velocity[cells] = d3q19.resisted(velocity[cells], state.screen.entry, times, np.float32(state.scales.odd_rate))
    return Snapshot(state.scales, velocity, density, outflow)


def read_here(state: State) -> tuple[NDArray[np.float32], NDArray[np.float32], Floats]:
    """Return density deviation (n,) and momentum (n, 3) of every cell, and the flow rate (k,) out of every end."""
    f, links = state.populations, state.links
    moment = d3q19.moments(f, state.addressing.stride, state.addressing.place).astype(np.float32)
    ends = range(len(links.start) - 1)
    outflow = [d3q19.outflow(f, links.address[links.start[k] : links.start[k + 1]]) for k in ends]
    return moment[:, 0], np.ascontiguousarray(moment[:, 1:]), np.array(outflow)


def monitored(state: State, now: Sequence[Snapshot]) -> Floats:
    """Return the monitored quantities: mean speed in the sac, inlet pressure, mean speed in the vessel, neck inflow.

    `now` is the flow on every level. The sac is read on the finest one kept, a point of the neck on the finest there.
    """
    first_inflow = state.links.patch[np.argmax(state.links.is_inflow)]
    inlet = state.domain.link_cell[state.domain.link_patch == first_inflow]
    in_sac = speeds(now[state.levels.index(state.main)].velocity_m_s[state.main.sac_cells])
    values = [in_sac.mean(), now[0].pressure_Pa[inlet].mean(), now[0].speed_m_s.mean()]
    if state.neck:
        parts = zip(state.levels, now, state.neck, strict=True)
        through = (sampling.read_through_mL_s(a.domain, b.velocity_m_s.astype(float), *at) for a, b, at in parts)
        values.append(sum(map(sampling.inflow_mL_s, through)))
    return np.array(values, dtype=float)
