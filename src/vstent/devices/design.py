"""Designs of stents: braids and laser-cut tubes with their sizes, as frozen data classes.

Both families share one lattice with n columns around the device. Junctions are crossings of wires, or the places where
laser-cut cells meet. Every row has n/2 of them, on every second column, and each row is shifted by one column against
the one before. The piece of wire (or strut) between junctions of consecutive rows cannot stretch. At the local diameter
D it spans one column, pi D / n, around the device. The row spacing follows from its length l/n: h(D) = sqrt((l/n)^2 -
(pi D / n)^2).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from vstent.errors import DeviceError
from vstent.units import MM_PER_UM

Confidence = Literal["cited", "derived", "estimated"]
"""How sure a number of the catalogue is; see `Fact.confidence`."""
STEEP_RAD = 0.1, 1.5
"""Smallest and largest angle between wire and axis at the free diameter, in rad."""
DENSE_WIRES = 24
"""Number of wires from which a braid is a flow diverter: they have 48 to 64, braids that hold coils 12 to 16."""
Fraction = TypeVar("Fraction", float, np.ndarray)


@dataclass(frozen=True)
class Fact:
    """Source of one number of the catalogue."""

    name: str
    """Field that the number belongs to."""
    source: str
    """Publication, or how the number was obtained."""
    confidence: Confidence
    """``cited`` from the source, ``derived`` from cited numbers, or ``estimated``."""


@dataclass(frozen=True)
class Range:
    """Range in which one number of the catalogue lies."""

    name: str
    """Field of the design, ``wire_count`` and ``wire_diameter_um`` (``wire_2_count`` for the second group of wires, and
    so on), ``free_diameter_margin_mm`` or ``label_length_mm``."""
    value: float
    """Value of the catalogue; 0 for ``label_length_mm``, whose range is the same around every label."""
    low: float
    """Smallest plausible value."""
    high: float
    """Largest plausible value."""
    reason: str
    """Tolerance or class from which the range follows."""
    confidence: Confidence
    """How sure the value is."""


@dataclass(frozen=True)
class Size:
    """One size of a device. Its diameters are those of the contour, which runs through the middle of the wires."""

    diameter_mm: float
    """Label diameter, in mm."""
    length_mm: float
    """Label length, in mm: the length at the label diameter."""
    free_diameter_mm: float
    """Diameter outside an artery, in mm; the device never becomes wider."""
    compaction_fraction: float = 0.0
    """Fraction by which pushing has shortened a braid at its label diameter; negative when pulled."""
    free_profile_mm: tuple[tuple[float, float], ...] = ()
    """Pairs of a fraction of the length, 0 at the proximal end, and the free diameter there, in mm, if it varies.

    It is linear between the pairs. `free_diameter_mm` is that of the body, and the angle of the wires is given there.
    """

    @property
    def compacted_length_mm(self) -> float:
        """Length at the label diameter after compaction, in mm."""
        return self.length_mm * (1 - self.compaction_fraction)

    @property
    def label(self) -> str:
        """Size as printed on the box."""
        return f"{self.diameter_mm:.2f} x {self.length_mm:g} mm"

    @property
    def coil_label(self) -> str:
        """Loops and length of a coil, as printed on the box."""
        return f"{self.diameter_mm:g} mm x {self.length_mm / 10:.3g} cm"


@dataclass(frozen=True)
class Strands:
    """Further wires of a braid, half of either hand, at the same angle as the wires of its mesh.

    Both layers of a dual-layer device shorten together because their wires have the same angle at every diameter.
    """

    count: int
    """Number of wires of both hands, evenly spaced around the device."""
    diameter_um: float
    """Wire diameter, in um."""
    place: Literal["outside", "beside"]
    """``outside``: a layer of its own around the mesh. ``beside``: next to wires of the mesh and woven with them."""
    beyond_mm: float = 0.0
    """Length by which a layer outside is longer than the mesh at each end, at the label diameter, in mm."""


@dataclass(frozen=True, eq=False)
class _Listed:
    """What the catalogue states of a device of any family."""

    key: str
    """Short lower-case name."""
    name: str
    """Name as the maker writes it."""
    maker: str = field(default="", kw_only=True)
    """Manufacturer."""
    facts: tuple[Fact, ...] = field(default=(), kw_only=True)
    """Source and confidence of every number."""
    ranges: tuple[Range, ...] = field(default=(), kw_only=True)
    """Range of every number."""

    def covered(self, struts: Fraction, layer: Fraction) -> Fraction:
        """Return the fraction under metal where struts, which meet without crossing, cover a fraction of the wall."""
        return struts


@dataclass(frozen=True, eq=False)
class Braid(_Listed):
    """A tube braided from round wires of two hands, with further strands where it has them."""

    wires: tuple[tuple[int, float], ...]
    """Groups of wires: (count, diameter in um)."""
    braid_angle_rad: float
    """Angle between wire and axis at the free diameter, in rad."""
    sizes: tuple[Size, ...]
    """Available sizes."""
    strands: tuple[Strands, ...] = ()
    """Outer layer of a dual-layer device, or radiopaque strands beside the wires of the mesh."""
    has_closed_ends: bool = False
    """Whether the wires turn back in loops at both ends, as in a braid of a single wire."""
    kind: Literal["braid", "basket"] = field(default="braid", init=False)
    """Device family."""

    follows_bends = True
    joined_fraction = 1.0
    joined_crowns: ClassVar[tuple[str, ...]] = ()
    crown_gap_um = 0.0

    def __post_init__(self) -> None:
        _check_lattice(self)
        for count, diameter_um in self.wires:
            if count % 2:
                raise DeviceError(
                    f"{self.name} has {count} wires of {diameter_um:g} um, but half of the wires of each kind "
                    "run either way. Give an even number."
                )
        for strands in self.strands:
            if strands.count % 2 or not 2 <= strands.count <= self.n_wires:
                raise DeviceError(
                    f"{self.name} has {strands.count} strands {strands.place} a mesh of {self.n_wires} wires. Give an "
                    "even number of at least 2 that is not above the number of wires."
                )
            if strands.place == "beside" and self.n_wires % strands.count:
                raise DeviceError(
                    f"{self.name} has {strands.count} strands beside wires of a mesh of {self.n_wires}. Give a number "
                    "that divides the number of wires."
                )
            if strands.beyond_mm and strands.place == "beside":
                raise DeviceError(
                    f"{self.name} has strands beside the wires of its mesh that are longer than the mesh. Place them "
                    "outside, or let them end with the mesh."
                )
        if self.has_closed_ends and len({diameter for _, diameter in self.wires}) > 1:
            raise DeviceError(
                f"{self.name} has closed ends but wires of several diameters, so no two of them are one wire. Give one "
                "diameter, and thicker ones as strands."
            )
        _check_sizes(self)

    @property
    def n_wires(self) -> int:
        """Number of wires of both hands."""
        return sum(count for count, _ in self.wires)

    @property
    def use(self) -> str:
        """What it is for: ``flow diverter``, ``stent for coils`` or ``basket``."""
        return "flow diverter" if self.n_wires >= DENSE_WIRES else "stent for coils"

    @property
    def n_columns(self) -> int:
        """Columns of the lattice: one per wire."""
        return self.n_wires

    @property
    def angle_rad(self) -> float:
        """Angle between wire and axis at the free diameter, in rad."""
        return self.braid_angle_rad

    @property
    def beyond_mm(self) -> float:
        """Length of each end of the device without a mesh, at the label diameter, in mm."""
        return max((strands.beyond_mm for strands in self.strands), default=0.0)

    @property
    def mesh_offset_um(self) -> float:
        """Distance from the outer face of the mesh to its middle, in um: the diameter of its thickest wire."""
        beside = [strands.diameter_um for strands in self.strands if strands.place == "beside"]
        return max([diameter for _, diameter in self.wires] + beside)

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the contour, in um (dd in Zhong et al. 2016).

        The contour runs through the middle of the mesh. Outside it lie one wire of the mesh, and two of an outer layer.
        """
        outside = [strands.diameter_um for strands in self.strands if strands.place == "outside"]
        return self.mesh_offset_um + 2 * max(outside, default=0.0)

    @property
    def hand_um(self) -> float:
        """Sum of the diameters of the wires of one hand, with the strands beside them, in um."""
        beside = [(strands.count, strands.diameter_um) for strands in self.strands if strands.place == "beside"]
        return 0.5 * sum(count * diameter for count, diameter in [*self.wires, *beside])

    @property
    def layer_um(self) -> float:
        """Sum of the diameters of the wires of one hand of an outer layer, in um."""
        return 0.5 * sum(one.count * one.diameter_um for one in self.strands if one.place == "outside")

    def covered(self, hand: Fraction, layer: Fraction) -> Fraction:
        """Return the fraction under metal where a hand of the mesh and one of an outer layer cover these fractions."""
        return 1 - (1 - hand) ** 2 * (1 - layer) ** 2

    @property
    def strand_names(self) -> list[str]:
        """Name of every group of strands, as in `Range.name`."""
        groups = [nth("strand", k) for k in range(len(self.strands))]
        return ["outer_layer" if one.place == "outside" else groups.pop(0) for one in self.strands]

    @property
    def numbers(self) -> dict[str, float]:
        """Numbers of wires and strands by name, as in `Range.name`."""
        found: dict[str, float] = {}
        for k, (count, diameter_um) in enumerate(self.wires):
            found |= {f"{nth('wire', k)}_count": count, f"{nth('wire', k)}_diameter_um": diameter_um}
        found["braid_angle_rad"] = self.braid_angle_rad
        for name, strands in zip(self.strand_names, self.strands, strict=True):
            found |= {f"{name}_count": strands.count, f"{name}_diameter_um": strands.diameter_um}
            found |= {f"{name}_beyond_mm": strands.beyond_mm} if strands.place == "outside" else {}
        return found

    def altered(self, values: Mapping[str, float], sizes: tuple[Size, ...]) -> "Braid":
        """Return the braid in other sizes and with other values of its numbers, counts rounded to even ones."""
        new = self.numbers | dict(values)
        groups = [nth("wire", k) for k in range(len(self.wires))]
        wires = tuple((_even(new[f"{name}_count"]), new[f"{name}_diameter_um"]) for name in groups)
        strands = tuple(
            Strands(
                _even(new[f"{name}_count"]), new[f"{name}_diameter_um"], one.place, new.get(f"{name}_beyond_mm", 0.0)
            )
            for name, one in zip(self.strand_names, self.strands, strict=True)
        )
        return replace(self, wires=wires, braid_angle_rad=new["braid_angle_rad"], strands=strands, sizes=sizes)


