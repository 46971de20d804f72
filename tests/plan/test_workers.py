"""Work shared by several processes."""

import gc
import operator

from vstent.plan.workers import spread


class Holder:
    """Refers to itself, so that only the garbage collector removes it."""

    def __init__(self) -> None:
        self.itself, self.answers = self, spread(operator.add, 1, [1, 2, 3], jobs=2)


def test_work_that_nobody_finishes_is_collected_without_a_warning() -> None:
    holder = Holder()
    assert next(holder.answers) == 2
    del holder
    gc.collect()
