"""Sizes and dates of files, by which unchanged files are recognized without reading them."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

State = list[int] | None
"""Size in bytes and date of the last change in ns; None: there is no such file."""


def state_of(file: Path) -> State:
    """Return the state of a file."""
    with suppress(OSError):
        found = file.stat()
        return [found.st_size, found.st_mtime_ns]
    return None


def states_of(folder: Path, names: Iterable[str]) -> dict[str, State]:
    """Return the states of files of a folder by name."""
    return {name: state_of(folder / name) for name in names}


def program_states() -> dict[str, State]:
    """Return the states of the program's own files, by their path in the package."""
    root = Path(__file__).parents[1]
    files = sorted(root.rglob("*.py")) + sorted(root.rglob("*.toml"))
    return states_of(root, (str(file.relative_to(root)) for file in files))
