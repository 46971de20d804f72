"""Ledger: finished stages of a study, their run times, and the keys under which they are stored and found."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass, replace
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any, Final, TypeVar

from vstent.errors import ReadError
from vstent.flow.engines import Progress as FlowProgress
from vstent.io.archive import load_data, save_data
from vstent.io.images import files_of
from vstent.io.writers import write_json
from vstent.study.types import Progress, Settings

Result = TypeVar("Result")
"""Data class that a stage returns."""
ANATOMY: Final = "anatomy"
"""Name under which an anatomy is stored."""


class Ledger:
    """Record of a study: times its stages, reports their progress, and stores their results.

    Results are stored under keys that depend on everything that affects them.

    Parameters
    ----------
    folder : folder of the stored results.
    progress : called at each stage.
    """

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.folder, self.progress = folder, progress
        self.seconds: dict[str, float] = {}
        self._held: list[tuple[str, str, Any, dict[str, float]]] = []
        self._before: dict[str, set[str]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[str], None]]:
        """Report the start and end of a stage and time it; the yielded function takes a sentence on the result."""
        found: list[str] = []
        self.progress(name, 0.0, "")
        began = time.perf_counter()
        yield found.append
        self.seconds[name] = time.perf_counter() - began
        self.progress(name, 1.0, " ".join(found))

    def teller(self, name: str) -> Callable[[FlowProgress], None]:
        """Return the function through which a flow engine reports its progress."""

        def tell(progress: FlowProgress) -> None:
            fraction = min(progress.fraction, 0.99)
            change = f"remaining change {progress.residual:.1%}, " if isfinite(progress.residual) else ""
            self.progress(name, fraction, f"{change}{progress.seconds_left:.0f} s left")

        return tell

    def recall(self, name: str, key: str, noun_type: type[Result]) -> Result | None:
        """Return the result stored under a key; None where it is missing or damaged.

        Parameters
        ----------
        name : name of the stage.
        key : key of everything that the result depends on.
        noun_type : data class of the result.
        """
        path = self.folder / f"{name}-{key}.npz"
        self._before[name] = set(self.seconds)
        if not path.exists():
            return None
        self.progress(name, 0.0, "")
        try:
            noun = load_data(path, noun_type)
        except ReadError:
            return None
        self.seconds |= _seconds_of(path)
        self.progress(name, 1.0, "already done")
        return noun

    def hold(self, name: str, key: str, noun: Any) -> None:
        """Store a result under a key once `settle` is called: until then the input may still prove unusable."""
        self._held.append((name, key, noun, self._seconds_since(name)))

    def is_held(self, name: str) -> bool:
        """Return whether a result of this name waits for `settle`."""
        return any(held == name for held, *_ in self._held)

    def settle(self) -> None:
        """Store the results that wait; the case folder is written from here on."""
        for held in self._held:
            self._write(*held)
        self._held.clear()

    def keep(self, name: str, key: str, noun: Any) -> None:
        """Store a result under a key and delete the previous one of the same name."""
        self._write(name, key, noun, self._seconds_since(name))

    def _seconds_since(self, name: str) -> dict[str, float]:
        """Return the run time in s of every stage that contributed to a result."""
        return {stage: took for stage, took in self.seconds.items() if stage not in self._before.get(name, ())}

    def _write(self, name: str, key: str, noun: Any, seconds: dict[str, float]) -> None:
        """Write a result with its run times, and delete older ones of the same name."""
        path = self.folder / f"{name}-{key}.npz"
        self.folder.mkdir(parents=True, exist_ok=True)
        told = path.with_suffix(".json")
        stale = set(self.folder.glob(f"{name}-*")) - {path, told}
        write_json(told, seconds, is_exact=True)
        save_data(path, noun)
        for old in stale:
            old.unlink()


def _seconds_of(path: Path) -> dict[str, float]:
    """Return the run time in s of every stage of a stored result; empty where it is not recorded."""
    with suppress(OSError, ValueError):
        return dict(json.loads(path.with_suffix(".json").read_text(encoding="utf-8")))
    return {}


def refuse_missing(path: Path) -> None:
    """Raise ReadError where `path` does not exist."""
    if not path.exists():
        raise ReadError(f"{path} does not exist: give a scan (DICOM folder, NIfTI, NRRD, MHA, raw) or a surface")


def hash_of(path: Path) -> str:
    """Return the SHA-256 of an input.

    For a file, that of its contents; for a folder, that of the names and contents of all its files, sorted by name.
    Where `path` is one file of a scan of several, that of the contents of all, one after the other.

    Raises
    ------
    ReadError
        The input does not exist.
    """
    refuse_missing(path)
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else files_of(path):
        if file.is_file():
            digest.update(file.name.encode() + b"\0" if path.is_dir() else b"")
            with file.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()


def anatomy_key(source: str, settings: Settings) -> str:
    """Return the key of an anatomy: it depends on the input (hash `source`) but not on devices or flow."""
    geometry = replace(settings, devices=(), diameter_mm=None, length_mm=None, center_mm=None, flow=None, placings={})
    return key_of(source, replace(geometry, uncertainty=None))


def vessel_key(source: str, settings: Settings) -> str:
    """Return the key of a traced vessel: it depends neither on where the vessel is cut nor on the neck."""
    given = settings.units, settings.spacing_mm, settings.shape, settings.threshold, settings.at_mm, settings.inlet_mm
    return key_of(source, "vessel", given)


def key_of(*parts: Any) -> str:
    """Return a short hash of everything that a result depends on, including the version of vstent."""
    plain = [asdict(part) if is_dataclass(part) and not isinstance(part, type) else part for part in parts]
    return hashlib.sha256(json.dumps([version("vstent"), plain], sort_keys=True).encode()).hexdigest()[:16]
