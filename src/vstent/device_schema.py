"""The catalogue's schema: every number carries its source and its confidence."""

import tomllib
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError

from vstent.device import Braid, Confidence, Design, Fact, LaserCut, Size
from vstent.errors import DeviceError


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Sourced(_Strict):
    source: str = Field(min_length=3)
    confidence: Confidence


class _Number(_Sourced):
    value: PositiveFloat


class _Count(_Sourced):
    value: PositiveInt


class _Margin(_Sourced):
    value: Annotated[float, Field(ge=0, le=1)]


class _Wires(_Sourced):
    count: PositiveInt
    diameter_um: PositiveFloat


class _Sizes(_Sourced):
    diameters_mm: list[PositiveFloat] = Field(min_length=1)
    lengths_mm: list[PositiveFloat] = Field(min_length=1)


class _Device(_Strict):
    key: str = Field(pattern=r"^[a-z0-9_]+$")
    name: str
    maker: str
    free_diameter_margin_mm: _Margin
    """Free diameter = label diameter + this."""
    sizes: list[_Sizes] = Field(min_length=1)

    def _sizes(self) -> tuple[Size, ...]:
        margin_mm = self.free_diameter_margin_mm.value
        pairs = {(d, length) for block in self.sizes for d in block.diameters_mm for length in block.lengths_mm}
        return tuple(Size(d, length, round(d + margin_mm, 6)) for d, length in sorted(pairs))

    def _shared_facts(self) -> tuple[Fact, ...]:
        return (
            _fact("free_diameter_margin_mm", self.free_diameter_margin_mm),
            *(_fact("sizes", block) for block in self.sizes),
        )


class _Braid(_Device):
    kind: Literal["braid"]
    wires: list[_Wires] = Field(min_length=1)
    braid_angle_rad: _Number

    def design(self) -> Design:
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
    kind: Literal["laser_cut"]
    n_columns: _Count
    strut_width_um: _Number
    strut_thickness_um: _Number
    cell_angle_rad: _Number

    def design(self) -> Design:
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
    device: list[Annotated[_Braid | _LaserCut, Field(discriminator="kind")]]


def _fact(name: str, sourced: _Sourced) -> Fact:
    return Fact(name, sourced.source, sourced.confidence)


def parse(text: str, name: str = "The device catalogue") -> dict[str, Design]:
    """Read a catalogue (TOML) called `name`: its devices by key.

    Raises
    ------
    DeviceError
        When it is no TOML, breaks the schema or names a device twice.
    """
    try:
        found = _Catalogue.model_validate(tomllib.loads(text)).device
    except tomllib.TOMLDecodeError as error:
        raise DeviceError(f"{name} is not valid TOML: {error}. Correct that line.") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DeviceError(f"{name} is wrong at {where}: {first['msg']}. Correct that entry.") from error
    designs = {entry.key: entry.design() for entry in found}
    if len(designs) < len(found):
        raise DeviceError(f"{name} uses one key for two devices: give each its own.")
    return designs
