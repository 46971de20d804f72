"""Write a fitted device as an entry of a catalogue, in the form of ``catalogue.toml``."""

import json
import re
from collections.abc import Iterator
from typing import Any, Final

from vstent.devices.design import Braid, Design, LaserCut
from vstent.devices.fit import Fitted, labels
from vstent.devices.ranges import LENGTH, MARGIN, PROFILE

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
    lines = ["[[device]]", *(f"{key} = {_text(value)}" for key, value in _head(fitted.design, like, name))]
    lines += writer.wires() if isinstance(fitted.design, Braid) else writer.struts()
    lines += [*writer.structures(), writer.number(MARGIN), "sizes = [", *writer.sizes(has_all_sizes), "]"]
    return "\n".join(lines) + "\n"


def _head(design: Design, like: Design, name: str) -> Iterator[tuple[str, str]]:
    """Yield key, name, maker and kind."""
    yield from (("key", key_of_name(name)), ("name", name), ("maker", like.maker), ("kind", design.kind))


def _text(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_text, value))}]"
    return str(value) if isinstance(value, int) else f"{value:.{DIGITS + 2}g}"


def _table(fields: dict[str, Any]) -> str:
    """Return fields as an inline table of TOML."""
    return f"{{ {', '.join(f'{key} = {_text(value)}' for key, value in fields.items())} }}"


