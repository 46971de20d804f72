"""Stopping criterion of a steady lattice-Boltzmann run: convergence, or time averages of sufficient accuracy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.state import Snapshot
from vstent.flow.stopping import series_left, standard_error
from vstent.kernels.arrays import Floats, Ints

CHECKS_APART: Final = 3
"""Number of checks between two velocity fields. Their difference serves to estimate the distance from convergence."""
SHARE_OF_FIELD: Final = 0.5
"""Weight of the velocity field's distance from convergence relative to that of the monitored quantities. With Silk and
Enterprise the distance of the quantities is 0.1 to 0.5 of that of the field."""
SHARE_OF_MEAN_FIELD: Final = 0.1
"""Weight of the statistical error of the local mean velocity relative to that of the monitored quantities. Local values
have a much larger error (C0038: 6 %)."""
BLOCKS: Final = 8
"""Maximum number of blocks of checks whose means are kept."""
NO_MEAN: Final = 0.05
"""Relative error above which a time average counts as unknown. The last `LATEST` checks are then averaged instead."""
LATEST: Final = 8
"""Number of last checks that are averaged when no time average is known."""


@dataclass(frozen=True)
class Mean:
    """Time average over the last checks of a run, and its statistical error."""

    checks: int
    """Number of checks in the average."""
    blocks: int
    """Number of blocks that these checks form."""
    standard_error: float
    """Largest relative standard error of the monitored quantities; inf with too few checks."""
    field_error: float
    """Relative standard error of the local mean velocity in the sac, root mean square."""

    @property
    def left(self) -> float:
        """Return the relative error to compare with the tolerance."""
        return max(self.standard_error, SHARE_OF_MEAN_FIELD * self.field_error)


def field_left(velocity: Sequence[NDArray[np.float32]]) -> float:
    """Return the expected remaining change of a velocity field as a fraction of it, root mean square.

    The field is used beside the monitored means because the change of a mean can pass through zero. Behind a braided
    stent the mean speed in the sac drops quickly and then rises for half a second while the vortex moves to its final
    position. At the turning point the mean seems converged although it will still change by 5 %.
    """
    if len(velocity) < 2 * CHECKS_APART + 1:
        return float("inf")
    now, then, before = (velocity[-1 - k * CHECKS_APART] for k in range(3))
    last, earlier = np.linalg.norm(now - then), np.linalg.norm(then - before)
    return float(series_left(last, earlier) / max(float(np.linalg.norm(now)), 1e-30))


def with_check(blocks: Sequence[Snapshot], now: Snapshot) -> tuple[Snapshot, ...]:
    """Return the block means of a run with one more check added.

    All blocks hold the same number of checks except the last, which is still being filled. When `BLOCKS` blocks are
    full, each pair is merged into one.
    """
    if blocks and blocks[-1].checks < blocks[0].checks:
        return *blocks[:-1], blocks[-1].and_also(now)
    if len(blocks) == BLOCKS:
        blocks = [first.and_also(second) for first, second in zip(blocks[::2], blocks[1::2], strict=True)]
    return *blocks, now


def mean_of(blocks: Sequence[Snapshot], history: Floats, sac: Ints) -> Mean:
    """Choose the last blocks of a run whose average has the smallest estimated error.

    At least half of all checks are averaged. The start of the run is left out so that the standard error of the
    remainder is smallest. Where the error exceeds `NO_MEAN`, the last `LATEST` checks are averaged instead (rounded up
    to whole blocks), so that little of the initial transient enters.

    References
    ----------
    White 1997, Simulation 69, 323: truncation that minimises the standard error.
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
    """Return the relative standard error of the mean velocity of `cells` (n,), root mean square.

    It is estimated from the difference between the averages of the first and the second half of the blocks. inf with a
    single block.
    """
    if len(blocks) < 2:
        return float("inf")
    half = len(blocks) // 2
    before, after = (
        np.average([one.velocity[cells] for one in part], axis=0, weights=[one.checks for one in part])
        for part in (blocks[:half], blocks[half:])
    )
    return float(np.linalg.norm(after - before) / max(float(np.linalg.norm(after + before)), 1e-30))
