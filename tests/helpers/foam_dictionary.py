"""Read OpenFOAM's dictionary syntax."""

import re
from typing import Any, Final

_TOKEN: Final = re.compile(r'"[^"]*"|[{}();]|\[[^\]]*\]|[^\s{}();"\[]+')
"""Matches one token."""
_COMMENT: Final = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
"""Matches a comment."""


def parse(text: str) -> dict[str, Any]:
    """Parse a dictionary: sub-dictionaries become mappings, every other value the list of its tokens.

    ValueError: a bracket or a semicolon is missing, or there is a bracket too many.
    """
    tokens = _TOKEN.findall(_COMMENT.sub(" ", text))
    entries, rest = _parsed(tokens, 0)
    if rest != len(tokens):
        raise ValueError(f"an OpenFOAM dictionary has an unmatched closing bracket at token {rest}")
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
    """Raise a ValueError unless the token at a position is the expected one."""
    if place >= len(tokens) or tokens[place] != wanted:
        raise ValueError(f"an OpenFOAM dictionary has no {wanted!r} at the end of {key!r}")
