"""Open a case folder of `vstent run` as a case of the page, with all its results."""

import json
from pathlib import Path

from pydantic import ValidationError

from vstent.app.cases import STEPS, Case, State, Store, dependencies
from vstent.app.choices import Choices
from vstent.app.finished import RUN, lost_steps
from vstent.errors import InputError, ReadError
from vstent.io.files import suffix


def stem(path: Path) -> str:
    """Return the name of a case from its file or folder: the name without the suffix."""
    ending = suffix(path)
    return path.name[: -len(ending)] if ending and path.is_file() else path.name


def reopened(store: Store, folder: Path) -> Case:
    """Create a case from the folder of a study.

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
    try:
        choices = Choices.of(settings)
    except (ValidationError, InputError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise ReadError(f"{folder} has a setting that the page cannot change ({why}). Use `vstent run`.") from None
    anatomy = next((path.stem.removeprefix("anatomy-") for path in (folder / CACHE).glob("anatomy-*.npz")), "")
    known = {"input": where, "source": source, "former": told["settings"], "choices": choices, "anatomy": anatomy}
    state = State(name=folder.name, **known)
    keys = dependencies(state)
    is_whole = choices.flow.is_wanted and not lost_steps(folder, state)
    done = {step: keys[step] for step in (STEPS if is_whole else STEPS[:5])}
    return store.create(folder.name, folder, done=done, **known)
