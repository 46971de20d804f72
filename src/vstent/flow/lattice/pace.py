"""How long the time steps of a lattice-Boltzmann run may be: the fastest blood moves so many cells in each.

In a pulse they are as long as they may be in every phase of the cycle: of the published pulse of the internal carotid
artery half as many as the peak's would be all over, or more where the lattice's sound is slow. Populations are carried
over by `collision.rescaled`.
"""

from typing import Final

import numpy as np

from vstent.flow.case import PHASES, FlowCase, FlowField, Waveform
from vstent.flow.cycles import pulse_of
from vstent.flow.domain import extended_volume_mm3
from vstent.flow.lattice.close_up import CloseUp
from vstent.flow.lattice.kernels import d3q19
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M_PER_MM

FASTER: Final = 1.1
"""The fastest blood over the fastest on the wider cells that it is foretold from."""
FEW: Final = 1e-3
"""Part of the blood that may be faster than what time steps go by, as in one narrow branch: its Mach number harms no
other."""
HASTE: Final = 2.0
"""How many times as fast that may be at most. In C0038 steps half as long change the sac's mean speed by 0.3 per
cent at the peak of systole and by 2 a phase later, when its vortices differ, and the speed that all but a thousandth of
the blood keep below by 0.3 at most."""
LONGEST: Final = 3.0
"""A pulse's longest time step over its shortest."""
STORED: Final = 0.005
"""Part of the flow that a phase with longer steps may store for a moment."""
MOMENTS: Final = 25
"""Moments of each phase at which the waveform is looked at."""


def peak_speed_m_s(case: FlowCase, start: FlowField | None, close_up: CloseUp | None = None) -> float:
    """Estimate the speed that all but a `FEW` of the blood keep below, and these below `HASTE` times that.

    At mean flow, or at the moment that `start` is of; in a close-up, where it begins.
    """
    if start is not None:
        within = slice(None) if close_up is None else close_up.part < 0
        speed_m_s = start.speed_m_s[within]
        return FASTER * float(max(np.quantile(speed_m_s, 1 - FEW), speed_m_s.max() / HASTE))
    at_outlets_m_s = 3.0 * case.inflow_mL_s / sum(outlet.area_mm2 for outlet in case.vessel.outlets)
    return float(max(3.0 * case.inlet_speeds_m_s.max(), at_outlets_m_s))


def longest_step_s(case: FlowCase, cell_size_mm: float, peak_m_s: float) -> float:
    """Time in which the fastest blood moves as far as it may in a time step."""
    return case.settings.lattice_speed * cell_size_mm * M_PER_MM / peak_m_s


def pace(case: FlowCase, cell_size_mm: float, start: FlowField | None, close_up: CloseUp | None = None) -> Ints:
    """Time steps (PHASES,) of every phase of a pulse, even: its fastest blood moves `lattice_speed` cells at most.

    Sound is the slower the longer the steps, and blood is stored while it is on its way: steps longer than the
    shortest have to keep that below `STORED`.

    Raises
    ------
    FlowError
        When the case has no pulse.
    """
    pulse = _Pulse(pulse_of(case))
    peak_m_s = pulse.peaks_m_s(case, start, close_up)
    step_s = np.array([longest_step_s(case, cell_size_mm, peak) for peak in peak_m_s])
    shortest_s = step_s.min()
    way_mm = extended_volume_mm3(case.vessel) / sum(inlet.area_mm2 for inlet in case.vessel.inlets)
    by_sound_s = pulse.sound_s() * d3q19.SOUND * cell_size_mm / way_mm
    step_s = np.clip(np.minimum(step_s, by_sound_s), shortest_s, LONGEST * shortest_s)
    return (2 * np.ceil(0.5 * pulse.phase_s / step_s)).astype(np.int32)


class _Pulse:
    """A waveform at moments of every phase."""

    def __init__(self, waveform: Waveform) -> None:
        self.phase_s = waveform.period_s / PHASES
        time_s = self.phase_s * (np.arange(PHASES)[:, None] + np.linspace(0, 1, MOMENTS))
        self._factor = np.abs(waveform.factor(time_s))
        self._curvature_per_s2 = np.abs(waveform.curvature_per_s2(time_s))

    def peaks_m_s(self, case: FlowCase, start: FlowField | None, close_up: CloseUp | None) -> Floats:
        """The fastest blood (PHASES,) in every phase.

        A whole cycle tells that itself at every phase's two ends. Otherwise blood is as much faster than in the mean as
        the flow is, or was in the phase before: it goes on while the flow falls.
        """
        within, at_end = self._factor.max(axis=1), self._factor[:, -1]
        if start is None or len(start.phases) < PHASES:
            return peak_speed_m_s(case, start, close_up) * np.maximum(within, np.roll(within, 1))
        ends_m_s = np.array([peak_speed_m_s(case, start.at_phase(phase), close_up) for phase in start.phases])
        at_ends = np.maximum(at_end, np.roll(at_end, 1))
        return np.maximum(ends_m_s, np.roll(ends_m_s, 1)) * within / np.maximum(at_ends, 0.5 * within)

    def sound_s(self) -> Floats:
        """Longest time (PHASES,) that sound may take through the vessel in every phase.

        Blood that gives way by rho p / c^2 to the pressure rho L q' / A that speeds it up stores T^2 q'' / 2 on a way
        that takes sound a time of T.
        """
        most_per_s2 = np.maximum(self._curvature_per_s2.max(axis=1), 1e-9)
        return np.asarray(np.sqrt(2 * STORED * self._factor.mean(axis=1) / most_per_s2))
