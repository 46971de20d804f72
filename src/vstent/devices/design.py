"""Devices: braided and laser-cut stents and their sizes, from one catalogue, and their closed formulas.

Both families share one lattice. n columns run round the device; on every row, n/2 junctions (crossings of wires, or
the places where laser-cut cells meet) sit on every second column, and the next row is shifted by one column. The
piece of wire (or strut) between junctions of consecutive rows cannot stretch. At local diameter D it spans one
column, pi D / n, and the row spacing is what is left: h(D) = sqrt((l/n)^2 - (pi D / n)^2) with l/n its length.
"""

import difflib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from vstent import plugins
from vstent.errors import DeviceError
from vstent.units import MM_PER_UM

Confidence = Literal["cited", "derived", "estimated"]

BARE = "bare"
"""Name of the flow without a device, so no device's."""
STEEP_RAD = 0.1, 1.5
"""Angles between wire and axis that a device may have at its free diameter."""
BEND_SAMPLES, BEND_STEPS = 12, 6
"""Angles round half the axis (the other half mirrors it), and Newton steps, for the spacing of rows in a bend."""
STEEPEST_BEND = 0.9
"""Artery's radius over the bend's, at most: sharper ones are only sharp where the wall is folded."""
STRAIGHTEST = 0.995
"""Cosine of the angle that wires outside a bend have to the axis, at most."""
NODE_SPACING_LIMIT_MM = 0.35
"""A contour's nodes are never further apart than this at the label diameter."""


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
                    f"{self.name} has {count} wires of {diameter_um:g} um: half of them wind either way, so use an "
                    "even number of each."
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
        raise DeviceError(f"{name} has {n_columns} wires or struts round: use an even number of at least 6.")


def _check_angle(name: str, angle_rad: float) -> None:
    if not STEEP_RAD[0] < angle_rad < STEEP_RAD[1]:
        raise DeviceError(f"{name} has an angle of {angle_rad:.3f} rad to the axis: give 0.1 to 1.5 rad.")


def _check_sizes(design: Design) -> None:
    """See that wires have room round every size, and that it is long enough to hold two rows of cells."""
    for size in design.sizes:
        taken = _strips_fraction(design, size, size.free_diameter_mm)
        if taken >= 1:
            raise DeviceError(
                f"{design.name} {size.label} has no room for its wires or struts: side by side they take {taken:.1f} "
                "times its circumference. Give fewer or thinner ones."
            )
        spacing_mm = float(row_spacing_mm(design, size, size.diameter_mm))
        if size.length_mm < 2 * spacing_mm:
            raise DeviceError(
                f"{design.name} {size.label} is shorter than two rows of its cells, {spacing_mm:.1f} mm apart: give a "
                "longer size, or more wires or struts."
            )


class Grid(NamedTuple):
    """How a device's lattice is laid on the contour's nodes."""

    rows: int
    """Rows of nodes."""
    columns: int
    """Nodes of a row."""
    row_split: int
    """Node rows per lattice row."""
    column_split: int
    """Node columns per lattice column."""

    @property
    def lattice_rows(self) -> int:
        """Rows of junctions."""
        return (self.rows - 1) // self.row_split + 1

    @property
    def lattice_columns(self) -> int:
        """Columns of the lattice."""
        return self.columns // self.column_split


def grid(design: Design, size: Size) -> Grid:
    """Return the contour's grid: one node per junction column and row, finer where cells are large."""
    spacing_mm = float(row_spacing_mm(design, size, size.diameter_mm))
    rows = max(2, round(size.compacted_length_mm / spacing_mm) + 1)
    row_split = int(np.ceil(spacing_mm / NODE_SPACING_LIMIT_MM))
    column_split = int(np.ceil(np.pi * size.diameter_mm / design.n_columns / NODE_SPACING_LIMIT_MM))
    return Grid((rows - 1) * row_split + 1, design.n_columns * column_split, row_split, column_split)


def piece_length_mm(design: Design, size: Size) -> float:
    """Length l/n of the wire or strut between junctions: an artery cannot change it."""
    return float(np.pi * size.free_diameter_mm / (design.n_columns * _free_sine(design, size)))


def compacted(design: Design, size: Size, fraction: float) -> Size:
    """Return a size of a braid pushed together (pulled apart: below zero) by a part of its length.

    The wires' ends are free: pushed, wires wind more often round the device and cross more often. A wire of the same
    length over the fraction (1 - q) of the axis has cos(alpha) = (1 - q) cos(alpha of the label).

    Raises
    ------
    DeviceError
        When the wires of such a device would stand too steep, or the device has none.
    """
    if fraction == 0.0:
        return size
    changed = replace(size, compaction_fraction=fraction)
    if not (isinstance(design, Braid) and np.sin(STEEP_RAD[0]) < _free_sine(design, changed) < np.sin(STEEP_RAD[1])):
        would = "its wires would stand too steep" if fraction > 0 else "its wires would be pulled straight"
        why, then = (
            (would, "a part nearer to 0")
            if isinstance(design, Braid)
            else ("its cells are joined", "0, or another device")
        )
        raise DeviceError(
            f"{design.name} {size.label} cannot be compacted by {fraction:g} of its length: {why}. Give {then}."
        )
    return changed


