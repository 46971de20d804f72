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

    It begins as `initial` (n,). `inflow` returns the concentration of the blood that enters at a time in s. Both are 0
    unless given, and at most `upper`.
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
        """March, and yield the concentration at 0 s and after every interval; the iteration may be stopped early."""
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
        amounts = np.zeros(len(self._laid.faces))
        amounts[self._laid.faces] = self._held.through
        return amounts

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
        count = len(network.time_s)
        if count > 1:  # linear between the stored moments of the cycle
            since_s = (start_s + 0.5 * step_s - network.time_s[0]) % network.period_s
            place = since_s / network.period_s * count
            first, part = int(place) % count, place - int(place)
            self._flux[:] = (1 - part) * network.flux_mm3_s[first] + part * network.flux_mm3_s[(first + 1) % count]
            advection.drift(laid.mesh, self._flux, self._moves)
        entering = 0.0
        if self._inflow is not None:
            before, after = self._inflow(start_s), self._inflow(start_s + step_s)
            self._held.state[n : n + network.inlets, : advection.TIME] = before, (after - before) / step_s
            entering = max(before, after)
        self._held.is_full[-1] = entering > 0
        base_s, limits = step_s / (1 << laid.top), np.array([self.upper, EMPTY * self.upper], np.float32)
        advection.march(laid.mesh, laid.groups, self._held, self._flux, self._moves, base_s, *limits)


def warm() -> None:
    """Compile the kernels ahead of their first use: march a frame through two cells."""
    cells = np.array([[0, 0, 0], [0, 0, 1]])
    two = Network(
        cells=cells,
        width=np.ones(2, dtype=np.int32),
        spacing_mm=1.0,
        points_mm=cells.astype(np.float64),
        volume_mm3=np.ones(2),
        left=np.array([0, 1, 2]),
        right=np.array([1, 3, 0]),
        axis=np.full(3, 2),
        flux_mm3_s=np.ones((1, 3)),
        time_s=np.zeros(1),
        period_s=np.inf,
        openings=2,
        inlets=1,
        correction_fraction=0.0,
    )
    list(Transport(two, inflow=lambda _: 1.0).frames(0.1, 0.1))
