"""Flow engine that runs OpenFOAM: it meshes the case, computes from check to check, and reads the fields.

OpenFOAM's mesh is unstructured. The result is interpolated to the same regular grid as that of the embedded engine, so
that all indices, streamlines and pictures work with either.
"""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import ClassVar, Final

import numpy as np

from vstent.errors import FlowError
from vstent.flow import domain as domains
from vstent.flow.case import PHASES, FlowCase, FlowField, Level, Phase
from vstent.flow.ends import outflows
from vstent.flow.engines import AbstractEngine, Outcome, Saved
from vstent.flow.openfoam import folder as folders, program, results
from vstent.flow.openfoam.boundary import cycle_s, flow_table, table_name
from vstent.flow.openfoam.bridge import Bridge, Snapshot, bridge, read
from vstent.flow.openfoam.case import foam_case, strut_solids
from vstent.flow.openfoam.cost import memory_bytes, tell_cost
from vstent.flow.openfoam.setup import CHECK_ITERATIONS, ITERATIONS, FoamSetup
from vstent.flow.stopping import cycle_change, cycles_advice, quantities_left
from vstent.io.writers import write_text
from vstent.kernels.arrays import Floats, Ints

CHECKS_AVERAGED: Final = 8
"""Number of last checks that are averaged if a steady flow does not converge."""
SETTLED: Final = 1e-4
"""Largest change of the flow through a resistance, over the inflow, at which a flow may have converged."""
CHECKS_HELD: Final = 3
"""Number of first checks at which the inflow is corrected for the meshed area of each inlet."""


@dataclass(eq=False)
class State:
    """An unfinished run; its files are in a folder."""

    case: FlowCase
    """The flow to compute."""
    setup: FoamSetup
    """Setup of the OpenFOAM case."""
    found: program.Program
    """The OpenFOAM installation."""
    application: str
    """Name of the solver program."""
    folder: Path
    """The case folder."""
    domain: domains.Domain
    """The grid of the result."""
    bridge: Bridge
    """Interpolation from OpenFOAM's mesh to the grid."""
    sac_cells: Ints
    """Grid cells in the sac, or in the whole lumen if there is no sac."""
    snapshots: deque[Snapshot]
    """The flow at the last checks."""
    is_settled: bool = False
    """Whether the solver's own residuals are below their limits."""
    history: list[Floats] = field(default_factory=list)
    """Monitored quantities at every check."""
    loop_seconds: float = 0.0
    """Run time of the solver."""

    @property
    def phase_s(self) -> float | None:
        """Time between two phases of a cycle; None: steady inflow."""
        return None if self.case.waveform is None else self.case.waveform.period_s / PHASES

    @property
    def phases_done(self) -> int:
        """Number of phases since the start of the waveform, including earlier runs that this one resumed."""
        return round(float(self.snapshots[-1].time) / self.phase_s) if self.phase_s and self.snapshots else 0

    def add_check(self, time: str) -> None:
        """Read the output at one time, and add the monitored quantities to the history.

        They are those of the embedded engine: mean speed in sac and vessel, inlet pressure, neck inflow.
        """
        now = read(self.case, self.bridge, self.folder, time)
        speed = np.linalg.norm(now.velocity_m_s, axis=1)
        inlet = self.domain.link_cell[self.domain.link_patch == 1]
        values = [speed[self.sac_cells].mean(), now.pressure_Pa[inlet].mean(), speed.mean()]
        self.snapshots.append(now)
        self.history.append(np.array(values if self.case.ostium is None else [*values, now.neck_inflow_mL_s]))


