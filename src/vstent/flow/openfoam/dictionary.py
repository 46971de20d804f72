"""Write OpenFOAM's dictionary syntax."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def foam_file(name: str, entries: Mapping[str, Any], *, kind: str = "dictionary", note: str = "") -> str:
    """Return the text of an OpenFOAM file."""
    header = {"FoamFile": {"version": "2.0", "format": "ascii", "class": kind, "object": name}}
    comment = f"// {note}\n\n" if note else ""
    return f"{_lines(header, '')}\n{comment}{_lines(entries, '')}"


def _lines(entries: Mapping[str, Any], indent: str) -> str:
    """Return the text of entries."""
    return "".join(
        f"{indent}{key}\n{indent}{_text(value, indent)}\n"
        if isinstance(value, Mapping)
        else f"{indent}{key:<15} {_text(value, indent)};\n"
        for key, value in entries.items()
    )


def _text(value: Any, indent: str) -> str:
    """Return a value in OpenFOAM's syntax."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, Mapping):
        return f"{{\n{_lines(value, indent + '    ')}{indent}}}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "(" + " ".join(_text(item, indent) for item in value) + ")"
    return str(value)


def vector(numbers: Iterable[float]) -> str:
    """Return a vector in OpenFOAM's syntax."""
    return "(" + " ".join(f"{x:.9g}" for x in numbers) + ")"