@dataclass(frozen=True, eq=False)
class Basket(Braid):
    """A braid that is closed at both ends by a marker, for the inside of a sac; its sizes are widths x heights.

    The free device is a body of revolution with the section ``|2 r / W|^p + |2 z / H|^p = 1`` of a superellipse, for
    the width W, the height H and the exponent p. The angle of the braid is that at its widest row.
    """

    exponent: float = 2.0
    """Exponent p of the section: 2 of an ellipse, more of a barrel with flat ends."""
    is_cup: bool = False
    """Whether the free device is a flat disk of two layers, which opens in the sac as a cup with both of them below."""
    kind: Literal["braid", "basket"] = field(default="basket", init=False)

    @property
    def use(self) -> str:
        """What it is for."""
        return "basket"

    @property
    def marker_radius_mm(self) -> float:
        """Radius within which the wires of one hand would lie side by side, in mm; the marker holds them there."""
        return self.hand_um * MM_PER_UM / (2 * np.pi)


@dataclass(frozen=True, eq=False)
class LaserCut(_Listed):
    """A tube cut into zigzag rings whose crowns are joined: all of them (closed cells) or some (open cells)."""

    n_columns: int
    """Columns of the lattice: struts around one ring, twice the number of cells around the device."""
    strut_width_um: float
    """Width of a strut along the wall, in um."""
    strut_thickness_um: float
    """Thickness of a strut perpendicular to the wall, in um."""
    cell_angle_rad: float
    """Angle between strut and axis at the free diameter, in rad."""
    sizes: tuple[Size, ...]
    """Available sizes."""
    joined_crowns: tuple[str, ...] = ()
    """Which crowns between two rings are joined, for an open-cell device: one text for each row of crowns, ``1`` for a
    joined and ``0`` for a free crown. The texts are repeated around and along the device. Empty: all are joined."""
    crown_gap_um: float = 0.0
    """Distance along the device between the tips of two free crowns that face each other, in um."""
    kind: Literal["laser_cut"] = field(default="laser_cut", init=False)
    """Device family."""

    use = "stent for coils"
    follows_bends = False
    beyond_mm = 0.0
    layer_um = 0.0

    def __post_init__(self) -> None:
        _check_lattice(self)
        around = self.n_columns // 2
        for text in self.joined_crowns:
            if set(text) - set("01") or len(text) > around:
                raise DeviceError(
                    f"{self.name} has the pattern {text!r} of joined crowns. Give 0 and 1, at most one for each of its "
                    f"{around} crowns around."
                )
            if "1" not in text:
                raise DeviceError(f"{self.name} has a row without joined crowns, so its rings are separate. Join one.")
        _check_sizes(self)

    @property
    def angle_rad(self) -> float:
        """Angle between strut and axis at the free diameter, in rad."""
        return self.cell_angle_rad

    @property
    def joined_fraction(self) -> float:
        """Fraction of the crowns between two rings that are joined."""
        shares = [text.count("1") / len(text) for text in self.joined_crowns]
        return sum(shares) / len(shares) if shares else 1.0

    def is_joined(self, row: int, crown: int) -> bool:
        """Return whether a crown on a row between two rings is joined; both are counted from 0."""
        if not self.joined_crowns:
            return True
        around = self.joined_crowns[row % len(self.joined_crowns)]
        return around[crown % len(around)] == "1"

    @property
    def mesh_offset_um(self) -> float:
        """Distance from the outer face of the device to its contour, in um: the thickness of a strut."""
        return self.strut_thickness_um

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the contour, in um (dd in Zhong et al. 2016): the thickness of a strut."""
        return self.strut_thickness_um

    @property
    def hand_um(self) -> float:
        """Sum of the widths of all struts around the device, in um."""
        return self.n_columns * self.strut_width_um

    @property
    def numbers(self) -> dict[str, float]:
        """Numbers of the struts by name, as in `Range.name`."""
        gap = ["crown_gap_um"] if self.joined_crowns else []
        names = ["n_columns", "strut_width_um", "strut_thickness_um", "cell_angle_rad", *gap]
        return {name: getattr(self, name) for name in names}

    def altered(self, values: Mapping[str, float], sizes: tuple[Size, ...]) -> "LaserCut":
        """Return the device in other sizes and with other values of its numbers, counts rounded to even ones."""
        new: dict[str, Any] = {name: values.get(name, value) for name, value in self.numbers.items()}
        return replace(self, **new | {"n_columns": _even(new["n_columns"]), "sizes": sizes})


@dataclass(frozen=True, eq=False)
class Coil(_Listed):
    """A line of detachable coils for sacs: a thin wire wound to a long spring that curls to loops when it is free.

    Its sizes are the diameter of the free loops x the length of the coil. It has no mesh, and the numbers that all
    designs have are those of none.
    """

    wound_diameter_um: float
    """Outer diameter of the spring, in um."""
    stock_wire_um: float
    """Diameter of the wire that is wound, in um."""
    sizes: tuple[Size, ...]
    """Available sizes."""
    kind: Literal["coil"] = field(default="coil", init=False)
    """Device family."""

    use = "coils"
    follows_bends = True
    joined_fraction, beyond_mm, layer_um, crown_gap_um, hand_um, angle_rad = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    joined_crowns: ClassVar[tuple[str, ...]] = ()
    n_columns: ClassVar[int] = 0

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the axis of the coil, in um."""
        return 0.5 * self.wound_diameter_um

    @property
    def mesh_offset_um(self) -> float:
        """Distance from the outer face of the coil to its axis, in um."""
        return self.wall_offset_um

    @property
    def numbers(self) -> dict[str, float]:
        """Numbers of the coil by name, as in `Range.name`."""
        return {"wound_diameter_um": self.wound_diameter_um, "stock_wire_um": self.stock_wire_um}

    def altered(self, values: Mapping[str, float], sizes: tuple[Size, ...]) -> "Coil":
        """Return the coils in other sizes and with other values of their numbers."""
        new: dict[str, Any] = self.numbers | dict(values)
        return replace(self, **new, sizes=sizes)


