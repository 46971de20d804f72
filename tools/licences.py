"""List the licence of everything that vstent needs, extras included, and fail where one is not on the list.

Run from the repository: ``python tools/licences.py``. Licences are those that the installed distributions state.
"""

import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution

ALLOWED = {
    "0BSD",
    "Apache-2.0",
    "BSD",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "FSFAP",
    "HPND",
    "ISC",
    "MIT",
    "MIT-CMU",
    "PSF-2.0",
    "Python-2.0",
    "Unlicense",
    "Zlib",
}
"""Licences that ask for no more than their own text and a notice."""

EXCEPTIONS = {"LLVM-exception"}
"""What a licence may add after WITH: it only allows more."""

SPOKEN = {
    r"apache.*2(\.0)?|apache software": "Apache-2.0",
    r"(3-clause|new|modified).*bsd|bsd.*(3-clause|new|modified)": "BSD-3-Clause",
    r"(2-clause|simplified).*bsd|bsd.*(2-clause|simplified)": "BSD-2-Clause",
    r"bsd": "BSD",
    r"\bmit\b|expat": "MIT",
    r"python software foundation|\bpsf\b": "PSF-2.0",
    r"\bisc\b": "ISC",
    r"historical permission|\bhpnd\b": "HPND",
    r"zlib": "Zlib",
    r"unlicense": "Unlicense",
}
"""What licences are called where no SPDX expression is given; the first that fits counts."""


@dataclass(frozen=True)
class Package:
    """One distribution that vstent needs."""

    name: str
    version: str
    licence: str
    is_allowed: bool


def needed(root: str) -> list[Package]:
    """Return all that a distribution needs, directly or not, as far as it is installed here, in order of the names.

    Its own extras count; those of others only where they are asked for. What a marker excludes here is left out.
    """
    found: dict[str, Distribution] = {}
    waiting = [(root, frozenset(distribution(root).metadata.get_all("Provides-Extra") or ()))]
    seen = set()
    while waiting:
        name, extras = waiting.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue
        waiting += list(_requirements(found[name], extras))
    del found[root]
    return [_package(found[name]) for name in sorted(found)]


def _requirements(package: Distribution, extras: frozenset[str]) -> Iterable[tuple[str, frozenset[str]]]:
    from packaging.requirements import Requirement

    for line in package.requires or ():
        requirement = Requirement(line)
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras | {""}):
            yield re.sub(r"[-_.]+", "-", requirement.name).lower(), frozenset(requirement.extras)


def _package(package: Distribution) -> Package:
    licence = stated(package)
    return Package(package.metadata["Name"], package.version, licence, is_allowed(licence))


def stated(package: Distribution) -> str:
    """Return a distribution's licence as an SPDX expression, or in its own words where they mean none."""
    meta = package.metadata
    if expression := meta.get("License-Expression"):
        return str(expression)
    classifiers = [c for c in meta.get_all("Classifier") or () if c.startswith("License ::")]
    spoken = [c.rpartition(":: ")[2] for c in classifiers if c != "License :: OSI Approved"]
    words = spoken or [(meta.get("License") or "none stated").strip().splitlines()[0]]
    return " OR ".join(_spdx(word) for word in words)


def _spdx(word: str) -> str:
    if word in ALLOWED:
        return word
    return next((name for pattern, name in SPOKEN.items() if re.search(pattern, word, re.IGNORECASE)), word)


def is_allowed(expression: str) -> bool:
    """Tell whether an SPDX expression leaves a choice of which all licences are allowed."""
    tokens = re.findall(r"\(|\)|[^\s()]+", expression)
    choice, rest = _choice(tokens)
    return choice and not rest


def _choice(tokens: list[str]) -> tuple[bool, list[str]]:
    value, tokens = _all(tokens)
    while tokens[:1] == ["OR"]:
        other, tokens = _all(tokens[1:])
        value = value or other
    return value, tokens


def _all(tokens: list[str]) -> tuple[bool, list[str]]:
    value, tokens = _one(tokens)
    while tokens[:1] == ["AND"]:
        other, tokens = _one(tokens[1:])
        value = value and other
    return value, tokens


def _one(tokens: list[str]) -> tuple[bool, list[str]]:
    if tokens[:1] == ["("]:
        value, tokens = _choice(tokens[1:])
        return value and tokens[:1] == [")"], tokens[1:]
    value, tokens = bool(tokens) and tokens[0] in ALLOWED, tokens[1:]
    if tokens[:1] == ["WITH"]:
        value, tokens = value and tokens[1] in EXCEPTIONS, tokens[2:]
    return value, tokens


def main(root: str = "vstent") -> int:
    """Print the list; return how many are not allowed."""
    packages = needed(root)
    for package in packages:
        mark = "" if package.is_allowed else "   NOT ON THE LIST"
        print(f"{package.name:28} {package.version:16} {package.licence}{mark}")
    refused = [package.name for package in packages if not package.is_allowed]
    print(f"{len(packages)} distributions, {len(refused)} not on the list{': ' if refused else ''}{', '.join(refused)}")
    return len(refused)


if __name__ == "__main__":
    sys.exit(main())
