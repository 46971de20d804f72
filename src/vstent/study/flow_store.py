"""Stored results of the flows of a ranking, so that an interrupted one goes on."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vstent.devices.treatment import BARE
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Anatomy
from vstent.io.writers import write_json
from vstent.plan.rank import Candidate
from vstent.study.folder import CACHE
from vstent.study.ledger import DEPLOYMENT_VERSION, key_of


class FlowStore:
    """Results by candidate, in a file of the cache folder for an anatomy and settings of the flow.

    Parameters
    ----------
    out : the case folder.
    anatomy : the artery, which its surfaces identify.
    settings : settings of the flows.
    """

    def __init__(self, out: Path, anatomy: Anatomy, settings: FlowSettings) -> None:
        lumen, landing = anatomy.vessel.lumen, anatomy.parent.landing_surface
        shape = [lumen.volume_mm3, lumen.area_mm2, landing.area_mm2, *landing.vertices_mm.mean(axis=0).tolist()]
        self.folder = out / CACHE
        self._path = self.folder / f"rank-flow-{key_of(shape, settings)}.json"
        self._lost: dict[str, Any] = {}
        try:
            self._found: dict[str, Any] = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._found = {}

    def get(self, candidate: Candidate | None) -> Mapping[str, Any] | None:
        """Return the result with a candidate (None: without a device), or None if there is none of these numbers."""
        name = _name_of(candidate)
        return self._lost.get(name, self._found.get(name))

    def __setitem__(self, candidate: Candidate | None, result: Mapping[str, Any]) -> None:
        self._found[_name_of(candidate)] = dict(result)
        write_json(self._path, self._found, is_exact=True)

    def lose(self, candidate: Candidate, why: str) -> None:
        """Remember, for this run only, that a flow was lost with the process that computed it."""
        self._lost[_name_of(candidate)] = {"error": why}


def _name_of(candidate: Candidate | None) -> str:
    """Return the name of a result; it contains a digest of the device's numbers, because a catalogue can change."""
    if candidate is None:
        return BARE
    key = key_of(DEPLOYMENT_VERSION, candidate.design, candidate.size, candidate.shift_mm)
    return f"{candidate.label} {key}"
