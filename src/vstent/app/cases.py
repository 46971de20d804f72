"""Cases of the page: the user's choices, the state of every step, and the file that stores them."""

import asyncio
import hashlib
import json
import re
import shutil
import threading
from collections.abc import Iterator, Set
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vstent.app.choices import Choices
from vstent.errors import InputError, ReadError
from vstent.io.files import write_bytes
from vstent.study.folder import refuse_older
from vstent.study.settings import Settings

STATE: Final = "app.json"
"""File of a case folder that stores the page's state."""
STEPS: Final = ("image", "vessel", "sac", "device", "deploy", "flow", "report")
"""Steps of the page, from left to right."""
UNDOS: Final = 100
"""Number of changes that can be undone."""

Status = Literal["todo", "running", "done", "stale", "failed"]
"""Status of a step; stale: finished with other choices than the present ones."""


class Conflict(InputError):
    """The case was changed elsewhere since this client last read it."""


class Absent(ReadError):
    """There is no case of that name."""


class State(BaseModel):
    """State of a case, as stored in its folder."""

    model_config = ConfigDict(frozen=True)

    name: str
    """Display name of the case."""
    revision: int = 0
    """Number of changes so far, by which clients detect changes made elsewhere."""
    input: str = ""
    """Path of the scan or surface: inside the case folder, or elsewhere if it was given to the command."""
    source: str = ""
    """SHA-256 of the input."""
    former: dict[str, Any] = Field(default_factory=dict)
    """Settings of the study that the case was opened from (its `run.json`); empty for a case begun on the page."""
    choices: Choices = Choices()
    """Present choices."""
    undo: tuple[Choices, ...] = ()
    """Earlier choices, the latest last."""
    redo: tuple[Choices, ...] = ()
    """Undone choices, the latest last."""
    done: dict[str, str] = Field(default_factory=dict)
    """Digest of everything that a finished step depended on, by step."""
    failed: dict[str, str] = Field(default_factory=dict)
    """Error message of every failed step, by step."""
    failed_with: dict[str, str] = Field(default_factory=dict)
    """Digest of everything that a failed step depended on, by step."""
    anatomy: str = ""
    """Key of the anatomy in the case folder."""
    job: str = ""
    """Kind of the running job, also after the server was killed."""

    def former_settings(self) -> Settings:
        """Return the settings that the page cannot change.

        Raises ReadError: they belong to a study of another version.
        """
        from vstent.study.repeat import settings_of

        try:
            return settings_of(self.former) if self.former else Settings()
        except ValueError:
            raise ReadError(
                f"{self.name} was opened from a study of another version of vstent. Open its scan again."
            ) from None

    def settings(self) -> Settings:
        """Return the settings of the study."""
        return self.choices.settings(self.former_settings())

    def unseen(self) -> list[str]:
        """Return the settings, with their values, that the page cannot change and that differ from its own."""
        return list(_differences(asdict(self.settings()), asdict(self.choices.settings(Settings()))))


def _differences(given: dict[str, Any], usual: dict[str, Any], before: str = "") -> Iterator[str]:
    """Yield names of settings that differ from the usual ones, with their values where those are short."""
    from vstent.reporting.quantities import format_value, split_unit  # late, as everything that a page can wait for

    for name, value in given.items():
        if isinstance(value, dict) and isinstance(usual[name], dict):
            yield from _differences(value, usual[name], f"{before}{name} ")
        elif value != usual[name]:
            said = "" if isinstance(value, dict | tuple) else f" {format_value(name, value)}"
            yield f"{before}{split_unit(name)[0].replace('_', ' ')}{said}"


OF_IMAGE: Final = ("units", "frame", "spacing_mm", "shape", "crop_mm", "threshold", "at_mm")
"""Choices on which the step Image depends."""


