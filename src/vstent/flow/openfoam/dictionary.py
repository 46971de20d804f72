"""Write and read OpenFOAM's dictionary syntax."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from vstent.errors import ReadError

Entries = Mapping[str, Any]
"""Entries of a dictionary, by key."""

_TOKEN: Final = re.compile(r'"[^"]*"|[{}();]|\[[^\]]*\]|[^\s{}();"\[]+')
"""Matches one token."""
_COMMENT: Final = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
"""Matches a comment."""


def foam_file(name: str, entries: Entries | str, *, kind: str = "dictionary", note: str = "") -> str:
    """Return the text of an OpenFOAM file."""
    header = _entry("FoamFile", {"version": "2.0", "format": "ascii", "class": kind, "object": name}, "")
    body = entries if isinstance(entries, str) else "".join(_entry(key, value, "") for key, value in entries.items())
    comment = f"// {note}\n\n" if note else ""
    return f"{header}\n{comment}{body}"


def _entry(key: str, value: Any, indent: str) -> str:
    """Return the text of one entry."""
    if isinstance(value, Mapping):
        inside = "".join(_entry(k, v, indent + "    ") for k, v in value.items())
        return f"{indent}{key}\n{indent}{{\n{inside}{indent}}}\n"
    return f"{indent}{key:<15} {value_text(value, indent)};\n"


def value_text(value: Any, indent: str = "") -> str:
    """Return a value in OpenFOAM's syntax."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, Mapping):
        inside = "".join(_entry(k, v, indent + "    ") for k, v in value.items())
        return f"{{\n{inside}{indent}}}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "(" + " ".join(value_text(item, indent) for item in value) + ")"
    return str(value)


def parse(text: str) -> dict[str, Any]:
    """Parse a dictionary: sub-dictionaries become mappings, every other value the list of its tokens.

    Raises
    ------
    ReadError
        A bracket or a semicolon is missing, or there is a bracket too many.
    """
    tokens = _TOKEN.findall(_COMMENT.sub(" ", text))
    entries, rest = _parsed(tokens, 0)
    if rest != len(tokens):
        raise ReadError(
            f"an OpenFOAM dictionary has an unmatched closing bracket at token {rest}: write the file again"
        )
    return entries


def _parsed(tokens: list[str], place: int) -> tuple[dict[str, Any], int]:
    """Return the entries up to the closing bracket, and the position of that bracket."""
    entries: dict[str, Any] = {}
    while place < len(tokens) and tokens[place] != "}":
        key, place = tokens[place], place + 1
        if place < len(tokens) and tokens[place] == "{":
            entries[key], place = _parsed(tokens, place + 1)
            _expect(tokens, place, "}", key)
        elif key != ";":
            start, place = place, _end_of_value(tokens, place)
            _expect(tokens, place, ";", key)
            entries[key] = tokens[start:place]
        else:
            place -= 1
        place += 1
    return entries, place


def _end_of_value(tokens: list[str], place: int) -> int:
    """Return the position of the token after a value."""
    depth = 0
    while place < len(tokens) and (depth > 0 or tokens[place] not in ";}"):
        depth += {"(": 1, "{": 1, ")": -1, "}": -1}.get(tokens[place], 0)
        place += 1
    return place


def _expect(tokens: list[str], place: int, wanted: str, key: str) -> None:
    """Raise a ReadError unless the token at a position is the expected one."""
    if place >= len(tokens) or tokens[place] != wanted:
        raise ReadError(f"an OpenFOAM dictionary has no {wanted!r} at the end of {key!r}: write the file again")
