"""Schema of the device catalogue: every number has a source and a confidence."""

import tomllib
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from vstent.devices.design import BARE, Braid, Confidence, Design, Fact, LaserCut, Size, called
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

_Whole = Annotated[int, Field(gt=0, le=MOST_WIRES)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _in_um(width: float) -> float:
    """Return a width in um, or raise a ValueError if it is too small to be in um."""
    if width < THINNEST_UM:
        raise ValueError(f"{width:g} um is thinner than any wire or strut, give micrometres")
    return width


_Width_um = Annotated[float, Field(gt=0, le=LARGEST_UM), AfterValidator(_in_um)]
_Lengths_mm = Annotated[list[Annotated[float, Field(gt=0, le=LARGEST_MM)]], Field(min_length=1, max_length=MOST_SIZES)]


class _Strict(BaseModel):
    """Entry without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Sourced(_Strict):
    """Entry with a source and a confidence."""

    source: str = Field(min_length=3)
    confidence: Confidence


class _Number(_Sourced):
    """Positive number."""

    value: _Positive


class _Width(_Sourced):
    """Width or thickness of a strut, in um."""

    value: _Width_um


class _Count(_Sourced):
    """Number of wires or columns."""

    value: _Whole


class _Margin(_Sourced):
    """Free diameter minus label diameter, in mm."""

    value: Annotated[float, Field(ge=0, le=1)]


class _Wires(_Sourced):
    """Group of equal wires."""

    count: _Whole
    diameter_um: _Width_um


class _Sizes(_Sourced):
    """Block of sizes: all pairs of its diameters and lengths."""

    diameters_mm: _Lengths_mm
    lengths_mm: _Lengths_mm


class _Device(_Strict):
    """Entry of a device of either family."""

    key: str = Field(pattern=r"^[a-z0-9_]+$")
    name: str
    maker: str
    free_diameter_margin_mm: _Margin
    """Free diameter minus label diameter, in mm."""
    sizes: list[_Sizes] = Field(min_length=1)

    def _sizes(self) -> tuple[Size, ...]:
        """Return all sizes of the device."""
        margin_mm = self.free_diameter_margin_mm.value
        pairs = {(d, length) for block in self.sizes for d in block.diameters_mm for length in block.lengths_mm}
        return tuple(Size(d, length, round(d + margin_mm, 6)) for d, length in sorted(pairs))

    def _shared_facts(self) -> tuple[Fact, ...]:
        """Return the sources of the numbers that both families have."""
        return (
            _fact("free_diameter_margin_mm", self.free_diameter_margin_mm),
            *(_fact("sizes", block) for block in self.sizes),
        )


class _Braid(_Device):
    """Entry of a braid."""

    kind: Literal["braid"]
    wires: list[_Wires] = Field(min_length=1)
    braid_angle_rad: _Number

    def design(self) -> Design:
        """Return the braid."""
        facts = (*(_fact("wires", group) for group in self.wires), _fact("braid_angle_rad", self.braid_angle_rad))
        groups = tuple((group.count, group.diameter_um) for group in self.wires)
        return Braid(
            key=self.key,
            name=self.name,
            wires=groups,
            braid_angle_rad=self.braid_angle_rad.value,
            sizes=self._sizes(),
            maker=self.maker,
            facts=facts + self._shared_facts(),
        )


class _LaserCut(_Device):
    """Entry of a laser-cut device."""

    kind: Literal["laser_cut"]
    n_columns: _Count
    strut_width_um: _Width
    strut_thickness_um: _Width
    cell_angle_rad: _Number

    def design(self) -> Design:
        """Return the laser-cut device."""
        names = ("n_columns", "strut_width_um", "strut_thickness_um", "cell_angle_rad")
        return LaserCut(
            key=self.key,
            name=self.name,
            n_columns=self.n_columns.value,
            strut_width_um=self.strut_width_um.value,
            strut_thickness_um=self.strut_thickness_um.value,
            cell_angle_rad=self.cell_angle_rad.value,
            sizes=self._sizes(),
            maker=self.maker,
            facts=tuple(_fact(name, getattr(self, name)) for name in names) + self._shared_facts(),
        )


class _Catalogue(_Strict):
    """Content of a catalogue file."""

    device: list[Annotated[_Braid | _LaserCut, Field(discriminator="kind")]]


def _fact(name: str, sourced: _Sourced) -> Fact:
    """Return the source of one number."""
    return Fact(name, sourced.source, sourced.confidence)


def parse(text: str, name: str = "The device catalogue") -> dict[str, Design]:
    """Read a catalogue from TOML text.

    Parameters
    ----------
    text : str
        Content of the file.
    name : str, optional
        Name of the catalogue in messages.

    Returns
    -------
    dict
        Designs by their key.

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
