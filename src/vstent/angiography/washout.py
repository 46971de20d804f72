"""Washout of a sac: how long its own blood stays, where, and how old it is."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from vstent.angiography.network import Network
from vstent.angiography.transport import Transport
from vstent.kernels.arrays import Floats, Ints, freeze

INTERVAL_S: Final = 0.05
"""Time between samples of the washout, in s."""
ENOUGH: Final = 0.02
"""Fraction of the sac's blood left at which the washout is stopped."""
MOMENTS_S: Final = (1.0, 2.0, 5.0)
"""Times at which the part without exchange is reported, in s."""
STAYED: Final = 0.5
"""Fraction of the first blood above which a place counts as not exchanged."""


@dataclass(frozen=True, eq=False)
class Washout:
    """Blood that is in the sac at 0 s, and how it is replaced."""

    time_s: Floats
    """(t,) times from 0."""
    left_fraction: Floats
    """(t,) part of that blood still, or again, in the sac."""
    stayed: tuple[Floats, ...]
    """For each of `MOMENTS_S` that was reached, the fraction (n,) of that blood in every cell of the sac."""
    tail_fraction: float
    """Part of the mean age that is extrapolated from the last times."""

    def __post_init__(self) -> None:
        freeze(self, "time_s left_fraction", np.float64, (len(self.time_s),))

    @property
    def mean_age_s(self) -> float:
        """Mean time that the blood in the sac has been there."""
        inside = float(np.trapezoid(self.left_fraction, self.time_s))
        return inside / (1 - self.tail_fraction)


def wash_out(
    network: Network,
    sac: Ints,
    *,
    end_s: float,
    diffusivity_mm2_s: float = 0.0,
    told: Callable[[float], None] | None = None,
) -> Washout:
    """March the washout of a sac, which consists of some cells (s,) of a network."""
    first = np.zeros(len(network.cells))
    first[sac] = 1.0
    march = Transport(network, diffusivity_mm2_s=diffusivity_mm2_s, initial=first)
    weight = network.volume_mm3[sac] / network.volume_mm3[sac].sum()
    times: list[float] = []
    left: list[float] = []
    stayed: list[Floats] = []
    for time_s, values in march.frames(INTERVAL_S, end_s):
        times.append(time_s)
        left.append(float(weight @ values[sac]))
        if any(abs(time_s - moment) < 1e-6 for moment in MOMENTS_S):
            stayed.append(values[sac].astype(np.float64))
        if told is not None:
            told(time_s / end_s)
        if left[-1] < ENOUGH and time_s > MOMENTS_S[-1] + 1e-6:
            break
    # The time constant of the last half of the washout, at most the time marched.
    middle = len(times) // 2
    drop = np.log(np.maximum(left[middle], 1e-12) / np.maximum(left[-1], 1e-12))
    decay_s = float(min((times[-1] - times[middle]) / max(drop, 1e-9), times[-1]))
    tail = decay_s * left[-1]
    tail_fraction = tail / (float(np.trapezoid(left, times)) + tail)
    return Washout(np.array(times), np.array(left), tuple(stayed), tail_fraction)
