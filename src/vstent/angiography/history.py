"""Stored concentration over time, so that films along other views need no second transport."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.kernels.arrays import Floats, freeze

STEPS: Final = 255
"""Largest stored value. Values are stored as the square root of the concentration, so that a faint washout keeps its
shades: the error is at most 0.4 % of the largest concentration, and 0.04 % near zero."""


@dataclass(frozen=True, eq=False)
class History:
    """Concentration on grid cells at the times of a film."""

    points_mm: NDArray[np.float32]
    """(n, 3) cell centers in LPS."""
    spacing_mm: NDArray[np.float32]
    """(n,) edges of the cells."""
    time_s: Floats
    """(f,) times."""
    stored: NDArray[np.uint8]
    """(f, n) square roots of the concentration, 0 to 255."""
    most_mg_mL: float
    """Concentration of the value 255."""
    key: str = ""
    """Digest of the injection and the times, by which a stored history is recognized."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float32, (-1, 3))
        freeze(self, "spacing_mm", np.float32, (len(self.points_mm),))
        freeze(self, "time_s", np.float64, (-1,))
        if self.stored.shape != (len(self.time_s), len(self.points_mm)) or self.stored.dtype != np.uint8:
            raise ValueError(f"stored has shape {self.stored.shape} and type {self.stored.dtype}")
        self.stored.flags.writeable = False  # not copied: it may take hundreds of MB

    @cached_property
    def value_mg_mL(self) -> NDArray[np.float32]:
        """(256,) concentration of every stored value."""
        return (self.most_mg_mL * (np.arange(STEPS + 1) / STEPS) ** 2).astype(np.float32)

    def frames(self) -> Iterator[tuple[float, NDArray[np.float32]]]:
        """Yield time in s and concentration (n,) in mg/mL."""
        for time_s, stored in zip(self.time_s, self.stored, strict=True):
            yield float(time_s), self.value_mg_mL[stored]


def recorded(
    frames: Iterable[tuple[float, NDArray[Any]]],
    points_mm: Floats,
    spacing_mm: Floats,
    most_mg_mL: float,
    key: str = "",
) -> History:
    """Return the stored history of a concentration; values above `most_mg_mL` are stored as that.

    Parameters
    ----------
    frames : time in s and concentration (n,) in mg/mL; the arrays may be reused after each step.
    points_mm : (n, 3) cell centers in LPS.
    spacing_mm : (n,) edges of the cells.
    most_mg_mL : largest concentration, that of the injected agent.
    key : digest of the injection and the times.
    """
    times, stored = [], []
    for time_s, values in frames:
        share = np.clip(np.asarray(values, dtype=np.float32) / np.float32(most_mg_mL), 0.0, 1.0)
        times.append(time_s)
        stored.append(np.rint(STEPS * np.sqrt(share)).astype(np.uint8))
    kept = np.stack(stored) if stored else np.zeros((0, len(points_mm)), np.uint8)
    return History(points_mm.astype(np.float32), spacing_mm.astype(np.float32), np.array(times), kept, most_mg_mL, key)
