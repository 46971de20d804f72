"""Answer a command at once where nothing has changed since it was last finished.

A finished command leaves a record in the cache of its case folder: its arguments, the state of the program, of the
input and of every file of the folder, and what it printed. If all of these are the same, the next call of the same
command prints that again. This needs no import of the computations, which takes longer than everything else here.
"""

import argparse
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from vstent.io.files import State, program_states, state_of
from vstent.study.folder import CACHE, LOCK
from vstent.study.store import UNREADABLE, Key, Store, digest

RECORD: Final = "finished"
"""Name of the record in the store."""
DEPENDENT: Final = ("gpu", "angiogram", "plan", "ro_crate")
"""Options that depend on the machine or the day, or write files of their own: such commands run in full."""
OF_TERMINAL: Final = ("COLUMNS", "TERM", "COLORTERM", "NO_COLOR", "FORCE_COLOR")
"""Environment variables that change how tables are printed."""
OF_CATALOGUE: Final = ("HOME", "XDG_CONFIG_HOME", "APPDATA")
"""Environment variables that say where the user's devices are."""


Begun = tuple[Key, dict[str, State]]
"""What the output of a command depends on, as it was before the command ran: its key; states of files by path."""


def answered(arguments: argparse.Namespace) -> bool:
    """Print what a command printed when it was finished, if nothing has changed; return whether it was printed."""
    cache = arguments.out / CACHE
    record = Store(cache).record(RECORD, _command(arguments))
    with suppress(*UNREADABLE):
        if (cache / LOCK).exists() or any(state_of(Path(file)) != state for file, state in record["files"].items()):
            return False
        sys.stdout.write(record["printed"])
        print("vstent: nothing has changed since this command was finished.", file=sys.stderr)
        return True
    return False


def begun(arguments: argparse.Namespace, source: Path) -> Begun:
    """Return what the output of a command on a scan or surface depends on, before the command runs.

    The states are those of the input, of files given as options, and of the user's devices. Those of folders too, to
    which further files might be added.
    """
    from vstent.devices.catalogue import user_folder
    from vstent.errors import VstentError
    from vstent.io.dicom import is_dicom
    from vstent.io.images import files_of

    devices = user_folder()
    files = {source, devices, *devices.glob("*.toml")}
    with suppress(OSError, VstentError):  # the study states what is wrong with an input
        if source.is_dir():
            files |= {*source.rglob("*")}
        else:
            files |= {*files_of(source), *([source.parent] if is_dicom(source) else [])}
    for value in vars(arguments).values():
        for item in value if isinstance(value, (list, tuple)) else [value]:
            with suppress(OSError, ValueError):
                if isinstance(item, (str, Path)) and Path(item).is_file():
                    files.add(Path(item))
    return _command(arguments), _states(files)


def remember(arguments: argparse.Namespace, before: Begun, told: Mapping[str, Any], printed: str) -> None:
    """Store the record of a command that is finished.

    No record is stored where another process uses the folder, or has changed it since, or where it cannot be written.
    """
    from vstent.errors import FolderError
    from vstent.plugins import plugins
    from vstent.study.folder import claimed
    from vstent.study.repeat import is_of_another

    if any(getattr(arguments, name, False) for name in DEPENDENT):
        return
    if plugins("vstent.devices") or plugins("vstent.engines"):
        return  # their code may change too
    with suppress(OSError, FolderError), claimed(arguments.out):
        if is_of_another(arguments.out, told):
            return
        own = {file for file in arguments.out.rglob("*") if file.is_file() and not file.name.startswith((RECORD, LOCK))}
        command, states = before
        Store(arguments.out / CACHE).write(RECORD, command, {}, files=_states(own) | states, printed=printed)


def _states(files: Iterable[Path]) -> dict[str, State]:
    """Return the states of files and folders by their full path."""
    return {str(file.resolve()): state_of(file) for file in sorted(files)}


def _command(arguments: argparse.Namespace) -> Key:
    """Return the key of everything but files that the output of a command depends on."""
    given = {name: str(value) for name, value in vars(arguments).items() if not callable(value)}
    surroundings: list[Any] = [os.environ.get(name) for name in (*OF_TERMINAL, *OF_CATALOGUE)]
    for number in (0, 1, 2):
        with suppress(OSError):
            surroundings.append([number, os.get_terminal_size(number).columns])
    packages = {place: state_of(Path(place)) for place in sys.path if place.endswith("-packages")}
    programs: dict[str, State] = program_states() | packages
    return Key(digest([given, os.getcwd(), surroundings, sys.stdout.isatty()]), digest([programs, sys.version]))
