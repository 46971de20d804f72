"""Time-density curves of sac and parent artery, and the times that describe them."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from vstent.kernels.arrays import Floats, freeze

ARRIVED: Final = 0.1
"""Fraction of its peak at which contrast has arrived."""
HALF: Final = 0.5
"""Fraction of its peak below which contrast has washed out."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Mean iodine concentration over time."""

    time_s: Floats
    """(t,) time since the start of the injection."""
    sac_mg_mL: Floats
    """(t,) in the sac."""
    parent_mg_mL: Floats
    """(t,) in the parent artery proximal to the neck."""

    def __post_init__(self) -> None:
        freeze(self, "time_s sac_mg_mL parent_mg_mL", np.float64, (len(self.time_s),))

    def measures(self) -> dict[str, float]:
        """Return the times of the curves, in s; those that the curves do not reach are left out.

        - ``contrast_arrival_s``: the sac reaches a tenth of its peak; ``contrast_peak_s``: its peak;
        - ``contrast_peak_mg_mL``: mean iodine concentration of the sac at its peak, ``contrast_peak_fraction``: over
          that of the parent artery;
        - ``washout_half_life_s``: from the sac's peak until it falls to half of it;
        - ``contrast_retention_s``: the sac falls to half of its peak later than the parent artery by this time;
        - ``contrast_mean_transit_s``: centroid of the sac's curve minus that of the parent artery's, with the sac's
          last values continued exponentially.
        """
        sac, parent, time = self.sac_mg_mL, self.parent_mg_mL, self.time_s
        if sac.max() <= 0 or parent.max() <= 0:
            return {}
        top, arrived_mg_mL = int(sac.argmax()), ARRIVED * sac.max()
        k = int(np.argmax(sac >= arrived_mg_mL))
        part = (arrived_mg_mL - sac[k - 1]) / (sac[k] - sac[k - 1]) if k else 0.0
        half_s, parent_half_s = _falls_s(time, sac), _falls_s(time, parent)
        found = {
            "contrast_arrival_s": float(time[k - 1] + part * (time[k] - time[k - 1])) if k else float(time[0]),
            "contrast_peak_s": float(time[top]),
            "contrast_peak_mg_mL": float(sac[top]),
            "contrast_peak_fraction": float(sac[top] / parent.max()),
        }
        if half_s is not None:
            found["washout_half_life_s"] = half_s - float(time[top])
        if half_s is not None and parent_half_s is not None:
            found["contrast_retention_s"] = half_s - parent_half_s
            found["contrast_mean_transit_s"] = _centroid_s(time, sac) - _centroid_s(time, parent)
        return found


def retention_s(curves: Curves) -> tuple[float, bool] | None:
    """Return the retention, and whether it is only the least that it can be; None where there is none.

    The sac may keep more than half of its peak to the end of the curve; the retention is then at least the time from
    there to the end.
    """
    parent_s, sac_s = (_falls_s(curves.time_s, one) for one in (curves.parent_mg_mL, curves.sac_mg_mL))
    if parent_s is None or curves.sac_mg_mL.max() <= 0:
        return None
    return (float(curves.time_s[-1]) if sac_s is None else sac_s) - parent_s, sac_s is None


def _falls_s(time_s: Floats, values: Floats) -> float | None:
    """Return when a curve last falls to half of its peak; None where it ends above."""
    level = HALF * values.max()
    above = np.flatnonzero(values >= level)
    k = int(above[-1])
    if k + 1 == len(values):
        return None
    part = (values[k] - level) / (values[k] - values[k + 1])
    return float(time_s[k] + part * (time_s[k + 1] - time_s[k]))


def _centroid_s(time_s: Floats, values: Floats) -> float:
    """Return the centroid of a curve, with its last tenth continued exponentially."""
    area, moment = np.trapezoid(values, time_s), np.trapezoid(values * time_s, time_s)
    first, last = values[int(0.9 * len(values))], values[-1]
    if last > 1e-3 * values.max() and first > last:
        span_s = time_s[-1] - time_s[int(0.9 * len(values))]
        decay_s = span_s / np.log(first / last)
        area += last * decay_s
        moment += last * decay_s * (time_s[-1] + decay_s)
    return float(moment / area)
