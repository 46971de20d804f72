"""Live flow: a lattice that never stops, in which the screen of a device is exchanged while the blood flows on.

The sac and a piece of the artery are computed on a fine grid, inside the flow of the whole vessel on a coarse grid
(`close_up`). The coarse flow is computed once, without a device: a device changes the flow of the artery far less than
that of the neck.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Final

import numpy as np

from vstent.flow.case import FlowCase, FlowField, Screen
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.engines import run, stepped
from vstent.flow.lattice.close_up import WIDTH
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.screen import build_screen
from vstent.flow.lattice.state import NECK_INFLOW, State
from vstent.flow.lattice.stepping import advance, monitored, snapshot
from vstent.flow.widths import neck_diameter_mm, parent_diameter_mm
from vstent.kernels.arrays import Floats

CELLS_ACROSS_NECK: Final = 28.0
"""Number of cells across the neck: with 20 the reductions of the demo are 12 points too small, with 28 within 2."""
CELLS_ACROSS_PARENT: Final = 18.0
"""Number of cells across the parent artery."""
TOLERANCE: Final = 0.02
"""Residual below which the flow without a device counts as converged in a preview."""
READING_S: Final = 0.05
"""Interval of readings in flow time, in units of the sac's turnover time without a device."""
AVERAGED: Final = 8
"""Number of readings whose mean is shown."""


@dataclass(frozen=True)
class Reading:
    """What a live flow shows: means over the last readings."""

    neck_inflow_mL_s: float
    """Neck inflow."""
    sac_velocity_m_s: float
    """Mean speed in the sac."""
    is_settled: bool
    """Whether the last readings agree within the tolerance of a preview."""


class LiveFlow:
    """The flow in one vessel, without a device until `place` is called.

    Parameters
    ----------
    case : FlowCase
        The flow case without a device; it must have a sac and an ostium.
    told : callable, optional
        Called with the fraction that is done while the flow without a device is computed.

    Raises
    ------
    FlowError
        The flow without a device diverges.
    """

    def __init__(self, case: FlowCase, told: Callable[[float], None] | None = None) -> None:
        self.case = replace(case, settings=replace(case.settings, waveform=None, close_up=False, tolerance=TOLERANCE))
        self.cell_size_mm = preview_spacing_mm(self.case)
        self.outer = self._around(told)
        self._engine = LatticeBoltzmann(self.cell_size_mm, None, self.outer)
        self.state: State = self._engine.init(self.case, self.outer)
        self._readings: deque[Floats] = deque(maxlen=AVERAGED)
        self._converge(told)
        self.bare = self.read()

    def _around(self, told: Callable[[float], None] | None) -> FlowField:
        """Return the flow of the whole vessel on the coarse grid."""
        progress = None if told is None else (lambda now: told(0.4 * now.fraction))
        # Oscillations at the neck would need most of the steps, and the fine grid computes the neck.
        around = replace(self.case, ostium=None)
        return run(LatticeBoltzmann(WIDTH * self.cell_size_mm), around, progress=progress)

    def _converge(self, told: Callable[[float], None] | None) -> None:
        """Advance the flow without a device until it has converged or its steps are used up."""
        limit = self._engine.max_checks(self.state)
        for check in range(limit):
            left = None
            while left is None:  # between checks
                self.state, left = stepped(self._engine, self.state)
            self._readings.append(self.state.history[-1])
            if told is not None:
                told(0.4 + 0.6 * (check + 1) / limit)
            if left < TOLERANCE:
                return

    def place(self, screen: Screen | None) -> None:
        """Exchange the device; None removes it. The flow goes on from where it is."""
        case = replace(self.case, screen=screen)
        state = self.state
        entries = build_screen(case, state.domain, state.addressing, state.scales)
        state.case, state.screen, state.built = case, entries, (state.built[0], entries)
        self._readings.clear()

    def advance(self, seconds: float) -> int:
        """Make time steps for about a wall-clock time, take one reading at least, and return the number of steps."""
        began, done = perf_counter(), 0
        while not done or perf_counter() - began < seconds:
            advance(self.state, self.steps_per_reading)
            self.state.since_check = 0
            self._readings.append(monitored(self.state, snapshot(self.state)))
            done += self.steps_per_reading
        return done

    @property
    def steps_per_reading(self) -> int:
        """Even number of time steps between two readings."""
        sac = self.case.sac
        assert sac is not None
        turnover_s = abs(sac.volume_mm3) * 1e-3 / max(self.bare.neck_inflow_mL_s, 1e-9)
        return 2 * max(1, round(0.5 * READING_S * turnover_s / self.state.scales.step_s))

    def read(self) -> Reading:
        """Return the means of the last readings."""
        found = np.array(self._readings)
        mean = found.mean(axis=0)
        spread = np.ptp(found[:, [0, NECK_INFLOW]], axis=0) / np.maximum(np.abs(mean[[0, NECK_INFLOW]]), 1e-12)
        settled = len(found) == AVERAGED and bool((spread < TOLERANCE).all())
        return Reading(float(mean[NECK_INFLOW]), float(mean[0]), settled)

    def field(self) -> FlowField:
        """Return the present flow in the refined region, for streamlines: only its velocity is meaningful."""
        now, domain, wall = snapshot(self.state), self.state.domain, self.case.vessel.lumen
        n, outer = len(wall.vertices_mm), self.outer
        return replace(
            outer,
            cells=domain.cells,
            origin_mm=domain.origin_mm,
            cell_size_mm=domain.cell_size_mm,
            velocity_m_s=now.velocity_m_s.astype(np.float64),
            pressure_Pa=now.pressure_Pa.astype(np.float64),
            wall_shear_stress_Pa=np.zeros((n, 3)),
            swing=None,
        )


def preview_spacing_mm(case: FlowCase) -> float:
    """Return the grid spacing of a preview: as coarse as neck and artery allow, not finer than by default."""
    assert case.ostium is not None
    coarsest_mm = min(neck_diameter_mm(case.ostium) / CELLS_ACROSS_NECK, parent_diameter_mm(case) / CELLS_ACROSS_PARENT)
    return max(coarsest_mm, default_cell_size_mm(replace(case, settings=replace(case.settings, cell_size_mm=None))))
