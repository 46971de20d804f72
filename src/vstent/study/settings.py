"""Settings of a study, one nested model: input, anatomy, treatments, flow, uncertainty.

Every setting that a user can state carries its option (`vstent.fields`). The options of the command line, the columns
of a cohort's table and the fields of the page are made from these. This module imports no numpy, so that the help of
the command line appears at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, Literal, get_args

from vstent.devices.treatment import Treatment, read_treatment, with_device
from vstent.errors import InputError
from vstent.fields import (
    LENGTH,
    POSITION,
    Option,
    box,
    flag,
    point,
    sections_of,
    setting,
    shape,
    spacing,
    stated,
    whole,
)
from vstent.flow.settings import HIGH_SHEAR_VISCOSITY_PA_S, FlowSettings
from vstent.plan.ranges import Ranges

Point = tuple[float, float, float]
"""Three lengths in mm: a point or voxel edges."""
Units = Literal["m", "cm", "mm"]
"""Length unit of a surface file."""
Frame = Literal["lps", "ras"]
"""Coordinate frame."""
PLACE: Final[dict[str, Any]] = {"metavar": "X,Y,Z", "is_place": True, **POSITION}
"""What options that state a point have in common."""


def _read_neck(path: str) -> tuple[Point, ...]:
    """Return the points of a CSV file."""
    from vstent.io.tables import read_columns

    return tuple((x, y, z) for x, y, z in read_columns(Path(path), 3).tolist())


@dataclass(frozen=True)
class InputSettings:
    """How the input is read; None means that the value is found or proposed."""

    units: Units | None = setting(
        None, "units", "length unit of a surface file", str, choices=get_args(Units), usual="derived from its size"
    )
    """Length unit of a surface file."""
    frame: Frame | None = setting(
        None,
        "frame",
        "frame of a surface file and of points",
        str,
        choices=get_args(Frame),
        usual="as stated in the file, else lps",
    )
    """Frame of a surface file and of the points given; None: as the file states, and LPS points."""
    acquisition: int | None = setting(
        None,
        "acquisition",
        "acquisition of a DICOM series with several",
        whole,
        metavar="N",
        low=1,
        usual="the brightest",
    )
    """Acquisition of a DICOM series that holds several, counted from 1."""
    spacing_mm: Point | None = setting(
        None, "spacing", "voxel spacing of a raw volume", spacing, metavar="S|X,Y,Z", **LENGTH
    )
    """Voxel spacing of a raw volume, in mm."""
    shape: tuple[int, int, int] | None = setting(
        None,
        "shape",
        "number of voxels of a raw volume, fastest axis first",
        shape,
        metavar="I,J,K",
        low=1,
        high=100_000,
    )
    """Number of voxels of a raw volume."""
    crop_mm: tuple[Point, Point] | None = setting(
        None,
        "crop",
        "opposite corners of the box along the image axes to which a scan is cropped",
        box,
        usual="whole scan",
        **PLACE | {"metavar": "X,Y,Z,X,Y,Z"},
    )
    """Opposite corners, LPS mm, of the box along the image axes to which a scan is cropped."""
    threshold: float | None = setting(
        None,
        "threshold",
        "intensity at the lumen wall of a scan",
        metavar="T",
        usual="half way between tissue and lumen",
    )
    """Intensity at the lumen wall of a scan."""


@dataclass(frozen=True)
class AnatomySettings:
    """What of the anatomy is given; None means that it is found."""

    at_mm: Point | None = setting(None, "at", "point in or near the aneurysm", point, usual="the largest sac", **PLACE)
    """Point near the sac, LPS mm."""
    inlet_mm: Point | tuple[Point, ...] | None = setting(
        None,
        "inlet",
        "point near the inlet",
        point,
        usual="the widest opening",
        separators=";",
        counts=(1, 50),
        **PLACE,
    )
    """Point near the inlet, or near each inlet; the parent artery begins at the first."""
    outlet_mm: Point | None = setting(None, "outlet", "point near the outlet of the parent artery", point, **PLACE)
    """Point near the outlet of the parent artery."""
    neck_mm: tuple[Point, ...] | None = setting(
        None,
        "neck",
        "neck drawn by hand: columns x, y, z of points along a closed curve",
        str,
        load=_read_neck,
        is_file=True,
        counts=(3, 1000),
        **PLACE | {"metavar": "CSV"},
    )
    """Neck drawn by hand: a closed curve near the wall around the mouth of the sac."""
    upstream_mm: float | None = setting(
        None, "upstream", "length of artery kept proximal to the sac", usual="35", **LENGTH
    )
    """Length of artery to keep proximal to the middle of the sac, in mm."""
    downstream_mm: float | None = setting(
        None, "downstream", "length of vessel kept distal to the sac", usual="25", **LENGTH
    )
    """Length of vessel to keep distal to the middle of the sac, in mm."""


@dataclass(frozen=True)
class Settings:
    """All settings of a study."""

    input: InputSettings = InputSettings()
    """How the input is read."""
    anatomy: AnatomySettings = AnatomySettings()
    """What of the anatomy is given."""
    treatments: tuple[Treatment, ...] = setting(
        (with_device("silk"), with_device("enterprise")),
        "treatment",
        "treatment of several devices in the order of their deployment, each inside those before it, such as "
        "'silk 4x20 + silk@-4': with a size, or with a shift of the proposed place in mm; NAME= before it names it",
        read_treatment,
        metavar="TEXT",
        separators=";",
    )
    """Treatments to compare with the bare artery, each under a name of its own."""
    flow: FlowSettings | None = setting(FlowSettings(), "no-flow", "deploy only, without computing the flow", flag)
    """Settings of the flows; None: no flow is computed."""
    uncertainty: Ranges | None = None
    """Ranges of the uncertainty study; None: no uncertainty study."""

    def __post_init__(self) -> None:
        names = [treatment.name.casefold() for treatment in self.treatments]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise InputError(f"two treatments are called {twice[0]}: give each a name of its own, or leave one out")

    @property
    def devices(self) -> tuple[str, ...]:
        """Keys of the devices of all treatments, each once."""
        return tuple(dict.fromkeys(device for treatment in self.treatments for device in treatment.devices))


STATED: Final = stated(Settings)
"""Option of every setting that has one, by the dotted path of the setting."""
OPTIONS: Final = {option.name: option for option in STATED.values()}
"""All options by name."""
OF_DEVICES: Final = ("diameter", "length", "center")
"""Options that belong to every device given alone."""


def in_section(name: str) -> dict[str, Option]:
    """Return the options of a section of the settings, by name."""
    return {option.name: option for path, option in STATED.items() if path.partition(".")[0] == name}


def settings_of(given: Mapping[str, Any]) -> Settings:
    """Return the settings that options state.

    Parameters
    ----------
    given : values by name of the option, as `Option.value` returns them; None: not given.

    Raises
    ------
    InputError
        A file cannot be read, or an option is given without the one that it belongs to.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if given.get("shear-thinning"):
        given = {"viscosity": HIGH_SHEAR_VISCOSITY_PA_S} | given
    varied = [name for name in in_section("uncertainty") if name in given]
    if varied and "uncertainty" not in given:
        raise InputError(f"--{varied[0]} needs --uncertainty N: give that too")
    return Settings(
        _section(InputSettings, given),
        _section(AnatomySettings, given),
        _treatments(given),
        None if given.get("no-flow") else _section(FlowSettings, given),
        _section(Ranges, given) if varied else None,
    )


