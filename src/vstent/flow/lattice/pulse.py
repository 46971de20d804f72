"""The embedded engine for pulsatile inflow: the inflow follows a waveform until two cycles agree."""

from dataclasses import dataclass, replace

import numpy as np

from vstent.flow.case import PHASES, FlowCase, FlowField, Phase
from vstent.flow.engines import Outcome
from vstent.flow.lattice.engine import AbstractLattice
from vstent.flow.lattice.pace import pace
from vstent.flow.lattice.reading import field_of, read
from vstent.flow.lattice.state import State
from vstent.flow.lattice.stepping import build, is_at_check
from vstent.flow.stopping import cycle_change, cycles_advice


@dataclass(frozen=True)
class PulsatileLatticeBoltzmann(AbstractLattice):
    """The sparse D3Q19 engine with a flow waveform at the inlets."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Set up a run whose time steps divide each phase, with a peak speed below `lattice_speed` cells per step."""
        close_up, phase_s = self.close_up(case), case.pulse.period_s / PHASES
        steps = pace(case, self.cell_size_mm, self.pacing(start), close_up)
        return build(case, self.cell_size_mm, phase_s, steps, close_up=close_up, start=start, kept=PHASES)

    def terminate(self, state: State) -> float | None:
        """Return the relative difference of the monitored quantities between the last two cycles.

        None between checks; inf within a cycle; nan when the run has diverged.
        """
        if not is_at_check(state):
            return None
        return float("nan") if state.snapshots[-1].is_lost else cycle_change(np.array(state.history))

    def max_checks(self, state: State) -> int:
        """Return the number of phases in the maximum number of cycles."""
        return PHASES * state.case.numerics.max_cycles

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the mean flow of the last cycle, with its phases."""
        phases = []
        for k, snapshot in enumerate(state.snapshots):
            flow = read(state, [snapshot])
            time_s = (k + 1) * state.check_s
            moment = (flow.velocity_m_s,), (flow.pressure_Pa,), flow.wall_shear_stress_Pa
            phases.append(Phase(time_s, flow.inlets_mL_s, flow.outlets_mL_s, *moment))
        changes = np.array([change for change in outcome.residual if np.isfinite(change)])
        advice = cycles_advice(changes, len(state.history) // PHASES, is_converged=outcome.is_converged)
        # For shear-thinning blood the wall shear stress of the mean flow differs from the mean wall shear stress.
        mean_Pa = np.asarray(np.mean([phase.wall_shear_stress_Pa for phase in phases], axis=0, dtype=np.float64))
        flow = replace(read(state, list(state.snapshots)), wall_shear_stress_Pa=mean_Pa)
        return field_of(state, flow, outcome, outcome.residual[-1], advice, tuple(phases))