def dependencies(state: State) -> dict[str, str]:
    """Return a digest of everything that each step depends on, by step."""
    chosen = state.choices.model_dump(mode="json")
    treatments = chosen["treatments"]
    placings = [[implant.pop("placing") for implant in treatment["implants"]] for treatment in treatments]
    parts: dict[str, Any] = {
        "image": [state.source, *(chosen[name] for name in OF_IMAGE)],
        "vessel": [chosen[name] for name in ("inlet_mm", "upstream_mm", "downstream_mm")],
        "sac": [chosen["outlet_mm"], chosen["neck_mm"], chosen["without_aneurysm"]],
        "device": treatments,
        "deploy": placings,
        "flow": chosen["flow"],
        "report": chosen["uncertainty_samples"],
    }
    digest, found = "", {}
    for step in STEPS:
        digest = hashlib.sha256(json.dumps([digest, parts[step]]).encode()).hexdigest()[:16]
        found[step] = digest
    return found


def failures(state: State) -> dict[str, str]:
    """Return the error messages, by step, of the steps that failed with the present choices."""
    keys = set(dependencies(state).values())
    return {step: why for step, why in state.failed.items() if state.failed_with.get(step) in keys}


def statuses(state: State, at_work: str, lost: Set[str]) -> dict[str, Status]:
    """Return the status of every step."""
    keys, failed = dependencies(state), failures(state)
    # A report without its flows, as after an update of vstent, is as old as they are.
    old = {"flow", "report"} if "flow" in lost and "report" not in lost else set()

    def status(step: str) -> Status:
        if step == at_work:
            return "running"
        if step in failed:
            return "failed"
        if step not in state.done or step in lost - old:
            return "todo"
        return "done" if state.done[step] == keys[step] and step not in old else "stale"

    return {step: status(step) for step in STEPS}


class Case:
    """A case folder that several browser tabs may read and change, one change at a time; `id` is its name in URLs."""

    def __init__(self, case_id: str, folder: Path, state: State) -> None:
        self.id, self.folder = case_id, folder
        self._state = state
        self._lock = threading.RLock()
        self._listeners: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()

    @property
    def state(self) -> State:
        """Present state: choices and results of the steps."""
        return self._state

    @property
    def input(self) -> Path:
        """Path of the scan or surface.

        Raises ReadError: there is no input yet.
        """
        if not self._state.input:
            raise ReadError(f"{self._state.name} has no scan yet. Drop one on the page.")
        return self.folder / self._state.input

    def change(self, revision: int, choices: Choices) -> State:
        """Replace the choices, based on a revision.

        Raises Conflict: the case was changed since that revision.
        """
        with self._lock:
            self._check(revision)
            before = self._state
            if choices == before.choices:
                return before
            undo = (*before.undo, before.choices)[-UNDOS:]
            return self.update(choices=choices, undo=undo, redo=(), revision=before.revision + 1)

    def step_back(self, revision: int, *, forward: bool = False) -> State:
        """Undo the last change, or redo the last undone one.

        Raises Conflict: the case was changed since that revision, or there is nothing to undo or redo.
        """
        with self._lock:
            self._check(revision)
            now = self._state
            taken, given = (now.redo, now.undo) if forward else (now.undo, now.redo)
            if not taken:
                raise Conflict("There is nothing to redo." if forward else "There is nothing to undo.")
            rest, other = taken[:-1], (*given, now.choices)
            undo, redo = (other, rest) if forward else (rest, other)
            return self.update(choices=taken[-1], undo=undo, redo=redo, revision=now.revision + 1)

    def update(self, **changes: Any) -> State:
        """Change the state, store it, and notify all clients."""
        with self._lock:
            self._state = self._state.model_copy(update=changes)
            write_bytes(self.folder / STATE, self._state.model_dump_json(indent=1).encode())
        self.tell()
        return self._state

    def _check(self, revision: int) -> None:
        """Raise Conflict where the case was changed since a revision."""
        if revision != self._state.revision:
            raise Conflict("This case was changed in another window. The page now shows that change; make yours again.")

    def tell(self) -> None:
        """Notify all clients of a change."""
        for loop, event in tuple(self._listeners):
            with suppress(RuntimeError):  # the event loop of a closed client is closed
                loop.call_soon_threadsafe(event.set)

    def listen(self) -> asyncio.Event:
        """Return an event that is set at every change; to be called in the client's event loop."""
        event = asyncio.Event()
        self._listeners.add((asyncio.get_running_loop(), event))
        return event

    def leave(self, event: asyncio.Event) -> None:
        """Stop notifying a client."""
        self._listeners = {pair for pair in self._listeners if pair[1] is not event}