def _section(kind: Any, given: Mapping[str, Any]) -> Any:
    """Return a section of the settings with the values that options state, points in LPS."""
    values = {}
    for one in fields(kind):
        option: Option | None = one.metadata.get("option")
        if option is not None and option.name in given:
            value = given[option.name]
            if option.load:
                value = option.check(option.load(value))
            values[one.name] = _from_ras(value) if option.is_place and given.get("frame") == "ras" else value
        elif option is None and sections_of(one.type):
            values[one.name] = _section(sections_of(one.type)[0], given)
    return kind(**values)


def _treatments(given: Mapping[str, Any]) -> tuple[Treatment, ...]:
    """Return the treatments that options state: those with one device, then those with several."""
    several = given.get("treatment", ())
    devices = given.get("device", () if several else ("silk", "enterprise"))  # those of the paper
    size = {name: given.get(name) for name in OF_DEVICES}
    if not devices and any(value is not None for value in size.values()):
        raise InputError("--diameter, --length and --center belong to --device: state them in the --treatment instead")
    return (*(with_device(name, **{f"{what}_mm": mm for what, mm in size.items()}) for name in devices), *several)


def _from_ras(place_mm: Any) -> Any:
    """Return a RAS point, or each of several, in LPS."""
    if isinstance(place_mm[0], tuple):
        return tuple(map(_from_ras, place_mm))
    return -place_mm[0], -place_mm[1], place_mm[2]
