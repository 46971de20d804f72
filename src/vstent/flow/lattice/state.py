"""State of a lattice-Boltzmann run: grid, memory layout, populations and history.

A *check* is a moment at which the monitored quantities are recorded and convergence is judged.
"""

from collections import deque
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vstent.flow import domain as domains, sampling
from vstent.flow.case import FlowCase
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.levels import Interface, wire_levels
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.screen import ScreenEntries
from vstent.flow.lattice.setup import Addressing, Links, Refill
from vstent.kernels.arrays import Bools, Floats, Ints

DEFER_PAIRS = 8
"""Number of step pairs between updates of the deferred wall correction and mass balance."""
DEFER_PART = 0.15
"""Under-relaxation factor of each of these updates."""
TOO_FAST = 0.75
"""Mach number on the lattice above which a result counts as diverged: at that speed a tube loses a tenth of its
flow."""
NECK_INFLOW = 3
"""Column of the neck inflow among the monitored quantities, where there is a neck."""
BESIDE_CELLS = 3.5
"""Distance, in cells of a level, to its nearest cell within which a point counts as in it: half a wire, diagonally."""


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

    def fetch(self) -> None:
        """Copy what a GPU has changed on this level back to the arrays here."""
        if self.device is not None:
            self.device.fetch(self)

    @property
    def kept(self) -> "tuple[State, ...]":
        """Return the levels whose flow is a result: all but those finer than the grid spacing."""
        return self.levels[: 1 + self.case.numerics.coarser_levels]

    @property
    def main(self) -> "State":
        """Return the finest level kept that contains the sac."""
        return self.kept[-1] if "sac" in self.case.numerics.refine else self

    @property
    def at_wires(self) -> "State":
        """Return the finest level around wires or a neck; finer ones lie in narrow branches."""
        of_wires = wire_levels(self.case, self.kept[-1].domain.cell_size_mm)
        return self.levels[self.case.numerics.coarser_levels + of_wires]

    @cached_property
    def sac_cells(self) -> Ints:
        """Cells of the sac, or of the whole lumen where there is no sac."""
        return domains.cells_of_sac(self.case, self.domain)

    @cached_property
    def neck(self) -> tuple[tuple[Floats, Floats], ...]:
        """Points (p, 3) on the ostium that are read on each level, in its grid units, and their area vectors (p, 3)."""
        if self.case.ostium is None:
            return ()
        points_mm, area_mm2 = sampling.surface_samples(self.case.ostium, self.levels[-1].domain.cell_size_mm)
        number = np.zeros(len(points_mm), dtype=int)
        for depth, (coarse, fine) in enumerate(pairwise(self.levels), start=1):
            number[trusted(coarse, fine, points_mm)] = depth
        parts = [(level.domain, number == depth) for depth, level in enumerate(self.levels)]
        return tuple((grid.places(points_mm[chosen]), area_mm2[chosen]) for grid, chosen in parts)

    @property
    def steps_per_check(self) -> int:
        """Return the number of time steps from the last check to the next."""
        return int(self.pace[len(self.history) % len(self.pace)])

    @property
    def time_s(self) -> float:
        """Return the flow time since the start of the run."""
        return self.check_s * (len(self.history) + self.since_check / self.steps_per_check)


def trusted(coarse: State, fine: State, points_mm: Floats) -> Bools:
    """Return whether points (m, 3) lie inside the border of a level, in its blood or in a wire beside it."""
    assert coarse.interface is not None
    distance_mm, nearest = cKDTree(fine.domain.centers_mm).query(points_mm)
    return (distance_mm < BESIDE_CELLS * fine.domain.cell_size_mm) & coarse.interface.is_trusted[nearest]
