"""The embedded engine: sparse lattice-Boltzmann, D3Q19, single precision, two relaxation times."""

from dataclasses import dataclass, field
from time import perf_counter

import numba
import numpy as np
from numpy.typing import NDArray

from vstent.flow import domain as domains
from vstent.flow import sampling
from vstent.flow.engines import AbstractEngine, Outcome
from vstent.flow.profile import developed_profile
from vstent.flow.screen import on_grid
from vstent.flow.types import Blood, FlowCase, FlowField
from vstent.flow.wall_stress import wall_stress
from vstent.kernels import lattice, lattice_sampling, voxels
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M3_PER_ML, M_PER_MM

MAGIC = 3 / 16
"""Product of the two relaxation times (less one half): half-way walls then lie exactly half-way."""
CHECK_DIAMETERS = 0.5
"""Flow time between checks, in inlet diameters over mean inlet speed."""
INLET_VISCOSITY = 0.04
"""Viscosity at the imposed inlet, in lattice units, falling to the blood's own where the lumen begins."""
SOUND_MEMORY = 0.002
"""Rate per step pair at which the inlet forgets the pressure that it takes for the mean."""


@dataclass(frozen=True, eq=False)
class Addressing:
    """Where populations lie (see `vstent.kernels.lattice`)."""

    stride: int
    """Storage places."""
    place: Ints
    """(n,) storage place of every cell."""
    length: Ints
    """(s,) cells of every segment."""
    first_cell: Ints
    """(s,) first cell of every segment."""
    even_address: Ints
    """(s, 19) where the populations of every segment begin in an even step."""
    odd_address: Ints
    """(s, 19) the same in an odd step."""
    link_address: Ints
    """(l, 4) see `lattice.reflect`."""
    link_is_single: NDArray[np.bool_]
    """(l,) the cell behind the link's cell is no blood."""
    swap_address: Ints
    """(2, t) see `lattice.swap`."""


def address(domain: domains.Domain) -> Addressing:
    """Lay out the populations of a domain."""
    cells = domain.cells
    inside = np.zeros(cells.max(axis=0) + 3, dtype=bool)
    inside[tuple(cells.T)] = True
    stored = voxels.dilate(inside, lattice.VELOCITIES[1:])
    number = np.full(inside.shape, -1, dtype=np.int32)
    stride = int(stored.sum())
    number[stored] = np.arange(stride, dtype=np.int32)
    place = number[tuple(cells.T)]
    first = np.flatnonzero(np.r_[True, (np.diff(cells[:, :2], axis=0) != 0).any(axis=1) | (np.diff(cells[:, 2]) != 1)])
    length = np.diff(np.r_[first, len(cells)])
    first, length = _cut(first, length)
    start = cells[first]
    behind = [number[tuple((start - c).T)] for c in lattice.VELOCITIES]
    even = place[first][:, None] + stride * np.arange(19)
    odd = np.stack([lattice.OPPOSITE[q] * stride + behind[q] for q in range(19)], axis=1)
    links, is_single = _link_addresses(domain, number, inside, stride)
    swaps = _swap_addresses(domain, number, stride)
    to_int = np.int32
    return Addressing(
        stride,
        place,
        length.astype(to_int),
        first.astype(to_int),
        even.astype(to_int),
        odd.astype(to_int),
        links,
        is_single,
        swaps,
    )


