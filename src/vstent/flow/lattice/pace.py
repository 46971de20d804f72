"""Time step of a lattice-Boltzmann run: the fastest blood moves at most `lattice_speed` cells per step.

In a pulse the time step is chosen for each phase of the cycle. With the published pulse of the internal carotid artery
this halves the number of steps compared with the time step of the peak throughout; the saving is smaller where the
lattice's speed of sound limits the step. `collision.rescaled` converts the populations when the time step changes.
"""

from typing import Final

import numpy as np

from vstent.flow.case import PHASES, FlowCase, FlowField
from vstent.flow.domain import extended_volume_mm3
from vstent.flow.lattice.kernels import d3q19
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M_PER_MM

FASTER: Final = 1.1
"""Assumed ratio of the peak speed to the peak speed on the coarser grid from which it is estimated."""
FEW: Final = 1e-3
"""Fraction of the blood that may exceed the speed that sets the time step, for example in one narrow branch. Its higher
Mach number does not affect the flow elsewhere."""
HASTE: Final = 2.0
"""Maximum ratio of the overall peak speed to the speed that sets the time step. In C0038 half the time step changes the
mean speed in the sac by 0.3 % at peak systole and by 2 % one phase later, when its vortices differ. It changes the
speed below which all but a thousandth of the blood stays by at most 0.3 %."""
LONGEST: Final = 3.0
"""Maximum ratio of the longest to the shortest time step of a pulse."""
STORED: Final = 0.005
"""Maximum fraction of the flow that may be stored by compressibility during a phase with longer time steps."""
MOMENTS: Final = 25
"""Number of moments per phase at which the waveform is evaluated."""


def peak_speed_m_s(case: FlowCase, start: FlowField | None) -> float:
    """Estimate the speed that sets the time step: all but a fraction `FEW` of the blood stays below it.

    The overall peak speed is at most `HASTE` times as high.
    """
    if start is not None:
        return FASTER * float(max(np.quantile(start.speed_m_s, 1 - FEW), start.speed_m_s.max() / HASTE))
    at_outlets_m_s = 3.0 * case.inflow_mL_s / sum(outlet.area_mm2 for outlet in case.vessel.outlets)
    return float(max(3.0 * case.inlet_speeds_m_s.max(), at_outlets_m_s))


def longest_step_s(case: FlowCase, cell_size_mm: float, peak_m_s: float) -> float:
    """Return the time step, s, in which blood at `peak_m_s` moves `lattice_speed` cells."""
    return case.numerics.lattice_speed * cell_size_mm * M_PER_MM / peak_m_s


def pace(case: FlowCase, cell_size_mm: float, start: FlowField | None) -> Ints:
    """Return the number of time steps (PHASES,) in every phase of a pulse; all are even.

    The fastest blood of each phase moves at most `lattice_speed` cells per step. A longer time step also lowers the
    lattice's speed of sound, so that more flow is stored by compressibility. Where a step is longer than the shortest,
    it is limited so that this part stays below `STORED`.
    """
    waveform = case.pulse
    phase_s = waveform.period_s / PHASES
    time_s = phase_s * (np.arange(PHASES)[:, None] + np.linspace(0, 1, MOMENTS))
    factor = np.abs(waveform.factor(time_s))
    peak_m_s = _peaks_m_s(case, factor, start)
    step_s = np.array([longest_step_s(case, cell_size_mm, peak) for peak in peak_m_s])
    shortest_s = step_s.min()
    way_mm = extended_volume_mm3(case.vessel) / sum(inlet.area_mm2 for inlet in case.vessel.inlets)
    # The pressure rho L q' / A accelerates the blood and compresses it by rho p / c^2. If sound takes a time T along
    # the vessel, the stored flow is T^2 q'' / 2.
    most_per_s2 = np.maximum(np.abs(waveform.curvature_per_s2(time_s)).max(axis=1), 1e-9)
    sound_s = np.sqrt(2 * STORED * factor.mean(axis=1) / most_per_s2)
    by_sound_s = sound_s * d3q19.SOUND * cell_size_mm / way_mm
    step_s = np.clip(np.minimum(step_s, by_sound_s), shortest_s, LONGEST * shortest_s)
    return (2 * np.ceil(0.5 * phase_s / step_s)).astype(np.int32)


def _peaks_m_s(case: FlowCase, factor: Floats, start: FlowField | None) -> Floats:
    """Return the peak speed (PHASES,) in every phase from the factor of the flow rate at moments of it (PHASES, m).

    With a whole cycle in `start`, the speed at both ends of each phase is used. Otherwise the peak speed is scaled with
    the flow rate, or with that of the phase before if that is higher, because inertia keeps blood moving while the flow
    rate falls.
    """
    within, at_end = factor.max(axis=1), factor[:, -1]
    if start is None or len(start.phases) < PHASES:
        return peak_speed_m_s(case, start) * np.maximum(within, np.roll(within, 1))
    ends_m_s = np.array([peak_speed_m_s(case, start.at_phase(phase)) for phase in start.phases])
    at_ends = np.maximum(at_end, np.roll(at_end, 1))
    return np.maximum(ends_m_s, np.roll(ends_m_s, 1)) * within / np.maximum(at_ends, 0.5 * within)
