"""Flow engine that runs OpenFOAM: it meshes the case, computes from check to check, and reads the fields.

OpenFOAM's mesh is unstructured. The result is interpolated to the same regular grid as that of the embedded engine, so
that all indices, streamlines and pictures work with either.
"""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np

from vstent.errors import FlowError
from vstent.flow import domain as domains
from vstent.flow.case import PHASES, FlowCase, FlowField, Level, Phase
from vstent.flow.cycles import cycle_change, cycles_advice, pulse_of
from vstent.flow.engines import AbstractEngine, Outcome, Saved
from vstent.flow.openfoam import folder as folders
from vstent.flow.openfoam import program, results
from vstent.flow.openfoam.bridge import Bridge, Snapshot, bridge, read
from vstent.flow.openfoam.case import foam_case, strut_solids
from vstent.flow.openfoam.cost import memory_bytes, tell_cost
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.stopping import quantities_left
from vstent.kernels.arrays import Floats, Ints

CHECK_ITERATIONS: Final = 50
"""Number of iterations of a steady flow between checks."""
CHECKS_AVERAGED: Final = 8
"""Number of last checks that are averaged if a steady flow does not converge."""
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
    def is_pulse(self) -> bool:
        """Whether the inflow follows a waveform."""
        return self.case.waveform is not None


@dataclass(frozen=True, eq=False)
class OpenFoam(AbstractEngine[State]):
    """Engine that uses OpenFOAM's laminar solvers (simpleFoam, or pimpleFoam for a waveform) and snappyHexMesh.

    The grid spacing is that of the mesh in the vessel, before layers and refinement. A run of the same case in the same
    folder resumes from the last time written. A stent is meshed as its struts over necks and ostia.
    """

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
        setup = FoamSetup(
            self.cell_size_mm, found.flavour, self.layers, processes=case.numerics.processes, struts=solids
        )
        domain = domains.build(case.vessel, self.grid_size_mm or self.cell_size_mm)
        sac = domains.cells_of_sac(case, domain)
        foam = foam_case(case, setup)
        folders.prepare(self.folder, foam)
        folders.mesh(found, self.folder, setup)
        if start is not None and not results.times(self.folder):
            folders.begin_from(self.folder, start)
        across = bridge(case, domain, self.folder)
        kept: deque[Snapshot] = deque(maxlen=PHASES if case.waveform else CHECKS_AVERAGED)
        state = State(case, setup, found, foam.application, self.folder, domain, across, sac, kept)
        for time in _whole_cycles(case, results.times(self.folder)):
            _note(state, time)
        return state

    def step(self, state: State) -> State:
        """Run the solver to the next check and read its output."""
        began = perf_counter()
        reached = results.times(state.folder)
        end = _next_end(state, float(reached[-1]) if reached else 0.0)
        folders.stop_at(state.folder, end, every=None if state.is_pulse else CHECK_ITERATIONS)
        said = program.run(state.found, state.folder, [state.application], processes=state.setup.processes)
        state.loop_seconds += perf_counter() - began
        _note(state, results.times(state.folder)[-1])
        state.is_settled = not _correct_inflow(state) and "solution converged" in said
        return state

    def terminate(self, state: State) -> float:
        """Return the largest expected remaining change of a monitored quantity, or the change between cycles."""
        history = np.array(state.history)
        if not np.isfinite(history[-1]).all():
            return float("nan")
        if state.is_pulse:
            return cycle_change(history)
        if state.is_settled:
            return 0.0
        return quantities_left(history)

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
        if state.is_pulse:
            left = PHASES * state.case.numerics.max_cycles - _phases_done(state)
            return left if left > 0 else PHASES
        return state.setup.iterations // CHECK_ITERATIONS

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the last check's flow, or a mean: of the last checks if not converged, of the cycle if pulsatile."""
        is_last = outcome.is_converged and not state.is_pulse
        return _field_of(state, [state.snapshots[-1]] if is_last else list(state.snapshots), outcome)


def _next_end(state: State, reached: float) -> float:
    """Return the iteration or time of the next check."""
    if not state.is_pulse:
        return reached + CHECK_ITERATIONS
    phase_s = pulse_of(state.case).period_s / PHASES
    return (round(reached / phase_s) + 1) * phase_s


