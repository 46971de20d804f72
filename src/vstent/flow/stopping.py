"""Stopping criteria of a run: remaining change of monitored quantities, standard error of means, change of cycles."""

from typing import Any, Final

import numpy as np

from vstent.flow.case import PHASES
from vstent.kernels.arrays import Floats

CHECKS_AGREEING: Final = 3
"""Number of consecutive checks that must agree on convergence: an oscillating quantity passes its limit by chance."""
BATCHES: Final = 6
"""Number of batches of checks from which the standard error of a mean is estimated."""
LEAST_IN_BATCH: Final = 4
"""Minimum number of checks in a batch."""
SURE: Final = 3
"""Number of standard errors reported as the uncertainty of a mean: Student's 2.6 for six batches (95 %), plus a
margin because runs end when the estimate happens to be small (C0038 at a grid spacing of 0.4 mm, stopped at 1 %:
error 1.5 % root mean square)."""
LEAST_CROSSINGS: Final = 5
"""Minimum number of times that an oscillating quantity must cross its mean; a drifting one crosses it once."""
STALLED: Final = 0.8
"""If a cycle's change is more than this fraction of the previous one's, further cycles are not expected to converge."""


def quantities_left(history: Floats) -> float:
    """Return the largest remaining change of any quantity (checks, quantities) in the last `CHECKS_AGREEING` checks."""
    return max(fraction_left(history[: len(history) - k]) for k in range(min(CHECKS_AGREEING, len(history))))


def fraction_left(history: Floats) -> float:
    """Return the largest expected remaining change of any monitored quantity, as a fraction of it.

    The range of a quantity in the last third of the checks is compared with that in the third before. If the ranges
    keep shrinking at this ratio, the remaining change is the sum of a geometric series. The range is used because it
    works for a quantity that oscillates while it converges; the change of its mean would pass through zero. nan when
    the last check is not finite, inf with too few checks.
    """
    if not np.isfinite(history[-1]).all():
        return float("nan")
    window = (len(history) - 1) // 3
    if window < 3:
        return float("inf")
    last, before = (
        np.ptp(history[len(history) - 1 - (k + 1) * window : len(history) - k * window], axis=0) for k in range(2)
    )
    scale = np.maximum(np.abs(history[-1]), 1e-12)
    return float((series_left(last, before) / scale).max())


def series_left(last: Any, before: Any) -> Any:
    """Return the remaining sum of changes that keep shrinking as from `before` to `last`: a geometric series."""
    shrinking = np.clip(last / np.maximum(before, 1e-30), 0.3, 0.9)
    return last * shrinking / (1 - shrinking)


def standard_error(history: Floats) -> float:
    """Return the largest standard error of the mean of any monitored quantity, as a fraction of the mean.

    It is estimated from the means of batches (Schmeiser 1982, Oper. Res. 30, 556), or of the two halves where that is
    larger, as for a drifting quantity. For a quantity that has crossed its mean fewer than `LEAST_CROSSINGS` times the
    whole range is used. inf with too few checks.
    """
    if len(history) < BATCHES * LEAST_IN_BATCH:
        return float("inf")
    mean = history.mean(axis=0)
    by_parts = []
    for count in (BATCHES, 2):
        means = [batch.mean(axis=0) for batch in np.array_split(history, count)]
        by_parts.append(np.std(means, axis=0, ddof=1) / np.sqrt(count))
    has_swung = np.diff(np.sign(history - mean), axis=0).astype(bool).sum(axis=0) >= LEAST_CROSSINGS
    error = np.where(has_swung, np.maximum(*by_parts), np.ptp(history, axis=0))
    return float((error / np.maximum(np.abs(mean), 1e-12)).max())


def swings(history: Floats, checks: int) -> tuple[float, float]:
    """Return the largest range of any monitored quantity in the last `checks` checks and the largest shift of a mean.

    Both are fractions of the mean. The shift is relative to the mean of as many checks before, nan if there are fewer.
    """
    last, before = history[-checks:], history[-2 * checks : -checks]
    mean = last.mean(axis=0)
    scale = np.maximum(np.abs(mean), 1e-12)
    moved = np.abs(mean - before.mean(axis=0)) / scale if len(before) == len(last) else np.full(len(mean), np.nan)
    return float((np.ptp(last, axis=0) / scale).max()), float(moved.max())


def cycle_change(history: Floats) -> float:
    """Return the largest relative change of any monitored quantity (phases, quantities) between the last two cycles."""
    if not np.isfinite(history[-1]).all():
        return float("nan")
    cycles, rest = divmod(len(history), PHASES)
    if rest or cycles < 2:
        return float("inf")
    before, last = history[-2 * PHASES : -PHASES], history[-PHASES:]
    scale = np.maximum(np.sqrt((last**2).mean(axis=0)), 1e-12)
    return float((np.sqrt(((last - before) ** 2).mean(axis=0)) / scale).max())


def cycles_advice(changes: Floats, cycles: int, *, is_converged: bool) -> str:
    """Describe the convergence of the cycles, from the change (c,) after each of them, and what to do about it."""
    if len(changes) == 0:
        return "Only a single cycle was computed: allow at least two to check that the flow is periodic."
    said = f"Cycle {cycles} differs from the previous one by {100 * changes[-1]:.1f} %"
    if is_converged:
        return f"{said}: the flow has converged to a periodic state."
    if len(changes) > 1 and changes[-1] > STALLED * changes[-2]:
        return (
            f"{said}, hardly less than the change before ({100 * changes[-2]:.1f} %): the vortices differ from cycle "
            "to cycle, and more cycles will not reduce the difference."
        )
    return f"{said}, more than the tolerance: allow more cycles, or accept this difference."