def _free_sine(design: Design, size: Size) -> float:
    """Sine of the angle between wire and axis at the free diameter; a compacted braid's may exceed 1: it is none."""
    if size.compaction_fraction == 0.0:
        return float(np.sin(design.angle_rad))
    cosine = np.sqrt(1 - (np.sin(design.angle_rad) * size.diameter_mm / size.free_diameter_mm) ** 2)
    left = min(1.0, (1 - size.compaction_fraction) * cosine)
    return float(np.sqrt(1 - left**2) * size.free_diameter_mm / size.diameter_mm)


def angle_rad(design: Design, size: Size, diameter_mm: float | np.ndarray) -> np.ndarray:
    """Angle between wire and axis at a local diameter: sin(alpha) = sin(alpha_free) D / D_free."""
    return np.arcsin(_free_sine(design, size) * np.minimum(diameter_mm, size.free_diameter_mm) / size.free_diameter_mm)


def row_spacing_mm(
    design: Design, size: Size, diameter_mm: float | np.ndarray, curvature_per_mm: float | np.ndarray = 0.0
) -> np.ndarray:
    """Distance h along the axis between rows of junctions at a local diameter, at most the free one.

    Where the axis bends, rows are h (1 + k cos(theta)) apart at the angle theta round it, k = curvature D / 2. Pieces
    of wire keep their length l, so that cos(alpha) = h (1 + k cos(theta)) / l, and a column takes l sin(alpha) of the
    circumference: n of them fill it when the mean of 1 / sin(alpha) round it is n l / (pi D). h is less than in a
    straight artery: what columns lose outside, where wires are drawn along the axis, is more than what they gain
    inside. This is the net of inextensible threads (Chebyshev 1878, Sur la coupe des vetements) on a torus. It asks
    nothing but that pieces keep their length between crossings that all their wires keep, so it holds for the joined
    struts of a laser-cut device as for a braid, as long as its cells can lie against the wall: where h (1 + k) would
    have to exceed l in a straight artery's rows they begin to leave it outside, and the device is longer than this.
    """
    piece_mm, angle = piece_length_mm(design, size), angle_rad(design, size, diameter_mm)
    if not np.any(curvature_per_mm):
        return piece_mm * np.cos(angle)
    opened_mm = np.minimum(diameter_mm, size.free_diameter_mm)
    bend = np.minimum(0.5 * np.abs(curvature_per_mm) * opened_mm, STEEPEST_BEND)
    apart = 1 + np.multiply.outer(bend, np.cos(np.pi * (np.arange(BEND_SAMPLES) + 0.5) / BEND_SAMPLES))
    longest = STRAIGHTEST / (1 + bend)
    cosine = np.minimum(np.cos(angle), longest)
    for _ in range(BEND_STEPS):  # Newton's; the mean grows faster than linearly with the cosine
        width = 1 / np.sqrt(1 - (cosine[..., None] * apart) ** 2)
        excess = width.mean(axis=-1) - 1 / np.sin(angle)
        slope = cosine * (apart * apart * width * width * width).mean(axis=-1)
        cosine = np.clip(cosine - excess / slope, 0.0, longest)
    return piece_mm * cosine


def deployed_length_mm(design: Design, size: Size, diameter_mm: float) -> float:
    """Length in a straight tube where the contour's diameter is `diameter_mm` all along."""
    rows = grid(design, size).lattice_rows
    return float((rows - 1) * row_spacing_mm(design, size, diameter_mm))


def foreshortening_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Shortening at a local diameter against the label: 1 - L(D)/L_label = 1 - (1 - q) cos(alpha)/cos(alpha_label)."""
    here, label = angle_rad(design, size, np.array([diameter_mm, size.diameter_mm]))
    return float(1 - (1 - size.compaction_fraction) * np.cos(here) / np.cos(label))


def coverage_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Part of the wall under metal at a local diameter.

    Two hands of strips cover 1 - (1 - f)^2, f = sum of wire diameters of one hand / (pi D cos(alpha)); struts that
    meet without crossing cover 2 f.
    """
    strips = min(1.0, _strips_fraction(design, size, diameter_mm))
    return strips if isinstance(design, LaserCut) else 1 - (1 - strips) ** 2


