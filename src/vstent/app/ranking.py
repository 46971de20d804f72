"""Deploy and rank all sizes of the chosen devices, and store the ranking for the page."""

import os
from typing import Any, Final

from vstent.app.cases import Case
from vstent.app.jobs import RANKING
from vstent.devices.catalogue import find_design
from vstent.io.writers import write_json
from vstent.plan.rank import rank
from vstent.study.folder import CACHE
from vstent.study.ledger import Ledger, anatomy_key
from vstent.study.stages import find_anatomy
from vstent.study.types import Progress

MOST_PROCESSES: Final = 4
"""Largest number of parallel processes."""
WORTH_A_PROCESS: Final = 12
"""Number of sizes whose deployment takes longer than starting another process."""


def rank_sizes(case: Case, progress: Progress) -> None:
    """Rank every size of the chosen devices and store the ranking in the case folder.

    Parameters
    ----------
    case : the case.
    progress : called at every stage.

    Raises
    ------
    InputError
        No device is chosen.
    """
    settings = case.state.settings()
    ledger = Ledger(case.folder / CACHE, progress)
    anatomy = find_anatomy(case.input, case.state.source, settings, ledger)

    def told(n_done: int, n_all: int) -> None:
        progress("rank", min(n_done / n_all, 0.99), f"{n_done} of {n_all} sizes")

    progress("rank", 0.0, "")
    designs = [find_design(name) for name in settings.devices]
    n_sizes = sum(len(design.sizes) for design in designs)
    jobs = min(os.cpu_count() or 1, MOST_PROCESSES, 1 + n_sizes // WORTH_A_PROCESS)
    found = rank(anatomy, designs, jobs=jobs, progress=told)
    rows = found.rows()
    content: dict[str, Any] = {
        "anatomy": anatomy_key(case.state.source, settings),
        "devices": sorted(settings.devices),
        "names": {design.key: design.name for design in designs},
        "rows": rows,
    }
    write_json(case.folder / RANKING, content)
    progress("rank", 1.0, f"{len(found.suitable)} of {len(rows)} sizes are suitable.")
