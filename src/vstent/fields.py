"""Fields of the settings: each states its option, unit and limits, from which command line, tables and page are made.

This module imports no numpy, so that the help of the command line appears at once.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from functools import reduce
from pathlib import Path
from typing import Any, Final, get_args

from vstent.errors import InputError

WORDS: Final = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}
"""Values of a flag in a table."""


@dataclass(frozen=True)
class Limits:
    """Permitted values of a number, or of each of several."""

    unit: str = ""
    """Unit of the value."""
    low: float = -math.inf
    """Lowest value."""
    high: float = math.inf
    """Highest value."""
    above: float = -math.inf
    """Number that every value exceeds."""
    remark: str = ""
    """A conversion into the unit, such as 240 mL/min are 4 mL/s."""

    def __str__(self) -> str:
        """Return the permitted values with their unit; empty where all are."""
        low = f"above {self.above:g}" if self.above > self.low else f"{self.low:g}" if self.low > -math.inf else ""
        if math.isinf(self.high):
            said = low if self.above > self.low or not low else f"at least {low}"
        else:
            said = f"{low}{', up' if self.above > self.low else ''} to {self.high:g}"
        return f"{said} {self.unit}".strip() + (f" ({self.remark})" if self.remark else "")

    def check(self, value: float) -> None:
        """Raise InputError where a number is outside the limits."""
        if not (self.low <= value <= self.high and self.above < value and math.isfinite(value)):
            raise InputError(f"{value:g} {self.unit}".rstrip() + f" is out of range: give {self}")


ANY: Final = Limits()
"""Any number."""
LENGTH: Final = Limits("mm", above=0.0, high=1000.0)
"""Limits of a length."""
POSITION: Final = Limits("mm", -1e4, 1e4)
"""Limits of a position along an artery, or of the coordinates of points in the frame of the input."""


def number(text: str) -> float:
    """Return a number read from text."""
    return _numbers(text, float, 1)[0]


class Speed(float):
    """A mean speed, m/s, given in place of a flow rate."""


def flow_rate(text: str) -> float:
    """Return a flow rate in mL/s read from text with its unit, mL/s where none is written; m/s is a `Speed`."""
    value, _, unit = re.sub(r"(?<=[\d.])\s*(?=[a-zA-Z]+/)", " ", text.strip()).partition(" ")
    kinds = {"": float, "ml/s": float, "ml/min": lambda mL_min: mL_min / 60, "m/s": Speed}
    if unit.lower() not in kinds:
        raise InputError(f"{text!r} has another unit: give mL/s, mL/min or m/s")
    return kinds[unit.lower()](number(value))


def whole(text: str) -> int:
    """Return a whole number read from text."""
    return _numbers(text, int, 1)[0]


def numbers(text: str) -> tuple[float, ...]:
    """Return numbers read from text."""
    return _numbers(text, float, len(_parts(text)))


def point(text: str) -> tuple[float, ...]:
    """Return three numbers read from text."""
    return _numbers(text, float, 3)


def box(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return two points read from text."""
    found = _numbers(text, float, 6)
    return found[:3], found[3:]


def shape(text: str) -> tuple[int, ...]:
    """Return three whole numbers read from text."""
    return _numbers(text, int, 3)


def spacing(text: str) -> tuple[float, ...]:
    """Return three numbers read from text; one number stands for all three."""
    return _numbers(text, float, 3) if len(_parts(text)) > 1 else 3 * _numbers(text, float, 1)


def flag(text: str) -> bool:
    """Return whether a text says yes."""
    if text.lower() not in WORDS:
        raise InputError(f"{text!r} is not yes or no")
    return WORDS[text.lower()]


PLACEHOLDERS: Final[dict[Callable[[str], Any], str]] = {
    whole: "N",
    point: "X,Y,Z",
    box: "X,Y,Z,X,Y,Z",
    shape: "I,J,K",
    spacing: "S|X,Y,Z",
}
"""Placeholders of values in the help of the command line, by what reads them."""


def _parts(text: str) -> list[str]:
    """Return the parts of a text that are separated by commas, semicolons, spaces or x."""
    return re.split(r"\s*[,;x]\s*|\s+", text.strip())


def _numbers(text: str, kind: type, count: int) -> tuple[Any, ...]:
    """Return `count` finite numbers read from text."""
    try:
        found = tuple(kind(part) for part in _parts(text))
    except ValueError:
        found = ()
    if len(found) != count or not all(map(math.isfinite, found)):
        what = {(1, float): "a number", (1, int): "a whole number"}.get((count, kind), f"{count} numbers such as 1,2,3")
        raise InputError(f"{text!r} is not {what}")
    return found


