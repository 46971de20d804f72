"""Records of runs in `run.json`: repeat a run, compare the results, and merge a run with the last one of its folder.

Computed results are kept: a run with another device adds it. A change of the input or of a setting that would
invalidate results is refused, unless the user asks to replace them.
"""

import json
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vstent.devices.catalogue import find_design
from vstent.errors import InputError, ReadError
from vstent.fields import differing
from vstent.flow.lattice.gpu import gpu_name
from vstent.io.files import existing
from vstent.io.writers import write_json
from vstent.study.folder import CACHE, INPUT, LAYOUT, METRICS, RUN, TREATMENTS
from vstent.study.keys import hash_of
from vstent.study.settings import Settings
from vstent.study.store import UNREADABLE, digest

if TYPE_CHECKING:
    from pydantic import TypeAdapter

BEGUN: Final = "settings.json"
"""File in the cache folder with the settings of the last run that was started, finished or not."""
PACKAGES: Final = ("vstent", "numpy", "scipy", "numba", "vtk", "SimpleITK", "pydicom")
"""Packages whose versions are recorded."""
MISSING: Final = "absent"
"""Text for a value that a record does not state."""
SECONDS: Final = "seconds"
"""Key of the run times of the stages, in s."""
TOLERANCE: Final = 1e-3
"""Relative difference of metrics that another machine may cause, since processors round differently. Measured on one
processor with and without wide and fused instructions: 2e-4 for a steady flow."""
ROUNDING: Final = 1e-9
"""Absolute difference, in the unit of a metric, below which two values near zero are equal."""


def provenance(path: Path, source: str, settings: Settings) -> dict[str, Any]:
    """Return everything that the results of an input, with its SHA-256 `source`, depend on."""
    return {
        "layout": LAYOUT,
        **_surroundings(settings),
        "input": {"name": "DICOM folder" if path.is_dir() else path.name, "sha256": source},
        "settings": asdict(settings),
        "research_use_only": True,
    }


def _surroundings(settings: Settings) -> dict[str, dict[str, str]]:
    """Return versions, machine and devices: all that may change a result besides input and settings."""
    machine = {"system": platform.system(), "processor": platform.machine()}
    if settings.flow is not None and settings.flow.numerics.device_gpu:
        machine["gpu"] = gpu_name()
    return {
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "machine": machine,
        "devices": {name: digest(find_design(name)) for name in settings.devices},  # a catalogue can change
    }


@dataclass(frozen=True, eq=False)
class Record:
    """A run as stated by its ``run.json``."""

    folder: Path
    """Its case folder."""
    input: Path
    """Scan or surface; its hash equals the recorded one."""
    settings: Settings
    """All settings, without rounding."""
    differences: tuple[str, ...]
    """Differences from the present versions, machine and devices, one sentence each."""


def read_record(path: Path, moved_to: Path | None = None) -> Record:
    """Read the ``run.json`` of a case folder and find its input, at the recorded path or where it has been moved to.

    ReadError is raised where the file does not exist or is from another version, or the input is missing, and
    InputError where the input is not the recorded one.
    """
    try:
        told, settings = told_in(existing(path))
        sha256 = str(told["input"]["sha256"])
        changed = differences(told, settings)
    except UNREADABLE:
        raise ReadError(f"{path} is not a run.json of this version: give the scan and the options again") from None
    folder = path.parent
    try:
        recorded = json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["path"] if not moved_to else ""
    except UNREADABLE:
        raise ReadError(
            f"{folder} does not state the place of its input (its folder {CACHE} is missing): give it with --input"
        ) from None
    source = moved_to or Path(recorded)
    if not source.exists():
        raise ReadError(f"{source}, the input of {path}, does not exist: give its present place with --input")
    if hash_of(source) != sha256:
        raise InputError(f"{source} is not the input of {path}, or has changed since: give that input with --input")
    return Record(folder, source, settings, changed)


def former_source(folder: Path) -> str | None:
    """Return the hash of the input of a case folder's results; None where it is not stated."""
    with suppress(*UNREADABLE):
        return str(json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["sha256"])
    with suppress(*UNREADABLE):
        return str(json.loads((folder / RUN).read_text(encoding="utf-8"))["input"]["sha256"])
    return None


def is_of_another(folder: Path, told: Mapping[str, Any]) -> bool:
    """Return whether a folder holds results of an unfinished run, or of other input or settings than `told` states."""
    with suppress(*UNREADABLE):
        former = json.loads((folder / RUN).read_text(encoding="utf-8"))
        now = json.loads(json.dumps(told))
        return bool(former["settings"] != now["settings"] or former["input"]["sha256"] != now["input"]["sha256"])
    return former_source(folder) is not None


def told_in(run: Path) -> tuple[dict[str, Any], Settings]:
    """Return the content of a ``run.json`` and its settings; one of `UNREADABLE` is raised where it cannot be read."""
    told = json.loads(run.read_text(encoding="utf-8"))
    if told["layout"] != LAYOUT:
        raise ValueError("another layout")
    return told, settings_of(told["settings"])


def finished_run(out: Path) -> tuple[str, Settings]:
    """Return the SHA-256 of the input and the settings of the run of a case folder.

    ReadError is raised where the folder holds no finished run of this version.
    """
    if not (out / RUN).is_file():
        raise ReadError(f"{out} is not a case folder with a finished run: run `vstent run` with this --out first")
    try:
        told, study = told_in(out / RUN)
        return str(told["input"]["sha256"]), study
    except UNREADABLE:
        raise ReadError(f"{out / RUN} is from another version: run the case again") from None


