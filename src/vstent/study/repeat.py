"""Repetition of a run from its `run.json`, and comparison of the two results."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vstent.errors import InputError, ReadError
from vstent.io.files import existing
from vstent.study.folder import CACHE
from vstent.study.ledger import hash_of
from vstent.study.provenance import INPUT, METRICS, RUN, devices_of, machine, versions
from vstent.study.types import Settings

if TYPE_CHECKING:
    from pydantic import TypeAdapter

MISSING: Final = "absent"
"""Value shown where `run.json` does not contain an entry."""
SECONDS: Final = "seconds"
"""Key in `run.json` of the run time of every stage."""
UNTOLD: Final = (OSError, ValueError, KeyError, TypeError)
"""Exceptions raised by reading a file that is missing, damaged, or of another kind."""
TOLERANCE: Final = 1e-3
"""Accepted relative difference between machines. Processors round differently, which can change a pixel count or the
time step at which a flow has converged. Measured on one processor with and without vector and fused instructions: 2e-4
for a steady flow."""
ROUNDING: Final = 1e-9
"""Differences below this value, in the unit of the metric, are rounding errors."""


@dataclass(frozen=True, eq=False)
class Record:
    """A run described by its `run.json`."""

    folder: Path
    """The case folder."""
    input: Path
    """Scan or surface, whose hash has been checked."""
    settings: Settings
    """All settings, exact to the last bit."""
    differences: tuple[str, ...]
    """Differences between then and now in versions, machine and devices, one phrase each."""


def read_record(path: Path, moved_to: Path | None = None) -> Record:
    """Read a `run.json` and find its input.

    Parameters
    ----------
    path : the file, in its case folder.
    moved_to : the present path of the input; None: the recorded path.

    Raises
    ------
    ReadError
        The file does not exist or cannot be read by this version, or the input is not at its path.
    InputError
        The input has changed.
    """
    try:
        told, settings = told_in(existing(path))
        sha256 = str(told["input"]["sha256"])
        differences = _differences(told, settings)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise ReadError(
            f"{path} is not a run.json that this version can read: give the scan or surface and the options instead."
        ) from None
    source = moved_to or _input(path.parent)
    if not source.exists():
        raise ReadError(f"{source}, the input of {path}, does not exist: give its present path (--input).")
    if hash_of(source) != sha256:
        raise InputError(
            f"{source} is not the input of {path}, or it has changed since the run: give the original file (--input)."
        )
    return Record(path.parent, source, settings, differences)


def _input(folder: Path) -> Path:
    """Return the recorded path of the input of a case folder."""
    try:
        return Path(json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["path"])
    except UNTOLD:
        raise ReadError(
            f"{folder} does not contain the path of its input, because its folder {CACHE} is missing: give the path "
            "(--input)."
        ) from None


def former_source(folder: Path) -> str | None:
    """Return the hash of the input of the results in a case folder; None where it is not recorded."""
    with suppress(*UNTOLD):
        return str(json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["sha256"])
    with suppress(*UNTOLD):
        return str(json.loads((folder / RUN).read_text(encoding="utf-8"))["input"]["sha256"])
    return None


def is_of_another(folder: Path, told: Mapping[str, Any]) -> bool:
    """Return whether a case folder contains a run with a provenance other than `told`, or an unfinished run."""
    with suppress(*UNTOLD):
        former = json.loads((folder / RUN).read_text(encoding="utf-8"))
        return {key: former[key] for key in former if key != SECONDS} != json.loads(json.dumps(told))
    return former_source(folder) is not None


def told_in(run: Path) -> tuple[dict[str, Any], Settings]:
    """Return the contents of a `run.json` and its settings.

    Raises
    ------
    OSError, ValueError, KeyError, TypeError
        This version cannot read the file.
    """
    told = json.loads(run.read_text(encoding="utf-8"))
    return told, settings_of(told["settings"])


def settings_of(told: Mapping[str, Any]) -> Settings:
    """Rebuild the settings from their entry in a `run.json`.

    Raises
    ------
    ValueError
        This version does not know a setting.
    """
    unknown = sorted(set(told) - {field.name for field in fields(Settings)})
    if unknown:
        raise ValueError(f"unknown settings: {unknown}")
    return _adapter().validate_python(dict(told))


@cache
def _adapter() -> "TypeAdapter[Settings]":
    """Return the validator of settings."""
    from pydantic import TypeAdapter  # its ValidationError is a ValueError

    return TypeAdapter(Settings)


def _differences(told: Mapping[str, Any], settings: Settings) -> tuple[str, ...]:
    """Return the differences in versions, machine and devices, one phrase each."""
    now = {"versions": versions(), "machine": machine(settings), "devices": devices_of(settings.devices)}
    return tuple(
        f"{name.replace('_', ' ')} ({part}): {told.get(part, {}).get(name, MISSING)} then, {value} now"
        for part, values in now.items()
        for name, value in values.items()
        if told.get(part, {}).get(name, MISSING) != value
    )


def agreement(first: Path, second: Path) -> str:
    """Return a sentence on how well the metrics of two case folders agree.

    Raises
    ------
    ReadError
        A folder contains no metrics.
    """
    try:
        one, other = ((folder / METRICS).read_bytes() for folder in (first, second))
    except OSError as error:
        raise ReadError(f"{error.filename} cannot be read, so there is nothing to compare with.") from None
    if one == other:
        return "The metrics are identical to the last bit."
    then, now = dict(_numbers(json.loads(one))), dict(_numbers(json.loads(other)))
    if set(then) != set(now):
        return f"The metrics differ: {len(set(then) ^ set(now))} of them exist in one run only."
    apart = {name: _relative(then[name], now[name]) for name in then}
    worst = max(apart, key=lambda name: apart[name])
    n_apart = sum(value > 0 for value in apart.values())
    if n_apart == 0:
        return "The metrics are identical except for rounding."
    verdict = "within" if apart[worst] <= TOLERANCE else "more than"
    return (
        f"{n_apart} of {len(apart)} metrics differ. The largest relative difference is {apart[worst]:.2g}, of {worst}: "
        f"{verdict} the {TOLERANCE:g} expected between machines."
    )


def _relative(one: Any, other: Any) -> float:
    """Return the relative difference of two values; 1 for different texts."""
    if one == other:
        return 0.0
    if isinstance(one, str) or isinstance(other, str):
        return 1.0
    apart = abs(one - other)
    return 0.0 if apart < ROUNDING else float(apart / max(abs(one), abs(other)))


def _numbers(values: Mapping[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Return the values of nested mappings, under keys joined by dots."""
    found = []
    for name, value in values.items():
        found += _numbers(value, f"{before}{name}.") if isinstance(value, Mapping) else [(f"{before}{name}", value)]
    return found