def _whole_cycles(case: FlowCase, written: list[str]) -> list[str]:
    """Return the times from the start of the first complete cycle on; none for a steady flow."""
    if case.waveform is None:
        return []
    phase_s = case.waveform.period_s / PHASES
    is_first = [round(float(time) / phase_s) % PHASES == 1 for time in written]
    return written[is_first.index(True) :] if any(is_first) else []


def _phases_done(state: State) -> int:
    """Return the number of phases since the start of the waveform, including earlier runs that this one resumed."""
    if not state.snapshots:
        return 0
    return round(float(state.snapshots[-1].time) * PHASES / pulse_of(state.case).period_s)


def _note(state: State, time: str) -> None:
    """Read the output at one time and record the monitored quantities."""
    state.snapshots.append(read(state.case, state.bridge, state.folder, time))
    state.history.append(_monitored(state, state.snapshots[-1]))


def _monitored(state: State, now: Snapshot) -> Floats:
    """Return the quantities of the embedded engine: mean speed in sac and vessel, inlet pressure, neck inflow."""
    speed = np.linalg.norm(now.velocity_m_s, axis=1)
    inlet = state.domain.link_cell[state.domain.link_patch == 1]
    values = [speed[state.sac_cells].mean(), now.pressure_Pa[inlet].mean(), speed.mean()]
    return np.array([*values, now.neck_inflow_mL_s] if state.case.ostium is not None else values, dtype=float)


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


def _field_of(state: State, kept: list[Snapshot], outcome: Outcome) -> FlowField:
    """Return the mean of the snapshots as a flow field."""

    def mean(name: str) -> Floats:
        return np.asarray(np.mean([getattr(one, name) for one in kept], axis=0))

    vessel, domain = state.case.vessel, state.domain
    pressure_Pa, outflow_mL_s = mean("pressure_Pa"), mean("outflow_mL_s")
    inlet_Pa, outlet_Pa = vessel.of_inlets_and_outlets(domains.section_pressure_Pa(vessel, domain, pressure_Pa))
    backwards_mL_s, outlets_mL_s = vessel.of_inlets_and_outlets(outflow_mL_s)
    speed_m_s, shear_Pa = (None, None) if state.is_pulse or len(kept) == 1 else mean_magnitudes(kept)
    steps = len(state.history) * (1 if state.is_pulse else CHECK_ITERATIONS)
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
        phases=_phases(state.case, kept) if state.is_pulse else (),
        mean_shear_Pa=shear_Pa,
        neck_inflow_mL_s=float(mean("neck_inflow_mL_s")),
    )


def mean_magnitudes(kept: list[Snapshot]) -> tuple[Floats, Floats]:
    """Return mean speed (n,) and mean wall shear stress (v,) of the checks of a steady solver that did not converge."""
    speed_m_s = np.mean([np.linalg.norm(one.velocity_m_s, axis=1) for one in kept], axis=0)
    shear_Pa = np.mean([np.linalg.norm(one.wall_shear_stress_Pa, axis=1) for one in kept], axis=0)
    return np.asarray(speed_m_s), np.asarray(shear_Pa)


def _phases(case: FlowCase, cycle: list[Snapshot]) -> tuple[Phase, ...]:
    """Return the last cycle as phases, with times of the waveform."""
    phase_s = pulse_of(case).period_s / PHASES

    def phase(k: int, one: Snapshot) -> Phase:
        backwards_mL_s, outlets_mL_s = case.vessel.of_inlets_and_outlets(one.outflow_mL_s)
        moment = (one.velocity_m_s,), (one.pressure_Pa,), one.wall_shear_stress_Pa
        return Phase((k + 1) * phase_s, -backwards_mL_s, outlets_mL_s, *moment, one.neck_inflow_mL_s)

    return tuple(phase(k, one) for k, one in enumerate(cycle))


def _advice(state: State, outcome: Outcome) -> str:
    """Return a sentence on convergence and what to do, followed by the size of the mesh."""
    mesh = f"OpenFOAM on {state.bridge.n_cells} cells ({state.folder})."
    if state.is_pulse:
        changes = np.array([change for change in outcome.residual if np.isfinite(change)])
        cycles = _phases_done(state) // PHASES
        return f"{cycles_advice(changes, cycles, is_converged=outcome.is_converged)} {mesh}"
    if outcome.is_converged:
        return f"The flow has converged. {mesh}"
    return (
        f"The steady solver did not converge within {state.setup.iterations} iterations, perhaps because the flow is "
        f"unsteady: compute it in time with an inflow waveform. {mesh}"
    )
