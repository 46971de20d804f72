"""Stored concentration over time, so that films along other views need no second transport."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vstent.flow.case import FlowField
from vstent.flow.sampling import uniform
from vstent.kernels.arrays import Floats, Ints, freeze

STEPS: Final = 255
"""Largest stored value. Values are stored as the square root of the concentration, so that a faint washout keeps its
shades: the error is at most 0.4 % of the largest concentration, and 0.04 % near zero."""


FARTHEST: Final = 3**0.5
"""Largest distance of a cell of the flow from the center of its block, in edges of the largest block: no cell of a
block is farther from the center of its blood. Cells beyond it are not connected to the vessel."""


@dataclass(frozen=True, eq=False)
class History:
    """Concentration over time in the cells of a flow, of which several may share one value."""

    points_mm: NDArray[np.float32]
    """(m, 3) centers in LPS of the cells of the flow."""
    spacing_mm: float
    """Grid spacing."""
    block: Ints
    """(m,) column of `stored` that holds the value of each cell."""
    time_s: Floats
    """(f,) times since the start of the injection."""
    stored: NDArray[np.uint8]
    """(f, n) square roots of the concentration, 0 to 255."""
    most_mg_mL: float
    """Concentration of the value 255."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float32, (-1, 3))
        freeze(self, "block", np.int32, (len(self.points_mm),))
        freeze(self, "time_s", np.float64, (-1,))
        if self.stored.shape[:1] != self.time_s.shape or self.stored.ndim != 2 or self.stored.dtype != np.uint8:
            raise ValueError(f"stored has shape {self.stored.shape} and type {self.stored.dtype}")
        self.stored.flags.writeable = False  # not copied: it may take hundreds of MB

    @cached_property
    def value_mg_mL(self) -> NDArray[np.float32]:
        """(256,) concentration of every stored value."""
        return (self.most_mg_mL * (np.arange(STEPS + 1) / STEPS) ** 2).astype(np.float32)

    def frames(self) -> Iterator[tuple[float, NDArray[np.float32]]]:
        """Yield time in s and concentration (n,) in mg/mL; cell k of the flow has the value `block[k]`."""
        for time_s, stored in zip(self.time_s, self.stored, strict=True):
            yield float(time_s), self.value_mg_mL[stored]


class Recorder:
    """Stores the frames of a transport through a flow while it marches.

    Concentrations above the largest are stored as that. The injection starts at `begin_s` of the transport, which is
    0 s of the history; earlier frames are left out.
    """

    def __init__(self, field: FlowField, most_mg_mL: float, begin_s: float = 0.0) -> None:
        self._field, self._most_mg_mL, self._begin_s = field, most_mg_mL, begin_s
        self._times: list[float] = []
        self._stored: list[NDArray[np.uint8]] = []

    def watch(self, points_mm: Floats, edge_mm: Floats) -> Callable[[float, NDArray[Any]], None]:
        """Take centers (n, 3) in LPS and edges (n,) of the marched cells; return what takes every frame."""
        self._points_mm, self._reach_mm = points_mm, FARTHEST * float(edge_mm.max())
        return self._add

    def _add(self, time_s: float, values_mg_mL: NDArray[Any]) -> None:
        """Store one frame (n,); the array may be reused afterwards."""
        if time_s < self._begin_s - 1e-9:
            return
        share = np.clip(np.asarray(values_mg_mL, dtype=np.float32) / np.float32(self._most_mg_mL), 0.0, 1.0)
        self._times.append(time_s - self._begin_s)
        self._stored.append(np.rint(STEPS * np.sqrt(share)).astype(np.uint8))

    def history(self) -> History:
        """Return all frames so far; cells of the flow share the value of the marched cell that contains them."""
        grid = uniform(self._field).finest
        spacing_mm, centers_mm = grid.cell_size_mm, grid.centers_mm
        distance_mm, block = cKDTree(self._points_mm).query(centers_mm)
        near = distance_mm < self._reach_mm
        stored, times = np.stack(self._stored), np.array(self._times)
        points_mm = centers_mm[near].astype(np.float32)
        return History(points_mm, spacing_mm, np.asarray(block)[near], times, stored, self._most_mg_mL)
