"""A lattice-Boltzmann run as data: its grid, storage, populations and history."""

from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vstent.flow import domain as domains
from vstent.flow.case import FlowCase
from vstent.flow.lattice.close_up import CloseUp
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.screen import ScreenEntries
from vstent.flow.lattice.setup import (
    Addressing,
    Links,
    Refill,
)
from vstent.kernels.arrays import Floats, Ints

DEFER_PAIRS = 8
"""Step pairs between updates of what is deferred."""
DEFER_PART = 0.15
"""Part of the way that each update goes."""
TOO_FAST = 0.75
"""Speed over the sound's from which a result is not to be trusted: at that speed a tube loses a tenth of its blood."""
NECK_INFLOW = 3
"""Column of the monitored quantities that is the neck inflow, where there is a neck."""


@dataclass(frozen=True, eq=False)
class Probe:
    """Where the monitored quantities are read."""

    cells: Ints
    """Cells of the sac, or of the whole lumen where there is no sac."""
    ostium_points: Floats
    """(p, 3) points on the ostium, grid units."""
    ostium_area_mm2: Floats
    """(p, 3) area vectors there."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The flow at a check, or its mean over some, in lattice units."""

    scales: Scales
    """These units."""
    velocity: NDArray[np.float32]
    """(n, 3) of every cell."""
    density: NDArray[np.float32]
    """(n,) deviation of every cell."""
    outflow: Floats
    """(k,) through every end."""
    checks: int = 1
    """Checks that it is the mean of."""
    mean_speed: NDArray[np.float32] | None = None
    """(n,) mean speed of every cell over them; None of a single one."""

    @property
    def speed(self) -> NDArray[np.float32]:
        """(n,) speed of every cell, or its mean over the checks."""
        if self.mean_speed is None:
            return np.asarray(np.linalg.norm(self.velocity, axis=1))
        return self.mean_speed

    def and_also(self, other: "Snapshot") -> "Snapshot":
        """Return the mean of this and another, each counting as many times as it has checks; units are alike."""
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
        """(n, 3) of every cell."""
        return self.velocity * np.float32(self.scales.speed_m_s)

    @property
    def speed_m_s(self) -> NDArray[np.float32]:
        """(n,) of every cell, or its mean over the checks."""
        return self.speed * np.float32(self.scales.speed_m_s)

    @property
    def pressure_Pa(self) -> NDArray[np.float32]:
        """(n,) of every cell."""
        return self.density * np.float32(self.scales.pressure_Pa)

    @property
    def outflow_mL_s(self) -> Floats:
        """(k,) through every end."""
        return self.outflow * self.scales.flow_mL_s

    @property
    def is_lost(self) -> bool:
        """Whether the run has diverged, or its blood is so near the lattice's sound that it is no flow."""
        return not np.abs(self.velocity).max() < TOO_FAST * d3q19.SOUND  # which nan is not either


class OnDevice(Protocol):
    """The arrays of a run on a GPU, and what is done with them there."""

    def advance(self, wanted: Floats, moments: Floats, first_pair: int) -> None:
        """Make pairs of steps with what `stepping.imposed` returns; the first is that pair since a check."""

    def read(self) -> tuple[NDArray[np.float32], Floats]:
        """Density deviation and momentum (n, 4) of every cell, and the flow out (k,) through every opening."""

    def fetch(self, state: "State") -> None:
        """Put what the time steps have changed back into the state."""


@dataclass(eq=False)
class State:
    """A run under way; the populations and the links' sources change in place.

    On a GPU they change there: what is here is what they were when the run went there, or was last saved.
    """

    case: FlowCase
    """What is computed."""
    close_up: CloseUp | None
    """What of it is computed, and what surrounds that; None: all of it."""
    domain: domains.Domain
    """The grid."""
    addressing: Addressing
    """The storage."""
    scales: Scales
    """Lattice units; they change with the time step."""
    built: tuple[Links, ScreenEntries]
    """What walls and openings send back, and the resistance of the stent by segment, for the first time steps."""
    links: Links
    """The former for the present ones."""
    screen: ScreenEntries
    """The latter for the present ones."""
    probe: Probe
    """Monitored quantities."""
    refill: Refill
    """What the walls lose."""
    bands: Ints
    """(b + 1, 5) see `d3q19.update`."""
    limit: NDArray[np.float32]
    """(s,) largest cell Reynolds number in every segment."""
    populations: NDArray[np.float32]
    """(19 * stride + lanes.COUNT,) shifted populations."""
    pace: Ints
    """(m,) time steps from each check to the next, even, in turn."""
    check_s: float
    """Time between checks."""
    snapshots: deque[Snapshot]
    """The flow at the last checks."""
    blocks: tuple[Snapshot, ...] = ()
    """Its means over all checks of a steady run, block by block."""
    steps: int = 0
    """Time steps made."""
    since_check: int = 0
    """Those since the last check."""
    history: list[Floats] = field(default_factory=list)
    """Monitored quantities at every check."""
    loop_seconds: float = 0.0
    """Time spent in the time steps."""
    device: "OnDevice | None" = None
    """The run on a GPU, once it is there."""

    @property
    def steps_per_check(self) -> int:
        """Time steps from the last check to the next."""
        return int(self.pace[len(self.history) % len(self.pace)])

    @property
    def time_s(self) -> float:
        """Time since the run began."""
        return self.check_s * (len(self.history) + self.since_check / self.steps_per_check)
