"""Boundary conditions of the embedded engine at the openings of the vessel."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from vstent.flow.case import PHASES, FlowCase
from vstent.flow.domain import Domain
from vstent.flow.ends import FlowRate, Inflow, Pressure, Resistance
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.scales import Scales
from vstent.kernels import directions
from vstent.kernels.arrays import Floats, Ints

SOUND_MEMORY = 0.002
"""Rate per pair of time steps at which an inlet updates its mean pressure in steady flow. In pulsatile flow the rate is
1: the mean follows every pressure change, so that the imposed waveform is kept exactly."""

FINER = 8
"""Number of moments per phase of a cycle at which a pulsating profile is evaluated; between them it is linear."""


@dataclass(frozen=True, eq=False)
class Ends:
    """Boundary conditions at the openings that a grid has."""

    case: FlowCase
    """The flow case."""
    domain: Domain
    """The grid."""
    scales: Scales
    """Lattice units."""

    def imposed(self, patches: Ints, links: Sequence[Ints]) -> tuple[Floats, Floats, Floats, Floats]:
        """Return rows (k, `d3q19.OPENING`) of the ends, and `Links.wanted`, `course` and `shape`."""
        ends = [self._opening(int(patch) - 1, of_end) for patch, of_end in zip(patches, links, strict=True)]
        usual = np.array([row for row, _ in ends]).reshape(-1, d3q19.OPENING)
        shape = np.concatenate([np.zeros((0, 2)), *(shape for _, shape in ends)])
        wanted, time_s = usual[:, d3q19.WANTED].copy(), self._moments_s()
        course, shapes = np.zeros((len(time_s), len(patches))), np.repeat(shape[None], len(time_s), axis=0)
        first = np.cumsum([0, *map(len, links)])
        for row, patch in enumerate(patches):
            if self._is_pulsating(int(patch)):  # the course of the flow rate is in the profile
                course[:, row], wanted[row] = wanted[row], 0.0
                shapes[:, first[row] : first[row + 1]] = self._pulsating(int(patch) - 1, links[row], time_s)
        return usual, wanted, course, shapes

    def _moments_s(self) -> Floats:
        """Return the times (m,) in a cycle of the rows of `Links.course`, equally spaced from the first check."""
        finer = 0
        if self.case.waveform is not None:
            is_pulsating = any(map(self._is_pulsating, range(1, 1 + len(self.case.vessel.inlets))))
            finer = FINER if is_pulsating else bool(self.case.resistances)
        if not finer:
            return np.zeros(1)
        count = PHASES * finer
        return np.asarray(self.case.pulse.period_s * (finer + np.arange(count)) / count, dtype=np.float64)

    def _is_pulsating(self, patch: int) -> bool:
        """Return whether the velocity profile at an end changes its shape over a cycle."""
        end = self.case.ends[patch - 1]
        return isinstance(end, Inflow) and end.is_pulsating and self.case.waveform is not None

    def _opening(self, k: int, links: Ints) -> tuple[Floats, Floats]:
        """Return the row and profile coefficients (l, 2) of opening `k`.

        Of several resistances the widest outlet has zero pressure and takes the rest.
        """
        opening, end = self.case.vessel.openings[k], self.case.ends[k]
        area = opening.area_mm2 / self.domain.cell_size_mm**2
        shape = np.zeros((len(links), 2))
        match end:
            case Inflow():
                kind, mean_mL_s, shape = d3q19.INFLOW, end.mean_mL_s, self._profile(k, links, area, end)
            case FlowRate():
                kind, mean_mL_s = d3q19.OUTFLOW, end.mean_mL_s
            case Resistance() if k > len(self.case.vessel.inlets):
                kind, mean_mL_s = d3q19.OUTFLOW, end.mean_mL_s
            case Pressure() | Resistance():
                kind, mean_mL_s = d3q19.PRESSURE, 0.0
                shape[:, 0] = end.pressure_Pa / self.scales.pressure_Pa if isinstance(end, Pressure) else 0.0
            case _:
                assert_never(end)
        speed = mean_mL_s / opening.area_mm2 / self.scales.speed_m_s
        return self._row(kind, speed, opening.normal, area), shape

    def _row(self, kind: float, speed: float, normal: Floats, area: float) -> Floats:
        """Return the row (`d3q19.OPENING`,) of an end: its condition, mean speed, outward normal and area in cells."""
        if kind == d3q19.INFLOW:
            rate = SOUND_MEMORY if self.case.waveform is None else 1.0
        else:  # critical damping for a column of blood about as long as the grid
            rate = 0.25 / float(np.ptp(self.domain.cells, axis=0).max())
        row = np.zeros(d3q19.OPENING)
        row[[d3q19.KIND, d3q19.WANTED, d3q19.RATE, d3q19.AREA]] = kind, speed, rate, area
        row[d3q19.NORMAL : d3q19.NORMAL + 3] = normal
        return row

    def _profile(self, k: int, links: Ints, area: float, end: Inflow) -> Floats:
        """Return the profile coefficients (l, 2) of the links of inlet `k` for a profile of constant shape."""
        section = self.domain.sections[k], self.case.vessel.openings[k].normal, self._places_mm(links)
        return self._sent(links, section[1], area, *end.relative_velocity(*section).reshape(3, -1, 3))

    def _pulsating(self, k: int, links: Ints, time_s: Floats) -> Floats:
        """Return the profile coefficients (m, l, 2) of the links of inlet `k` at times (m,), relative to mean flow."""
        case, opening, direction = self.case, self.case.vessel.openings[k], self.domain.link_direction[links]
        section = self.domain.sections[k], opening.normal, self._places_mm(links)
        end = case.ends[k]
        assert isinstance(end, Inflow)
        steady, velocity = end.pulsating_velocity(case.pulse, case.blood, time_s, *section)
        area = opening.area_mm2 / self.domain.cell_size_mm**2
        rim = _rim(direction, opening.normal, steady.reshape(3, -1, 3)[1])
        result = np.zeros((len(time_s), len(links), 2))
        for row, (flow, now) in enumerate(zip(area * case.pulse.factor(time_s), velocity, strict=True)):
            inner, at, outer = now.reshape(3, -1, 3)
            result[row] = self._sent(links, opening.normal, flow, inner, at, outer, rim)
        return result

    def _places_mm(self, links: Ints) -> Floats:
        """Return the near ends, middles and far ends (3 l, 3) of links."""
        return np.concatenate([self._along(links, part)[2] for part in (0.0, 0.5, 1.0)])

    def _along(self, links: Ints, part: float = 0.0) -> tuple[Ints, Ints, Floats]:
        """Return direction (l,) and velocity (l, 3) of links, and the point (l, 3), mm, at fraction `part` of each."""
        q = self.domain.link_direction[links]
        c = directions.VELOCITIES[q]
        cell = self.domain.cells[self.domain.link_cell[links]]
        return q, c, self.domain.origin_mm + (cell + part * c) * self.domain.cell_size_mm

    def _sent(
        self,
        links: Ints,
        normal: Floats,
        area: float,
        inner: Floats,
        at: Floats,
        outer: Floats,
        rim: Floats | None = None,
    ) -> Floats:
        """Return the source coefficients (l, 2) of an inflow: linear and quadratic in its mean speed.

        The velocities (l, 3) are those at the near end, the middle and the far end of every link.

        Links at the rim of the opening end at the wall instead of the opening, and their share of the flow would be
        missing. It is added to the links near the `rim`. Scaling the whole profile instead would make the velocity on
        the axis too high, and this error persists for tens of diameters downstream.

        A velocity profile gains momentum from the relaxation rate of the odd populations, which would push blood
        towards the axis: the inflow sends it back through the links with opposite sign.
        """
        direction = self.domain.link_direction[links]
        c, weight = directions.VELOCITIES[direction], d3q19.WEIGHTS[direction]
        sent = -6 * weight * (c * at).sum(axis=1)
        of_inner, of_outer = (4.5 * (c * u).sum(axis=1) ** 2 - 1.5 * (u**2).sum(axis=1) for u in (inner, outer))
        pushed = (2 / self.scales.odd_rate - 1) * weight * (of_outer - of_inner)
        rim = _rim(direction, normal, at) if rim is None else rim
        return np.stack([sent + (area - sent.sum()) * rim, pushed - pushed.sum() * rim], axis=1)


def _rim(direction: Ints, normal: Floats, at: Floats) -> Floats:
    """Return the share (l,) of every link in what is missing at the rim, from the velocity (l, 3) there.

    A uniform flow is slowest nowhere: all links that bring blood have a share.
    """
    c, weight = directions.VELOCITIES[direction], d3q19.WEIGHTS[direction]
    speed = -(at @ normal)
    of_link = weight * np.maximum(c @ normal, 0.0)
    rim = np.where(speed > 0, of_link * (1 - speed / speed.max()), 0.0)
    if not rim.any():
        rim = np.where(speed > 0, of_link, 0.0)
    rim /= rim.sum()
    return rim
