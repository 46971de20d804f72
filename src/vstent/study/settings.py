"""Settings of a study, one nested model: input, anatomy, treatments, flow, uncertainty.

Every setting that a user can state carries its option (`vstent.fields`). The options of the command line, the columns
of a cohort's table and the fields of the page are made from these. This module imports no numpy, so that the help of
the command line appears at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields as fields_of, replace
from pathlib import Path
from typing import Any, Final, Literal, get_args

from vstent import fields
from vstent.devices.treatment import Treatment, read_straightening, read_treatment, with_device
from vstent.errors import InputError
from vstent.fields import LENGTH, POSITION, Limits, Option, Speed, box, flag, point, setting, shape, spacing, whole
from vstent.flow.measured import MeasuredProfile
from vstent.flow.settings import HIGH_SHEAR_VISCOSITY_PA_S, FlowSettings
from vstent.plan.ranges import Ranges

Point = tuple[float, float, float]
"""Three lengths in mm: a point or voxel edges."""
Units = Literal["m", "cm", "mm"]
"""Length unit of a surface file."""
Frame = Literal["lps", "ras"]
"""Coordinate frame."""


def _read_neck(path: str) -> tuple[Point, ...]:
    """Return the points of a CSV file."""
    from vstent.io.tables import read_columns

    return tuple((x, y, z) for x, y, z in read_columns(Path(path), 3).tolist())


@dataclass(frozen=True)
class InputSettings:
    """How the input is read; None means that the value is found or proposed."""

    units: Units | None = setting(
        None, "units", "length unit of a surface file", str, usual="derived from its size", choices=get_args(Units)
    )
    frame: Frame | None = setting(
        None,
        "frame",
        "frame of a surface file and of points",
        str,
        usual="the file's, else lps",
        choices=get_args(Frame),
    )
    """Frame of a surface file; the settings themselves are in LPS."""
    acquisition: int | None = setting(
        None,
        "acquisition",
        "acquisition, from 1, of a DICOM series with several",
        whole,
        Limits(low=1),
        "the brightest",
    )
    spacing_mm: Point | None = setting(None, "spacing", "voxel spacing of a raw volume", spacing, LENGTH)
    shape: tuple[int, int, int] | None = setting(
        None, "shape", "number of voxels of a raw volume, fastest axis first", shape, Limits(low=1, high=100_000)
    )
    crop_mm: tuple[Point, Point] | None = setting(
        None, "crop", "corners of the box along the image axes to which a scan is cropped", box, POSITION, "whole scan"
    )
    threshold: float | None = setting(
        None, "threshold", "intensity at the lumen wall of a scan", usual="half way from tissue to lumen", metavar="T"
    )


@dataclass(frozen=True)
class AnatomySettings:
    """What of the anatomy is given, points in LPS mm; None means that it is found."""

    at_mm: Point | None = setting(None, "at", "point in or near the aneurysm", point, POSITION, "the largest sac")
    inlet_mm: Point | tuple[Point, ...] | None = setting(
        None, "inlet", "point near the inlet", point, POSITION, "the widest opening", separators=";", counts=(1, 50)
    )
    """Point near the inlet, or near each inlet; the parent artery begins at the first."""
    outlet_mm: Point | None = setting(None, "outlet", "point near the outlet of the parent artery", point, POSITION)
    neck_mm: tuple[Point, ...] | None = setting(
        None,
        "neck",
        "neck drawn by hand: columns x, y, z of points along a closed curve",
        str,
        POSITION,
        metavar="CSV",
        load=_read_neck,
        is_file=True,
        counts=(3, 1000),
    )
    upstream_mm: float | None = setting(
        None, "upstream", "length of artery kept proximal to the middle of the sac", limits=LENGTH, usual="35"
    )
    downstream_mm: float | None = setting(
        None, "downstream", "length of vessel kept distal to the middle of the sac", limits=LENGTH, usual="25"
    )
    without_aneurysm: bool = setting(False, "no-aneurysm", "deploy in an artery in which no aneurysm is found", flag)
    """Whether devices get their proposed places in an artery without an aneurysm too."""


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
        "'silk 4x20 + silk@-4': with a size, a path, or a shift of the proposed place in mm; "
        "'enterprise > outlet_1 + enterprise > outlet_2' is a Y at a fork, | in place of + places them side by side; "
        "NAME= before it names it",
        read_treatment,
        metavar="TEXT",
        separators=";",
    )
    """Treatments to compare with the bare artery, each under a name of its own."""
    flow: FlowSettings | None = setting(FlowSettings(), "no-flow", "deploy only, without computing the flow", flag)
    """Settings of the flows; None: no flow is computed."""
    uncertainty: Ranges | None = None
    """Ranges of the uncertainty study; None: no uncertainty study."""
    straightening: str = setting(
        "off",
        "straightening",
        "how much devices straighten the artery: off, immediate, six_months, or what was measured: the angle by which "
        "it opens, such as 12deg, or the radius of its sharpest bend afterwards, such as 10.7mm",
        read_straightening,
        metavar="HOW",
    )
    """How much the artery yields to its devices."""

    def __post_init__(self) -> None:
        names = [treatment.name.casefold() for treatment in self.treatments]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise InputError(f"two treatments are called {twice[0]}: give each a name of its own, or leave one out")

    @property
    def devices(self) -> tuple[str, ...]:
        """Keys of the devices of all treatments, each once."""
        return tuple(dict.fromkeys(device for treatment in self.treatments for device in treatment.devices))


STATED: Final = fields.stated(Settings)
"""Option of every setting that has one, by the dotted path of the setting."""
OPTIONS: Final = {option.name: option for option in STATED.values()}
"""All options by name."""
OF_DEVICES: Final = ("diameter", "length", "center")
"""Options that belong to every device given alone."""


def in_section(name: str) -> dict[str, Option]:
    """Return the options of a section of the settings, by name."""
    return {option.name: option for path, option in STATED.items() if path.partition(".")[0] == name}


def settings_of(given: Mapping[str, Any]) -> Settings:
    """Return the settings that options state, from values by name as `Option.value` returns them; None: not given.

    InputError is raised where a file cannot be read, or an option is given without the one that it belongs to.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if {"flow-rate", "inlet-speed"} <= given.keys():
        raise InputError("--flow-rate and --inlet-speed both state the inflow: leave out one of them")
    if isinstance(given.get("flow-rate"), Speed):
        given["inlet-speed"] = OPTIONS["inlet-speed"].checked(float(given.pop("flow-rate")))
    if given.get("shear-thinning"):
        given = {"viscosity": HIGH_SHEAR_VISCOSITY_PA_S} | given
    varied = [name for name in in_section("uncertainty") if name in given]
    if varied and "uncertainty" not in given:
        raise InputError(f"--{varied[0]} needs --uncertainty N: give that too")
    flow = None if given.get("no-flow") else _section(FlowSettings, given)
    measured = None if flow is None else flow.profile
    if flow is not None and isinstance(measured, MeasuredProfile) and not {"pulsatile", "steady"} & given.keys():
        flow = replace(flow, waveform=measured.waveform)
    return Settings(
        _section(InputSettings, given),
        _section(AnatomySettings, given),
        _treatments(given),
        flow,
        _section(Ranges, given) if varied else None,
        given.get("straightening", "off"),
    )


def _section(kind: Any, given: Mapping[str, Any]) -> Any:
    """Return a section of the settings with the values that options state, points in LPS."""
    values = {}
    for one in fields_of(kind):
        option: Option | None = one.metadata.get("option")
        if option is not None and option.name in given:
            value = given[option.name]
            if option.load:
                value = option.check(option.load(value))
            is_ras = option.limits is POSITION and given.get("frame") == "ras"
            values[one.name] = _from_ras(value) if is_ras else value
        elif option is None and fields.sections_of(one.type):
            values[one.name] = _section(fields.sections_of(one.type)[0], given)
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
