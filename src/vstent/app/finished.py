"""Finished: what the study last finished in a case folder has left there, by what its `run.json` says of it."""

import json
from functools import lru_cache
from pathlib import Path
from typing import Final

from vstent.app.cases import State

RUN: Final = "run.json"
"""What a study says of itself."""
REPORT: Final = "report.html"
REMEMBERED: Final = 256
"""So many versions of `run.json` are not read again."""


def kept_flows(folder: Path) -> dict[str, Path]:
    """Return where the flows of the study last finished are kept, ``bare`` first; none where one of them is not.

    A study that began after it and was stopped may have put flows of other settings in their places.
    """
    run = folder / RUN
    try:
        paths = _flows_of(run, run.stat().st_mtime_ns)
    except OSError:
        return {}
    return paths if all(path.is_file() for path in paths.values()) else {}


def lost_steps(folder: Path, state: State) -> set[str]:
    """Return the steps that may have been done and whose results are there no more."""
    lost = set()
    if state.choices.flow.is_wanted and not kept_flows(folder):
        lost.add("flow")
    if not (folder / REPORT).is_file():
        lost.add("report")
    return lost


@lru_cache(maxsize=REMEMBERED)
def _flows_of(run: Path, _written_ns: int) -> dict[str, Path]:
    """Where the flows are to be kept that a `run.json` tells of; nowhere where this version cannot read it."""
    from vstent.device import find_design
    from vstent.errors import InputError
    from vstent.study import CACHE
    from vstent.study.repeat import UNTOLD, settings_of
    from vstent.study.stages import BARE, flow_key

    try:
        told = json.loads(run.read_text(encoding="utf-8"))
        settings, source = settings_of(told["settings"]), str(told["input"]["sha256"])
        designs = {BARE: None} | {name: find_design(name) for name in settings.devices}
    except (*UNTOLD, InputError):
        return {}
    if settings.flow is None:
        return {}
    keys = {name: flow_key(source, settings, name, design) for name, design in designs.items()}
    return {name: run.parent / CACHE / f"flow {name}-{key}.npz" for name, key in keys.items()}