def _strips_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Part of the circumference that all struts, or the wires of one hand, take side by side; 1 and more: no room."""
    per_axis_mm = np.pi * diameter_mm * float(np.cos(angle_rad(design, size, diameter_mm)))
    if isinstance(design, LaserCut):
        return float(design.n_columns * design.strut_width_um * MM_PER_UM / per_axis_mm)
    hand_um = 0.5 * sum(count * diameter for count, diameter in design.wires)
    return float(hand_um * MM_PER_UM / per_axis_mm)


def pore_density_per_mm2(design: Design, size: Size, diameter_mm: float) -> float:
    """Pores per area of wall at a local diameter: 2 (n/2)^2 tan(alpha) / (pi D)^2."""
    tangent = float(np.tan(angle_rad(design, size, diameter_mm)))
    return float(0.5 * design.n_columns**2 * tangent / (np.pi * diameter_mm) ** 2)


@cache
def catalogue() -> dict[str, Design]:
    """Return every device by its key: those of the catalogue, of plug-ins, then those that the user has added.

    Raises
    ------
    DeviceError
        When a catalogue breaks its schema or names a device that another one names.
    PluginError
        When a plug-in cannot be loaded.
    """
    from importlib.resources import files

    from vstent.devices.schema import parse  # pydantic is loaded only when the catalogue is

    designs = parse(files("vstent.devices").joinpath("catalogue.toml").read_text(encoding="utf-8"))
    for name, entry in plugins.plugins("vstent.devices").items():
        text = plugins.load("vstent.devices", name, built_in="vstent")()
        added = parse(text, f"The plug-in {name} ({entry.value})")
        _check_new(added, designs, f"The plug-in {name}")
        designs |= added
    for path in sorted(user_folder().glob("*.toml")):
        added = parse(_text(path), str(path))
        _check_new(added, designs, path)
        designs |= added
    return designs


def user_folder() -> Path:
    """Return where the user's own device files are kept: ``$XDG_CONFIG_HOME/vstent/devices``, or in ``~/.config``."""
    home = os.environ.get("XDG_CONFIG_HOME") or os.environ.get("APPDATA") or "~/.config"
    return Path(home).expanduser() / "vstent" / "devices"


def add_devices(path: Path) -> dict[str, Design]:
    """Check a device file (TOML, as ``catalogue.toml``) and keep a copy of it: its devices join the catalogue.

    A file of the same name that was added before is replaced.

    Raises
    ------
    DeviceError
        When it is no readable text, breaks the schema or names a device that the catalogue has already.
    """
    from vstent.devices.schema import parse

    text = _text(path)
    added, kept = parse(text, str(path)), user_folder() / f"{path.stem}.toml"
    others = parse(_text(kept), str(kept)) if kept.exists() else {}
    _check_new(added, {key: design for key, design in catalogue().items() if key not in others}, path)
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(kept)
    catalogue.cache_clear()
    return added


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DeviceError(f"{path} does not exist: check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(f"{path} cannot be read as text: give a TOML file of devices, or remove it.") from error


def called(designs: Iterable[Design]) -> list[str]:
    """Return what devices are called, their keys and names in lower case; two that clash are in it twice."""
    return [word for design in designs for word in sorted({design.key.casefold(), design.name.casefold()})]


def _check_new(added: Mapping[str, Design], known: Mapping[str, Design], source: object) -> None:
    twice = sorted(set(called(added.values())) & set(called(known.values())))
    if twice:
        raise DeviceError(
            f"{source} names a device that the catalogue has already, {twice[0]}: give it another key and name."
        )


def find_design(name: str) -> Design:
    """Return the device called `name` (its key or its name, any case).

    Raises
    ------
    DeviceError
        When there is none; the sentence says which there are and the nearest.
    """
    designs = catalogue()
    by_name = {word: design for design in designs.values() for word in called([design])}
    wanted = name.strip().casefold()
    if wanted in by_name:
        return by_name[wanted]
    near = difflib.get_close_matches(wanted, by_name, n=1)
    hint = f" Did you mean {by_name[near[0]].key}?" if near else ""
    raise DeviceError(f"There is no device called {name!r}.{hint} Choose one of: {', '.join(sorted(designs))}.")


def find_sizes(design: Design, *, diameter_mm: float | None = None, length_mm: float | None = None) -> tuple[Size, ...]:
    """Return all sizes with this label diameter and length, the smallest and shortest first; None matches any.

    Raises
    ------
    DeviceError
        When the device is not made in that size; the sentence says what there is.
    """
    fits = [
        size for size in design.sizes if diameter_mm in (None, size.diameter_mm) and length_mm in (None, size.length_mm)
    ]
    if fits:
        return tuple(sorted(fits, key=lambda size: (size.diameter_mm, size.length_mm)))
    asked = " x ".join(f"{value:g} mm" for value in (diameter_mm, length_mm) if value is not None)
    same = [size for size in design.sizes if size.diameter_mm == diameter_mm]
    offered = _listed(size.length_mm for size in same) if same else _listed(size.diameter_mm for size in design.sizes)
    what = f"in {diameter_mm:g} mm its lengths are" if same else "its diameters are"
    raise DeviceError(f"{design.name} is not made in {asked}: {what} {offered} mm. Choose one of them.")


def find_size(design: Design, *, diameter_mm: float | None = None, length_mm: float | None = None) -> Size:
    """Return the smallest and shortest size of `find_sizes`, and raise what that raises."""
    return find_sizes(design, diameter_mm=diameter_mm, length_mm=length_mm)[0]


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:g}" for value in sorted(set(values)))
