"""State of a lattice-Boltzmann run: grid, memory layout, populations and history.

A *check* is a moment at which the monitored quantities are recorded and convergence is judged.
"""

from collections import deque
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vstent.flow import domain as domains
from vstent.flow import sampling
from vstent.flow.case import FlowCase
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.levels import Interface
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.screen import ScreenEntries
from vstent.flow.lattice.setup import Addressing, Links, Refill
from vstent.kernels.arrays import Floats, Ints

DEFER_PAIRS = 8
"""Number of step pairs between updates of the deferred wall correction and mass balance."""
DEFER_PART = 0.15
"""Under-relaxation factor of each of these updates."""
TOO_FAST = 0.75
"""Mach number on the lattice above which a result counts as diverged: at that speed a tube loses a tenth of its
flow."""
NECK_INFLOW = 3
"""Column of the neck inflow among the monitored quantities, where there is a neck."""


@dataclass(frozen=True, eq=False)
class Probe:
    """Places where the monitored quantities are evaluated."""

    cells: Ints
    """Cells of the sac, or of the whole lumen where there is no sac."""
    ostium_points: Floats
    """(p, 3) points on the ostium, in grid units."""
    ostium_area_mm2: Floats
    """(p, 3) area vectors at these points."""


def speeds(velocity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the magnitudes (n,) of velocities (n, 3), the same as numpy's norm but eight times as fast."""
    x, y, z = velocity.T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The flow at a check, or its mean over several checks, in lattice units."""

    scales: Scales
    """Units of this snapshot."""
    velocity: NDArray[np.float32]
    """(n, 3) velocity of every cell."""
    density: NDArray[np.float32]
    """(n,) deviation of the density from 1 in every cell."""
    outflow: Floats
    """(k,) flow rate out of every end."""
    checks: int = 1
    """Number of checks in the mean."""
    mean_speed: NDArray[np.float32] | None = None
    """(n,) mean speed of every cell over these checks; None for a single check."""

    @property
    def speed(self) -> NDArray[np.float32]:
        """Return the speed (n,) of every cell, or its mean over the checks."""
        if self.mean_speed is None:
            return speeds(self.velocity)
        return self.mean_speed

    def and_also(self, other: "Snapshot") -> "Snapshot":
        """Return the mean of this and another snapshot in the same units, weighted by their number of checks."""
        share = np.float32(other.checks / (self.checks + other.checks))
        return Snapshot(
            self.scales,
            self.velocity + share * (other.velocity - self.velocity),
            self.density + share * (other.density - self.density),
            self.outflow + share * (other.outflow - self.outflow),
            self.checks + other.checks,
            self.speed + share * (other.speed - self.speed),
        )

    @property
    def velocity_m_s(self) -> NDArray[np.float32]:
        """Return the velocity (n, 3) of every cell."""
        return self.velocity * np.float32(self.scales.speed_m_s)

    @property
    def speed_m_s(self) -> NDArray[np.float32]:
        """Return the speed (n,) of every cell, or its mean over the checks."""
        return self.speed * np.float32(self.scales.speed_m_s)

    @property
    def pressure_Pa(self) -> NDArray[np.float32]:
        """Return the pressure (n,) of every cell."""
        return self.density * np.float32(self.scales.pressure_Pa)

    @property
    def outflow_mL_s(self) -> Floats:
        """Return the flow rate (k,) out of every end."""
        return self.outflow * self.scales.flow_mL_s

    @property
    def is_lost(self) -> bool:
        """Return whether the run has diverged, or is too close to the lattice's speed of sound to be valid."""
        return not np.abs(self.velocity).max() < TOO_FAST * d3q19.SOUND  # the comparison is false for nan, too


@dataclass(eq=False)
class State:
    """A run in progress; the populations and the source terms of the links change in place.

    During a run on a GPU they change there. The arrays here are then those of the start or of the last save.
    """

    case: FlowCase
    """The flow case."""
    domain: domains.Domain
    """The grid."""
    addressing: Addressing
    """Memory layout of the populations."""
    scales: Scales
    """Lattice units; they change with the time step."""
    built: tuple[Links, ScreenEntries]
    """Links and screen for the first time step length of the run."""
    links: Links
    """Links for the present time step length."""
    screen: ScreenEntries
    """Screen for the present time step length."""
    refill: Refill
    """Redistribution of the mass lost at the walls."""
    bands: Ints
    """(b + 1, 5) layers of cells (see `d3q19.update`)."""
    limit: NDArray[np.float32]
    """(s,) largest grid Reynolds number of every segment, above which the viscosity is raised."""
    populations: NDArray[np.float32]
    """(19 * stride + lanes.COUNT,) populations minus their rest weights."""
    pace: Ints
    """(m,) number of time steps from each check to the next; even; repeated cyclically."""
    check_s: float
    """Time between checks."""
    snapshots: deque[Snapshot]
    """The flow at the last checks."""
    blocks: tuple[Snapshot, ...] = ()
    """Block means over all checks of a steady run."""
    steps: int = 0
    """Number of time steps made."""
    since_check: int = 0
    """Number of time steps since the last check."""
    history: list[Floats] = field(default_factory=list)
    """Monitored quantities at every check."""
    loop_seconds: float = 0.0
    """Run time of the time steps."""
    begun_s: float | None = None
    """Time at which a GPU began the next time steps, which it makes while the host judges the last check; else None."""
    device: Any = None
    """The run on a GPU (`on_gpu.Device`), once it has been copied there; else None."""
    finer: "State | None" = None
    """The next finer level, which shares the history of the run; None: this is the finest."""
    interface: Interface | None = None
    """Coupling with the next finer level."""

    @property
    def levels(self) -> "tuple[State, ...]":
        """Return this grid and the finer ones inside it, coarse to fine."""
        return (self,) if self.finer is None else (self, *self.finer.levels)

    @property
    def finest(self) -> "State":
        """Return the level with the finest grid."""
        return self.levels[-1]

    @cached_property
    def probe(self) -> Probe:
        """Places of the monitored quantities."""
        points_mm, area_mm2 = np.zeros((0, 3)), np.zeros((0, 3))
        if self.case.ostium is not None:
            points_mm, area_mm2 = sampling.surface_samples(self.case.ostium, self.domain.cell_size_mm)
        return Probe(domains.cells_of_sac(self.case, self.domain), self.domain.places(points_mm), area_mm2)

    @property
    def steps_per_check(self) -> int:
        """Return the number of time steps from the last check to the next."""
        return int(self.pace[len(self.history) % len(self.pace)])

    @property
    def time_s(self) -> float:
        """Return the flow time since the start of the run."""
        return self.check_s * (len(self.history) + self.since_check / self.steps_per_check)
