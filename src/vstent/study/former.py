"""Compare a run with the earlier runs of its case folder: merge settings that agree, refuse those that do not.

Computed results are kept: a run with another device adds it. A change of the input or of a setting that would
invalidate results is refused, unless the user asks to replace them.
"""

import json
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from vstent.errors import InputError
from vstent.fields import differing
from vstent.io.writers import write_json
from vstent.study.folder import CACHE, RUN, TREATMENTS
from vstent.study.repeat import former_source, settings_of
from vstent.study.settings import Settings
from vstent.study.store import UNREADABLE

BEGUN: Final = "settings.json"
"""File in the cache folder with the settings of the last run that was started, finished or not."""


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


def merged(out: Path, source: str, settings: Settings) -> Settings:
    """Return the settings of a run of an input, with its SHA-256 `source`, merged with those of the folder's last run.

    Earlier treatments come first and keep their sizes, places and flows; new ones are added. Where a run requests no
    flow, new treatments get none and existing flows are kept.

    Raises
    ------
    InputError
        The folder holds results of another input, or of settings that the new ones would invalidate.
    """
    refuse_other_input(out, source)
    former = former_settings(out)
    if former is None:
        return settings
    refuse_other_anatomy(out, settings)
    before, now = ({one.name: one for one in run.treatments} for run in (former, settings))
    treatments = []
    for name in {**before, **now}:
        old, new = before.get(name), now.get(name)
        if new and not (out / TREATMENTS / name).exists():  # the old one failed, or was not reached
            old = None
        runs = ((old, former.flow), (new, settings.flow))
        has_flow = any(one is not None and one.has_flow and flow is not None for one, flow in runs)
        if old and new and new.is_proposed and old.devices == new.devices:
            new = None  # it leaves sizes and places to the old one
        given = (one and replace(one, has_flow=has_flow) for one in (old, new))
        treatments.append(_same(out, f"sizes or places of {name}", *given))
    flow = _same(out, "flow settings", former.flow, settings.flow)
    return replace(
        former,
        treatments=tuple(treatments if flow else (replace(one, has_flow=True) for one in treatments)),
        flow=flow,
        uncertainty=_same(out, "ranges of uncertainty", former.uncertainty, settings.uncertainty),
    )


def refuse_other_input(out: Path, source: str) -> None:
    """Raise InputError where a case folder holds results of an input with another SHA-256 than `source`."""
    if former_source(out) not in (source, None):
        raise InputError(f"{out} holds the results of another input. Give another --out, or --replace to replace them.")


def refuse_other_anatomy(out: Path, settings: Settings) -> None:
    """Raise InputError where a case folder holds results of an anatomy found with other settings."""
    former = former_settings(out)
    if former is None:
        return
    changed = [*differing(former.input, settings.input), *differing(former.anatomy, settings.anatomy)]
    if changed:
        raise InputError(
            f"{out} holds results with another {', '.join(changed)}. Give another --out, or --replace to replace them."
        )


def _same(out: Path, what: str, former: Any, given: Any) -> Any:
    """Return a setting that at least one of two runs states; raise InputError where both do and differ."""
    if former is not None and given is not None and former != given:
        raise InputError(f"{out} holds results with other {what}. Give another --out, or --replace to replace them.")
    return given if former is None else former
