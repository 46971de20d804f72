"""Record of a study: the run time of every stage, and the stored results under keys of everything they depend on."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any, Final, TypeVar

from vstent.devices.design import Braid, LaserCut
from vstent.errors import ReadError
from vstent.flow.engines import Progress as FlowProgress
from vstent.io.archive import load_data, save_data
from vstent.io.images import files_of
from vstent.io.writers import write_json
from vstent.study.types import OnProgress, Progress, Settings

Kept = TypeVar("Kept")
RESULTS_VERSION: Final = "0.1.0"
"""Version of the computations: it changes only when results change, so that a new release keeps stored results."""
DEPLOYMENT_VERSION: Final = "0.2.0"
"""Version of the deployment: it changes when deployed devices change, so that what was computed with them is computed
again; anatomies and flows without a device are kept."""
CONTRAST_VERSION: Final = "0.2.0"
"""Version of the angiogram: it changes only when its results change."""
KEY_DIGITS: Final = 16
"""Number of digits of a key."""
ANATOMY: Final = "anatomy"
"""Name under which an anatomy is stored."""


class Ledger:
    """Measures the time of the stages, reports their progress, and stores and retrieves their results.

    Parameters
    ----------
    folder : cache folder of the case.
    progress : called at every stage.
    """

    def __init__(self, folder: Path, progress: OnProgress) -> None:
        self.folder, self._watch = folder, progress
        self.seconds: dict[str, float] = {}
        self._held: list[tuple[str, str, Any, dict[str, float]]] = []
        self._before: dict[str, set[str]] = {}

    def progress(self, stage: str, fraction: float, detail: str, **more: Any) -> None:
        """Report the progress of a stage; the arguments are the fields of a `Progress`."""
        self._watch(Progress(stage, fraction, detail, **more))

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[str], None]]:
        """Report the start of a stage, measure its time, and report its result.

        The yielded function takes a sentence on the result.
        """
        found: list[str] = []
        self.progress(name, 0.0, "")
        began = time.perf_counter()
        yield found.append
        self.seconds[name] = time.perf_counter() - began
        self.progress(name, 1.0, " ".join(found))

    def teller(self, name: str) -> Callable[[FlowProgress], None]:
        """Return a function that reports the progress of a flow under a stage name."""

        def tell(progress: FlowProgress) -> None:
            residual = progress.residual if isfinite(progress.residual) else None
            left_s = progress.seconds_left
            self.progress(name, min(progress.fraction, 0.99), "", residual=residual, seconds_left=left_s)

        return tell

    def recall(self, name: str, key: str, kind: type[Kept]) -> Kept | None:
        """Return the result stored under a key, and add its run time; None where it is missing or damaged.

        Parameters
        ----------
        name : name of the result.
        key : key of everything that it depends on.
        kind : data class of the result.
        """
        path = self.folder / f"{name}-{key}.npz"
        self._before[name] = set(self.seconds)
        if not path.exists():
            return None
        self.progress(name, 0.0, "")
        result = self.stored(name, key, kind)
        if result is None:
            return None
        self.seconds |= _seconds_of(path)
        self.progress(name, 1.0, "already done")
        return result

    def stored(self, name: str, key: str, kind: type[Kept]) -> Kept | None:
        """Return the result stored under a key, without a report of it; None where it is missing or damaged.

        Parameters
        ----------
        name : name of the result.
        key : key of everything that it depends on.
        kind : data class of the result.
        """
        try:
            return load_data(self.folder / f"{name}-{key}.npz", kind)
        except (ReadError, OSError):
            return None

    def hold(self, name: str, key: str, result: Any) -> None:
        """Keep a result in memory until `settle` is called, because a later input may still prove unusable.

        Parameters
        ----------
        name : name of the result.
        key : key of everything that it depends on.
        result : a data class of vstent.
        """
        self._held.append((name, key, result, self._seconds_since(name)))

    def is_held(self, name: str) -> bool:
        """Return whether a result of this name is in memory and not stored yet."""
        return any(held == name for held, *_ in self._held)

    def settle(self) -> None:
        """Store all results kept in memory; from here on files are written."""
        for held in self._held:
            self._write(*held)
        self._held.clear()

    def keep(self, name: str, key: str, result: Any) -> None:
        """Store a result under a key; older results of the same name are deleted.

        Parameters
        ----------
        name : name of the result.
        key : key of everything that it depends on.
        result : a data class of vstent.
        """
        self.keeping(name, key, result)()

    def keeping(self, name: str, key: str, result: Any) -> Callable[[], None]:
        """Return a function that does what `keep` does, with the run times of the stages until now.

        Parameters
        ----------
        name : name of the result.
        key : key of everything that it depends on.
        result : a data class of vstent.
        """
        return partial(self._write, name, key, result, self._seconds_since(name))

    def _seconds_since(self, name: str) -> dict[str, float]:
        """Return the run time in s of every stage since a result was looked up."""
        return {stage: took for stage, took in self.seconds.items() if stage not in self._before.get(name, ())}

    def _write(self, name: str, key: str, result: Any, seconds: dict[str, float]) -> None:
        """Store a result with the run times of its stages; older results of the same name are deleted."""
        path = self.folder / f"{name}-{key}.npz"
        self.folder.mkdir(parents=True, exist_ok=True)
        told = path.with_suffix(".json")
        # The digits keep the results of another device whose name begins with this one.
        stale = set(self.folder.glob(f"{name}-{KEY_DIGITS * '[0-9a-f]'}.*")) - {path, told}
        write_json(told, seconds, is_exact=True)
        save_data(path, result)
        for old in stale:
            old.unlink()


def _seconds_of(path: Path) -> dict[str, float]:
    """Return the run times in s of the stages of a stored result; empty where they are not stated."""
    with suppress(OSError, ValueError):
        return dict(json.loads(path.with_suffix(".json").read_text(encoding="utf-8")))
    return {}


def refuse_missing(path: Path) -> None:
    """Raise ReadError where an input does not exist."""
    if not path.exists():
        raise ReadError(f"{path} does not exist: give a scan (DICOM folder, NIfTI, NRRD, MHA, raw) or a surface")


def hash_of(path: Path) -> str:
    """Return the SHA-256 of an input.

    For a folder it covers the names and contents of all files, in the order of their paths. For one file of a scan that
    has several, it covers the contents of all of them.

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
    """Return the key of the anatomy of an input; it does not depend on treatments and flow.

    Parameters
    ----------
    source : SHA-256 of the input.
    settings : settings of the study.
    """
    return key_of(source, settings.input, settings.anatomy)


def vessel_key(source: str, settings: Settings) -> str:
    """Return the key of the vessel of an input; it does not depend on trimming and restoration.

    Parameters
    ----------
    source : SHA-256 of the input.
    settings : settings of the study.
    """
    return key_of(source, "vessel", settings.input, settings.anatomy.at_mm, settings.anatomy.inlet_mm)


def key_of(*parts: Any) -> str:
    """Return a short digest of everything that a result depends on, including `RESULTS_VERSION`."""
    plain = [_plain(part) if is_dataclass(part) and not isinstance(part, type) else part for part in parts]
    return hashlib.sha256(json.dumps([RESULTS_VERSION, plain], sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]


def _plain(part: Any) -> dict[str, Any]:
    """Return the fields of a data class that a key depends on."""
    fields = asdict(part)
    if isinstance(part, (Braid, LaserCut)):
        fields.pop("ranges")  # they change the bands, but no deployment and no flow
    return fields