Design = Braid | LaserCut | Coil
"""A device of any family."""


def nth(name: str, number: int) -> str:
    """Return the name of a group of wires, counted from 0: wire, wire_2 and so on."""
    return f"{name}_{number + 1}" if number else name


def _even(count: float) -> int:
    """Return the nearest even number."""
    return 2 * int(np.floor(0.5 * count + 0.5))


def _check_lattice(design: Design) -> None:
    """Raise a DeviceError if the number of wires or struts around, or their angle to the axis, is out of range."""
    if design.n_columns < 6 or design.n_columns % 2:
        raise DeviceError(
            f"{design.name} has {design.n_columns} wires or struts around. Give an even number of at least 6."
        )
    if not STEEP_RAD[0] < design.angle_rad < STEEP_RAD[1]:
        raise DeviceError(f"{design.name} has an angle of {design.angle_rad:.3f} rad to the axis. Give 0.1 to 1.5 rad.")


def _check_sizes(design: Design) -> None:
    """Raise a DeviceError if the wires of a size have no room side by side, or it is shorter than two rows of cells."""
    for size in design.sizes:
        taken = strips_fraction(design, size, size.free_diameter_mm, design.hand_um)
        if taken >= 1:
            raise DeviceError(
                f"{design.name} {size.label} has no room for its wires or struts: side by side they take "
                f"{taken:.1f} times its circumference. Give fewer or thinner ones."
            )
        spacing_mm = piece_length_mm(design, size) * float(np.cos(angle_rad(design, size, size.diameter_mm)))
        if size.length_mm < 2 * spacing_mm:
            raise DeviceError(
                f"{design.name} {size.label} is shorter than two rows of its cells, which are {spacing_mm:.1f} "
                "mm apart. Give a longer size, or more wires or struts."
            )


