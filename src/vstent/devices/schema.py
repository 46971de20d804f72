"""Schema of the device catalogue: every number has a source, a confidence and a range."""

import tomllib
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Final, Generic, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from vstent.devices.design import (
    Basket,
    Braid,
    Coil,
    Confidence,
    Design,
    Fact,
    LaserCut,
    Range,
    Size,
    Strands,
    called,
    nth,
)
from vstent.devices.ranges import LENGTH
from vstent.devices.treatment import BARE
from vstent.errors import DeviceError, VstentError

LARGEST_MM: Final = 600.0
"""Largest diameter or length of a size that the schema accepts, in mm."""
MOST_SIZES: Final = 100
"""Largest number of diameters, or of lengths, in one block of sizes."""


def _in_um(width: float) -> float:
    """Return a width in um, or raise a ValueError if it is too small to be in um."""
    if width < 5:
        raise ValueError(f"{width:g} um is thinner than any wire or strut, give micrometres")
    return width


_Whole = Annotated[int, Field(gt=0, le=1000)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Words = Annotated[str, Field(min_length=3)]
_Width_um = Annotated[float, Field(gt=0, le=1000), AfterValidator(_in_um)]
_Length_mm = Annotated[float, Field(ge=0, le=LARGEST_MM)]
_Margin_mm = Annotated[float, Field(ge=-1.5, le=1.5)]  # LEO: up to 1.2
_Lengths_mm = Annotated[list[Annotated[float, Field(gt=0, le=LARGEST_MM)]], Field(min_length=1, max_length=MOST_SIZES)]
Value = TypeVar("Value", int, float)
Schema = TypeVar("Schema", bound=BaseModel)


class Strict(BaseModel):
    """Entry without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Sourced(Strict):
    """Entry with a source and a confidence."""

    source: _Words
    confidence: Confidence

    def noted(self, name: str, number: int) -> Iterator[Fact | Range]:
        """Yield the sources and the ranges of what the field `name` holds, as the entry `number` of a list."""
        yield Fact(name, self.source, self.confidence)


class _Number(Strict, Generic[Value]):
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

    def noted(self, name: str, number: int) -> Iterator[Fact | Range]:
        """Yield the source and the range of the number."""
        yield Fact(name, self.source, self.confidence)
        yield Range(name, self.value, self.low, self.high, self.reason, self.confidence)


class _Wires(_Sourced):
    """Group of equal wires; their diameter may have a source of its own, because makers publish the count alone."""

    reason: _Words
    count: _Number[_Whole]
    diameter_um: _Number[_Width_um]

    def noted(self, name: str, number: int) -> Iterator[Fact | Range]:
        """Yield the source of the group, those of numbers that have their own, and the ranges of all."""
        yield from super().noted(name, number)
        for key in type(self).model_fields:
            if isinstance(one := getattr(self, key), _Number):
                if one.source is not None and one.confidence is not None:
                    yield Fact(f"{nth(name, number)}_{key}", one.source, one.confidence)
                reason, confidence = one.reason or self.reason, one.confidence or self.confidence
                full_name = f"{nth(name.removesuffix('s'), number)}_{key}"
                yield Range(full_name, one.value, one.low, one.high, reason, confidence)


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

    def noted(self, name: str, number: int) -> Iterator[Fact | Range]:
        """Yield the source, and the range of the difference from the numbers."""
        yield from super().noted(name, number)
        yield Range(name, 0.0, -self.wider_tolerance_mm, self.wider_tolerance_mm, self.reason, self.confidence)

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


class _Device(Strict):
    """Entry of a device of either family."""

    key: str = Field(pattern=r"^[a-z0-9_]+$")
    name: str
    maker: str
    free_diameter_margin_mm: _Stated[_Margin_mm]
    """Free diameter minus label diameter, in mm."""
    sizes: list[_Sizes] = Field(min_length=1)
    free_profile: _FreeProfile | None = None
    """Flared ends, or a free diameter that tapers along the device."""

    def shared(self, beyond_mm: float = 0.0) -> dict[str, Any]:
        """Return the fields that the designs of all families have, and the numbers that are fields of this one.

        The ends of the device that the label does not count are `beyond_mm` long.
        """
        pairs = {(d, length) for block in self.sizes for d in block.diameters_mm for length in block.lengths_mm}
        sizes = []
        for diameter_mm, length_mm in sorted(pairs):
            free_mm = round(diameter_mm + self.free_diameter_margin_mm.value, 6)
            along = self.free_profile.along(free_mm, length_mm + beyond_mm) if self.free_profile else ()
            sizes.append(Size(diameter_mm, length_mm, free_mm, free_profile_mm=along))
        noted = list(self._noted())
        own = {name: getattr(self, name) for name in type(self).model_fields if name not in _Device.model_fields}
        return {
            **{name: entry.value for name, entry in own.items() if isinstance(entry, _Stated)},
            "key": self.key,
            "name": self.name,
            "maker": self.maker,
            "sizes": tuple(sizes),
            "facts": tuple(one for one in noted if isinstance(one, Fact)),
            "ranges": tuple(one for one in noted if isinstance(one, Range)),
        }

    def _noted(self) -> Iterator[Fact | Range]:
        """Yield the sources and the ranges of all numbers, first of those that only this family has."""
        for name in sorted(type(self).model_fields, key=list(_Device.model_fields).__contains__):
            entries = getattr(self, name)
            if name == "sizes":  # blocks of one source count once, and their widest range is that of all
                yield from dict.fromkeys(fact for block in self.sizes for fact in block.noted(name, 0))
                widest = max(reversed(self.sizes), key=lambda block: block.length_tolerance_mm)
                tolerance_mm = widest.length_tolerance_mm
                yield Range(LENGTH, 0.0, -tolerance_mm, tolerance_mm, widest.reason, widest.confidence)
            else:
                for number, entry in enumerate(entries if isinstance(entries, list) else [entries]):
                    if isinstance(entry, _Sourced | _Stated):
                        yield from entry.noted(name, number)


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
        strands = [Strands(group.count.value, group.diameter_um.value, "beside") for group in self.strands]
        if layer := self.outer_layer:
            strands.append(Strands(layer.count.value, layer.diameter_um.value, "outside", layer.beyond_mm.value))
        return Braid(
            wires=tuple((group.count.value, group.diameter_um.value) for group in self.wires),
            strands=tuple(strands),
            has_closed_ends=self.closed_ends is not None and self.closed_ends.value,
            **self.shared(2 * layer.beyond_mm.value if layer else 0.0),
        )


class _Basket(_Braid):
    """Entry of a closed braid for the inside of a sac; the lengths of its sizes are heights."""

    kind: Literal["basket"]  # type: ignore[assignment]
    exponent: _Stated[_Positive]
    cup: _Flag | None = None
    """Whether it is a flat disk that opens as a cup."""

    def design(self) -> Design:
        """Return the basket."""
        wires = tuple((group.count.value, group.diameter_um.value) for group in self.wires)
        return Basket(wires=wires, is_cup=self.cup is not None and self.cup.value, **self.shared())


class _LaserCut(_Device):
    """Entry of a laser-cut device."""

    kind: Literal["laser_cut"]
    n_columns: _Stated[_Whole]
    strut_width_um: _Stated[_Width_um]
    strut_thickness_um: _Stated[_Width_um]
    cell_angle_rad: _Stated[_Positive]
    crown_gap_um: _Stated[_Width_um] | None = None
    """Distance between free crowns that face each other, in um."""
    joined_crowns: _Crowns | None = None
    """Which crowns are joined, for a device with open cells."""

    @model_validator(mode="after")
    def _check(self) -> "_LaserCut":
        """Return the entry, or raise a ValueError if an open-cell device states only half of its cells."""
        if (self.joined_crowns is None) != (self.crown_gap_um is None):
            raise ValueError("a device with open cells needs both joined_crowns and crown_gap_um")
        return self

    def design(self) -> Design:
        """Return the laser-cut device."""
        return LaserCut(joined_crowns=tuple(self.joined_crowns.value) if self.joined_crowns else (), **self.shared())


class _Coil(_Device):
    """Entry of a line of coils; the diameters of its sizes are those of the free loops."""

    kind: Literal["coil"]
    wound_diameter_um: _Stated[_Width_um]
    stock_wire_um: _Stated[_Width_um]

    def design(self) -> Design:
        """Return the line of coils."""
        return Coil(**self.shared())


class _Catalogue(Strict):
    """Content of a catalogue file."""

    device: list[Annotated[_Braid | _Basket | _LaserCut | _Coil, Field(discriminator="kind")]]


def content(text: str, schema: type[Schema], name: str, error: type[VstentError]) -> Schema:
    """Return TOML text in the form of a schema; an error of this class says where `name` breaks it."""
    try:
        return schema.model_validate(tomllib.loads(text))
    except ValidationError as fault:
        first = fault.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise error(f"{name} is wrong at {where}: {first['msg']}. Correct that entry.") from fault
    except ValueError as fault:  # not TOML, or a number with thousands of digits
        raise error(f"{name} is not valid TOML: {fault}. Correct that line.") from fault
    except RecursionError:
        raise error(f"{name} is nested too deeply: remove the inner brackets.") from None


def parse(text: str, name: str = "The device catalogue") -> dict[str, Design]:
    """Read a catalogue from TOML text, and return its designs by their key; `name` is its name in messages.

    A DeviceError is raised if the text is not TOML, breaks the schema or lists a device twice.
    """
    found = content(text, _Catalogue, name, DeviceError).device
    designs = {entry.key: entry.design() for entry in found}
    words = called(designs.values())
    if len(designs) < len(found) or len(set(words)) < len(words):
        raise DeviceError(f"{name} uses one key or name for two devices. Give each its own.")
    if BARE in words:
        raise DeviceError(
            f"{name} names a device {BARE!r}, which is reserved for the flow without a device. Give it another name."
        )
    return designs