@dataclass(frozen=True, eq=False)
class OpenFoam(AbstractEngine[State]):
    """Engine that uses OpenFOAM's laminar solvers (simpleFoam, or pimpleFoam for a waveform) and snappyHexMesh.

    The grid spacing is that of the mesh in the vessel, before layers and refinement. A run of the same case in the same
    folder resumes from the last time written. A stent is meshed as its struts over necks and ostia.
    """

    has_all_ends: ClassVar[bool] = True
    layers: int = 2
    """Number of flat cell layers along the wall."""
    grid_size_mm: float | None = None
    """Grid spacing of the result; None: that of the mesh."""

    def cost(self, case: FlowCase) -> str:
        """Return a sentence on cells, memory and run time, including a stent's struts."""
        return tell_cost(case, self.cell_size_mm)

    def memory_bytes(self, case: FlowCase) -> float:
        """Return the expected peak memory, including a stent's struts."""
        return memory_bytes(case, self.cell_size_mm)

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Find OpenFOAM, write and mesh the case, and build the interpolation from its mesh to the grid."""
        if self.folder is None:
            raise FlowError("the engine openfoam needs a folder for its files: name one")
        solids, found = strut_solids(case), program.find()
        setup = FoamSetup(self.cell_size_mm, found.flavour, self.layers, case.numerics.processes, solids)
        domain = domains.build(case.vessel, self.grid_size_mm or self.cell_size_mm)
        sac = domains.cells_of_sac(case, domain)
        foam = foam_case(case, setup)
        folders.prepare(self.folder, foam)
        folders.mesh(found, self.folder, setup)
        if start is not None and not results.times(self.folder):
            folders.begin_from(self.folder, start)
        across = bridge(case, domain, self.folder)
        snapshots: deque[Snapshot] = deque(maxlen=PHASES if case.waveform else CHECKS_AVERAGED)
        state = State(case, setup, found, foam.application, self.folder, domain, across, sac, snapshots)
        if state.phase_s:  # resumed at the first complete cycle
            written = results.times(self.folder)
            is_first = [round(float(time) / state.phase_s) % PHASES == 1 for time in written]
            for time in written[is_first.index(True) :] if any(is_first) else []:
                state.add_check(time)
        return state

    def step(self, state: State) -> State:
        """Run the solver to the next check and read its output."""
        began, phase_s = perf_counter(), state.phase_s
        reached = float((results.times(state.folder) or ["0"])[-1])
        end = reached + CHECK_ITERATIONS if phase_s is None else (round(reached / phase_s) + 1) * phase_s
        folders.stop_at(state.folder, end)
        said = program.run(state.found, state.folder, [state.application], processes=state.setup.processes)
        state.loop_seconds += perf_counter() - began
        state.add_check(results.times(state.folder)[-1])
        is_corrected = _correct_inflow(state)
        moved = _follow(state)
        state.is_settled = not is_corrected and moved < SETTLED and "solution converged" in said
        return state

    def terminate(self, state: State) -> float:
        """Return the largest expected remaining change of a monitored quantity, or the change between cycles."""
        history = np.array(state.history)
        if not np.isfinite(history[-1]).all():
            return float("nan")
        if state.phase_s:
            return cycle_change(history)
        return 0.0 if state.is_settled else quantities_left(history)

    def save(self, state: State) -> None:
        """Return None: a run resumes from OpenFOAM's own output in the case folder."""

    def resume(self, case: FlowCase, saved: Saved) -> State:
        """Resume from the last time written."""
        return self.init(case, None)

    def trouble(self, state: State) -> str:
        """Return a sentence on where the run diverged and what to do."""
        good = state.snapshots[-2].time if len(state.snapshots) > 1 else "none"
        return (
            f"the flow in OpenFOAM diverged at time {state.snapshots[-1].time} (last good time: {good}) in "
            f"{state.folder}: change the grid spacing slightly or use fewer wall layers"
        )

    def max_checks(self, state: State) -> int:
        """Return the number of checks within the limit of iterations, or of remaining phases of all cycles."""
        if state.phase_s is None:
            return ITERATIONS // CHECK_ITERATIONS
        left = PHASES * state.case.numerics.max_cycles - state.phases_done
        return left if left > 0 else PHASES

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the last check's flow, or a mean: of the last checks if not converged, of the cycle if pulsatile."""
        snapshots, phase_s = list(state.snapshots), state.phase_s
        if outcome.is_converged and phase_s is None:
            snapshots = snapshots[-1:]

        def mean(name: str) -> Floats:
            return np.asarray(np.mean([getattr(one, name) for one in snapshots], axis=0))

        vessel, domain = state.case.vessel, state.domain
        pressure_Pa = mean("pressure_Pa")
        inlet_Pa, outlet_Pa = vessel.of_inlets_and_outlets(domains.section_pressure_Pa(vessel, domain, pressure_Pa))
        backwards_mL_s, outlets_mL_s = vessel.of_inlets_and_outlets(mean("outflow_mL_s"))
        common_Pa = 0.0
        if ends := state.case.resistances:
            inflow_mL_s = np.array([state.case.inflow_mL_s])
            common_Pa = float(outflows(ends, inflow_mL_s, np.nan_to_num(outlet_Pa)[None])[1][0])
        speed_m_s = shear_Pa = None
        if phase_s is None and len(snapshots) > 1:  # checks of a steady solver that did not converge
            speeds_m_s = [np.linalg.norm(one.velocity_m_s, axis=1) for one in snapshots]
            shears_Pa = [np.linalg.norm(one.wall_shear_stress_Pa, axis=1) for one in snapshots]
            speed_m_s, shear_Pa = np.mean(speeds_m_s, axis=0), np.mean(shears_Pa, axis=0)
        steps = len(state.history) * (1 if phase_s else CHECK_ITERATIONS)
        phases = []
        for k, one in enumerate(snapshots if phase_s else ()):
            back_mL_s, out_mL_s = vessel.of_inlets_and_outlets(one.outflow_mL_s)
            moment = (one.velocity_m_s,), (one.pressure_Pa,), one.wall_shear_stress_Pa
            phases.append(Phase((k + 1) * (phase_s or 0.0), -back_mL_s, out_mL_s, *moment, one.neck_inflow_mL_s))
        return FlowField(
            levels=(Level.of(domain, mean("velocity_m_s"), pressure_Pa, speed_m_s),),
            wall=vessel.lumen,
            wall_shear_stress_Pa=mean("wall_shear_stress_Pa"),
            wall_pressure_Pa=mean("wall_pressure_Pa"),
            inlets_mL_s=-backwards_mL_s,
            outlets_mL_s=outlets_mL_s,
            inlet_pressure_Pa=inlet_Pa,
            outlet_pressure_Pa=outlet_Pa,
            blood=state.case.blood,
            is_converged=outcome.is_converged,
            unsettled_fraction=outcome.residual[-1],
            advice=_advice(state, outcome),
            residual=np.array(outcome.residual),
            steps=steps,
            seconds=outcome.seconds,
            updates_per_s=state.bridge.n_cells * steps / max(state.loop_seconds, 1e-9),
            phases=tuple(phases),
            mean_shear_Pa=shear_Pa,
            common_pressure_Pa=common_Pa,
            neck_inflow_mL_s=float(mean("neck_inflow_mL_s")),
        )


