"""Store the state of an unfinished flow computation in the cache of a case folder."""

from pathlib import Path

import numpy as np

from vstent.flow.engines import Saved
from vstent.io.archive import DAMAGE
from vstent.io.files import atomic


class FlowCheckpoint:
    """Saved states of the runs of one flow computation, one file per run.

    The ledger deletes these files when it stores the finished flow, because their names begin with the flow's name.

    Parameters
    ----------
    folder : cache folder of the case.
    flow : name of the flow in the ledger.
    key : key of everything that the flow depends on.
    """

    def __init__(self, folder: Path, flow: str, key: str) -> None:
        self._folder, self._flow, self._key = folder, flow, key

    def load(self, run: str) -> Saved | None:
        """Return the last saved state of a run; None where there is none, or it is damaged."""
        try:
            with self._path(run).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except DAMAGE:
            return None

    def save(self, run: str, saved: Saved) -> None:
        """Store the state of a run; it replaces the one before."""
        with atomic(self._path(run)) as partial, partial.open("wb") as file:
            np.savez(file, **saved)  # type: ignore[arg-type]

    def _path(self, run: str) -> Path:
        """Return the file of a run."""
        return self._folder / f"{self._flow}-{self._key}-{run}.running.npz"
