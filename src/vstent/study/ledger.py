"""Ledger: what a study has finished, how long it took, and the keys under which it is kept and found again."""

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

Noun = TypeVar("Noun")
ANATOMY: Final = "anatomy"
"""Name under which an anatomy is kept."""


class Ledger:
    """Times the stages, tells of them, and keeps what they found under keys of what they depend on."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.folder, self.progress = folder, progress
        self.seconds: dict[str, float] = {}
        self._held: list[tuple[str, str, Any, dict[str, float]]] = []
        self._before: dict[str, set[str]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[str], None]]:
        """Announce a stage, time it, and say what it found (the yielded function takes the sentence)."""
        found: list[str] = []
        self.progress(name, 0.0, "")
        began = time.perf_counter()
        yield found.append
        self.seconds[name] = time.perf_counter() - began
        self.progress(name, 1.0, " ".join(found))

    def teller(self, name: str) -> Callable[[FlowProgress], None]:
        """Return what a flow engine tells its progress to."""

        def tell(progress: FlowProgress) -> None:
            fraction = min(progress.fraction, 0.99)
            settling = f"{progress.residual:.1%} from convergence, " if isfinite(progress.residual) else ""
            self.progress(name, fraction, f"{settling}{progress.seconds_left:.0f} s left")

        return tell

    def recall(self, name: str, key: str, noun_type: type[Noun]) -> Noun | None:
        """Return what was kept under this key, with the seconds it took then; None where it is missing or damaged."""
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
        """Keep a noun under a key when `settle` is called: until then something given may yet turn out unusable."""
        self._held.append((name, key, noun, self._seconds_since(name)))

    def is_held(self, name: str) -> bool:
        """Tell whether what is called so was found anew and is not kept yet."""
        return any(held == name for held, *_ in self._held)

    def settle(self) -> None:
        """Keep what is held: from here on things are written."""
        for held in self._held:
            self._write(*held)
        self._held.clear()

    def keep(self, name: str, key: str, noun: Any) -> None:
        """Keep a noun under a key; what was kept under the same name before is dropped."""
        self._write(name, key, noun, self._seconds_since(name))

    def _seconds_since(self, name: str) -> dict[str, float]:
        """Seconds of every stage since a noun was asked for: of those that it took."""
        return {stage: took for stage, took in self.seconds.items() if stage not in self._before.get(name, ())}

    def _write(self, name: str, key: str, noun: Any, seconds: dict[str, float]) -> None:
        path = self.folder / f"{name}-{key}.npz"
        self.folder.mkdir(parents=True, exist_ok=True)
        told = path.with_suffix(".json")
        stale = set(self.folder.glob(f"{name}-*")) - {path, told}
        write_json(told, seconds, is_exact=True)
        save_data(path, noun)
        for old in stale:
            old.unlink()


def _seconds_of(path: Path) -> dict[str, float]:
    """Seconds of every stage that something kept took; none where it does not say."""
    with suppress(OSError, ValueError):
        return dict(json.loads(path.with_suffix(".json").read_text(encoding="utf-8")))
    return {}


def refuse_missing(path: Path) -> None:
    """Raise ReadError where there is nothing to read."""
    if not path.exists():
        raise ReadError(f"{path} does not exist: give a scan (DICOM folder, NIfTI, NRRD, MHA, raw) or a surface")


def hash_of(path: Path) -> str:
    """SHA-256 of a file, whatever its name, or of all files of a folder with their names, in the order of these.

    Of a scan that is several files, one of which is given, it is that of their contents one after the other.
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
    """Key of the geometry of an input: devices and flow do not change it."""
    geometry = replace(settings, devices=(), diameter_mm=None, length_mm=None, center_mm=None, flow=None, placings={})
    return key_of(source, replace(geometry, uncertainty=None, without_flow=()))


def vessel_key(source: str, settings: Settings) -> str:
    """Key of the vessel of an input: where it is cut and how its sac is taken off does not change it."""
    given = settings.units, settings.spacing_mm, settings.shape, settings.threshold, settings.at_mm, settings.inlet_mm
    later = [value for value in (settings.frame, settings.acquisition) if value is not None]
    return key_of(source, "vessel", given, *later)


def key_of(*parts: Any) -> str:
    """Short name of everything that a result depends on, this version of the code included."""
    plain = [_plain(part) if is_dataclass(part) and not isinstance(part, type) else part for part in parts]
    return hashlib.sha256(json.dumps([version("vstent"), plain], sort_keys=True).encode()).hexdigest()[:16]


_LATER: Final = {"without_flow": (), "acquisition": None, "frame": None}
"""Fields that settings got after version 0.1 with their defaults: where they have these, keys are those of 0.1."""


def _plain(part: Any) -> dict[str, Any]:
    """Return the fields of a data class that a key depends on."""
    fields = asdict(part)
    return {key: value for key, value in fields.items() if key not in _LATER or value != _LATER[key]}
