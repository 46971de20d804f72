"""When a run may stop: how much its monitored quantities still change, and how well their means are known."""

from typing import Any, Final

import numpy as np

from vstent.kernels.arrays import Floats

CHECKS_AGREEING: Final = 3
"""Checks that must agree that a flow has settled: a quantity that swings passes its end by chance."""
BATCHES: Final = 6
"""Batches of checks whose means tell how well the mean of all is known."""
LEAST_IN_BATCH: Final = 4
"""Fewest checks of a batch."""
SURE: Final = 3
"""Standard errors that a mean is told to be known to within: Student's 2.6 for six batches (95 %), and some more since
runs end when it looks small (C0038 in cells of 0.4 mm, stopped at 1 %: off by 1.5 % root mean square)."""
LEAST_CROSSINGS: Final = 5
"""Times that what swings about a mean must have passed it: what drifts passes it once."""


def quantities_left(history: Floats) -> float:
    """Largest fraction that any column of a history (checks, quantities) has left to go, the worst of the last checks.

    nan when it is not finite.
    """
    return max(fraction_left(history[: len(history) - k]) for k in range(min(CHECKS_AGREEING, len(history))))


def fraction_left(history: Floats) -> float:
    """Largest fraction that any column of a history (checks, quantities) has left to go; nan when one is not finite.

    What a quantity ranged over in the last third of the checks is compared with the third before: if it goes on
    shrinking so from each third to the next, a geometric series is left. Of a quantity that swings as it settles, the
    range tells how much; the change of its mean would pass through zero and tell nothing.
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
    """What is left of changes that go on shrinking as from the one before to the last: a geometric series."""
    shrinking = np.clip(last / np.maximum(before, 1e-30), 0.3, 0.9)
    return last * shrinking / (1 - shrinking)


def standard_error(history: Floats) -> float:
    """Largest standard error of the mean of any column of a history (checks, quantities), as a fraction of the mean.

    From the means of batches (Schmeiser 1982, Oper. Res. 30, 556), or of both halves where that is more, as it is of
    what drifts. Of what has not swung about its mean often, the whole range is taken for it; inf of too few checks.
    """
    if len(history) < BATCHES * LEAST_IN_BATCH:
        return float("inf")
    mean = history.mean(axis=0)
    by_batches, by_halves = (_error_by(history, count) for count in (BATCHES, 2))
    has_swung = np.diff(np.sign(history - mean), axis=0).astype(bool).sum(axis=0) >= LEAST_CROSSINGS
    error = np.where(has_swung, np.maximum(by_batches, by_halves), np.ptp(history, axis=0))
    return float((error / np.maximum(np.abs(mean), 1e-12)).max())


def _error_by(history: Floats, count: int) -> Floats:
    """Standard error of the mean of every column, from the means of so many batches of the last checks."""
    batches = np.array_split(history, count)
    return np.asarray(np.std([batch.mean(axis=0) for batch in batches], axis=0, ddof=1) / np.sqrt(count))


def swings(history: Floats, checks: int) -> tuple[float, float]:
    """What any column of a history (checks, quantities) ranged over at most in the last so many checks.

    And how far their mean is from the one of as many before, nan where there are not as many: fractions of the mean.
    """
    last, before = history[-checks:], history[-2 * checks : -checks]
    mean = last.mean(axis=0)
    scale = np.maximum(np.abs(mean), 1e-12)
    moved = np.abs(mean - before.mean(axis=0)) / scale if len(before) == len(last) else np.full(len(mean), np.nan)
    return float((np.ptp(last, axis=0) / scale).max()), float(moved.max())
