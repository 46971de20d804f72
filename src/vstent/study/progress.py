"""Progress of a study, as a record; sentences are made of it by whoever shows it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class Progress:
    """State of a stage of a study."""

    stage: str
    """Name of the stage: a word, and the treatment and implant it is about, such as ``deploy silk``."""
    fraction: float
    """Completed fraction: 0 as the stage begins, 1 as it ends."""
    detail: str = ""
    """Result of a finished stage, or what is being done, in words."""
    residual: float | None = None
    """Largest expected remaining change of any monitored quantity of a flow, as a fraction; None: unknown."""
    seconds_left: float | None = None
    """Estimated remaining run time in s; None: unknown."""
    computed: Any = None
    """What is about to be measured (`vstent.study.pipeline.Computed`), where the stage ``measure`` begins."""


OnProgress = Callable[[Progress], None]
"""Called at every stage of a study."""
