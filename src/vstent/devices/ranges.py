"""Ranges of the numbers of a device: which are uncertain, and the device with other values."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from vstent.devices.design import Braid, Design, LaserCut, Range, Size, Strands

MARGIN = "free_diameter_margin_mm"
"""Name of the free diameter minus the label diameter."""
PROFILE = "free_profile"
"""Name of the difference between the free diameter along the device and its catalogue values."""
LENGTH = "label_length_mm"
"""Name of the difference between the length at the label diameter and the label length."""


def numbers(design: Design) -> tuple[str, ...]:
    """Return the names of all numbers of a device, as `Range.name` has them."""
    if isinstance(design, LaserCut):
        gap = ("crown_gap_um",) if design.joined_crowns else ()
        return ("n_columns", "strut_width_um", "strut_thickness_um", "cell_angle_rad", *gap, *_of_sizes(design))
    groups = [nth("wire", number) for number in range(len(design.wires))]
    named = [f"{group}_{what}" for group in groups for what in ("count", "diameter_um")]
    of_strands = [name for group in _strand_names(design) for name in group if name]
    return (*named, "braid_angle_rad", *of_strands, *_of_sizes(design))


def _of_sizes(design: Design) -> tuple[str, ...]:
    """Return the names of the numbers that the sizes of a device have."""
    return (MARGIN, LENGTH, PROFILE) if any(size.free_profile_mm for size in design.sizes) else (MARGIN, LENGTH)


def nth(name: str, number: int) -> str:
    """Return the name of a group of wires, counted from 0: wire, wire_2 and so on."""
    return f"{name}_{number + 1}" if number else name


def _strand_names(braid: Braid) -> list[tuple[str, str, str]]:
    """Return the names of count, diameter and further length of all strands; no length is an empty name."""
    beside = [strands for strands in braid.strands if strands.place == "beside"]
    found = []
    for strands in braid.strands:
        is_layer = strands.place == "outside"
        name = "outer_layer" if is_layer else nth("strand", beside.index(strands))
        found.append((f"{name}_count", f"{name}_diameter_um", f"{name}_beyond_mm" if is_layer else ""))
    return found


def uncertain(design: Design) -> tuple[Range, ...]:
    """Return the ranges of a device that contain more than one value."""
    return tuple(one for one in design.ranges if one.is_wide)


def values_at(ranges: Sequence[Range], place: Iterable[float]) -> dict[str, float]:
    """Return numbers by name at a place (d,) in their ranges: -1 is the low end, 1 the high end."""
    return {
        one.name: 0.5 * (one.low + one.high + (one.high - one.low) * float(at))
        for one, at in zip(ranges, place, strict=True)
    }


def altered(design: Design, size: Size, values: Mapping[str, float]) -> tuple[Design, Size]:
    """Return a device and its size with other values of its numbers.

    Parameters
    ----------
    values : new values by the name of the number (`Range.name`). Counts are rounded to the nearest even number. The
        value of ``label_length_mm`` is added to the length.

    Returns
    -------
    design : the device; it offers only the altered size.
    size : the altered size. Its label diameter stays, and its free diameter follows the margin.
    """
    size = _size(size, values)
    return _design(design, (size,), values), size


def altered_sizes(design: Design, values: Mapping[str, float]) -> tuple[Design, dict[Size, Size]]:
    """Return a device with other values of its numbers in all its sizes.

    Parameters
    ----------
    values : new values by the name of the number, as in `altered`.

    Returns
    -------
    design : the device with all its sizes altered.
    originals : size of the catalogue by altered size.
    """
    originals = {_size(size, values): size for size in design.sizes}
    return _design(design, tuple(originals), values), originals


def _size(size: Size, values: Mapping[str, float]) -> Size:
    """Return a size with other values of margin and length."""
    margin_mm = values.get(MARGIN, size.free_diameter_mm - size.diameter_mm)
    length_mm = size.length_mm + values.get(LENGTH, 0.0)
    free_mm = size.diameter_mm + margin_mm
    return replace(size, free_diameter_mm=free_mm, length_mm=length_mm, free_profile_mm=_profile(size, free_mm, values))


def _profile(size: Size, free_mm: float, values: Mapping[str, float]) -> tuple[tuple[float, float], ...]:
    """Return the free diameter along a size whose body has another one, with another value of its flare or taper."""
    by_mm = values.get(PROFILE, 0.0)
    wider = ((where, diameter_mm - size.free_diameter_mm) for where, diameter_mm in size.free_profile_mm)
    # Where the device is as wide as its body, it stays so: the value belongs to the flared or tapered part.
    return tuple((where, free_mm + more_mm + (by_mm if more_mm else 0.0)) for where, more_mm in wider)


def _design(design: Design, sizes: tuple[Size, ...], values: Mapping[str, float]) -> Design:
    """Return a device with other sizes and other values of its wires or struts."""
    if isinstance(design, Braid):
        wires = tuple(_wires(k, group, values) for k, group in enumerate(design.wires, start=1))
        angle_rad = values.get("braid_angle_rad", design.braid_angle_rad)
        strands = tuple(
            Strands(
                _even(values.get(count, one.count)),
                values.get(diameter_um, one.diameter_um),
                one.place,
                values.get(beyond_mm, one.beyond_mm),
            )
            for one, (count, diameter_um, beyond_mm) in zip(design.strands, _strand_names(design), strict=True)
        )
        return replace(design, wires=wires, braid_angle_rad=angle_rad, sizes=sizes, strands=strands)
    fields = {
        name: values[name]
        for name in ("strut_width_um", "strut_thickness_um", "cell_angle_rad", "crown_gap_um")
        if name in values
    }
    columns = _even(values.get("n_columns", design.n_columns))
    return replace(design, n_columns=columns, sizes=sizes, **fields)  # type: ignore[arg-type]


def _wires(number: int, group: tuple[int, float], values: Mapping[str, float]) -> tuple[int, float]:
    """Return count and diameter (um) of the group of wires with this number, with other values."""
    name = "wire" if number == 1 else f"wire_{number}"
    return _even(values.get(f"{name}_count", group[0])), values.get(f"{name}_diameter_um", group[1])


def _even(count: float) -> int:
    """Return the nearest even number."""
    return 2 * int(np.floor(0.5 * count + 0.5))


def how_sure(design: Design) -> str:
    """Return one sentence on how well the numbers of a device are known."""
    levels = Counter(fact.confidence for fact in design.facts)
    counted = ", ".join(f"{levels[level]} {level}" for level in ("cited", "derived", "estimated") if levels[level])
    return f"Numbers of {design.name}: {counted}." if counted else f"{design.name} has no sources."