def piece_length_mm(design: Design, size: Size) -> float:
    """Return the length l/n of the wire or strut between junctions, in mm; it is the same at every diameter."""
    return float(np.pi * size.free_diameter_mm / (design.n_columns * free_sine(design, size)))


def widest_mm(design: Design, size: Size) -> float:
    """Return the largest free diameter along a device, in mm.

    A flare opens at most until its wires lie across the axis (`STEEP_RAD`), because their pieces are as long there as
    in the body.
    """
    if not size.free_profile_mm:
        return size.free_diameter_mm
    flare_mm = max(diameter for _, diameter in size.free_profile_mm)
    return min(flare_mm, size.free_diameter_mm * float(np.sin(STEEP_RAD[1])) / free_sine(design, size))


def free_sine(design: Design, size: Size) -> float:
    """Return the sine of the angle between wire and axis at the free diameter; above 1 if compacted too far."""
    if size.compaction_fraction == 0.0:
        return float(np.sin(design.angle_rad))
    cosine = np.sqrt(1 - (np.sin(design.angle_rad) * size.diameter_mm / size.free_diameter_mm) ** 2)
    left = min(1.0, (1 - size.compaction_fraction) * cosine)
    return float(np.sqrt(1 - left**2) * size.free_diameter_mm / size.diameter_mm)


def angle_rad(design: Design, size: Size, diameter_mm: float | np.ndarray) -> np.ndarray:
    """Compute the angle between wire and axis, in rad, at a local diameter: sin(alpha) = sin(alpha_free) D / D_free.

    Values of `diameter_mm` above the largest free diameter count as that.
    """
    return np.arcsin(free_sine(design, size) * np.minimum(diameter_mm, widest_mm(design, size)) / size.free_diameter_mm)


def strips_fraction(design: Design, size: Size, diameter_mm: float, strips_um: float) -> float:
    """Return the fraction of the circumference that strips of this total width along the wires occupy side by side."""
    per_axis_mm = np.pi * diameter_mm * float(np.cos(angle_rad(design, size, diameter_mm)))
    return float(strips_um * MM_PER_UM / per_axis_mm)


def called(designs: Iterable[Design]) -> list[str]:
    """Return the keys and names of devices in lower case; a word is listed twice if two devices share it."""
    return [word for design in designs for word in sorted({design.key.casefold(), design.name.casefold()})]
