"""Ranges of the numbers of a device: which are uncertain, and the device with other values."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from vstent.devices.design import Design, Range, Size

MARGIN = "free_diameter_margin_mm"
"""Name of the free diameter minus the label diameter."""
PROFILE = "free_profile"
"""Name of the difference between the free diameter along the device and its catalogue values."""
LENGTH = "label_length_mm"
"""Name of the difference between the length at the label diameter and the label length."""


def numbers(design: Design) -> tuple[str, ...]:
    """Return the names of all numbers of a device, as `Range.name` has them."""
    profile = (PROFILE,) if any(size.free_profile_mm for size in design.sizes) else ()
    return (*design.numbers, MARGIN, LENGTH, *profile)


def uncertain(design: Design) -> tuple[Range, ...]:
    """Return the ranges of a device that contain more than one value."""
    return tuple(one for one in design.ranges if one.high > one.low)


def values_at(ranges: Sequence[Range], place: Iterable[float]) -> dict[str, float]:
    """Return numbers by name at a place (d,) in their ranges: -1 is the low end, 1 the high end."""
    return {
        one.name: 0.5 * (one.low + one.high + (one.high - one.low) * float(at))
        for one, at in zip(ranges, place, strict=True)
    }


def altered(design: Design, size: Size, values: Mapping[str, float]) -> tuple[Design, Size]:
    """Return a device, which offers only that size, and its size with other values of its numbers (`Range.name`).

    Counts are rounded to the nearest even number. The value of ``label_length_mm`` is added to the length. The label
    diameter stays, and the free diameter follows the margin.
    """
    size = altered_size(size, values)
    return design.altered(values, (size,)), size


def altered_size(size: Size, values: Mapping[str, float]) -> Size:
    """Return a size with other values of margin and length, and of its flare or taper."""
    free_mm = size.diameter_mm + values.get(MARGIN, size.free_diameter_mm - size.diameter_mm)
    wider = ((where, diameter_mm - size.free_diameter_mm) for where, diameter_mm in size.free_profile_mm)
    # Where the device is as wide as its body, it stays so: the value belongs to the flared or tapered part.
    by_mm = values.get(PROFILE, 0.0)
    along = tuple((where, free_mm + more_mm + (by_mm if more_mm else 0.0)) for where, more_mm in wider)
    length_mm = size.length_mm + values.get(LENGTH, 0.0)
    return replace(size, free_diameter_mm=free_mm, length_mm=length_mm, free_profile_mm=along)


def how_sure(design: Design) -> str:
    """Return one sentence on how well the numbers of a device are known."""
    levels = Counter(fact.confidence for fact in design.facts)
    counted = ", ".join(f"{levels[level]} {level}" for level in ("cited", "derived", "estimated") if levels[level])
    return (
        f"{design.name} is described by {len(design.facts)} numbers: {counted}."
        if counted
        else f"{design.name} has no sources."
    )
