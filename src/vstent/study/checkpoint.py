"""Checkpoint: a flow under way, kept in the case's cache until it is done."""

from pathlib import Path

import numpy as np

from vstent.flow.engines import Saved
from vstent.io.archive import DAMAGE
from vstent.io.files import atomic


class FlowCheckpoint:
    """One file for each run of a flow (the guesses and the answer), replaced whole.

    The ledger drops them when it keeps the flow itself, for their names begin as its own.
    """

    def __init__(self, folder: Path, flow: str, key: str) -> None:
        self._folder, self._flow, self._key = folder, flow, key

    def load(self, run: str) -> Saved | None:
        """Return what was saved of a run last; None where nothing was, or it is damaged."""
        try:
            with self._path(run).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except DAMAGE:
            return None

    def save(self, run: str, saved: Saved) -> None:
        """Keep the state of a run instead of the one before."""
        with atomic(self._path(run)) as partial, partial.open("wb") as file:
            np.savez(file, **saved)  # type: ignore[arg-type]

    def _path(self, run: str) -> Path:
        return self._folder / f"{self._flow}-{self._key}-{run}.running.npz"
