"""Write a fitted device as an entry of a catalogue, in the form of ``catalogue.toml``."""

import json
import re
from typing import Any, Final

from vstent.devices.design import Braid, Design, LaserCut
from vstent.devices.fit import Fitted, labels
from vstent.devices.ranges import LENGTH, MARGIN, PROFILE, nth

ERRORS: Final = 2.0
"""Standard errors to either side of a fitted value in its range: 95 % of normal errors lie in it."""
REASON: Final = "two standard errors of the fit"
"""Reason of the range of a fitted number."""
DIGITS: Final = 4
"""Significant digits of fitted values."""


def key_of_name(name: str) -> str:
    """Return a key of the catalogue for the name of a device: lower-case letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", name.casefold()).strip("_") or "device"


def entry(fitted: Fitted, like: Design, name: str, *, source: str, has_all_sizes: bool = False) -> str:
    """Return the entry of a fitted device.

    Parameters
    ----------
    fitted : Fitted
        The fit.
    like : Design
        The similar device. Numbers that the measurements do not determine are taken from it, with their confidence.
    name : str
        Name of the device.
    source : str
        Where the measurements are.
    has_all_sizes : bool, optional
        Whether the device is offered in all sizes of the similar one, and not only in the measured sizes.

    Returns
    -------
    str
        TOML text.
    """
    writer = _Writer(fitted, like, source)
    design = fitted.design
    found: dict[str, Any] = {"key": key_of_name(name), "name": name, "maker": like.maker, "kind": design.kind}
    found |= writer.braid(design) if isinstance(design, Braid) else writer.laser_cut(design)
    if like.sizes[0].free_profile_mm:
        found["free_profile"] = writer.profile()
    found |= {MARGIN: writer.stated(MARGIN), "sizes": writer.sizes(has_all_sizes)}
    return "\n".join(["[[device]]", *(f"{key} = {_text(value, lines=True)}" for key, value in found.items())]) + "\n"


def _text(value: Any, *, lines: bool = False) -> str:
    """Return a value as TOML; tables of a list have lines of their own where `lines` is true."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_text(one)}' for key, one in value.items())} }}"
    if isinstance(value, (list, tuple)) and lines and isinstance(value[0], dict):
        return "\n".join(["[", *(f"    {_text(one)}," for one in value), "]"])
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_text, value))}]"
    return str(value) if isinstance(value, int) else f"{value:.{DIGITS + 2}g}"


