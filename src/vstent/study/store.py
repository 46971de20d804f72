"""Store of a case folder: results by content, the run times that they took, and the states of unfinished runs.

A result lies in the cache folder under its name and its `Key`. ``NAME-KEY.json`` is its record: the run time of every
stage that it took, and its values if they are plain. ``NAME-KEY.npz`` holds a data class. The record is written last,
so a result with a record is complete. Older results of its name are deleted after that, except the latest flows of the
same code: a study that goes back to former settings finds them.

This module imports no numerical library, so that `vstent.cli.finished` can answer at once.
"""

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from vstent.errors import VstentError
from vstent.io.files import atomic, states_of, write_bytes
from vstent.study.progress import OnProgress, Progress

if TYPE_CHECKING:
    from vstent.flow.engines import Saved

Result = TypeVar("Result")
KEPT: Final = 3
"""Number of flows of one name that are kept."""
KEY_DIGITS: Final = 12
"""Number of hexadecimal digits of each part of a key."""
UNREADABLE: Final = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""Exceptions that reading a missing, damaged or foreign JSON file raises."""


class Key(NamedTuple):
    """Key of a result: what it was computed from."""

    given: str
    """Digest of the input and the settings."""
    code: str
    """Digest of the code that computes it and the results that it uses."""

    def __str__(self) -> str:
        """Return the key as it stands in names of files."""
        return f"{self.given}-{self.code}"


def digest(value: Any) -> str:
    """Return a short digest of plain values and data classes."""
    return hashlib.sha256(json.dumps(_plain(value), sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]


def _plain(value: Any) -> Any:
    """Return a value as JSON types; of a key only what was given."""
    if isinstance(value, Key):
        return value.given
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def silent(progress: Progress) -> None:
    """Report nothing."""


class Store:
    """Measures the time of the stages, reports their progress, and stores and finds their results.

    `folder` is the cache folder of the case. Every result has a name and a key. It is a data class, or plain values.
    """

    def __init__(self, folder: Path, progress: OnProgress = silent) -> None:
        self.folder, self._report = folder, progress
        self.seconds: dict[str, float] = {}
        self._deferred: dict[str, Callable[[], None]] = {}
        self._before: dict[str, set[str]] = {}

    def progress(self, stage: str, fraction: float, detail: str, **more: Any) -> None:
        """Report the progress of a stage; the arguments are the fields of a `Progress`."""
        self._report(Progress(stage, fraction, detail, **more))

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[str], None]]:
        """Report the start of a stage, measure its time, and report its result.

        The yielded function takes a sentence on the result.
        """
        sentences: list[str] = []
        self.progress(name, 0.0, "")
        began = time.perf_counter()
        yield sentences.append
        self.seconds[name] = time.perf_counter() - began
        self.progress(name, 1.0, " ".join(sentences))

    def foretell(self, keys: Mapping[str, Key]) -> None:
        """Report in one sentence which results were computed by other code, and how long computing them again takes."""
        seconds: dict[str, dict[str, float]] = {}
        for name, key in keys.items():
            if not self.record(name, key):
                for file in self._files(name):
                    given, code = file.name.removeprefix(f"{name}-").partition(".")[0].split("-")[:2]
                    record = self.record(name, Key(given, code)) if given == key.given else {}
                    if record:
                        seconds[name] = record["seconds"]
        if seconds:
            total_s = sum({stage: took for stages in seconds.values() for stage, took in stages.items()}.values())
            self.progress(
                "stored results",
                1.0,
                f"computed with other code: {', '.join(seconds)}; computing them again takes about "
                f"{max(1.0, total_s):.0f} s, and they are kept until then.",
            )

    # -- data classes --------------------------------------------------------------------------------------------------

    def find(self, name: str, key: Key, kind: type[Result]) -> Result | None:
        """Return the result stored under a key, report it and add its run time; None where it is missing or damaged."""
        self._before[name] = set(self.seconds)
        record = self.record(name, key)
        if not record:
            return None
        self.progress(name, 0.0, "")
        result = self.load(name, key, kind)
        if result is not None:
            self._tell_done(name, record)
        return result

    def load(self, name: str, key: Key, kind: type[Result]) -> Result | None:
        """Return the result stored under a key, without a report of it; None where it is missing or damaged."""
        from vstent.io.archive import load_data

        with suppress(OSError, VstentError):
            return load_data(self.path(name, key), kind) if self.record(name, key) else None
        return None

    def save(self, name: str, key: Key, result: Any) -> None:
        """Store a result under a key; older results of the same name are deleted as in `write`."""
        self.saver(name, key, result)()

    def saver(self, name: str, key: Key, result: Any) -> Callable[[], None]:
        """Return a function that does what `save` does, with the run times of the stages until now."""
        seconds = {stage: took for stage, took in self.seconds.items() if stage not in self._before.get(name, ())}

        def save() -> None:
            from vstent.io.archive import save_data

            save_data(self.path(name, key), result)
            self.write(name, key, seconds)

        return save

    def defer(self, name: str, key: Key, result: Any) -> None:
        """Store a result when `save_deferred` is called, because a later input may still prove unusable."""
        self._deferred[name] = self.saver(name, key, result)

    def is_deferred(self, name: str) -> bool:
        """Return whether a result of this name is in memory and not stored yet."""
        return name in self._deferred

    def save_deferred(self) -> None:
        """Store all deferred results; from here on files are written."""
        for save in self._deferred.values():
            save()
        self._deferred.clear()

    # -- files and plain values ----------------------------------------------------------------------------------------

    def write_once(self, name: str, key: Key, folder: Path, files: Iterable[str], write: Callable[[], str]) -> None:
        """Write the files of a stage unless they are there, unchanged since they were written under this key.

        `write` writes the `files` of the folder and returns a sentence.
        """
        record = self.record(name, key)
        if record and record.get("files") == states_of(folder, files):
            self._tell_done(name, record)
            return
        with self.stage(name) as tell:
            tell(write())
        self.write(name, key, {name: self.seconds[name]}, files=states_of(folder, files))

    def compute_once(self, name: str, key: Key, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the plain values of a stage, computed unless they are stored under this key; their order is kept."""
        record = self.record(name, key)
        if isinstance(record.get("values"), dict):
            self._tell_done(name, record)
            return dict(record["values"])
        with self.stage(name):
            values = compute()
        self.write(name, key, {name: self.seconds[name]}, values=values)
        return values

    def unfinished(self, name: str, key: Key) -> "Unfinished":
        """Return the saved states of the runs of an unfinished result; they are deleted when the result is stored."""
        return Unfinished(self.folder, f"{name}-{key}")

    # -- files of the store --------------------------------------------------------------------------------------------

    def path(self, name: str, key: Key, suffix: str = ".npz") -> Path:
        """Return the file of a result."""
        return self.folder / f"{name}-{key}{suffix}"

    def record(self, name: str, key: Key) -> dict[str, Any]:
        """Return the record of a result: run times, and values or states of files; empty where it is not complete."""
        with suppress(*UNREADABLE):
            record = json.loads(self.path(name, key, ".json").read_text(encoding="utf-8"))
            return record | {"seconds": {str(stage): float(took) for stage, took in record["seconds"].items()}}
        return {}

    def write(self, name: str, key: Key, seconds: Mapping[str, float], **more: Any) -> None:
        """Write the record of a result, with which it is complete, and delete older results of the same name.

        The latest flows by the same code are kept. The record states the run time of every stage that the result took,
        and values or states of files.
        """
        write_bytes(self.path(name, key, ".json"), json.dumps({"seconds": seconds} | more).encode())
        files = self._files(name)
        alike = [file for file in files if file.name.endswith(f"-{key.code}.json") and name.startswith("flow ")]
        alike.sort(key=lambda file: file.stat().st_mtime_ns)
        kept = {self.path(name, key).stem, *(file.stem for file in alike[-KEPT:])}
        for file in files:
            if not any(file.name.startswith(f"{stem}.") for stem in kept):
                with suppress(OSError):
                    file.unlink()

    def _files(self, name: str) -> list[Path]:
        """Return the files of all results of a name, of unfinished ones too."""
        part = f"[0-9a-f]{{{KEY_DIGITS}}}"
        form = re.compile(rf"{re.escape(name)}-{part}-{part}[-.].+")
        with suppress(OSError):
            return [file for file in self.folder.iterdir() if form.fullmatch(file.name)]
        return []

    def _tell_done(self, name: str, record: Mapping[str, Any]) -> None:
        """Report that a result is there, and add its run times."""
        self.seconds |= record["seconds"]
        self.progress(name, 1.0, "already done")


class Unfinished:
    """Saved states of the runs of an unfinished computation, one file per run (`vstent.flow.simulation.Checkpoint`)."""

    def __init__(self, folder: Path, stem: str) -> None:
        self._folder, self._stem = folder, stem

    def load(self, run: str) -> "Saved | None":
        """Return the last saved state of a run; None where there is none, or it is damaged."""
        import numpy as np

        from vstent.io.archive import DAMAGE

        try:
            with self._path(run).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except DAMAGE:
            return None

    def save(self, run: str, saved: "Saved") -> None:
        """Store the state of a run; it replaces the one before."""
        import numpy as np

        with atomic(self._path(run)) as partial_file, partial_file.open("wb") as file:
            np.savez(file, **saved)  # type: ignore[arg-type]

    def _path(self, run: str) -> Path:
        """Return the file of a run."""
        return self._folder / f"{self._stem}-{run}.running.npz"