def load(case_id: str, folder: Path) -> Case:
    """Return the case stored in a folder.

    Raises ReadError: the folder holds no state, or one that cannot be read.
    Raises InputError: it was written by an older version.
    """
    refuse_older(folder)
    try:
        state = State.model_validate_json((folder / STATE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ReadError(f"{folder} is not a case of the page: it has no {STATE}.") from None
    except (OSError, ValidationError, UnicodeDecodeError, InputError):
        raise ReadError(
            f"{folder / STATE} is damaged or from another version of vstent: open the scan of the case again."
        ) from None
    return Case(case_id, folder, state)


def identifier(name: str) -> str:
    """Return a name for a folder and a URL: letters, digits, points, dashes and underscores."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-._")[:60]
    return plain or "case"


class Cases:
    """All cases of a workspace folder, and the case given on the command line."""

    def __init__(self, workspace: Path) -> None:
        self.workspace = workspace
        self._cases: dict[str, Case] = {}
        self._lock = threading.Lock()

    def ids(self) -> list[str]:
        """Return the names of all cases, the latest first."""
        found = [path.parent for path in self.workspace.glob(f"*/{STATE}")]
        found.sort(key=lambda folder: -(folder / STATE).stat().st_mtime)
        return list(dict.fromkeys([*self._cases, *(folder.name for folder in found)]))

    def get(self, case_id: str) -> Case:
        """Return a case by its name.

        Raises Absent: there is no such case.
        Raises ReadError: the case is damaged.
        """
        with self._lock:
            if case_id not in self._cases:
                if identifier(case_id) != case_id or not (self.workspace / case_id / STATE).is_file():
                    raise Absent("This case does not exist. Choose one of the list on the first page.")
                self._cases[case_id] = load(case_id, self.workspace / case_id)
            return self._cases[case_id]

    def create(self, name: str, folder: Path | None = None, **known: Any) -> Case:
        """Create a case under a display name, with further fields of its state; without a folder in a new one."""
        with self._lock:
            case_id = free = identifier(name)
            count = 1
            while folder is None and (free in self._cases or (self.workspace / free).exists()):
                count += 1
                free = f"{case_id}-{count}"
            place = folder or self.workspace / free
            place.mkdir(parents=True, exist_ok=True)
            case = Case(free, place, State(name=name[:120], **known))
            self._cases[free] = case
        case.update()
        return case

    def of_input(self, path: Path) -> Case | None:
        """Return the case whose input is this file; None where there is none."""
        for case_id in self.ids():
            with suppress(ReadError):
                case = self.get(case_id)
                if case.state.input == str(path):
                    return case
        return None

    def remove(self, case: Case) -> None:
        """Delete a case of the workspace with its folder.

        Raises InputError: the folder lies elsewhere, because it was given on the command line.
        """
        if case.folder.resolve().parent != self.workspace.resolve():
            raise InputError(
                f"{case.folder} is not in the folder of the page's cases. Delete it there if you do not need it."
            )
        with self._lock:
            self._cases.pop(case.id, None)
            shutil.rmtree(case.folder)
        case.tell()

    def adopt(self, folder: Path) -> Case:
        """Add a case folder outside the workspace."""
        case = load(identifier(folder.resolve().name), folder.resolve())
        with self._lock:
            self._cases[case.id] = case
        return case