def _cut(first: Ints, length: Ints) -> tuple[Ints, Ints]:
    """Cut segments longer than the buffer."""
    pieces = -(-length // lattice.SEGMENT)
    owner = np.repeat(np.arange(len(first)), pieces)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    start = rank * lattice.SEGMENT
    return first[owner] + start, np.minimum(length[owner] - start, lattice.SEGMENT)


def _link_addresses(
    domain: domains.Domain, number: Ints, inside: NDArray[np.bool_], stride: int
) -> tuple[Ints, NDArray[np.bool_]]:
    q = domain.link_direction
    p = lattice.OPPOSITE[q]
    cell, c = domain.cells[domain.link_cell], lattice.VELOCITIES[q]
    here, ahead, behind = (number[tuple(x.T)] for x in (cell, cell + c, cell - c))
    rows = [p * stride + here, p * stride + behind, q * stride + here, q * stride + ahead]
    return np.stack(rows, axis=1).astype(np.int32), ~inside[tuple((cell - c).T)]


def _swap_addresses(domain: domains.Domain, number: Ints, stride: int) -> Ints:
    q = domain.septum_direction
    cell = domain.cells[domain.septum_cell]
    here, ahead = (number[tuple(x.T)] for x in (cell, cell + lattice.VELOCITIES[q]))
    return np.stack([lattice.OPPOSITE[q] * stride + here, q * stride + ahead]).astype(np.int32)


@dataclass(eq=False)
class State:
    """A run under way; the populations change in place."""

    case: FlowCase
    """What is computed."""
    domain: domains.Domain
    """The grid."""
    addressing: Addressing
    """The storage."""
    scales: "Scales"
    """Lattice units."""
    links: "Links"
    """What walls and openings send back."""
    screen: "ScreenEntries"
    """Resistance of the stent by segment."""
    probe: "Probe"
    """Monitored quantities."""
    rate: NDArray[np.float32]
    """(2, n + LANES) relaxation rates of the even and the odd part."""
    populations: NDArray[np.float32]
    """(19 * stride + LANES,) shifted populations."""
    steps_per_check: int
    """Time steps between checks, even."""
    steps: int = 0
    """Time steps made."""
    history: list[Floats] = field(default_factory=list)
    """Monitored quantities at every check."""
    loop_seconds: float = 0.0
    """Time spent in the time steps."""


@dataclass(frozen=True)
class Scales:
    """Lattice units of one grid and time step."""

    cell_m: float
    """Edge of a cell."""
    step_s: float
    """Time step."""
    blood: Blood
    """The fluid."""

    @property
    def speed_m_s(self) -> float:
        """One cell per time step."""
        return self.cell_m / self.step_s

    @property
    def pressure_Pa(self) -> float:
        """Pressure of unit density deviation: rho c^2 / 3."""
        return self.blood.density_kg_m3 * self.speed_m_s**2 / 3

    @property
    def flow_mL_s(self) -> float:
        """One cell volume per time step."""
        return self.cell_m**3 / self.step_s / M3_PER_ML

    @property
    def viscosity(self) -> float:
        """Kinematic viscosity."""
        return self.blood.kinematic_viscosity_m2_s * self.step_s / self.cell_m**2


@dataclass(frozen=True, eq=False)
class Links:
    """Coefficients of everything that is sent back (see `lattice.reflect` and `lattice.drive`)."""

    address: Ints
    """(l, 4) openings first, in order, then the wall."""
    weight: NDArray[np.float32]
    """(l, 3)."""
    source: NDArray[np.float32]
    """(l,)."""
    openings: Floats
    """(k, 7)."""
    start: Ints
    """(k + 1,) first link of every opening."""
    place: Ints
    """(o,) storage place of every opening link."""
    direction: Ints
    """(o,) lattice velocity of every opening link."""
    shape: Floats
    """(o,) what unit inflow sends back."""


@dataclass(frozen=True, eq=False)
class ScreenEntries:
    """A screen by segment (see `lattice.update`)."""

    start: Ints
    """(s + 1,)."""
    place: Ints
    """(e,) place within the segment."""
    entry: NDArray[np.float32]
    """(e, 6)."""
    cell: Ints
    """(e,) cell."""


@dataclass(frozen=True, eq=False)
class Probe:
    """Where the monitored quantities are read."""

    cells: Ints
    """Cells of the sac, or of the whole lumen where there is no sac."""
    neck_points: Floats
    """(p, 3) points on the neck, grid units."""
    neck_area_mm2: Floats
    """(p, 3) area vectors there."""


@dataclass(frozen=True)
class LatticeBoltzmann(AbstractEngine[State]):
    """Sparse D3Q19 in single precision with shifted populations, two relaxation times and interpolated walls."""

    cell_size_mm: float
    """Edge of a cell."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Build grid, storage and coefficients; begin at rest or from a field on any grid."""
        domain = domains.build(case.vessel, self.cell_size_mm)
        addressing = address(domain)
        scales = _scales(case, self.cell_size_mm, start)
        populations = np.zeros(19 * addressing.stride + lattice.LANES, dtype=np.float32)
        state = State(
            case,
            domain,
            addressing,
            scales,
            _links(case, domain, addressing, scales),
            _screen_entries(case, domain, addressing, scales),
            _probe(case, domain),
            _rates(case, domain, scales),
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
        state.history.append(_monitor(state))
        return state

    def terminate(self, state: State) -> float:
        """Fraction that the monitored quantities have left to go."""
        return fraction_left(np.array(state.history))

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
        peak_m_s = 3.0 * case.inflow_mL_s / case.vessel.inlet.area_mm2
    cell_m = cell_size_mm * M_PER_MM
    return Scales(cell_m, case.settings.lattice_speed * cell_m / peak_m_s, case.blood)


def _steps_per_check(case: FlowCase, scales: Scales) -> int:
    inlet = case.vessel.inlet
    speed_m_s = case.inflow_mL_s / inlet.area_mm2
    return 2 * max(1, round(0.5 * CHECK_DIAMETERS * inlet.diameter_mm * M_PER_MM / speed_m_s / scales.step_s))


def _rates(case: FlowCase, domain: domains.Domain, scales: Scales) -> NDArray[np.float32]:
    """Relaxation rates (2, n + LANES): the even one sets the viscosity, the odd one places the wall.

    Thicker blood in the inlet's extension keeps the imposed flow stable on coarse grids; flow that enters developed stays
    so whatever its viscosity, and the pressure is read behind it.
    """
    inlet = case.vessel.inlet
    ahead_mm = (domain.centers_mm - inlet.center_mm) @ inlet.normal
    is_near = np.linalg.norm(domain.centers_mm - inlet.center_mm, axis=1) < 2 * inlet.diameter_mm
    length_mm = float(((domain.sections[0] - inlet.center_mm) @ inlet.normal).mean())
    part = np.where(is_near, np.clip(ahead_mm / length_mm, 0.0, 1.0), 0.0)
    viscosity = scales.viscosity + max(0.0, INLET_VISCOSITY - scales.viscosity) * part
    rate = np.ones((2, len(domain.cells) + lattice.LANES), dtype=np.float32)
    rate[:, : len(domain.cells)] = 1 / (3 * viscosity + 0.5), 1 / (MAGIC / (3 * viscosity) + 0.5)
    return rate


def _links(case: FlowCase, domain: domains.Domain, addressing: Addressing, scales: Scales) -> Links:
    """Interpolated reflection at the wall, imposed flow or pressure at the openings; openings first."""
    order = np.argsort(np.where(domain.link_patch == 0, len(domain.sections) + 1, domain.link_patch), kind="stable")
    patch, q = domain.link_patch[order], domain.link_direction[order]
    start = np.searchsorted(patch[: int((patch > 0).sum())], np.arange(1, len(domain.sections) + 2)).astype(np.int32)
    weight = _wall_weights(domain.link_fraction[order], addressing.link_is_single[order])
    shape = np.zeros(start[-1])
    openings = np.zeros((len(domain.sections), 7))
    for k, flow_mL_s in enumerate(_imposed_flows_mL_s(case)):
        links = slice(start[k], start[k + 1])
        openings[k, 4:] = case.vessel.openings[k].normal
        weight[links] = (-1.0, 0.0, 0.0)
        if flow_mL_s is not None:
            weight[links] = (1.0, 0.0, 0.0)
            openings[k, :4] = 1.0, flow_mL_s / case.vessel.openings[k].area_mm2 / scales.speed_m_s, 0.0, SOUND_MEMORY
            shape[links] = (
                _unit_inflow(case, domain, k, order[links]) * case.vessel.openings[k].area_mm2 / domain.cell_size_mm**2
            )
    opening_links = order[: start[-1]]
    return Links(
        addressing.link_address[order],
        weight.astype(np.float32),
        np.zeros(len(order), dtype=np.float32),
        openings,
        start,
        addressing.place[domain.link_cell[opening_links]],
        q[: start[-1]],
        shape,
    )


def _wall_weights(fraction: Floats, is_single: NDArray[np.bool_]) -> Floats:
    """Linear interpolated reflection (Bouzidi, Firdaouss and Lallemand 2001, Phys. Fluids 13, 3452, eq. 5).

    Half-way where the cell behind is no blood.
    """
    near = np.stack([2 * fraction, 1 - 2 * fraction, np.zeros_like(fraction)], axis=1)
    far = np.stack([0.5 / fraction, np.zeros_like(fraction), 1 - 0.5 / fraction], axis=1)
    weight = np.where(fraction[:, None] < 0.5, near, far)
    weight[is_single & (fraction < 0.5)] = (1.0, 0.0, 0.0)
    return weight


def _imposed_flows_mL_s(case: FlowCase) -> list[float | None]:
    """Inflow through every opening, None where pressure is imposed; the widest outlet takes the rest."""
    outlets = case.vessel.outlets
    if case.settings.outlets == "zero_pressure" or len(outlets) < 2:
        return [case.inflow_mL_s, *[None] * len(outlets)]
    share = np.array([outlet.diameter_mm**3 for outlet in outlets])
    widest = int(np.argmax(share))
    return [case.inflow_mL_s] + [
        None if k == widest else -case.inflow_mL_s * float(share[k] / share.sum()) for k in range(len(outlets))
    ]


def _unit_inflow(case: FlowCase, domain: domains.Domain, k: int, links: Ints) -> Floats:
    """What each link of opening k sends back so that the whole flow is one cell volume per time step."""
    normal = case.vessel.openings[k].normal
    c = lattice.VELOCITIES[domain.link_direction[links]]
    halfway_mm = domain.origin_mm + (domain.cells[domain.link_cell[links]] + 0.5 * c) * domain.cell_size_mm
    speed = developed_profile(domain.sections[k], normal, halfway_mm)
    sent = lattice.WEIGHTS[domain.link_direction[links]] * speed * (c @ normal)
    return sent / sent.sum()


def _screen_entries(case: FlowCase, domain: domains.Domain, addressing: Addressing, scales: Scales) -> ScreenEntries:
    """The case's screen in lattice units."""
    segments = len(addressing.length)
    if case.screen is None:
        return ScreenEntries(
            np.zeros(segments + 1, np.int32), np.zeros(0, np.int32), np.zeros((0, 6), np.float32), np.zeros(0, np.int32)
        )
    spread = on_grid(case.screen, sampling.index_of(domain.cells), domain.origin_mm, domain.cell_size_mm)
    per_step = scales.step_s / case.blood.density_kg_m3
    entry = np.column_stack(
        [
            spread.normal,
            spread.along_Pa_s_m2 * per_step,
            spread.across_Pa_s_m2 * per_step,
            spread.inertial_per_m * scales.cell_m,
        ]
    )
    segment = np.searchsorted(addressing.first_cell, spread.cell, side="right") - 1
    start = np.searchsorted(segment, np.arange(segments + 1)).astype(np.int32)
    place = (spread.cell - addressing.first_cell[segment]).astype(np.int32)
    return ScreenEntries(start, place, entry.astype(np.float32), spread.cell)


def _probe(case: FlowCase, domain: domains.Domain) -> Probe:
    if case.sac is None or case.neck is None:
        return Probe(np.arange(len(domain.cells), dtype=np.int32), np.zeros((0, 3)), np.zeros((0, 3)))
    cells = domains.cells_inside(case.sac, domain.centers_mm, domain.cell_size_mm)
    points_mm, area_mm2 = sampling.surface_samples(case.neck, domain.cell_size_mm)
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
    f, a, links, screen = state.populations, state.addressing, state.links, state.screen
    threads = numba.get_num_threads()
    opening_source = links.source[: links.start[-1]]
    for _ in range(state.steps_per_check // 2):
        lattice.drive(
            f, a.stride, links.openings, links.start, links.place, links.direction, links.shape, opening_source
        )
        for address_of, is_even in ((a.even_address, True), (a.odd_address, False)):
            lattice.update(
                f, address_of, a.length, a.first_cell, state.rate, screen.start, screen.place, screen.entry, threads
            )
            lattice.reflect(f, links.address, links.weight, links.source, is_even)
            lattice.swap(f, *a.swap_address)
    state.steps += state.steps_per_check


def _macroscopic(state: State) -> tuple[Floats, Floats]:
    """Velocity (n, 3) in cells per step and density deviation (n,) of every cell."""
    moment = lattice.moments(state.populations, state.addressing.stride, state.addressing.place)
    velocity = np.ascontiguousarray(moment[:, 1:])
    if len(state.screen.cell):
        velocity[state.screen.cell] = lattice.resisted(velocity[state.screen.cell], state.screen.entry)
    return velocity, moment[:, 0]


def _monitor(state: State) -> Floats:
    """Mean speed of the sac, neck inflow, pressure and mean speed of the vessel: what convergence is judged by."""
    velocity, density = _macroscopic(state)
    speed = np.linalg.norm(velocity, axis=1)
    inlet = state.domain.link_cell[state.domain.link_patch == 1]
    values = [speed[state.probe.cells].mean(), density[inlet].mean(), speed.mean()]
    if len(state.probe.neck_points):
        index = sampling.index_of(state.domain.cells)
        through = lattice_sampling.interpolate(index, velocity, state.probe.neck_points, True)
        values.append(float(np.maximum(np.einsum("ij,ij->i", through, state.probe.neck_area_mm2), 0.0).sum()))
    return np.array(values)


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
    shrinking = np.clip(change / np.maximum(before, 1e-30), 0.1, 0.9)
    return float((change / scale * shrinking / (1 - shrinking)).max())


def _field(state: State, outcome: Outcome) -> FlowField:
    velocity, density = _macroscopic(state)
    scales, domain, vessel = state.scales, state.domain, state.case.vessel
    velocity_m_s, pressure_Pa = velocity * scales.speed_m_s, density * scales.pressure_Pa
    stress_Pa, wall_pressure_Pa = wall_stress(
        index=sampling.index_of(domain.cells),
        origin_mm=domain.origin_mm,
        cell_size_mm=domain.cell_size_mm,
        velocity_m_s=velocity_m_s,
        pressure_Pa=pressure_Pa,
        lumen=vessel.lumen,
        closed=domain.surface,
        blood=state.case.blood,
    )
    links = state.links
    out_mL_s = np.array(
        [
            lattice.outflow(state.populations, links.address[links.start[k] : links.start[k + 1]]) * scales.flow_mL_s
            for k in range(len(vessel.openings))
        ]
    )
    section_Pa = np.array([_section_pressure_Pa(state, pressure_Pa, k) for k in range(len(vessel.openings))])
    advice = (
        "The flow has settled."
        if outcome.is_converged
        else f"The flow still changes by {100 * outcome.residual[-1]:.1f} %: allow more steps, or compute it as pulsatile, for it may be unsteady."
    )
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
        advice=advice,
        residual=np.array(outcome.residual),
        steps=state.steps,
        seconds=outcome.seconds,
        updates_per_s=len(domain.cells) * state.steps / state.loop_seconds,
    )


def _section_pressure_Pa(state: State, pressure_Pa: Floats, k: int) -> float:
    """Mean pressure of the cells on the plane of opening k itself, not of its extension's end."""
    opening = state.case.vessel.openings[k]
    offset = state.domain.centers_mm - opening.center_mm
    along = offset @ opening.normal
    near = (np.abs(along) < state.domain.cell_size_mm) & (np.linalg.norm(offset, axis=1) < 0.75 * opening.diameter_mm)
    return float(pressure_Pa[near].mean()) if near.any() else float("nan")