def settings_of(told: Mapping[str, Any]) -> Settings:
    """Return the settings stated by a ``run.json``; ValueError where they are not those of this version."""
    found = _adapter().validate_python(dict(told))
    if json.loads(json.dumps(asdict(found))) != json.loads(json.dumps(told)):
        raise ValueError("these are not all settings of this version, or others")
    return found


@cache
def _adapter() -> "TypeAdapter[Settings]":
    """Return the pydantic adapter that reads the settings of a study."""
    from pydantic import TypeAdapter  # its ValidationError is a ValueError

    return TypeAdapter(Settings)


def differences(told: Mapping[str, Any], settings: Settings) -> tuple[str, ...]:
    """Return the differences between a recorded run and the present versions, machine and devices."""
    return tuple(
        f"{name.replace('_', ' ')} ({part}): {told.get(part, {}).get(name, MISSING)} before, {value} now"
        for part, values in _surroundings(settings).items()
        for name, value in values.items()
        if told.get(part, {}).get(name, MISSING) != value
    )


def agreement(first: Path, second: Path) -> str:
    """Return a sentence on how well the metrics of two case folders agree; ReadError where one has none."""
    try:
        one, other = ((folder / METRICS).read_bytes() for folder in (first, second))
    except OSError as error:
        raise ReadError(f"{error.filename} cannot be read, so there is nothing to compare with") from None
    if one == other:
        return "The metrics are identical to the last bit."
    then, now = flat(json.loads(one)), flat(json.loads(other))
    if set(then) != set(now):
        return f"The metrics differ: {len(set(then) ^ set(now))} of them exist in one run only."
    apart = {name: _apart(name, then[name], now[name]) for name in then}
    worst = max(apart, key=lambda name: apart[name])
    n_apart = sum(value > 0 for value in apart.values())
    if n_apart == 0:
        return "The metrics agree except for rounding."
    verdict = "within" if apart[worst] <= TOLERANCE else "more than"
    return (
        f"{n_apart} of {len(apart)} metrics differ, {worst} most (relative difference {apart[worst]:.2g}, "
        f"{verdict} the {TOLERANCE:g} that another machine may cause)."
    )


def _apart(name: str, one: Any, other: Any) -> float:
    """Return the relative difference of two values; 1 for different texts, 0 where only rounding differs.

    Residuals are relative to the inflow already.
    """
    if one == other:
        return 0.0
    if isinstance(one, str) or isinstance(other, str):
        return 1.0
    apart = abs(one - other)
    whole = 1.0 if name.endswith("residual_fraction") else max(abs(one), abs(other))
    return 0.0 if apart < ROUNDING else float(apart / whole)


def flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return all values of nested metrics under dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return found


def former_settings(out: Path) -> Settings | None:
    """Return the settings of the last run of a case folder; None where there is none, or they cannot be read."""
    for path in (out / CACHE / BEGUN, out / RUN):
        with suppress(*UNREADABLE):
            told = json.loads(path.read_text(encoding="utf-8"))
            return settings_of(told["settings"])
    return None


def note_begun(out: Path, settings: Settings) -> None:
    """Store the settings of a run that starts to write into a case folder."""
    write_json(out / CACHE / BEGUN, {"settings": asdict(settings)}, is_exact=True)


def merged(out: Path, settings: Settings) -> Settings:
    """Return the settings of a run merged with those of the folder's last run of the same input (`refuse_other`).

    Earlier treatments come first and keep their sizes, places and flows; new ones are added. Where a run requests no
    flow, new treatments get none and existing flows are kept. InputError is raised where the folder holds results of
    settings that the new ones would invalidate.
    """
    former = former_settings(out)
    if former is None:
        return settings
    before, now = ({one.name: one for one in run.treatments} for run in (former, settings))
    treatments = []
    for name in {**before, **now}:
        old, new = before.get(name), now.get(name)
        if new and not (out / TREATMENTS / name).exists():  # the old one failed, or was not reached
            old = None
        runs = ((old, former.flow), (new, settings.flow))
        has_flow = any(one is not None and one.has_flow and flow is not None for one, flow in runs)
        if old and new and new.is_proposed and old.plan == new.plan:
            new = None  # it leaves sizes and places to the old one
        given = (one and replace(one, has_flow=has_flow) for one in (old, new))
        treatments.append(_same(out, f"sizes, places or densities of {name}", *given))
    flow = _same(out, "flow settings", former.flow, settings.flow)
    return replace(
        former,
        treatments=tuple(treatments if flow else (replace(one, has_flow=True) for one in treatments)),
        flow=flow,
        uncertainty=_same(out, "ranges of uncertainty", former.uncertainty, settings.uncertainty),
        straightening=_same(out, "straightening", former.straightening, settings.straightening),
    )


def refuse_other(out: Path, source: str, settings: Settings) -> None:
    """Raise InputError where a case folder holds results of an input with another SHA-256, or of another anatomy."""
    former = former_settings(out)
    if former_source(out) not in (source, None):
        raise InputError(f"{out} holds the results of another input. Give another --out, or --replace to replace them.")
    if former is not None:
        changed = [*differing(former.input, settings.input), *differing(former.anatomy, settings.anatomy)]
        if changed:
            what = ", ".join(changed)
            raise InputError(
                f"{out} holds results with another {what}. Give another --out, or --replace to replace them."
            )


def _same(out: Path, what: str, former: Any, given: Any) -> Any:
    """Return a setting that at least one of two runs states; raise InputError where both do and differ."""
    if former is not None and given is not None and former != given:
        raise InputError(f"{out} holds results with other {what}. Give another --out, or --replace to replace them.")
    return given if former is None else former