class _Writer:
    """Writes the numbers of one fitted device."""

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

    def number(self, name: str) -> str:
        """Return the line of one number."""
        return f"{name} = {_table(self._number(name))}"

    def _number(self, name: str) -> dict[str, Any]:
        """Return value, range, source and confidence of a number: fitted where it is determined, else as it was."""
        if name in self.by_name:
            value, error = self.by_name[name]
            by = ERRORS * error
            ends = {"low": round(value - by, 5), "high": round(value + by, 5)}
            told = {"source": f"{self.source}; standard error {error:.2g}", "confidence": "derived", "reason": REASON}
            return {"value": round(value, 5)} | ends | told
        value = getattr(self.fitted.design, name)
        if name == "n_columns" and name in self.fitted.counted:
            return {"value": value, "low": value, "high": value} | self._counted()
        return {"value": value} | self._kept(name, name, ("low", "high"))

    def _counted(self) -> dict[str, str]:
        """Return source and confidence of a count."""
        return {"source": f"counted, as in {self.source}", "confidence": "derived", "reason": "a count"}

    def _kept(self, fact: str, name: str, keys: tuple[str, str], group: int = 0) -> dict[str, Any]:
        """Return range, source and confidence of a number of the similar device."""
        facts = [one for one in self.like.facts if one.name == fact]
        told = facts[min(group, len(facts) - 1)] if facts else None
        found: dict[str, Any] = {
            "source": f"{self.like.name}: {told.source}" if told else f"as {self.like.name}",
            "confidence": told.confidence if told else "estimated",
        }
        if name in self.ranges:
            found |= dict(zip(keys, (self.ranges[name].low, self.ranges[name].high), strict=True))
            found["reason"] = self.ranges[name].reason
        return found

    def struts(self) -> list[str]:
        """Return the lines of columns, widths and angle of a laser-cut device."""
        assert isinstance(self.fitted.design, LaserCut)
        return [self.number(name) for name in ("n_columns", "strut_width_um", "strut_thickness_um", "cell_angle_rad")]

    def wires(self) -> list[str]:
        """Return the lines of wires and angle of a braid."""
        assert isinstance(self.fitted.design, Braid)
        groups = [f"    {_table(self._wires(k, *group))}," for k, group in enumerate(self.fitted.design.wires)]
        return ["wires = [", *groups, "]", self.number("braid_angle_rad")]

    def _wires(self, group: int, count: int, diameter_um: float) -> dict[str, Any]:
        """Return count, diameter and source of a group of wires."""
        stem = "wire" if group == 0 else f"wire_{group + 1}"
        name, ends = f"{stem}_diameter_um", ("diameter_low_um", "diameter_high_um")
        is_counted = f"{stem}_count" in self.fitted.counted
        found = {"count": count, "diameter_um": round(diameter_um, 2)} | self._kept("wires", name, ends, group)
        if is_counted or f"{stem}_count" not in self.ranges:
            found |= {"count_low": count, "count_high": count}
        else:
            one = self.ranges[f"{stem}_count"]
            found |= {"count_low": int(one.low), "count_high": int(one.high)}
        if name in self.by_name:
            value, error = self.by_name[name]
            found |= {ends[0]: round(value - ERRORS * error, 2), ends[1]: round(value + ERRORS * error, 2)}
            return found | {"source": self.source, "confidence": "derived", "reason": f"{REASON}; {count} wires"}
        return found | self._own("wires" if group == 0 else f"wires_{group + 1}", "diameter", "um")

    def _own(self, fact: str, name: str, unit: str) -> dict[str, str]:
        """Return source and confidence of a number, if the similar device has them beside those of its group."""
        for one in self.like.facts:
            if one.name == f"{fact}_{name}_{unit}":
                return {f"{name}_source": f"{self.like.name}: {one.source}", f"{name}_confidence": one.confidence}
        return {}

    def structures(self) -> Iterator[str]:
        """Yield the lines of strands, layers, flares, closed ends and free crowns, as the similar device has them."""
        design = self.fitted.design
        if isinstance(design, Braid):
            yield from self._strands(design)
            if design.has_closed_ends:
                yield f"closed_ends = {_table({'value': True} | self._kept('closed_ends', '', ('', '')))}"
        elif design.joined_crowns:
            crowns = {"value": design.joined_crowns} | self._kept("joined_crowns", "", ("", ""))
            yield f"joined_crowns = {_table(crowns)}"
            yield self.number("crown_gap_um")
        if self.like.sizes[0].free_profile_mm:
            yield f"free_profile = {_table(self._profile())}"

    def _strands(self, design: Braid) -> Iterator[str]:
        """Yield the lines of the strands and of the outer layer of a braid."""
        beside: list[str] = []
        for strands in design.strands:
            is_layer = strands.place == "outside"
            name = "outer_layer" if is_layer else f"strand_{len(beside) + 1}" if beside else "strand"
            fact, ends = "outer_layer" if is_layer else "strands", ("diameter_low_um", "diameter_high_um")
            found = self._kept(fact, f"{name}_diameter_um", ends, len(beside)) | self._ends(
                f"{name}_count", "count_{}", int
            )
            found |= {"count": strands.count, "diameter_um": strands.diameter_um}
            found |= self._own(fact if is_layer or not beside else f"{fact}_{len(beside) + 1}", "diameter", "um")
            if is_layer:
                found |= {"beyond_mm": strands.beyond_mm} | self._ends(f"{name}_beyond_mm", "beyond_{}_mm", float)
                found |= self._own(fact, "beyond", "mm")
                yield f"outer_layer = {_table(found)}"
            else:
                beside.append(f"    {_table(found)},")
        if beside:
            yield from ("strands = [", *beside, "]")

    def _ends(self, name: str, key: str, kind: type) -> dict[str, Any]:
        """Return the ends of the range of a number of the similar device, under the keys that `key` makes."""
        one = self.ranges.get(name)
        return {} if one is None else {key.format("low"): kind(one.low), key.format("high"): kind(one.high)}

    def _profile(self) -> dict[str, Any]:
        """Return the free diameter along the similar device: flared ends by their distance, a taper by fractions."""
        size, kept = self.like.sizes[0], self._kept("free_profile", PROFILE, ("", "wider_tolerance_mm"))
        kept.pop("", None)
        pairs = [(where, diameter_mm - size.free_diameter_mm) for where, diameter_mm in size.free_profile_mm]
        by_place = {round(where, 6): round(wider, 6) for where, wider in pairs}
        is_flare = all(by_place.get(round(1 - where, 6)) == wider for where, wider in by_place.items())
        if not is_flare:
            return {"fractions": list(by_place), "wider_mm": list(by_place.values())} | kept
        beyond_mm = sum(2 * one.beyond_mm for one in getattr(self.like, "strands", ()))
        near = {where: wider for where, wider in by_place.items() if where <= 0.5}
        from_ends_mm = [round(where * (size.length_mm + beyond_mm), 4) for where in near]
        return {"from_ends_mm": from_ends_mm, "wider_mm": list(near.values())} | kept

    def sizes(self, has_all: bool) -> Iterator[str]:
        """Yield the blocks of sizes."""
        for diameter_mm, length_mm in labels(self.fitted.measurements):
            value, error = self.by_name.get(f"{LENGTH} {diameter_mm:g} x {length_mm:g}", (0.0, 0.5))
            told = {
                "source": self.source,
                "confidence": "derived",
                "reason": f"difference from the label, and {REASON}",
            }
            tolerance_mm = round(abs(value) + ERRORS * error, 2)
            block = {"diameters_mm": [diameter_mm], "lengths_mm": [length_mm], "length_tolerance_mm": tolerance_mm}
            yield f"    {_table(block | told)},"
        if has_all:
            for diameter_mm in sorted({size.diameter_mm for size in self.like.sizes}):
                lengths_mm = sorted(one.length_mm for one in self.like.sizes if one.diameter_mm == diameter_mm)
                kept = self._kept("sizes", LENGTH, ("", "length_tolerance_mm"))
                kept.pop("", None)
                yield f"    {_table({'diameters_mm': [diameter_mm], 'lengths_mm': lengths_mm} | kept)},"
