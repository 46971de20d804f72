"""Stopping criteria of a run: remaining change of the monitored quantities, and standard error of their means."""

from typing import Any, Final

import numpy as np

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


def quantities_left(history: Floats) -> float:
    """Return the largest remaining change of any monitored quantity, the worst of the last `CHECKS_AGREEING` checks.

    Shapes: `history` (checks, quantities).
    """
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

    Shapes: `history` (checks, quantities).
    """
    if len(history) < BATCHES * LEAST_IN_BATCH:
        return float("inf")
    mean = history.mean(axis=0)
    by_batches, by_halves = (_error_by(history, count) for count in (BATCHES, 2))
    has_swung = np.diff(np.sign(history - mean), axis=0).astype(bool).sum(axis=0) >= LEAST_CROSSINGS
    error = np.where(has_swung, np.maximum(by_batches, by_halves), np.ptp(history, axis=0))
    return float((error / np.maximum(np.abs(mean), 1e-12)).max())


def _error_by(history: Floats, count: int) -> Floats:
    """Return the standard error of the mean of every column from the means of `count` batches."""
    batches = np.array_split(history, count)
    return np.asarray(np.std([batch.mean(axis=0) for batch in batches], axis=0, ddof=1) / np.sqrt(count))


def swings(history: Floats, checks: int) -> tuple[float, float]:
    """Return the largest range of any monitored quantity in the last `checks` checks and the largest shift of a mean.

    Both are fractions of the mean. The shift is relative to the mean of as many checks before, nan if there are fewer.
    """
    last, before = history[-checks:], history[-2 * checks : -checks]
    mean = last.mean(axis=0)
    scale = np.maximum(np.abs(mean), 1e-12)
    moved = np.abs(mean - before.mean(axis=0)) / scale if len(before) == len(last) else np.full(len(mean), np.nan)
    return float((np.ptp(last, axis=0) / scale).max()), float(moved.max())
