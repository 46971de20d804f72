"""Open a case folder of `vstent run` as a case of the page, with all its results."""

import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pydantic import ValidationError

from vstent.app.cases import STEPS, Case, State, Store, dependencies
from vstent.app.choices import Choices
from vstent.app.finished import RUN, lost_steps
from vstent.errors import ReadError
from vstent.io.files import suffix

if TYPE_CHECKING:  # loaded when a folder is opened, as in `vstent.app.choices`
    from vstent.study.settings import Settings

FLOW: Final = ("inflow_mL_s", "outlets")
"""Settings of the flow that the page can change, besides grid spacing and waveform."""


def stem(path: Path) -> str:
    """Return the name of a case from its file or folder: the name without the suffix."""
    ending = suffix(path)
    return path.name[: -len(ending)] if ending and path.is_file() else path.name


def reopened(store: Store, folder: Path) -> Case:
    """Create a case from the folder of a study.

    Parameters
    ----------
    store : cases of the page.
    folder : the case folder.

    Raises
    ------
    ReadError
        The folder does not state its input and settings, is from another version, or has a setting that the page does
        not support.
    """
    from vstent.study.folder import CACHE, INPUT
    from vstent.study.repeat import told_in
    from vstent.study.store import UNREADABLE

    try:
        told, settings = told_in(folder / RUN)
        source = told["input"]["sha256"]
        where = json.loads((folder / CACHE / INPUT).read_text(encoding="utf-8"))["path"]
    except UNREADABLE:
        raise ReadError(
            f"{folder} was written by another version of vstent. Run the study again, or open its scan."
        ) from None
    choices = _choices(settings, folder)
    anatomy = next((path.stem.removeprefix("anatomy-") for path in (folder / CACHE).glob("anatomy-*.npz")), "")
    known = {"input": where, "source": source, "former": told["settings"], "choices": choices, "anatomy": anatomy}
    state = State(name=folder.name, **known)
    keys = dependencies(state)
    is_whole = choices.flow.is_wanted and not lost_steps(folder, state)
    done = {step: keys[step] for step in (STEPS if is_whole else STEPS[:5])}
    return store.create(folder.name, folder, done=done, **known)


def _choices(settings: "Settings", folder: Path) -> Choices:
    """Return the settings of a study that the page can change; ReadError is raised for an unsupported value."""
    flow, varied = settings.flow, settings.uncertainty
    parts = (settings.input, settings.anatomy)
    told = {field.name: getattr(part, field.name) for part in parts for field in fields(part)}
    chosen = {name: value for name, value in told.items() if name in Choices.model_fields}
    chosen |= {"treatments": settings.treatments, "flow": {"is_wanted": False}}
    if flow is not None:
        chosen["flow"] = {name: getattr(flow, name) for name in FLOW}
        chosen["flow"] |= {"cell_size_mm": flow.numerics.cell_size_mm, "is_pulsatile": flow.waveform is not None}
    chosen["uncertainty_samples"] = None if varied is None else varied.samples
    try:
        return Choices.model_validate(chosen)
    except ValidationError as error:
        first = error.errors()[0]
        raise ReadError(
            f"{folder} has {'.'.join(map(str, first['loc']))} = {first['input']}, which the page cannot change "
            f"({first['msg']}). Continue it with `vstent run`."
        ) from None