class _Writer:
    """Collects the numbers of one fitted device as they stand in its entry."""

    def __init__(self, fitted: Fitted, like: Design, source: str) -> None:
        self.fitted, self.like = fitted, like
        sources = dict.fromkeys(one.source for one in fitted.measurements if one.source)
        told = f" ({'; '.join(sources)})" if sources else ""
        self.source = f"fitted to {len(fitted.measurements)} measurements in {source}{told}"
        self.by_name = {
            one: (float(value), float(error))
            for one, value, error, is_determined in zip(
                fitted.names, fitted.values, fitted.errors, fitted.is_determined, strict=True
            )
            if is_determined
        }
        self.ranges = {one.name: one for one in like.ranges}

    def number(self, name: str, value: Any, digits: int) -> dict[str, Any]:
        """Return value and range of a number; where it is fitted or counted, with source, confidence and reason."""
        if name in self.by_name:
            value, error = self.by_name[name]
            ends = {"low": round(value - ERRORS * error, digits), "high": round(value + ERRORS * error, digits)}
            told = {"source": f"{self.source}; standard error {error:.2g}", "confidence": "derived", "reason": REASON}
            return {"value": round(value, digits)} | ends | told
        if name in self.fitted.counted:
            told = {"source": f"counted, as in {self.source}", "confidence": "derived", "reason": "a count"}
            return {"value": value, "low": value, "high": value} | told
        one = self.ranges[name]
        kind = type(value)
        return {"value": value, "low": kind(one.low), "high": kind(one.high)}

    def stated(self, name: str) -> dict[str, Any]:
        """Return a number with source, confidence and reason, of the similar device where it is not fitted."""
        design = self.fitted.design
        value = self.ranges[name].value if name == MARGIN else getattr(design, name)
        return self._kept(name) | {"reason": self.ranges[name].reason} | self.number(name, value, 5)

    def _kept(self, fact: str, group: int = 0) -> dict[str, Any]:
        """Return source and confidence of a number of the similar device."""
        facts = [one for one in self.like.facts if one.name == fact]
        told = facts[min(group, len(facts) - 1)]
        return {"source": f"{self.like.name}: {told.source}", "confidence": told.confidence}

    def _group(self, fact: str, name: str, numbers: dict[str, Any], group: int = 0) -> dict[str, Any]:
        """Return a group of wires called `name` with its numbers."""
        found: dict[str, Any] = {key: self.number(f"{name}_{key}", value, 2) for key, value in numbers.items()}
        for key, number in found.items():
            own = [one for one in self.like.facts if one.name == f"{nth(fact, group)}_{key}"]
            if own and "source" not in number:
                number |= {"source": f"{self.like.name}: {own[0].source}", "confidence": own[0].confidence}
        return found | self._kept(fact, group) | {"reason": self.ranges[f"{name}_diameter_um"].reason}

    def braid(self, design: Braid) -> dict[str, Any]:
        """Return wires, angle, strands, outer layer and closed ends of a braid."""
        wires = [{"count": count, "diameter_um": diameter_um} for count, diameter_um in design.wires]
        found: dict[str, Any] = {
            "wires": [self._group("wires", nth("wire", k), numbers, k) for k, numbers in enumerate(wires)],
            "braid_angle_rad": self.stated("braid_angle_rad"),
        }
        for strands in design.strands:
            numbers = {"count": strands.count, "diameter_um": strands.diameter_um}
            if strands.place == "outside":
                numbers["beyond_mm"] = strands.beyond_mm
                found["outer_layer"] = self._group("outer_layer", "outer_layer", numbers)
            else:
                beside = found.setdefault("strands", [])
                beside.append(self._group("strands", nth("strand", len(beside)), numbers, len(beside)))
        return found | ({"closed_ends": {"value": True} | self._kept("closed_ends")} if design.has_closed_ends else {})

    def laser_cut(self, design: LaserCut) -> dict[str, Any]:
        """Return columns, widths, angle and crowns of a laser-cut device."""
        names = ["n_columns", "strut_width_um", "strut_thickness_um", "cell_angle_rad"]
        crowns = {"value": design.joined_crowns} | self._kept("joined_crowns") if design.joined_crowns else {}
        numbers = {name: self.stated(name) for name in names + ["crown_gap_um"] * bool(crowns)}
        return numbers | ({"joined_crowns": crowns} if crowns else {})

    def profile(self) -> dict[str, Any]:
        """Return the free diameter along the similar device: flared ends by their distance, a taper by fractions."""
        size, one = self.like.sizes[0], self.ranges[PROFILE]
        kept: dict[str, Any] = self._kept("free_profile") | {"wider_tolerance_mm": one.high, "reason": one.reason}
        pairs = [(where, diameter_mm - size.free_diameter_mm) for where, diameter_mm in size.free_profile_mm]
        by_place = {round(where, 6): round(wider, 6) for where, wider in pairs}
        is_flare = all(by_place.get(round(1 - where, 6)) == wider for where, wider in by_place.items())
        if not is_flare:
            return kept | {"fractions": list(by_place), "wider_mm": list(by_place.values())}
        beyond_mm = sum(2 * one.beyond_mm for one in getattr(self.like, "strands", ()))
        near = {where: wider for where, wider in by_place.items() if where <= 0.5}
        from_ends_mm = [round(where * (size.length_mm + beyond_mm), 4) for where in near]
        return kept | {"from_ends_mm": from_ends_mm, "wider_mm": list(near.values())}

    def sizes(self, has_all: bool) -> list[dict[str, Any]]:
        """Return the blocks of sizes."""
        found = []
        for diameter_mm, length_mm in labels(self.fitted.measurements):
            value, error = self.by_name.get(f"{LENGTH} {diameter_mm:g} x {length_mm:g}", (0.0, 0.5))
            told = {
                "source": self.source,
                "confidence": "derived",
                "reason": f"difference from the label, and {REASON}",
            }
            tolerance_mm = round(abs(value) + ERRORS * error, 2)
            block: dict[str, Any] = {"diameters_mm": [diameter_mm], "lengths_mm": [length_mm]}
            found.append(block | {"length_tolerance_mm": tolerance_mm} | told)
        for diameter_mm in sorted({size.diameter_mm for size in self.like.sizes}) if has_all else ():
            lengths_mm = sorted(one.length_mm for one in self.like.sizes if one.diameter_mm == diameter_mm)
            one = self.ranges[LENGTH]
            told = self._kept("sizes") | {"length_tolerance_mm": one.high, "reason": one.reason}
            found.append({"diameters_mm": [diameter_mm], "lengths_mm": lengths_mm} | told)
        return found
