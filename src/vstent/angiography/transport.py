"""March a concentration through a network of flow rates: bounded, conservative, walls without flux."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.angiography.kernels import advection
from vstent.angiography.network import Network
from vstent.kernels.arrays import Floats, Ints

COURANT: Final = 0.8
"""Largest share of a cell that leaves it in one step of the cell."""
LEVELS: Final = 7
"""Number of step lengths, each twice the one before."""

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
        exchange_per_s = _exchange_per_s(network, diffusivity_mm2_s * _conductance_mm(network))
        self._order, level, face_level, total_per_s = _levels(network, exchange_per_s)
        network = _ordered(network, self._order, np.argsort(face_level, kind="stable"))
        self.network, self._inflow, self._upper = network, inflow, upper
        self.fastest_s = float(COURANT / total_per_s.max())
        self._level, self._face_level, self._total_per_s = level, np.sort(face_level), total_per_s
        self._mesh = _mesh(network, diffusivity_mm2_s * _conductance_mm(network))
        # Single precision halves the memory traffic; the mass that leaves one cell is still exactly that of the next.
        self._state = np.zeros((n + network.openings, 6), dtype=np.float32)
        self._masses = np.zeros((len(network.left), 2), dtype=np.float32)
        self._through = np.zeros(len(network.left))
        self._flux, self._moves = network.flux_mm3_s[0].copy(), np.zeros((n, 3), dtype=np.float32)
        advection.drift(self._mesh, self._flux, self._moves)
        if initial is not None:
            self._state[:n, advection.VALUE] = initial[self._order]
        self._began = self._inside()

    def frames(self, interval_s: float, end_s: float) -> Iterator[Frame]:
        """March, and yield the concentration at 0 s and after every interval.

        Parameters
        ----------
        interval_s : float
            Time between frames.
        end_s : float
            Time of the last frame; the iteration may be stopped before.
        """
        top = int(self._level.max())
        marches = int(np.ceil(interval_s / (self.fastest_s * (1 << top)) - 1e-9))
        step_s = interval_s / marches
        steps = self._steps(step_s / (1 << top))
        yield 0.0, self._values()
        for number in range(1, round(end_s / interval_s) + 1):
            for part in range(marches):
                self._march(steps, (number - 1) * interval_s + part * step_s, step_s)
            yield number * interval_s, self._values()

    def _values(self) -> NDArray[np.float32]:
        """Return the concentration (n,) in the order of the cells as given."""
        values = np.zeros(len(self._order), dtype=np.float32)
        values[self._order] = self._state[: len(self._order), advection.VALUE]
        return values

    def _inside(self) -> float:
        """Return the amount in all cells."""
        return float(self._state[: len(self._order), advection.VALUE].astype(np.float64) @ self.network.volume_mm3)

    def balance(self) -> Balance:
        """Return what entered, left and is inside so far."""
        network = self.network
        faces, opening, sign = network.at_openings
        out = np.bincount(opening, sign * self._through[faces], network.openings)
        return Balance(
            self._began - float(out[: network.inlets].sum()), float(out[network.inlets :].sum()), self._inside()
        )

    def _march(self, steps: advection.Steps, start_s: float, step_s: float) -> None:
        """Advance by one step of the slowest cells, with the flow rates of its middle."""
        n, network = len(self._order), self.network
        if len(network.time_s) > 1:
            self._flux[:] = _at_time(network, start_s + 0.5 * step_s)
            advection.drift(self._mesh, self._flux, self._moves)
        if self._inflow is not None:
            first, last = self._inflow(start_s), self._inflow(start_s + step_s)
            self._state[n : n + network.inlets, : advection.TIME] = first, (last - first) / step_s
        base_s = step_s / (1 << int(self._level.max()))
        held = self._state, self._masses, self._through
        advection.march(self._mesh, steps, *held, self._flux, self._moves, base_s, self._upper)

    def _steps(self, base_s: float) -> advection.Steps:
        """Return the step lengths of all cells."""
        step_s = base_s * 2.0**self._level
        outflow_per_s = self.network.outflow_per_s
        spread = (self._total_per_s - outflow_per_s) * step_s
        allowance = (1 - spread) / np.maximum(outflow_per_s * step_s, 1e-12)
        is_slower = self._face_level[self._mesh.face] < np.repeat(self._level, np.diff(self._mesh.first))
        top = int(self._level.max()) + 1
        cell_end = np.bincount(self._level, minlength=top).cumsum()
        face_end = np.bincount(self._face_level, minlength=top).cumsum()
        level = self._face_level.astype(np.int8)
        return advection.Steps(is_slower, cell_end, face_end, level, allowance.astype(np.float32))


def _levels(network: Network, exchange_per_s: Floats) -> tuple[Ints, Ints, Ints, Floats]:
    """Return the order of the cells by level, their levels and rates (n,) per s in that order, and those of the faces.

    The level of a cell is the power of two by which its step exceeds the base step; neighbours differ by one at most.
    """
    n = len(network.cells)
    total_per_s = network.outflow_per_s + exchange_per_s
    slowness = total_per_s.max() / np.maximum(total_per_s, 1e-12)
    level = np.minimum(np.floor(np.log2(slowness)), LEVELS - 1).astype(np.int64)
    inner = (network.left < n) & (network.right < n)
    left, right = network.left[inner], network.right[inner]
    for _ in range(LEVELS):
        np.minimum.at(level, left, level[right] + 1)
        np.minimum.at(level, right, level[left] + 1)
    padded = np.r_[level, np.full(network.openings, LEVELS)]
    order = np.argsort(level, kind="stable")
    face_level = np.minimum(padded[network.left], padded[network.right])
    return order, level[order], face_level, total_per_s[order]


def _ordered(network: Network, cells: Ints, faces: Ints) -> Network:
    """Return the network with its cells and faces in another order."""
    n = len(cells)
    number = np.r_[np.zeros(n, dtype=np.int64), n + np.arange(network.openings)]
    number[cells] = np.arange(n)
    return network.taken(cells, faces, number)


def _mesh(network: Network, exchange_mm3_s: Floats) -> advection.Mesh:
    """Return the connections of the cells, for the kernels."""
    n, f = len(network.cells), np.arange(len(network.left))
    cell, other = np.r_[network.left, network.right], np.r_[network.right, network.left]
    side = 2 * network.axis[np.r_[f, f]].astype(np.int64) + np.repeat([1, 0], len(f))
    order = np.lexsort((side, cell))
    order = order[cell[order] < n]
    cell, other, side = cell[order], other[order], side[order]
    width = np.r_[network.width, np.zeros(network.openings)]
    share = 2 * width[cell] / (width[cell] + width[other]) / np.bincount(6 * cell + side)[6 * cell + side]
    weight = np.where(other < n, share, 0.0)
    first = np.searchsorted(cell, np.arange(n + 1)).astype(np.int32)
    face, beside = np.r_[f, f][order].astype(np.int32), other.astype(np.int32)
    of_entries = face, beside, side.astype(np.int8), weight.astype(np.float32)
    return advection.Mesh(
        network.left,
        network.right,
        network.axis,
        first,
        *of_entries,
        network.volume_mm3,
        exchange_mm3_s.astype(np.float32),
    )


def _conductance_mm(network: Network) -> Floats:
    """Return the area of every face over the distance of its cells (f,); 0 at openings."""
    n = len(network.cells)
    width = np.r_[network.width, np.zeros(network.openings)]
    apart_mm = 0.5 * (width[network.left] + width[network.right]) * network.spacing_mm
    return np.where((network.left < n) & (network.right < n), network.area_mm2 / apart_mm, 0.0)


def _exchange_per_s(network: Network, exchange_mm3_s: Floats) -> Floats:
    """Return the diffusive exchange (n,) of each cell divided by its volume."""
    n = len(network.cells)
    total = np.bincount(network.left, exchange_mm3_s, n + network.openings)
    total += np.bincount(network.right, exchange_mm3_s, n + network.openings)
    return np.asarray(total[:n] / network.volume_mm3)


def _at_time(network: Network, time_s: float) -> Floats:
    """Return the flow rates (f,) at a time, interpolated linearly between the stored moments of the cycle."""
    count = len(network.time_s)
    place = ((time_s - network.time_s[0]) % network.period_s) / network.period_s * count
    first = int(place) % count
    part = place - int(place)
    return np.asarray((1 - part) * network.flux_mm3_s[first] + part * network.flux_mm3_s[(first + 1) % count])
