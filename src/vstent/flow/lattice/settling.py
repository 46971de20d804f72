"""Whether a steady lattice-Boltzmann run is at its end: it has settled, or it swings about a mean that is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.state import Snapshot
from vstent.kernels.arrays import Floats, Ints

CHECKS_AGREEING: Final = 3
"""Checks that must agree that a flow has settled: a quantity that swings passes its end by chance."""
CHECKS_APART: Final = 3
"""Checks between the fields whose difference tells what the velocity has left to go."""
SHARE_OF_FIELD: Final = 0.5
"""What means have left to go, at most, over what the field has (behind Silk and Enterprise: 0.1 to 0.5)."""
SHARE_OF_MEAN_FIELD: Final = 0.1
"""The same for the error of a mean about which they move: place by place it is much less well known (C0038: 6 %)."""
BLOCKS: Final = 8
"""Most blocks of checks whose means a run keeps."""
BATCHES: Final = 6
"""Batches of checks whose means tell how well the mean of all is known."""
LEAST_IN_BATCH: Final = 4
"""Fewest checks of a batch."""
SURE: Final = 3
"""Standard errors that a mean is told to be known to within: Student's 2.6 for six batches (95 %), and some more since
runs end when it looks small (C0038 in cells of 0.4 mm, stopped at 1 %: off by 1.5 % root mean square)."""
NO_MEAN: Final = 0.05
"""What is `left` of a mean that tells less than the last checks do."""
LATEST: Final = 8
"""These checks."""
LEAST_CROSSINGS: Final = 5
"""Times that what swings about a mean must have passed it: what drifts passes it once."""


@dataclass(frozen=True)
class Mean:
    """What is known of the mean over the last checks of a run."""

    checks: int
    """How many."""
    blocks: int
    """Blocks that they are."""
    standard_error: float
    """Of any monitored quantity's mean, the largest, as a fraction of it; inf where the checks do not tell."""
    field_error: float
    """The same of the sac's mean velocity, place by place, root mean square."""

    @property
    def left(self) -> float:
        """What the tolerance is asked of."""
        return max(self.standard_error, SHARE_OF_MEAN_FIELD * self.field_error)


def left_to_settle(history: Floats, velocity: Sequence[NDArray[np.float32]]) -> float:
    """Fraction that a history (checks, quantities) and the last fields (n, 3) have left to go; nan when not finite."""
    return max(quantities_left(history), SHARE_OF_FIELD * field_left(velocity))


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
    return float((_series(last, before) / scale).max())


def field_left(velocity: Sequence[NDArray[np.float32]]) -> float:
    """Fraction that a field has left to go, root mean square; `velocity` (n, 3) at every one of the last checks.

    The mean speed behind a braid falls at once and then rises for half a second as the vortex finds its place: at the
    turn nothing of the mean seems to be left, but 5 % is. A field's change does not pass through zero.
    """
    if len(velocity) < 2 * CHECKS_APART + 1:
        return float("inf")
    now, then, before = (velocity[-1 - k * CHECKS_APART] for k in range(3))
    last, earlier = np.linalg.norm(now - then), np.linalg.norm(then - before)
    return float(_series(last, earlier) / max(float(np.linalg.norm(now)), 1e-30))


def _series(last: Any, before: Any) -> Any:
    """What is left of changes that go on shrinking as from the one before to the last: a geometric series."""
    shrinking = np.clip(last / np.maximum(before, 1e-30), 0.3, 0.9)
    return last * shrinking / (1 - shrinking)


def with_check(blocks: Sequence[Snapshot], now: Snapshot) -> tuple[Snapshot, ...]:
    """Means over blocks of as many checks each, the last one growing, with one more check.

    When there are too many, every two become one.
    """
    if blocks and blocks[-1].checks < blocks[0].checks:
        return *blocks[:-1], blocks[-1].and_also(now)
    if len(blocks) == BLOCKS:
        blocks = [first.and_also(second) for first, second in zip(blocks[::2], blocks[1::2], strict=True)]
    return *blocks, now


def mean_of(blocks: Sequence[Snapshot], history: Floats, sac: Ints) -> Mean:
    """Choose the last blocks of a run, half of its checks at least, whose mean is known best.

    (White 1997, Simulation 69, 323: what comes before the steady state is left out so as to make the rest's standard
    error least.) The velocity of the `sac` (n,), place by place, is asked for a tenth as much. Where no mean is known,
    the last `LATEST` checks or some more: as little as may be of what came before.
    """
    lengths = np.cumsum([block.checks for block in blocks[::-1]])
    enough = range(int(np.searchsorted(lengths, 0.5 * lengths[-1])), len(blocks))

    def mean(last: int) -> Mean:
        checks = int(lengths[last])
        error = standard_error(history[-checks:])
        of_field = field_error(blocks[-last - 1 :], sac) if np.isfinite(error) else error
        return Mean(checks, last + 1, error, of_field)

    best = min((mean(last) for last in enough), key=lambda one: one.left)
    return best if best.left < NO_MEAN else mean(min(int(np.searchsorted(lengths, LATEST)), len(blocks) - 1))


def field_error(blocks: Sequence[Snapshot], cells: Ints) -> float:
    """Standard error of the mean velocity of cells (n,) over blocks, root mean square, from the means of both halves.

    As a fraction of it; inf of a single block.
    """
    if len(blocks) < 2:
        return float("inf")
    half = len(blocks) // 2
    before, after = (
        np.average([one.velocity[cells] for one in part], axis=0, weights=[one.checks for one in part])
        for part in (blocks[:half], blocks[half:])
    )
    return float(np.linalg.norm(after - before) / max(float(np.linalg.norm(after + before)), 1e-30))


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
