"""What the embedded engine imposes where its grid ends: at the openings, and where a close-up is cut off."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vstent.flow import sampling
from vstent.flow.case import FlowCase
from vstent.flow.domain import Domain
from vstent.flow.lattice.close_up import CloseUp
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.scales import ODD_RATE, Scales
from vstent.flow.profile import developed_profile
from vstent.kernels import directions
from vstent.kernels.arrays import Floats, Ints

SOUND_MEMORY = 0.002
"""Rate per step pair at which an inlet forgets the pressure that it takes for the mean, in steady flow. In pulsatile
flow it takes every new pressure for the mean at once (1): the flow is the waveform's, whatever answers it."""


STILL = 0.05
"""Part of its mean flow below which an entry takes the velocity of the mean, for what little passes has no profile."""


@dataclass(frozen=True, eq=False)
class Ends:
    """The ends of a grid, by their patch."""

    case: FlowCase
    """What is computed."""
    domain: Domain
    """The grid."""
    scales: Scales
    """Its units."""
    close_up: CloseUp | None
    """What surrounds it, if anything does."""

    def imposed(self, patches: Ints, links: Sequence[Ints]) -> tuple[Floats, Floats, Floats, Floats]:
        """What is imposed at ends of these patches (k,), each with its links.

        Returns
        -------
        Rows (k, 9) of `d3q19.drive`, what is wanted (k,) at mean flow, what is besides (m, k) at the moments of the
        flow outside, and shapes (m, l, 2) at these.
        """
        usual, shape = self._at(self.close_up, patches, links)
        wanted = usual[:, 1].copy()
        phases = () if self.close_up is None else self.close_up.outer.phases
        if not phases:
            return usual, wanted, np.zeros((1, len(patches))), shape[None]
        moments = [self._at(self._outside.at_phase(phase), patches, links) for phase in phases]
        factor = self.case.settings.inflow_factor(np.array([phase.time_s for phase in phases]))
        course = np.stack([rows[:, 1] for rows, _ in moments]) - factor[:, None] * wanted
        return usual, wanted, course, np.stack([shape for _, shape in moments])

    def _at(self, now: CloseUp | None, patches: Ints, links: Sequence[Ints]) -> tuple[Floats, Floats]:
        """Rows (k, 9) of `d3q19.drive`, and what is sent back through all links, (l, 2), at a moment."""
        ends = [self._end(now, int(patch), of_end) for patch, of_end in zip(patches, links, strict=True)]
        return np.stack([row for row, _ in ends]), np.concatenate([shape for _, shape in ends])

    def _end(self, now: CloseUp | None, patch: int, links: Ints) -> tuple[Floats, Floats]:
        part = patch - 1 - len(self.case.vessel.openings)
        if now is None or part < 0:
            return self._opening(patch - 1, links)
        return self._entry(now, part, links) if self._outside.inflow_mL_s[part] > 0 else self._exit(now, part, links)

    def _opening(self, k: int, links: Ints) -> tuple[Floats, Floats]:
        opening = self.case.vessel.openings[k]
        flow_mL_s = np.concatenate([self.case.inlets_mL_s, self.case.held_mL_s])[k]
        kind = d3q19.INFLOW if opening.is_inlet else d3q19.PRESSURE if np.isnan(flow_mL_s) else d3q19.OUTFLOW
        speed = np.nan_to_num(flow_mL_s) / opening.area_mm2 / self.scales.speed_m_s
        area = opening.area_mm2 / self.domain.cell_size_mm**2
        row = np.array([kind, speed, 0.0, self._rate(kind), *opening.normal, area, 0.0])
        return row, self._developed(k, links, area) if opening.is_inlet else np.zeros((len(links), 2))

    def _developed(self, k: int, links: Ints, area: float) -> Floats:
        """What links of inlet k send back, (l, 2): developed flow."""
        normal = self.case.vessel.openings[k].normal
        places_mm = np.concatenate([self._along(links, part)[2] for part in (0.0, 0.5, 1.0)])
        speed = developed_profile(self.domain.sections[k], normal, places_mm)
        return _sent(self.domain.link_direction[links], normal, area, *(-speed.reshape(3, -1, 1) * normal))

    def _rate(self, kind: float) -> float:
        """Rate at which an end changes what it remembers."""
        if kind == d3q19.INFLOW:
            return SOUND_MEMORY if self.case.settings.waveform is None else 1.0
        # Critically damped: the blood that the pressure moves is a column about as long as the grid.
        return 0.25 / float(np.ptp(self.domain.cells, axis=0).max())

    def _entry(self, now: CloseUp, part: int, links: Ints) -> tuple[Floats, Floats]:
        """A cut through which blood enters, at the velocity of the flow outside, made up to what passes there."""
        normal, area = self._section(links)
        shown = now if now.inflow_mL_s[part] > STILL * self._outside.inflow_mL_s[part] else self._outside
        mean = shown.inflow_mL_s[part] / self.scales.flow_mL_s / area
        profile = (self._velocity(shown, links, way) / mean for way in (0.0, 0.5, 1.0))
        speed = now.inflow_mL_s[part] / self.scales.flow_mL_s / area
        row = np.array([d3q19.INFLOW, speed, 0.0, self._rate(d3q19.INFLOW), *normal, area, 0.0])
        return row, _sent(self.domain.link_direction[links], normal, area, *profile)

    def _exit(self, now: CloseUp, part: int, links: Ints) -> tuple[Floats, Floats]:
        """A cut through which blood leaves, at the pressure of the flow outside.

        As a whole that is raised until what leaves is what passes there; where most leaves, the rest does.
        """
        normal, area = self._section(links)
        _, _, at_mm = self._along(links, 0.5)
        density = sampling.values_at(now.outer, at_mm)[1] / self.scales.pressure_Pa
        inward = np.maximum(0.0, -self._velocity(now, links, 0.5) @ normal)
        density += 1.5 * inward**2  # what `d3q19.outlet_source` takes off again
        kind = d3q19.PRESSURE if self._takes_the_rest(part) else d3q19.OUTFLOW
        speed = -now.inflow_mL_s[part] / self.scales.flow_mL_s / area
        row = np.array([kind, speed if kind == d3q19.OUTFLOW else 0.0, 0.0, self._rate(kind), *normal, area, 0.0])
        return row, np.stack([density, np.zeros(len(links))], axis=1)

    @property
    def _outside(self) -> CloseUp:
        assert self.close_up is not None
        return self.close_up

    def _takes_the_rest(self, part: int) -> bool:
        """Tell whether no more leaves anywhere else, at a cut or an outlet."""
        outside = self._outside
        first = len(self.case.vessel.inlets) + 1
        within = [k for k in range(len(self.case.vessel.outlets)) if (self.domain.link_patch == first + k).any()]
        most_mL_s = float(np.concatenate([-outside.inflow_mL_s, outside.outer.outlets_mL_s[within]]).max())
        return bool(-outside.inflow_mL_s[part] >= most_mL_s * (1 - 1e-9))

    def _along(self, links: Ints, part: float = 0.0) -> tuple[Ints, Ints, Floats]:
        """Direction (l,) and lattice velocity (l, 3) of links, and the point (l, 3) on each that part of its way."""
        q = self.domain.link_direction[links]
        c = directions.VELOCITIES[q]
        cell = self.domain.cells[self.domain.link_cell[links]]
        return q, c, self.domain.origin_mm + (cell + part * c) * self.domain.cell_size_mm

    def _velocity(self, now: CloseUp, links: Ints, part: float) -> Floats:
        """Velocity (l, 3) of the flow outside, in lattice units, that part of the way along links."""
        at_mm = self._along(links, part)[2]
        return now.velocity_m_s(at_mm, self.domain.surface) / self.scales.speed_m_s

    def _section(self, links: Ints) -> tuple[Floats, float]:
        """Outward normal (3,) of a cut and its area in cells: the sum of the cells' faces in it."""
        q, c, _ = self._along(links)
        faces = c[q <= d3q19.AXIAL].sum(axis=0)
        area = float(np.linalg.norm(faces))
        return faces / area, area


