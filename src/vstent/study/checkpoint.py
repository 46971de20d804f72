"""Checkpoints of unfinished flow computations, kept in the cache of the case folder."""

from pathlib import Path

import numpy as np

from vstent.flow.engines import Saved
from vstent.io.archive import DAMAGE
from vstent.io.files import atomic


class FlowCheckpoint:
    """Saved states of one flow: one file for each run (coarse starting solutions and the final one).

    Their names start with the name of the flow, so the ledger deletes them when it keeps the finished flow.
    """

    def __init__(self, folder: Path, flow: str, key: str) -> None:
        self._folder, self._flow, self._key = folder, flow, key

    def load(self, run: str) -> Saved | None:
        """Return the last saved state of a run; None where there is none or the file is damaged."""
        try:
            with self._path(run).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except DAMAGE:
            return None

    def save(self, run: str, saved: Saved) -> None:
        """Save the state of a run and replace the previous one."""
        with atomic(self._path(run)) as partial, partial.open("wb") as file:
            np.savez(file, **saved)  # type: ignore[arg-type]

    def _path(self, run: str) -> Path:
        """Return the file of a run."""
        return self._folder / f"{self._flow}-{self._key}-{run}.running.npz"
