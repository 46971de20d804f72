"""Results of the last finished study in a case folder, found through its `run.json`; such folders as cases."""

import glob
import json
from functools import lru_cache
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from vstent.app.cases import STEPS, Case, Cases, State, dependencies
from vstent.app.choices import Choices
from vstent.devices.treatment import BARE
from vstent.errors import InputError, ReadError
from vstent.study.folder import CACHE, INPUT, RUN
from vstent.study.settings import Settings
from vstent.study.store import KEY_DIGITS, UNREADABLE, Store

REPORT: Final = "report.html"
"""File of the case folder with the report."""
REMEMBERED: Final = 256
"""Number of `run.json` files whose content is kept in memory."""


def kept_flows(folder: Path) -> dict[str, Path]:
    """Return the files of all flows of the last finished study by name, ``bare`` first; empty where one is missing.

    A later study that was stopped may have replaced flows by those of other settings.
    """
    run = folder / RUN
    try:
        paths = _flows_told(run, run.stat().st_mtime_ns)
    except OSError:
        return {}
    return paths if all(path.is_file() for path in paths.values()) else {}


def shown_flows(folder: Path, state: State) -> dict[str, Path]:
    """Return the files of the flows to show by name: while they are computed, those that are finished."""
    if state.job != "flow":
        return kept_flows(folder)
    try:
        paths = _flows_wanted(folder, _given(state))
    except InputError:  # a device that does not exist: the job says so
        return {}
    return {name: path for name, path in paths.items() if path.is_file() and paths[BARE].is_file()}


def kept_histories(folder: Path) -> dict[str, Path]:
    """Return the stored contrast of all flows of the last finished study by name; empty where one is missing."""
    flows = kept_flows(folder)
    if not flows:
        return {}
    from vstent.study.contrast import written

    told, found = written(folder), {}
    for name, path in flows.items():
        if told.get(name, {}).get("flow") != path.stem.removeprefix(f"flow {name}-"):
            return {}
        key = "-".join(2 * ["?" * KEY_DIGITS])  # one file, since the store deletes those of other settings
        found[name] = next(path.parent.glob(f"contrast {glob.escape(name)}-{key}.npz"), path.with_name("absent"))
    return found if all(path.is_file() for path in found.values()) else {}


def lost_steps(folder: Path, state: State) -> set[str]:
    """Return the steps whose results are missing or belong to another study."""
    lost, flows, keys = set(), kept_flows(folder), dependencies(state)
    if state.choices.flow.is_wanted and not flows:
        lost.add("flow")
    if not (folder / REPORT).is_file():
        lost.add("report")
    if state.choices.flow.is_wanted and flows and state.done.get("flow") == keys["flow"]:
        lost |= {"flow", "report"} if flows != _flows_wanted(folder, _given(state)) else set()
    return lost


def are_flows_stored(folder: Path, state: State) -> bool:
    """Return whether all flows of the present choices were computed before the last study, which had others."""
    done, keys = state.done, dependencies(state)
    if not state.choices.flow.is_wanted or done.get("sac") != keys["sac"] or done.get("flow") in (None, keys["flow"]):
        return False
    try:
        paths = _flows_wanted(folder, _given(state)).values()
    except InputError:
        return False
    return all(path.with_suffix(".json").is_file() for path in paths)


def _given(state: State) -> str:
    """Return what the flows of a case depend on, as JSON."""
    return state.model_dump_json(include={"name", "source", "former", "choices"})


@lru_cache(maxsize=REMEMBERED)
def _flows_wanted(folder: Path, given: str) -> dict[str, Path]:
    """Return the files of the flows that the state of a case (JSON) requests."""
    state = State.model_validate_json(given)
    return _paths(folder, state.source, state.settings())


@lru_cache(maxsize=REMEMBERED)
def _flows_told(run: Path, _written_ns: int) -> dict[str, Path]:
    """Return the files of the flows that a ``run.json`` states; empty where this version cannot read it.

    The time of writing is a parameter so that a changed file is read again.
    """
    from vstent.study.repeat import told_in

    try:
        told, settings = told_in(run)
        return _paths(run.parent, str(told["input"]["sha256"]), settings)
    except (*UNREADABLE, InputError):
        return {}


def _paths(folder: Path, source: str, settings: Settings) -> dict[str, Path]:
    """Return the files in which a study stores its flows, by name."""
    from vstent.study.keys import study_keys

    flows = {name: key for name, key in study_keys(source, settings).items() if name.startswith("flow ")}
    return {name.removeprefix("flow "): Store(folder / CACHE).path(name, key) for name, key in flows.items()}


def reopened(cases: Cases, folder: Path) -> Case:
    """Create a case from the folder of a study.

    Raises ReadError: the folder does not state its input and settings, is from another version, or has a setting that
    the page does not support.
    """
    from vstent.study.repeat import told_in

    try:
        told, settings = told_in(folder / RUN)
        source = told["input"]["sha256"]
        where = json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["path"]
    except UNREADABLE:
        raise ReadError(
            f"{folder} was written by another version of vstent. Run the study again, or open its scan."
        ) from None
    try:
        choices = Choices.of(settings)
    except (ValidationError, InputError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise ReadError(f"{folder} has a setting that the page cannot change ({why}). Use `vstent run`.") from None
    anatomy = next((path.stem.removeprefix("anatomy-") for path in (folder / CACHE).glob("anatomy-*.npz")), "")
    known = {"input": where, "source": source, "former": told["settings"], "choices": choices, "anatomy": anatomy}
    state = State(name=folder.name, **known)
    keys = dependencies(state)
    is_whole = choices.flow.is_wanted and not lost_steps(folder, state)
    done = {step: keys[step] for step in (STEPS if is_whole else STEPS[:5])}
    return cases.create(folder.name, folder, done=done, **known)