@dataclass(frozen=True)
class Option:
    """How a setting is stated as text, and which values it may have."""

    name: str
    """Name of the option on the command line, without dashes, and of the column in a table."""
    help: str
    """What it is, for the help of the command line."""
    read: Callable[[str], Any] = number
    """Reads a value from text."""
    limits: Limits = ANY
    """Unit and permitted values of a number."""
    usual: str = ""
    """What is taken where it is not given."""
    metavar: str = ""
    """Placeholder of the value in the help; empty: that of what is read, or the unit."""
    counts: tuple[int, int] | None = None
    """Lowest and highest number of points; None: any."""
    choices: tuple[str, ...] = ()
    """All values of a word; empty: any. A file may be given besides."""
    separators: str = ""
    """Characters between several values in a cell of a table; empty: the option is given once."""
    short: str = ""
    """Another name of the option, with its dashes."""
    off: tuple[str, str] = ("", "")
    """Name and help of the option that states the opposite."""
    alone: str | None = None
    """Value of an option that is given without one."""
    load: Callable[[Any], Any] | None = None
    """Returns the setting that a value stands for, such as the content of a file; None: the value itself."""
    is_file: bool = False
    """Whether the value is the path of a file, unless it is `alone` or one of `choices`."""

    @property
    def placeholder(self) -> str:
        """Placeholder of the value in the help."""
        return self.metavar or PLACEHOLDERS.get(self.read) or re.sub(r"[ /]", "_", self.limits.unit.upper()) or "X"

    def value(self, text: str) -> Any:
        """Return a value read from the command line; InputError where the text is no value of this option."""
        if self.choices and not self.is_file and text not in self.choices:
            raise InputError(f"{text!r} is not one of {', '.join(self.choices)}")
        return self.check(self.read(text))

    def cell(self, text: str, folder: Path) -> Any:
        """Return a value, or several, read from a cell of a table in a folder, to which paths are relative."""
        if self.separators:
            return tuple(self.value(part.strip()) for part in re.split(f"[{self.separators}]", text) if part.strip())
        return self.value(str(folder / text) if self.is_file and text not in (self.alone, *self.choices) else text)

    def check(self, value: Any) -> Any:
        """Return a value; InputError where a number is outside the limits, or there are too many or too few points."""
        if not isinstance(value, tuple | list):
            if isinstance(value, int | float):
                self.limits.check(value)
            return value
        if self.counts and not (value and isinstance(value[0], int | float)):
            fewest, most = self.counts
            if not fewest <= len(value) <= most:
                raise InputError(f"{len(value)} points are given: give {fewest} to {most}")
        for one in value:
            self.check(one)
        return value

    def checked(self, value: Any) -> Any:
        """Do what `check` does, with the name of the option in the error."""
        try:
            return self.check(value)
        except InputError as error:
            raise InputError(f"{self.name.replace('-', ' ')}: {error}") from None


def setting(
    default: Any,
    name: str,
    text: str,
    read: Callable[[str], Any] = number,
    limits: Limits = ANY,
    usual: str = "",
    **more: Any,
) -> Any:
    """Return a field of a data class with an immutable default and an option, of which these are the fields.

    `usual` is the default where that is a number or a word.
    """
    is_said = isinstance(default, str | int | float) and not isinstance(default, bool)
    usual = usual or (f"{default:g}" if isinstance(default, int | float) else str(default)) if is_said else usual
    return field(default=default, metadata={"option": Option(name, text, read, limits, usual, **more)})


def stated(kind: type) -> dict[str, Option]:
    """Return the options of a data class and of those in it, by the dotted path of their fields."""
    found = {}
    for one in fields(kind):
        if "option" in one.metadata:
            found[one.name] = one.metadata["option"]
        for section in sections_of(one.type):
            found |= {f"{one.name}.{path}": option for path, option in stated(section).items()}
    return found


def sections_of(kind: Any) -> list[Any]:
    """Return the data classes that a type, an optional type or a tuple consists of."""
    return [one for one in (kind, *get_args(kind)) if is_dataclass(one)]


def at(section: Any, path: str) -> Any:
    """Return the setting at a dotted path of a data class."""
    return reduce(getattr, path.split("."), section)


def check_all(section: Any) -> None:
    """Raise InputError where a setting of a data class, or of those in it, is outside its limits."""
    for path, option in stated(type(section)).items():
        option.checked(at(section, path))


def differing(one: Any, other: Any) -> list[str]:
    """Return the names of the options whose settings differ between two data classes of one kind."""
    return [option.name for path, option in stated(type(one)).items() if at(one, path) != at(other, path)]
