"""Schema of the device catalogue: every number has a source, a confidence and a range."""

import tomllib
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Final, Generic, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from vstent.devices.design import Braid, Confidence, Design, Fact, LaserCut, Range, Size, Strands, called
from vstent.devices.ranges import LENGTH, MARGIN, PROFILE, nth
from vstent.devices.treatment import BARE
from vstent.errors import DeviceError

MOST_WIRES: Final = 1000
"""Largest number of wires or columns that the schema accepts."""
LARGEST_UM: Final = 1000.0
"""Largest width or diameter of a wire or strut that the schema accepts, in um."""
THINNEST_UM: Final = 5.0
"""Smallest width or diameter of a wire or strut that the schema accepts, in um."""
LARGEST_MM: Final = 200.0
"""Largest diameter or length of a size that the schema accepts, in mm."""
MOST_SIZES: Final = 100
"""Largest number of diameters, or of lengths, in one block of sizes."""
LARGEST_MARGIN_MM: Final = 1.5
"""Largest difference between free diameter and label diameter that the schema accepts, in mm (LEO: up to 1.2)."""

_Whole = Annotated[int, Field(gt=0, le=MOST_WIRES)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _in_um(width: float) -> float:
    """Return a width in um, or raise a ValueError if it is too small to be in um."""
    if width < THINNEST_UM:
        raise ValueError(f"{width:g} um is thinner than any wire or strut, give micrometres")
    return width


_Words = Annotated[str, Field(min_length=3)]
_Width_um = Annotated[float, Field(gt=0, le=LARGEST_UM), AfterValidator(_in_um)]
_Length_mm = Annotated[float, Field(ge=0, le=LARGEST_MM)]
_Margin_mm = Annotated[float, Field(ge=-LARGEST_MARGIN_MM, le=LARGEST_MARGIN_MM)]
Value = TypeVar("Value", int, float)
_Lengths_mm = Annotated[list[Annotated[float, Field(gt=0, le=LARGEST_MM)]], Field(min_length=1, max_length=MOST_SIZES)]


class _Strict(BaseModel):
    """Entry without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Sourced(_Strict):
    """Entry with a source and a confidence."""

    source: _Words
    confidence: Confidence


class _Number(_Strict, Generic[Value]):
    """Number of a group with its range. Source and reason are those of the group, unless it has its own."""

    value: Value
    low: Value
    """Smallest plausible value."""
    high: Value
    """Largest plausible value."""
    source: _Words | None = None
    confidence: Confidence | None = None
    reason: _Words | None = None
    """Tolerance or class from which the range follows."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the number, or raise a ValueError if its range or its source is invalid."""
        if not self.low <= self.value <= self.high:
            raise ValueError(f"the range {self.low:g} to {self.high:g} does not contain the value {self.value:g}")
        if (self.source is None) != (self.confidence is None):
            raise ValueError("source and confidence go together")
        return self


class _Stated(_Number[Value], Generic[Value]):
    """Number with its own source, confidence and reason."""

    source: _Words
    confidence: Confidence
    reason: _Words


class _Wires(_Sourced):
    """Group of equal wires; their diameter may have a source of its own, because makers publish the count alone."""

    reason: _Words
    count: _Number[_Whole]
    diameter_um: _Number[_Width_um]

    def ranges(self, name: str) -> Iterator[Range]:
        """Yield the ranges of the numbers of wires called `name`."""
        for key, number in self._numbers():
            yield _range(f"{name}_{key}", number, self)

    def facts(self, name: str, number: int = 0) -> Iterator[Fact]:
        """Yield the source of a group of `name`, counted from 0, and those of numbers that have their own."""
        yield _fact(name, self)
        for key, one in self._numbers():
            if one.source is not None and one.confidence is not None:
                yield Fact(f"{nth(name, number)}_{key}", one.source, one.confidence)

    def _numbers(self) -> Iterator[tuple[str, _Number[Any]]]:
        """Yield the numbers with the names of their fields."""
        for key in type(self).model_fields:
            if isinstance(one := getattr(self, key), _Number):
                yield key, one


class _Layer(_Wires):
    """Outer layer of a dual-layer device."""

    beyond_mm: _Number[_Length_mm]
    """Length by which it is longer than the mesh at each end, at the label diameter, in mm."""


class _Flag(_Sourced):
    """Property that a device has or has not."""

    value: bool


class _Crowns(_Sourced):
    """Pattern of joined and free crowns."""

    value: list[Annotated[str, Field(pattern="^[01]+$")]] = Field(min_length=1, max_length=MOST_SIZES)


class _FreeProfile(_Sourced):
    """Free diameter that varies along a device, relative to that of its body."""

    wider_mm: list[Annotated[float, Field(ge=-5, le=5)]] = Field(min_length=2, max_length=MOST_SIZES)
    """How much wider than the body the free device is at the places, in mm; linear between them."""
    wider_tolerance_mm: Annotated[float, Field(ge=0, le=5)]
    """Largest difference of these numbers to either side, in mm."""
    reason: _Words
    """Tolerance or class from which it follows."""
    from_ends_mm: list[Annotated[float, Field(ge=0, le=LARGEST_MM)]] | None = None
    """Distances from either end that the numbers refer to, in mm, for a device with flared ends."""
    fractions: list[Annotated[float, Field(ge=0, le=1)]] | None = None
    """Fractions of the length, 0 at the proximal end, that the numbers refer to, for a tapered device."""

    @model_validator(mode="after")
    def _check(self) -> "_FreeProfile":
        """Return the entry, or raise a ValueError if places and numbers do not match."""
        places = self.from_ends_mm if self.fractions is None else self.fractions
        if places is None or (self.from_ends_mm is not None and self.fractions is not None):
            raise ValueError("give the places of wider_mm, either as from_ends_mm or as fractions")
        if len(places) != len(self.wider_mm) or any(b <= a for a, b in pairwise(places)):
            raise ValueError("give as many increasing places as there are numbers in wider_mm")
        return self

    def along(self, free_mm: float, length_mm: float) -> tuple[tuple[float, float], ...]:
        """Return pairs of a fraction of the length and the free diameter there, in mm."""
        pairs = {where: free_mm + wider for where, wider in zip(self.fractions or [], self.wider_mm, strict=False)}
        for from_end_mm, wider in zip(self.from_ends_mm or [], self.wider_mm, strict=False):
            where = min(from_end_mm / length_mm, 0.5)
            pairs |= {where: free_mm + wider, 1 - where: free_mm + wider}
        return tuple((where, round(diameter_mm, 6)) for where, diameter_mm in sorted(pairs.items()))


class _Sizes(_Sourced):
    """Block of sizes: all pairs of its diameters and lengths."""

    diameters_mm: _Lengths_mm
    lengths_mm: _Lengths_mm
    length_tolerance_mm: _Length_mm
    """Largest difference to either side between the label length and the length at the label diameter, in mm."""
    reason: _Words
    """Tolerance or class from which it follows."""


class _Device(_Strict):
    """Entry of a device of either family."""

    key: str = Field(pattern=r"^[a-z0-9_]+$")
    name: str
    maker: str
    free_diameter_margin_mm: _Stated[_Margin_mm]
    """Free diameter minus label diameter, in mm."""
    sizes: list[_Sizes] = Field(min_length=1)
    free_profile: _FreeProfile | None = None
    """Flared ends, or a free diameter that tapers along the device."""

    def _sizes(self) -> tuple[Size, ...]:
        """Return all sizes of the device."""
        pairs = {(d, length) for block in self.sizes for d in block.diameters_mm for length in block.lengths_mm}
        return tuple(self._size(diameter_mm, length_mm) for diameter_mm, length_mm in sorted(pairs))

    def _size(self, diameter_mm: float, length_mm: float) -> Size:
        """Return one size of the device."""
        free_mm, whole_mm = round(diameter_mm + self.free_diameter_margin_mm.value, 6), length_mm + self._beyond_mm()
        along = self.free_profile.along(free_mm, whole_mm) if self.free_profile else ()
        return Size(diameter_mm, length_mm, free_mm, free_profile_mm=along)

    def _beyond_mm(self) -> float:
        """Return the length of both ends of the device that the label does not count, in mm."""
        return 0.0

    def _shared_ranges(self) -> tuple[Range, ...]:
        """Return the ranges of the numbers that both families have; of blocks of sizes the widest."""
        widest = sorted(self.sizes, key=lambda block: block.length_tolerance_mm)[-1]
        found = [
            _range(MARGIN, self.free_diameter_margin_mm),
            _about_zero(LENGTH, widest.length_tolerance_mm, widest),
        ]
        if self.free_profile:
            found.append(_about_zero(PROFILE, self.free_profile.wider_tolerance_mm, self.free_profile))
        return tuple(found)

    def _shared_facts(self) -> tuple[Fact, ...]:
        """Return the sources of the numbers that both families have; blocks of sizes of one source have one fact."""
        blocks = {(block.source, block.confidence): block for block in self.sizes}
        return (
            _fact(MARGIN, self.free_diameter_margin_mm),
            *(_fact("sizes", block) for block in blocks.values()),
            *([_fact("free_profile", self.free_profile)] if self.free_profile else []),
        )


class _Braid(_Device):
    """Entry of a braid."""

    kind: Literal["braid"]
    wires: list[_Wires] = Field(min_length=1)
    braid_angle_rad: _Stated[_Positive]
    outer_layer: _Layer | None = None
    """Few thick wires around the mesh, longer than it."""
    strands: list[_Wires] = Field(default=[], max_length=MOST_SIZES)
    """Radiopaque wires beside those of the mesh."""
    closed_ends: _Flag | None = None
    """Whether wires turn back in loops at both ends."""

    def design(self) -> Design:
        """Return the braid."""
        return Braid(
            key=self.key,
            name=self.name,
            wires=tuple((group.count.value, group.diameter_um.value) for group in self.wires),
            braid_angle_rad=self.braid_angle_rad.value,
            sizes=self._sizes(),
            maker=self.maker,
            facts=(*self._facts(), *self._shared_facts()),
            ranges=self._ranges(),
            strands=self._strands(),
            has_closed_ends=self.closed_ends is not None and self.closed_ends.value,
        )

    def _beyond_mm(self) -> float:
        """Return the length of both ends of the device that the label does not count, in mm."""
        return 2 * self.outer_layer.beyond_mm.value if self.outer_layer else 0.0

    def _facts(self) -> Iterator[Fact]:
        """Yield the sources of the numbers that only braids have."""
        for number, group in enumerate(self.wires):
            yield from group.facts("wires", number)
        yield _fact("braid_angle_rad", self.braid_angle_rad)
        if self.outer_layer is not None:
            yield from self.outer_layer.facts("outer_layer")
        for number, group in enumerate(self.strands):
            yield from group.facts("strands", number)
        if self.closed_ends is not None:
            yield _fact("closed_ends", self.closed_ends)

    def _strands(self) -> tuple[Strands, ...]:
        """Return the further wires of the braid."""
        beside = tuple(Strands(group.count.value, group.diameter_um.value, "beside") for group in self.strands)
        if self.outer_layer is None:
            return beside
        layer = self.outer_layer
        return (*beside, Strands(layer.count.value, layer.diameter_um.value, "outside", layer.beyond_mm.value))

    def _ranges(self) -> tuple[Range, ...]:
        """Return the ranges of all numbers."""
        layer = [] if self.outer_layer is None else self.outer_layer.ranges("outer_layer")
        return (
            *(one for number, group in enumerate(self.wires) for one in group.ranges(nth("wire", number))),
            _range("braid_angle_rad", self.braid_angle_rad),
            *layer,
            *(one for number, group in enumerate(self.strands) for one in group.ranges(nth("strand", number))),
            *self._shared_ranges(),
        )


class _LaserCut(_Device):
    """Entry of a laser-cut device."""

    kind: Literal["laser_cut"]
    n_columns: _Stated[_Whole]
    strut_width_um: _Stated[_Width_um]
    strut_thickness_um: _Stated[_Width_um]
    cell_angle_rad: _Stated[_Positive]
    joined_crowns: _Crowns | None = None
    """Which crowns are joined, for a device with open cells."""
    crown_gap_um: _Stated[_Width_um] | None = None
    """Distance between free crowns that face each other, in um."""

    @model_validator(mode="after")
    def _check(self) -> "_LaserCut":
        """Return the entry, or raise a ValueError if an open-cell device states only half of its cells."""
        if (self.joined_crowns is None) != (self.crown_gap_um is None):
            raise ValueError("a device with open cells needs both joined_crowns and crown_gap_um")
        return self

    def design(self) -> Design:
        """Return the laser-cut device."""
        names = ["n_columns", "strut_width_um", "strut_thickness_um", "cell_angle_rad"]
        numbers = names + (["crown_gap_um"] if self.crown_gap_um else [])
        words = numbers + (["joined_crowns"] if self.joined_crowns else [])
        return LaserCut(
            key=self.key,
            name=self.name,
            n_columns=self.n_columns.value,
            strut_width_um=self.strut_width_um.value,
            strut_thickness_um=self.strut_thickness_um.value,
            cell_angle_rad=self.cell_angle_rad.value,
            sizes=self._sizes(),
            maker=self.maker,
            facts=tuple(_fact(name, getattr(self, name)) for name in words) + self._shared_facts(),
            ranges=(
                *(_range(name, getattr(self, name)) for name in numbers),
                *self._shared_ranges(),
            ),
            joined_crowns=tuple(self.joined_crowns.value) if self.joined_crowns else (),
            crown_gap_um=self.crown_gap_um.value if self.crown_gap_um else 0.0,
        )


class _Catalogue(_Strict):
    """Content of a catalogue file."""

    device: list[Annotated[_Braid | _LaserCut, Field(discriminator="kind")]]


def _fact(name: str, sourced: _Sourced | _Stated[int] | _Stated[float]) -> Fact:
    """Return the source of one number."""
    return Fact(name, sourced.source, sourced.confidence)


def _range(name: str, number: _Number[int] | _Number[float], group: _Wires | None = None) -> Range:
    """Return the range of a number, with its own reason and confidence or those of its group."""
    reason, confidence = number.reason, number.confidence
    if group is not None:
        reason, confidence = reason or group.reason, confidence or group.confidence
    assert reason is not None
    assert confidence is not None
    return Range(name, number.value, number.low, number.high, reason, confidence)


def _about_zero(name: str, tolerance: float, group: _Sizes | _FreeProfile) -> Range:
    """Return the range of a difference from values of the catalogue."""
    return Range(name, 0.0, -tolerance, tolerance, group.reason, group.confidence)


def parse(text: str, name: str = "The device catalogue") -> dict[str, Design]:
    """Read a catalogue from TOML text.

    Parameters
    ----------
    text : content of the file.
    name : name of the catalogue in messages.

    Returns designs by their key.

    Raises
    ------
    DeviceError
        The text is not TOML, breaks the schema or lists a device twice.
    """
    try:
        found = _Catalogue.model_validate(tomllib.loads(text)).device
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DeviceError(f"{name} is wrong at {where}: {first['msg']}. Correct that entry.") from error
    except ValueError as error:  # not TOML, or a number with thousands of digits
        raise DeviceError(f"{name} is not valid TOML: {error}. Correct that line.") from error
    except RecursionError:
        raise DeviceError(
            f"{name} is nested too deeply to be a catalogue. Give it the form of catalogue.toml."
        ) from None
    designs = {entry.key: entry.design() for entry in found}
    words = called(designs.values())
    if len(designs) < len(found) or len(set(words)) < len(words):
        raise DeviceError(f"{name} uses one key or name for two devices. Give each its own.")
    if BARE in words:
        raise DeviceError(
            f"{name} names a device {BARE!r}, which is reserved for the flow without a device. Give it another name."
        )
    return designs
