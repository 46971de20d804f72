"""Whether a steady lattice-Boltzmann run may stop: it has converged, or its time averages are known well enough."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.state import Snapshot
from vstent.flow.stopping import quantities_left, series_left, standard_error
from vstent.kernels.arrays import Floats, Ints

CHECKS_APART: Final = 3
"""Number of checks between the fields whose difference estimates the distance of the velocity from convergence."""
SHARE_OF_FIELD: Final = 0.5
"""Largest ratio of the distance of means from convergence to that of the field (with Silk and Enterprise: 0.1-0.5)."""
SHARE_OF_MEAN_FIELD: Final = 0.1
"""The same ratio for the error of time averages, which is much larger for local values (C0038: 6 %)."""
BLOCKS: Final = 8
"""Largest number of blocks of checks whose means are kept."""
NO_MEAN: Final = 0.05
"""Error of a mean above which the last checks are used instead."""
LATEST: Final = 8
"""Number of the last checks that are averaged then."""


@dataclass(frozen=True)
class Mean:
    """The mean over the last checks of a run, and its error."""

    checks: int
    """Number of checks."""
    blocks: int
    """Number of blocks that they form."""
    standard_error: float
    """Largest relative standard error of the monitored quantities; inf where there are too few checks."""
    field_error: float
    """Root-mean-square relative error of the local mean velocity in the sac."""

    @property
    def left(self) -> float:
        """Error that is compared with the tolerance."""
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
