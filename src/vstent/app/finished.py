"""Finished: what the study last finished in a case folder has left there, by what its `run.json` says of it."""

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vstent.app.cases import State, dependencies
from vstent.errors import InputError

if TYPE_CHECKING:  # loaded when a folder is looked at, as in `vstent.app.choices`
    from vstent.study.types import Settings

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
        paths = _flows_told(run, run.stat().st_mtime_ns)
    except OSError:
        return {}
    return paths if all(path.is_file() for path in paths.values()) else {}


def lost_steps(folder: Path, state: State) -> set[str]:
    """Return the steps that may have been done and whose results are there no more, or those of another study."""
    lost, flows, keys = set(), kept_flows(folder), dependencies(state)
    if state.choices.flow.is_wanted and not flows:
        lost.add("flow")
    if not (folder / REPORT).is_file():
        lost.add("report")
    if state.choices.flow.is_wanted and flows and state.done.get("flow") == keys["flow"]:
        given = state.model_dump_json(include={"name", "source", "former", "choices"})
        lost |= {"flow", "report"} if flows != _flows_wanted(folder, given) else set()
    return lost


@lru_cache(maxsize=REMEMBERED)
def _flows_wanted(folder: Path, given: str) -> dict[str, Path]:
    """Where the flows of what a case's state (JSON) asks for are to be kept."""
    state = State.model_validate_json(given)
    return _paths(folder, state.source, state.settings())


@lru_cache(maxsize=REMEMBERED)
def _flows_told(run: Path, _written_ns: int) -> dict[str, Path]:
    """Where the flows are to be kept that a `run.json` tells of; nowhere where this version cannot read it."""
    from vstent.study.repeat import UNTOLD, told_in

    try:
        told, settings = told_in(run)
        return _paths(run.parent, str(told["input"]["sha256"]), settings)
    except (*UNTOLD, InputError):
        return {}


def _paths(folder: Path, source: str, settings: "Settings") -> dict[str, Path]:
    """Where a study keeps its flows."""
    from vstent.devices.catalogue import find_design
    from vstent.devices.design import BARE
    from vstent.study.folder import CACHE
    from vstent.study.stages import flow_key

    if settings.flow is None:
        return {}
    designs = {BARE: None} | {name: find_design(name) for name in settings.devices}
    keys = {name: flow_key(source, settings, name, design) for name, design in designs.items()}
    return {name: folder / CACHE / f"flow {name}-{key}.npz" for name, key in keys.items()}
