"""Stored results of the flows of a ranking, so that an interrupted one goes on."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vstent.devices.treatment import BARE
from vstent.flow.settings import FlowSettings
from vstent.plan.rank import Candidate
from vstent.study.folder import CACHE
from vstent.study.keys import key_of
from vstent.study.store import Key, Store


class FlowStore:
    """Results by candidate, in the store of a case folder.

    Parameters
    ----------
    out : the case folder.
    anatomy : key of the artery.
    settings : settings of the flows.
    """

    def __init__(self, out: Path, anatomy: Key, settings: FlowSettings) -> None:
        self.folder = out / CACHE
        self._store, self._anatomy, self._settings = Store(self.folder), anatomy, settings
        self._lost: dict[str, Any] = {}

    def get(self, candidate: Candidate | None) -> Mapping[str, Any] | None:
        """Return the result with a candidate (None: without a device), or None if there is none of these numbers."""
        name = _name_of(candidate)
        return self._lost.get(name, self._store.record(name, self._key(candidate)).get("values"))

    def __setitem__(self, candidate: Candidate | None, result: Mapping[str, Any]) -> None:
        self._store.write(_name_of(candidate), self._key(candidate), {}, values=dict(result))

    def lose(self, candidate: Candidate, why: str) -> None:
        """Remember, for this run only, that a flow was lost with the process that computed it."""
        self._lost[_name_of(candidate)] = {"error": why}

    def _key(self, candidate: Candidate | None) -> Key:
        """Return the key of a result."""
        device = None
        if candidate is not None:
            device = replace(candidate.design, facts=(), ranges=()), candidate.size, candidate.shift_mm
        return key_of("vstent.plan.rank_flow", self._anatomy, self._settings, device)


def _name_of(candidate: Candidate | None) -> str:
    """Return the name of a result in the store."""
    if candidate is None:
        return f"rank flow {BARE}"
    return f"rank flow {candidate.design.key} {candidate.size.label} {candidate.shift_mm:+g}"