def _correct_inflow(state: State) -> bool:
    """Correct the inlets' mean speeds for their smaller meshed areas; return whether a correction was made."""
    case, now = state.case, state.snapshots[-1]
    share = float(case.inflow_factor(np.array([float(now.time)]))[0])
    if len(state.history) > CHECKS_HELD or abs(share) < 0.2:
        return False
    factors = -share * case.inlets_mL_s / case.vessel.of_inlets_and_outlets(now.outflow_mL_s)[0]
    scaled = [
        folders.scale_inflow(state.folder, inlet.role, factor)
        for inlet, factor in zip(case.vessel.inlets, factors, strict=True)
        if abs(factor - 1) > 1e-5
    ]
    return any(scaled)


def _follow(state: State) -> float:
    """Adjust the flow through resistances to the pressures at the outlets; return the largest change over the inflow.

    This is done at every check of a steady flow, and after every cycle of a pulse.
    """
    case, count = state.case, len(state.snapshots) if state.phase_s else 1
    if len(case.resistances) < 2 or (state.phase_s and (count < PHASES or state.phases_done % PHASES)):
        return 0.0
    last = list(state.snapshots)[-count:]
    time_s = np.array([float(one.time) for one in last])
    sections_Pa = [domains.section_pressure_Pa(case.vessel, state.domain, one.pressure_Pa) for one in last]
    at_outlets_Pa = np.nan_to_num(sections_Pa)[:, len(case.vessel.inlets) :]
    period_s = np.inf if case.waveform is None else case.waveform.period_s
    inflow_mL_s = case.inflow_mL_s * case.inflow_factor(time_s)
    flow_mL_s = outflows(case.resistances, inflow_mL_s, at_outlets_Pa, period_s)[0]
    through_mL_s = np.array([one.outflow_mL_s for one in last])[:, len(case.vessel.inlets) :]
    wrong_mL_s = flow_mL_s - through_mL_s
    flow_mL_s = through_mL_s + (case.followed(wrong_mL_s) if state.phase_s else wrong_mL_s)
    for k, outlet in enumerate(case.vessel.outlets[1:], start=1):
        table_s = cycle_s(case)
        finer = np.interp(table_s, time_s % table_s[-1], flow_mL_s[:, k], period=table_s[-1])
        write_text(state.folder / "constant" / table_name(outlet.role), flow_table(table_s, finer))
    return float(np.abs(wrong_mL_s).max()) / case.inflow_mL_s


def _advice(state: State, outcome: Outcome) -> str:
    """Return a sentence on convergence and what to do, followed by the size of the mesh."""
    mesh = f"OpenFOAM on {state.bridge.n_cells} cells ({state.folder})."
    if state.phase_s:
        changes = np.array([change for change in outcome.residual if np.isfinite(change)])
        return f"{cycles_advice(changes, state.phases_done // PHASES, is_converged=outcome.is_converged)} {mesh}"
    if outcome.is_converged:
        return f"The flow has converged. {mesh}"
    return (
        f"The steady solver did not converge within {ITERATIONS} iterations, perhaps because the flow is unsteady: "
        f"compute it in time with an inflow waveform. {mesh}"
    )