def _sent(direction: Ints, normal: Floats, area: float, inner: Floats, at: Floats, outer: Floats) -> Floats:
    """What links of an entry send back, (l, 2): for its mean speed, and besides for that squared.

    Links at the rim meet the wall instead of the entry: what they would send is made up for near the rim, for a
    profile scaled up as a whole would be too fast on the axis, and keep so for tens of diameters.

    Parameters
    ----------
    direction : (l,) of each link.
    normal : (3,) outwards.
    area : of the entry, in faces of cells.
    inner, at, outer : (l, 3) velocity where each link begins, half-way, and where it ends, over the mean speed.
    """
    c, weight = directions.VELOCITIES[direction], d3q19.WEIGHTS[direction]
    sent = -6 * weight * (c * at).sum(axis=1)
    pushed = _pushed(direction, inner, outer)
    speed = -(at @ normal)
    rim = np.where(speed > 0, weight * np.maximum(c @ normal, 0.0) * (1 - speed / speed.max()), 0.0)
    rim /= rim.sum()
    return np.stack([sent + (area - sent.sum()) * rim, pushed - pushed.sum() * rim], axis=1)


def _pushed(direction: Ints, inner: Floats, outer: Floats) -> Floats:
    """What the odd rate would push across a profile of velocities (l, 3) where each link begins and ends.

    Sent back through the links, it is taken out: it would push blood towards the axis.
    """
    c, weight = directions.VELOCITIES[direction], d3q19.WEIGHTS[direction]

    def squared(u: Floats) -> Floats:
        return np.asarray(4.5 * (c * u).sum(axis=1) ** 2 - 1.5 * (u**2).sum(axis=1))

    return (2 / ODD_RATE - 1) * weight * (squared(outer) - squared(inner))
