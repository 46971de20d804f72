"""March a concentration through a network of flow rates: bounded, conservative, walls without flux."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.angiography.kernels import advection
from vstent.angiography.layout import layout
from vstent.angiography.network import Network
from vstent.kernels.arrays import Floats

COURANT: Final = 0.8
"""Largest share of a cell that leaves it in one step of the cell."""
EMPTY: Final = 1e-5
"""Largest concentration, relative to that of the inflow, in a group of cells that is not marched. What such cells hold
stays in them, so that nothing is lost."""

Frame = tuple[float, NDArray[np.float32]]
"""Time in s, and the concentration (n,) of every cell."""


@dataclass(frozen=True, eq=False)
class Balance:
    """Contrast that entered, left and is inside, in the unit of the concentration times mm3."""

    entered: float
    """Amount through the inlets since the start, and at the start inside."""
    left: float
    """Amount out through the outlets since the start."""
    inside: float
    """Amount in the cells."""

    @property
    def error_fraction(self) -> float:
        """Amount that appeared or disappeared, as a fraction of what entered."""
        return abs(self.entered - self.left - self.inside) / max(self.entered, 1e-300)


class Transport:
    """Concentration in a network, from 0 s onwards.

    Parameters
    ----------
    network : Network
        Cells and flow rates.
    diffusivity_mm2_s : float
        Molecular diffusivity of the contrast agent.
    initial : (n,) float, optional
        Concentration at 0 s; 0 unless given.
    inflow : callable, optional
        Concentration of the blood that enters at a time in s; 0 unless given.
    upper : float
        Largest concentration of the inflow and at 0 s.
    """

    def __init__(
        self,
        network: Network,
        *,
        diffusivity_mm2_s: float = 0.0,
        initial: Floats | None = None,
        inflow: Callable[[float], float] | None = None,
        upper: float = 1.0,
    ) -> None:
        n = len(network.cells)
        self._laid = layout(network, diffusivity_mm2_s)
        self.network, self._inflow, self.upper = self._laid.network, inflow, upper
        self.fastest_s = float(COURANT / self._laid.total_per_s.max())
        groups = len(self._laid.groups.level)
        # Single precision halves the memory traffic; the mass that leaves one cell is still exactly that of the next.
        self._held = advection.Held(
            state=np.zeros((n + network.openings, 8), dtype=np.float32),
            gains=np.zeros(len(self._laid.mesh.face), dtype=np.float32),
            through=np.zeros(len(network.left)),
            is_full=np.ones(groups + 1, dtype=bool),
            moved=np.zeros(groups, dtype=np.int32),
        )
        self._flux = self.network.flux_mm3_s[0].astype(np.float32)
        self._moves = np.zeros((n, 3), dtype=np.float32)
        advection.drift(self._laid.mesh, self._flux, self._moves)
        if initial is not None:
            self._held.state[:n, advection.VALUE] = initial[self._laid.order]
        self._began = self._inside()

    def frames(self, interval_s: float, end_s: float) -> Iterator[Frame]:
        """March, and yield the concentration at 0 s and after every interval.

        Parameters
        ----------
        interval_s : time between frames.
        end_s : time of the last frame; the iteration may be stopped before.
        """
        top = self._laid.top
        marches = int(np.ceil(interval_s / (self.fastest_s * (1 << top)) - 1e-9))
        step_s = interval_s / marches
        self._held.state[: len(self._laid.order), advection.ALLOWANCE] = self._laid.allowance(step_s / (1 << top))
        yield 0.0, self._values()
        for number in range(1, round(end_s / interval_s) + 1):
            for part in range(marches):
                self._march((number - 1) * interval_s + part * step_s, step_s)
            yield number * interval_s, self._values()

    def _values(self) -> NDArray[np.float32]:
        """Return the concentration (n,) in the order of the cells as given."""
        order = self._laid.order
        values = np.zeros(len(order), dtype=np.float32)
        values[order] = self._held.state[: len(order), advection.VALUE]
        return values

    def _inside(self) -> float:
        """Return the amount in all cells."""
        values = self._held.state[: len(self._laid.order), advection.VALUE]
        return float(values.astype(np.float64) @ self.network.volume_mm3)

    def moved(self) -> Floats:
        """Return the amount (f,) that passed every face to its upper side so far, in the order as given."""
        found = np.zeros(len(self._laid.faces))
        found[self._laid.faces] = self._held.through
        return found

    def balance(self) -> Balance:
        """Return what entered, left and is inside so far."""
        network = self.network
        faces, opening, sign = network.at_openings
        out = np.bincount(opening, sign * self._held.through[faces], network.openings)
        return Balance(
            self._began - float(out[: network.inlets].sum()), float(out[network.inlets :].sum()), self._inside()
        )

    def _march(self, start_s: float, step_s: float) -> None:
        """Advance by one step of the slowest cells, with the flow rates of its middle."""
        n, network, laid = len(self._laid.order), self.network, self._laid
        if len(network.time_s) > 1:
            self._flux[:] = _at_time(network, start_s + 0.5 * step_s)
            advection.drift(laid.mesh, self._flux, self._moves)
        entering = 0.0
        if self._inflow is not None:
            first, last = self._inflow(start_s), self._inflow(start_s + step_s)
            self._held.state[n : n + network.inlets, : advection.TIME] = first, (last - first) / step_s
            entering = max(first, last)
        self._held.is_full[-1] = entering > 0
        base_s, limits = step_s / (1 << laid.top), np.array([self.upper, EMPTY * self.upper], np.float32)
        advection.march(laid.mesh, laid.groups, self._held, self._flux, self._moves, base_s, *limits)


def _at_time(network: Network, time_s: float) -> Floats:
    """Return the flow rates (f,) at a time, interpolated linearly between the stored moments of the cycle."""
    count = len(network.time_s)
    place = ((time_s - network.time_s[0]) % network.period_s) / network.period_s * count
    first = int(place) % count
    part = place - int(place)
    return np.asarray((1 - part) * network.flux_mm3_s[first] + part * network.flux_mm3_s[(first + 1) % count])
