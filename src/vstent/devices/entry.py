"""Write a fitted device as an entry of a catalogue, in the form of ``catalogue.toml``."""

import re
from typing import Any, Final

import tomlkit

from vstent.devices.design import Braid, Design, nth
from vstent.devices.fit import Fitted, labels
from vstent.devices.ranges import LENGTH, MARGIN, PROFILE

ERRORS: Final = 2.0
"""Standard errors to either side of a fitted value in its range: 95 % of normal errors lie in it."""
REASON: Final = "two standard errors of the fit"
"""Reason of the range of a fitted number."""


def key_of_name(name: str) -> str:
    """Return a key of the catalogue for the name of a device: lower-case letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", name.casefold()).strip("_") or "device"


def entry(fitted: Fitted, like: Design, name: str, *, source: str, has_all_sizes: bool = False) -> str:
    """Return the entry of a fitted device as TOML text.

    Parameters
    ----------
    like : the similar device. Numbers that the measurements do not determine are taken from it, with their confidence.
    name : name of the device.
    source : where the measurements are.
    has_all_sizes : whether the device is offered in all sizes of the similar one, and not only in the measured sizes.
    """
    writer, design = _Writer(fitted, like, source), fitted.design
    found: dict[str, Any] = {"key": key_of_name(name), "name": name, "maker": "not stated", "kind": design.kind}
    if isinstance(design, Braid):
        beside = [strands for strands in design.strands if strands.place == "beside"]
        found["wires"] = [writer.group("wires", number) for number in range(len(design.wires))]
        found["braid_angle_rad"] = writer.stated("braid_angle_rad")
        if beside:
            found["strands"] = [writer.group("strands", number) for number in range(len(beside))]
        if len(beside) < len(design.strands):
            found["outer_layer"] = writer.group("outer_layer", 0)
        if design.has_closed_ends:
            found["closed_ends"] = {"value": True} | writer.taken("closed_ends")
    else:
        found |= {number: writer.stated(number) for number in design.numbers}
        if design.joined_crowns:
            found["joined_crowns"] = {"value": list(design.joined_crowns)} | writer.taken("joined_crowns")
    if like.sizes[0].free_profile_mm:
        found["free_profile"] = writer.profile()
    found |= {MARGIN: writer.stated(MARGIN), "sizes": writer.sizes(has_all_sizes)}
    return tomlkit.dumps({"device": [found]})


class _Writer:
    """Collects the numbers of one fitted device as they stand in its entry."""

    def __init__(self, fitted: Fitted, like: Design, source: str) -> None:
        self.fitted, self.like = fitted, like
        sources = dict.fromkeys(one.source for one in fitted.measurements if one.source)
        notes = f" ({'; '.join(sources)})" if sources else ""
        self.source = f"fitted to {len(fitted.measurements)} measurements in {source}{notes}"
        values = zip(fitted.names, fitted.values.tolist(), fitted.errors.tolist(), fitted.is_determined, strict=True)
        self.by_name = {name: (value, error) for name, value, error, is_determined in values if is_determined}
        self.ranges = {one.name: one for one in like.ranges}

    def number(self, name: str, digits: int) -> dict[str, Any]:
        """Return value and range of a number; where it is fitted or counted, with source, confidence and reason."""
        one = self.ranges[name]
        value = self.fitted.design.numbers.get(name, one.value)
        if name in self.by_name:
            value, error = self.by_name[name]
            ends = {"low": round(value - ERRORS * error, digits), "high": round(value + ERRORS * error, digits)}
            noted = {"source": f"{self.source}; standard error {error:.2g}", "confidence": "derived", "reason": REASON}
            return {"value": round(value, digits)} | ends | noted
        if name in self.fitted.counted:
            noted = {"source": f"counted, as in {self.source}", "confidence": "derived", "reason": "a count"}
            return {"value": value, "low": value, "high": value} | noted
        return {"value": value, "low": one.low, "high": one.high}

    def stated(self, name: str) -> dict[str, Any]:
        """Return a number with source, confidence and reason, of the similar device where it is not fitted."""
        return self.taken(name) | {"reason": self.ranges[name].reason} | self.number(name, 5)

    def taken(self, fact: str, group: int = 0) -> dict[str, Any]:
        """Return source and confidence of a number of the similar device."""
        facts = [one for one in self.like.facts if one.name == fact]
        one = facts[min(group, len(facts) - 1)]
        return {"source": f"{self.like.name}: {one.source}", "confidence": one.confidence}

    def group(self, field: str, number: int) -> dict[str, Any]:
        """Return a group of wires, the entry `number` of a field."""
        name = nth(field.removesuffix("s"), number)
        keys = ["count", "diameter_um", *(["beyond_mm"] if field == "outer_layer" else [])]
        found: dict[str, Any] = {key: self.number(f"{name}_{key}", 2) for key in keys}
        for key, one in found.items():
            own = f"{nth(field, number)}_{key}"
            if "source" not in one and any(fact.name == own for fact in self.like.facts):
                one |= self.taken(own)
        return found | self.taken(field, number) | {"reason": self.ranges[f"{name}_diameter_um"].reason}

    def profile(self) -> dict[str, Any]:
        """Return the free diameter along the similar device: flared ends by their distance, a taper by fractions."""
        size, one = self.like.sizes[0], self.ranges[PROFILE]
        found: dict[str, Any] = self.taken(PROFILE) | {"wider_tolerance_mm": one.high, "reason": one.reason}
        pairs = [(where, diameter_mm - size.free_diameter_mm) for where, diameter_mm in size.free_profile_mm]
        by_place = {round(where, 6): round(wider, 6) for where, wider in pairs}
        is_flare = all(by_place.get(round(1 - where, 6)) == wider for where, wider in by_place.items())
        if not is_flare:
            return found | {"fractions": list(by_place), "wider_mm": list(by_place.values())}
        near = {where: wider for where, wider in by_place.items() if where <= 0.5}
        from_ends_mm = [round(where * (size.length_mm + 2 * self.like.beyond_mm), 4) for where in near]
        return found | {"from_ends_mm": from_ends_mm, "wider_mm": list(near.values())}

    def sizes(self, has_all: bool) -> list[dict[str, Any]]:
        """Return the blocks of sizes."""
        found: list[dict[str, Any]] = []
        noted = {"source": self.source, "confidence": "derived", "reason": f"difference from the label, and {REASON}"}
        for diameter_mm, length_mm in labels(self.fitted.measurements):
            value, error = self.by_name.get(f"{LENGTH} {diameter_mm:g} x {length_mm:g}", (0.0, 0.5))
            tolerance_mm = round(abs(value) + ERRORS * error, 2)
            block = {"diameters_mm": [diameter_mm], "lengths_mm": [length_mm], "length_tolerance_mm": tolerance_mm}
            found.append(block | noted)
        one = self.ranges[LENGTH]
        noted = self.taken("sizes") | {"length_tolerance_mm": one.high, "reason": one.reason}
        for diameter_mm in sorted({size.diameter_mm for size in self.like.sizes}) if has_all else ():
            lengths_mm = sorted(size.length_mm for size in self.like.sizes if size.diameter_mm == diameter_mm)
            found.append({"diameters_mm": [diameter_mm], "lengths_mm": lengths_mm} | noted)
        return found
