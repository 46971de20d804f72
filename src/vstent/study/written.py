"""Files and values of finished stages: what has not changed since is neither written nor computed again.

Keys contain the state of the program's own files, so that another version, or a changed line, computes everything anew.
"""

import json
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

from vstent.io.states import program_states, states_of
from vstent.io.writers import write_text
from vstent.study.ledger import Ledger, key_of
from vstent.study.repeat import UNTOLD

FINISHED: Final = ".done"
"""Suffix of the files in the cache folder that state what a stage has written, and when."""


@cache
def code_key() -> str:
    """Return a digest of the sizes and dates of the program's files."""
    return key_of(program_states())


def write_once(
    ledger: Ledger, stage: str, key: str, folder: Path, names: Iterable[str], write: Callable[[], str]
) -> None:
    """Write the files of a stage unless they are there, unchanged since they were written under this key.

    Parameters
    ----------
    ledger : record of the study.
    stage : name of the stage.
    key : key of everything that the files depend on.
    folder : folder of the files.
    names : names of the files.
    write : writes them and returns a sentence.
    """
    mark = ledger.folder / f"{stage}{FINISHED}"
    kept = _read(mark)
    if kept.get("key") == key and kept.get("files") == states_of(folder, names):
        ledger.seconds[stage] = kept["seconds"]
        ledger.progress(stage, 1.0, "already done")
        return
    mark.unlink(missing_ok=True)
    with ledger.stage(stage) as tell:
        tell(write())
    told = {"key": key, "seconds": ledger.seconds[stage], "files": states_of(folder, names)}
    write_text(mark, json.dumps(told))


def compute_once(ledger: Ledger, stage: str, key: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the plain values of a stage, computed unless they are stored under this key; their order is kept.

    Parameters
    ----------
    ledger : record of the study.
    stage : name of the stage.
    key : key of everything that the values depend on.
    compute : computes them.
    """
    mark = ledger.folder / f"{stage}{FINISHED}"
    kept = _read(mark)
    if kept.get("key") == key:
        ledger.seconds[stage] = kept["seconds"]
        ledger.progress(stage, 1.0, "already done")
        return dict(kept["values"])
    with ledger.stage(stage):
        values = compute()
    write_text(mark, json.dumps({"key": key, "seconds": ledger.seconds[stage], "values": values}))
    return values


def _read(mark: Path) -> dict[str, Any]:
    """Return what is stored of a stage; empty where it is missing or damaged."""
    with suppress(*UNTOLD):
        kept = json.loads(mark.read_text(encoding="utf-8"))
        return kept if isinstance(kept, dict) and "seconds" in kept else {}
    return {}
