"""Stored results of the flows of a ranking, so that an interrupted one goes on."""

import json
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any

from vstent.flow.case import FlowSettings
from vstent.geometry.vessel import Anatomy
from vstent.io.writers import write_json
from vstent.study.folder import CACHE
from vstent.study.ledger import key_of


class FlowStore(MutableMapping[str, Mapping[str, Any]]):
    """Results by candidate, in a file of the cache folder for an anatomy and settings of the flow.

    Parameters
    ----------
    out : the case folder.
    anatomy : the artery, which its surfaces identify.
    settings : settings of the flows.
    """

    def __init__(self, out: Path, anatomy: Anatomy, settings: FlowSettings) -> None:
        lumen, landing = anatomy.vessel.lumen, anatomy.landing_surface
        shape = [lumen.volume_mm3, lumen.area_mm2, landing.area_mm2, *landing.vertices_mm.mean(axis=0).tolist()]
        self._path = out / CACHE / f"rank-flow-{key_of(shape, settings)}.json"
        try:
            self._found: dict[str, Any] = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._found = {}

    def __getitem__(self, key: str) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self._found[key]
        return found

    def __setitem__(self, key: str, value: Mapping[str, Any]) -> None:
        self._found[key] = dict(value)
        write_json(self._path, self._found, is_exact=True)

    def __delitem__(self, key: str) -> None:
        del self._found[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)
