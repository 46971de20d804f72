"""Reopening: a case folder that `vstent run` has written becomes a case of the page, with all that was found."""

import json
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from vstent.app.cases import STEPS, Case, State, Store, dependencies
from vstent.app.choices import Choices, DeviceChoice, FlowChoice
from vstent.app.finished import RUN, lost_steps
from vstent.errors import ReadError
from vstent.io.files import suffix

GEOMETRY: Final = (
    *("units", "spacing_mm", "shape", "threshold", "at_mm", "inlet_mm", "outlet_mm"),
    *("neck_mm", "upstream_mm", "downstream_mm"),
)


def stem(path: Path) -> str:
    """Return what a case of this file or folder is called."""
    ending = suffix(path)
    return path.name[: -len(ending)] if ending and path.is_file() else path.name


def reopened(store: Store, folder: Path) -> Case:
    """Make a case of a study's folder.

    Raises
    ------
    ReadError
        The folder does not say how it was made, or not in a way that this version understands.
    """
    from vstent.study import CACHE, INPUT

    try:
        told = json.loads((folder / RUN).read_text(encoding="utf-8"))
        choices = _choices(told["settings"])
        where = json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["path"]
    except (OSError, ValueError, KeyError, TypeError, ValidationError):
        raise ReadError(
            f"{folder} was not written by this version of vstent: run the study again, or open its scan."
        ) from None
    anatomy = next((path.stem.rpartition("-")[2] for path in (folder / CACHE).glob("anatomy-*.npz")), "")
    known = {"input": where, "source": told["input"]["sha256"], "choices": choices, "anatomy": anatomy}
    state = State(name=folder.name, **known)
    keys = dependencies(state)
    is_whole = choices.flow.is_wanted and not lost_steps(folder, state)
    done = {step: keys[step] for step in (STEPS if is_whole else STEPS[:5])}
    return store.create(folder.name, folder, done=done, **known)


def _choices(settings: dict[str, Any]) -> Choices:
    placings = settings.get("placings", {})
    shared = {name: settings[name] for name in ("diameter_mm", "length_mm", "center_mm")}
    devices = tuple(DeviceChoice(name=name, **placings.get(name, shared)) for name in settings["devices"])
    flow, varied = settings["flow"], settings["uncertainty"]
    chosen = FlowChoice(is_wanted=False)
    if flow is not None:
        chosen = FlowChoice(
            cell_size_mm=flow["cell_size_mm"],
            inflow_mL_s=flow["inflow_mL_s"],
            is_pulsatile=flow["waveform"] is not None,
            outlets=flow["outlets"],
        )
    geometry = {name: settings[name] for name in GEOMETRY}
    samples = None if varied is None else varied["samples"]
    return Choices(devices=devices, flow=chosen, uncertainty_samples=samples, **geometry)
