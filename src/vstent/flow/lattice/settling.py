"""Whether a steady lattice-Boltzmann run is at its end: it has settled, or it swings about a mean that is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.state import Snapshot
from vstent.flow.stopping import quantities_left, series_left, standard_error
from vstent.kernels.arrays import Floats, Ints

CHECKS_APART: Final = 3
"""Checks between the fields whose difference tells what the velocity has left to go."""
SHARE_OF_FIELD: Final = 0.5
"""What means have left to go, at most, over what the field has (behind Silk and Enterprise: 0.1 to 0.5)."""
SHARE_OF_MEAN_FIELD: Final = 0.1
"""The same for the error of a mean about which they move: place by place it is much less well known (C0038: 6 %)."""
BLOCKS: Final = 8
"""Most blocks of checks whose means a run keeps."""
NO_MEAN: Final = 0.05
"""What is `left` of a mean that tells less than the last checks do."""
LATEST: Final = 8
"""These checks."""


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


def field_left(velocity: Sequence[NDArray[np.float32]]) -> float:
    """Fraction that a field has left to go, root mean square; `velocity` (n, 3) at every one of the last checks.

    The mean speed behind a braid falls at once and then rises for half a second as the vortex finds its place: at the
    turn nothing of the mean seems to be left, but 5 % is. A field's change does not pass through zero.
    """
    if len(velocity) < 2 * CHECKS_APART + 1:
        return float("inf")
    now, then, before = (velocity[-1 - k * CHECKS_APART] for k in range(3))
    last, earlier = np.linalg.norm(now - then), np.linalg.norm(then - before)
    return float(series_left(last, earlier) / max(float(np.linalg.norm(now)), 1e-30))


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
