"""Designs of stents: braids and laser-cut tubes with their sizes, as frozen data classes.

Both families share one lattice. n columns run round the device; on every row, n/2 junctions (crossings of wires, or
the places where laser-cut cells meet) sit on every second column, and the next row is shifted by one column. The
piece of wire (or strut) between junctions of consecutive rows cannot stretch. At local diameter D it spans one
column, pi D / n, and the row spacing is what is left: h(D) = sqrt((l/n)^2 - (pi D / n)^2) with l/n its length.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vstent.errors import DeviceError
from vstent.units import MM_PER_UM

Confidence = Literal["cited", "derived", "estimated"]
BARE = "bare"
"""Name of the flow without a device, so no device's."""
STEEP_RAD = 0.1, 1.5
"""Angles between wire and axis that a device may have at its free diameter."""


@dataclass(frozen=True)
class Fact:
    """Where one number of the catalogue comes from."""

    name: str
    """The field it fills."""
    source: str
    """Publication, or how it was obtained."""
    confidence: Confidence
    """``cited`` from the source, ``derived`` from cited numbers, or ``estimated``."""


@dataclass(frozen=True)
class Size:
    """One size of a device; its diameters are compared with the contour's, which runs through the wires' middle."""

    diameter_mm: float
    """Label diameter."""
    length_mm: float
    """Label length: the length at the label diameter."""
    free_diameter_mm: float
    """Diameter without an artery around it; the device never gets wider."""
    compaction_fraction: float = 0.0
    """Part by which pushing has shortened a braid at its label diameter; below zero where it was pulled."""

    @property
    def compacted_length_mm(self) -> float:
        """Length at the label diameter, pushed together as it is."""
        return self.length_mm * (1 - self.compaction_fraction)

    @property
    def label(self) -> str:
        """The size as one reads it on the box."""
        return f"{self.diameter_mm:.2f} x {self.length_mm:g} mm"


@dataclass(frozen=True, eq=False)
class Braid:
    """A tube braided from two hands of round wires."""

    key: str
    """Short lower-case name."""
    name: str
    """Name as the maker writes it."""
    wires: tuple[tuple[int, float], ...]
    """Groups of wires: (count, diameter in um)."""
    braid_angle_rad: float
    """Angle between wire and axis at the free diameter."""
    sizes: tuple[Size, ...]
    """Sizes on offer."""
    maker: str = ""
    """Who makes it."""
    facts: tuple[Fact, ...] = ()
    """Source and confidence of every number."""
    kind: Literal["braid"] = field(default="braid", init=False)
    """Family, for tables."""

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
        """Number of wires, both hands together."""
        return sum(count for count, _ in self.wires)

    @property
    def n_columns(self) -> int:
        """Columns of the lattice: one per wire."""
        return self.n_wires

    @property
    def angle_rad(self) -> float:
        """Angle between wire and axis at the free diameter."""
        return self.braid_angle_rad

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the contour, the paper's dd: one wire (the thickest) fits between them."""
        return max(diameter for _, diameter in self.wires)


@dataclass(frozen=True, eq=False)
class LaserCut:
    """A tube cut into closed cells: zigzag rings whose crowns are joined."""

    key: str
    """Short lower-case name."""
    name: str
    """Name as the maker writes it."""
    n_columns: int
    """Columns of the lattice: struts round one ring, twice the number of cells round."""
    strut_width_um: float
    """Width of a strut along the wall."""
    strut_thickness_um: float
    """Thickness of a strut across the wall."""
    cell_angle_rad: float
    """Angle between strut and axis at the free diameter."""
    sizes: tuple[Size, ...]
    """Sizes on offer."""
    maker: str = ""
    """Who makes it."""
    facts: tuple[Fact, ...] = ()
    """Source and confidence of every number."""
    kind: Literal["laser_cut"] = field(default="laser_cut", init=False)
    """Family, for tables."""

    def __post_init__(self) -> None:
        _check_columns(self.name, self.n_columns)
        _check_angle(self.name, self.cell_angle_rad)
        _check_sizes(self)

    @property
    def angle_rad(self) -> float:
        """Angle between strut and axis at the free diameter."""
        return self.cell_angle_rad

    @property
    def wall_offset_um(self) -> float:
        """Distance from the wall to the contour, the paper's dd: one strut fits between them."""
        return self.strut_thickness_um


Design = Braid | LaserCut


def _check_columns(name: str, n_columns: int) -> None:
    if n_columns < 6 or n_columns % 2:
        raise DeviceError(f"{name} has {n_columns} wires or struts around. Give an even number of at least 6.")


def _check_angle(name: str, angle_rad: float) -> None:
    if not STEEP_RAD[0] < angle_rad < STEEP_RAD[1]:
        raise DeviceError(f"{name} has an angle of {angle_rad:.3f} rad to the axis. Give 0.1 to 1.5 rad.")


def _check_sizes(design: Design) -> None:
    """See that wires have room round every size, and that it is long enough to hold two rows of cells."""
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
    """Length l/n of the wire or strut between junctions: an artery cannot change it."""
    return float(np.pi * size.free_diameter_mm / (design.n_columns * free_sine(design, size)))


def free_sine(design: Design, size: Size) -> float:
    """Sine of the angle between wire and axis at the free diameter; a compacted braid's may exceed 1: it is none."""
    if size.compaction_fraction == 0.0:
        return float(np.sin(design.angle_rad))
    cosine = np.sqrt(1 - (np.sin(design.angle_rad) * size.diameter_mm / size.free_diameter_mm) ** 2)
    left = min(1.0, (1 - size.compaction_fraction) * cosine)
    return float(np.sqrt(1 - left**2) * size.free_diameter_mm / size.diameter_mm)


def angle_rad(design: Design, size: Size, diameter_mm: float | np.ndarray) -> np.ndarray:
    """Angle between wire and axis at a local diameter: sin(alpha) = sin(alpha_free) D / D_free."""
    return np.arcsin(free_sine(design, size) * np.minimum(diameter_mm, size.free_diameter_mm) / size.free_diameter_mm)


def strips_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Part of the circumference that all struts, or the wires of one hand, take side by side; 1 and more: no room."""
    per_axis_mm = np.pi * diameter_mm * float(np.cos(angle_rad(design, size, diameter_mm)))
    if isinstance(design, LaserCut):
        return float(design.n_columns * design.strut_width_um * MM_PER_UM / per_axis_mm)
    hand_um = 0.5 * sum(count * diameter for count, diameter in design.wires)
    return float(hand_um * MM_PER_UM / per_axis_mm)


def called(designs: Iterable[Design]) -> list[str]:
    """Return what devices are called, their keys and names in lower case; two that clash are in it twice."""
    return [word for design in designs for word in sorted({design.key.casefold(), design.name.casefold()})]
