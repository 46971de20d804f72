"""The embedded engine for pulsatile flow: the same steps, the inflow following a waveform until cycles repeat."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from vstent.flow.case import PHASES, FlowCase, FlowField, Phase
from vstent.flow.engines import Outcome
from vstent.flow.lattice.engine import AbstractLattice
from vstent.flow.lattice.pace import pace, waveform_of
from vstent.flow.lattice.reading import field_of, read
from vstent.flow.lattice.state import State, build, is_at_check
from vstent.kernels.arrays import Floats

STALLED: Final = 0.8
"""Where a cycle's change is more than this part of the last one's, further cycles will not become alike."""


@dataclass(frozen=True)
class PulsatileLatticeBoltzmann(AbstractLattice):
    """The sparse D3Q19 engine with a waveform at the inlet."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Choose time steps that divide a phase and keep its fastest blood below `lattice_speed` cells a step."""
        close_up, phase_s = self.close_up(case), waveform_of(case).period_s / PHASES
        steps = pace(case, self.cell_size_mm, start, close_up)
        return build(case, self.cell_size_mm, phase_s, steps, close_up=close_up, start=start, kept=PHASES)

    def terminate(self, state: State) -> float | None:
        """Relative change of the monitored quantities from the last cycle but one to the last; inf within a cycle."""
        if not is_at_check(state):
            return None
        return float("nan") if state.snapshots[-1].is_lost else cycle_change(np.array(state.history))

    def max_checks(self, state: State) -> int:
        """Phases of all cycles allowed."""
        return PHASES * state.case.settings.max_cycles

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the mean of the last cycle, with its phases."""
        phases = []
        for k, snapshot in enumerate(state.snapshots):
            flow = read(state, [snapshot])
            time_s = (k + 1) * state.check_s
            moment = flow.velocity_m_s, flow.pressure_Pa, flow.wall_shear_stress_Pa
            phases.append(Phase(time_s, flow.inlets_mL_s, flow.outlets_mL_s, *moment))
        changes = np.array([change for change in outcome.residual if np.isfinite(change)])
        advice = cycles_advice(changes, len(state.history) // PHASES, is_converged=outcome.is_converged)
        # The stress of the mean flow is the mean stress only where blood does not thin.
        mean_Pa = np.asarray(np.mean([phase.wall_shear_stress_Pa for phase in phases], axis=0, dtype=np.float64))
        flow = replace(read(state, list(state.snapshots)), wall_shear_stress_Pa=mean_Pa)
        return field_of(state, flow, outcome, outcome.residual[-1], advice, tuple(phases))


def cycle_change(history: Floats) -> float:
    """Largest root-mean-square change of any column of a history (phases, quantities) between its last two cycles.

    Relative to the quantity's root mean square; inf where no cycle ends or no two are complete; nan where the history
    is not finite.
    """
    if not np.isfinite(history[-1]).all():
        return float("nan")
    cycles, rest = divmod(len(history), PHASES)
    if rest or cycles < 2:
        return float("inf")
    before, last = history[-2 * PHASES : -PHASES], history[-PHASES:]
    scale = np.maximum(np.sqrt((last**2).mean(axis=0)), 1e-12)
    return float((np.sqrt(((last - before) ** 2).mean(axis=0)) / scale).max())


def cycles_advice(changes: Floats, cycles: int, *, is_converged: bool) -> str:
    """Say what the changes (c,) from cycle to cycle, as fractions, mean for the result."""
    if len(changes) == 0:
        return "A single cycle was computed: allow two, to see whether it repeats."
    said = f"Cycle {cycles} repeats the one before to within {100 * changes[-1]:.1f} %"
    if is_converged:
        return f"{said}: the flow is periodic."
    if len(changes) > 1 and changes[-1] > STALLED * changes[-2]:
        return (
            f"{said}, no better than that one did ({100 * changes[-2]:.1f} %): vortices differ from cycle to cycle, "
            "and more cycles will not make them alike."
        )
    return f"{said}, which is more than was asked for: allow more cycles, or take it as it is."
