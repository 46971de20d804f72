"""Designs of stents: braids and laser-cut tubes with their sizes, as frozen data classes.

Both families share one lattice with n columns around the device. Junctions are crossings of wires, or the places where
laser-cut cells meet. Every row has n/2 of them, on every second column, and each row is shifted by one column against
the one before. The piece of wire (or strut) between junctions of consecutive rows cannot stretch. At the local diameter
D it spans one column, pi D / n, around the device. The row spacing follows from its length l/n: h(D) = sqrt((l/n)^2 -
(pi D / n)^2).
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vstent.errors import DeviceError
from vstent.units import MM_PER_UM

Confidence = Literal["cited", "derived", "estimated"]
"""How sure a number of the catalogue is; see `Fact.confidence`."""
BARE = "bare"
"""Name of the flow without a device. No device may have it."""
STEEP_RAD = 0.1, 1.5
"""Smallest and largest angle between wire and axis at the free diameter, in rad."""


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

    @property
    def is_wide(self) -> bool:
        """Whether the range contains more than one value."""
        return self.high > self.low


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

    @property
    def compacted_length_mm(self) -> float:
        """Length at the label diameter after compaction, in mm."""
        return self.length_mm * (1 - self.compaction_fraction)

    @property
    def label(self) -> str:
        """Size as printed on the box."""
        return f"{self.diameter_mm:.2f} x {self.length_mm:g} mm"


@dataclass(frozen=True, eq=False)
class Braid:
    """A tube braided from round wires of two hands."""

    key: str
    """Short lower-case name."""
    name: str
    """Name as the maker writes it."""
    wires: tuple[tuple[int, float], ...]
    """Groups of wires: (count, diameter in um)."""
    braid_angle_rad: float
    """Angle between wire and axis at the free diameter, in rad."""
    sizes: tuple[Size, ...]
    """Available sizes."""
    maker: str = ""
    """Manufacturer."""
    facts: tuple[Fact, ...] = ()
    """Source and confidence of every number."""
    ranges: tuple[Range, ...] = ()
    """Range of every number; a number of an older catalogue that states none is left out."""
    kind: Literal["braid"] = field(default="braid", init=False)
    """Device family."""

    def __post_init__(self) -> None:
        _check_columns(self.name, self.n_wires)
        _check_angle(self.name, self.braid_angle_rad)
        for count, diameter_um in self.wires:
            if count % 2:
                raise DeviceError(
                    f"{self.name} has {count} wires of {diameter_um:g} um, but half of the wires of each kind "
                    "run either way. Give an even number."
                )
        _check_sizes(self)

    @property
    def n_wires(self) -> int:
        """Number of wires of both hands."""
        return sum(count for count, _ in self.wires)

    @property
    def n_columns(self) -> int:
        """Columns of the lattice: one per wire."""
        return self.n_wires

    @property
    def angle_rad(self) -> float:
        """Angle between wire and axis at the free diameter, in rad."""
        return self.braid_angle_rad

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the contour, in um (dd in Zhong et al. 2016): the diameter of the thickest wire."""
        return max(diameter for _, diameter in self.wires)


@dataclass(frozen=True, eq=False)
class LaserCut:
    """A tube cut into closed cells: zigzag rings whose crowns are joined."""

    key: str
    """Short lower-case name."""
    name: str
    """Name as the maker writes it."""
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
    maker: str = ""
    """Manufacturer."""
    facts: tuple[Fact, ...] = ()
    """Source and confidence of every number."""
    ranges: tuple[Range, ...] = ()
    """Range of every number; a number of an older catalogue that states none is left out."""
    kind: Literal["laser_cut"] = field(default="laser_cut", init=False)
    """Device family."""

    def __post_init__(self) -> None:
        _check_columns(self.name, self.n_columns)
        _check_angle(self.name, self.cell_angle_rad)
        _check_sizes(self)

    @property
    def angle_rad(self) -> float:
        """Angle between strut and axis at the free diameter, in rad."""
        return self.cell_angle_rad

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the contour, in um (dd in Zhong et al. 2016): the thickness of a strut."""
        return self.strut_thickness_um


Design = Braid | LaserCut
"""A device of either family."""


def _check_columns(name: str, n_columns: int) -> None:
    """Raise a DeviceError if the number of wires or struts around the device is odd or below 6."""
    if n_columns < 6 or n_columns % 2:
        raise DeviceError(f"{name} has {n_columns} wires or struts around. Give an even number of at least 6.")


def _check_angle(name: str, angle_rad: float) -> None:
    """Raise a DeviceError if the angle to the axis is out of range."""
    if not STEEP_RAD[0] < angle_rad < STEEP_RAD[1]:
        raise DeviceError(f"{name} has an angle of {angle_rad:.3f} rad to the axis. Give 0.1 to 1.5 rad.")


def _check_sizes(design: Design) -> None:
    """Raise a DeviceError if the wires of a size have no room side by side, or it is shorter than two rows of cells."""
    for size in design.sizes:
        taken = strips_fraction(design, size, size.free_diameter_mm)
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


def free_sine(design: Design, size: Size) -> float:
    """Return the sine of the angle between wire and axis at the free diameter; above 1 if compacted too far."""
    if size.compaction_fraction == 0.0:
        return float(np.sin(design.angle_rad))
    cosine = np.sqrt(1 - (np.sin(design.angle_rad) * size.diameter_mm / size.free_diameter_mm) ** 2)
    left = min(1.0, (1 - size.compaction_fraction) * cosine)
    return float(np.sqrt(1 - left**2) * size.free_diameter_mm / size.diameter_mm)


def angle_rad(design: Design, size: Size, diameter_mm: float | np.ndarray) -> np.ndarray:
    """Compute the angle between wire and axis at a local diameter: sin(alpha) = sin(alpha_free) D / D_free.

    Parameters
    ----------
    design : Design
        The device.
    size : Size
        Its size.
    diameter_mm : float or array, mm
        Local diameter; values above the free diameter count as the free diameter.

    Returns
    -------
    array of the shape of `diameter_mm`, rad
        Angle between wire and axis.
    """
    return np.arcsin(free_sine(design, size) * np.minimum(diameter_mm, size.free_diameter_mm) / size.free_diameter_mm)


def strips_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Compute the fraction of the circumference that wires of one hand, or all struts, occupy side by side.

    Parameters
    ----------
    design : Design
        The device.
    size : Size
        Its size.
    diameter_mm : float
        Local diameter, in mm.

    Returns
    -------
    float
        Fraction; from 1 on there is no room for them.
    """
    per_axis_mm = np.pi * diameter_mm * float(np.cos(angle_rad(design, size, diameter_mm)))
    if isinstance(design, LaserCut):
        return float(design.n_columns * design.strut_width_um * MM_PER_UM / per_axis_mm)
    hand_um = 0.5 * sum(count * diameter for count, diameter in design.wires)
    return float(hand_um * MM_PER_UM / per_axis_mm)


def called(designs: Iterable[Design]) -> list[str]:
    """Return the keys and names of devices in lower case; a word is listed twice if two devices share it."""
    return [word for design in designs for word in sorted({design.key.casefold(), design.name.casefold()})]
