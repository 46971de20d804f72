"""The user's choices as the page and the REST interface state them, and their conversion to settings of a study."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

if (
    TYPE_CHECKING
):  # the modules of a study are imported only when its settings are needed, so that the page appears at once
    from vstent.flow.settings import FlowSettings, Waveform
    from vstent.study.types import Placing, Settings

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000, allow_inf_nan=False)]
"""A coordinate or position in mm."""
Length = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
"""A length in mm."""
Count = Annotated[int, Field(gt=0, le=100_000)]
"""A number of voxels."""
NECK_HANDLES: Final = 12
"""Number of evenly spaced handles on a neck."""
Point = tuple[Coordinate, Coordinate, Coordinate]
"""A point in LPS mm."""


class Strict(BaseModel):
    """A model that rejects unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DeviceChoice(Strict):
    """A device with its size and the position of its middle; missing values are proposed."""

    name: str = Field(max_length=60)
    """Name in the catalogue."""
    diameter_mm: Length | None = None
    """Label diameter."""
    length_mm: Length | None = None
    """Label length."""
    center_mm: Coordinate | None = None
    """Position of the device's middle along the parent axis."""


class FlowChoice(Strict):
    """How the blood flow is computed."""

    is_wanted: bool = True
    """Whether a flow is computed."""
    cell_size_mm: Annotated[float, Field(ge=0.04, le=1.0)] | None = None
    """Grid spacing."""
    inflow_mL_s: Annotated[float, Field(gt=0, le=50)] | None = None
    """Mean inflow of all inlets."""
    is_pulsatile: bool = False
    """Whether the inflow is pulsatile."""
    outlets: Literal["zero_pressure", "murray"] = "zero_pressure"
    """Boundary condition at the outlets."""

    def settings(self, former: "FlowSettings") -> "FlowSettings | None":
        """Return the flow settings of the study; settings that the page cannot change are taken from `former`."""
        if not self.is_wanted:
            return None
        return replace(
            former,
            inflow_mL_s=self.inflow_mL_s,
            waveform=pulse_of(former) if self.is_pulsatile else None,
            outlets=self.outlets,
            numerics=replace(former.numerics, cell_size_mm=self.cell_size_mm),
        )


Unit = Annotated[float, Field(ge=-1.001, le=1.001, allow_inf_nan=False)]
"""A component of a unit vector."""
Axes = Annotated[tuple[Unit, ...], Field(min_length=9, max_length=9)]
"""Unit vectors to the right, up and toward the eye, one after the other."""


class SavedView(Strict):
    """Where the camera of the 3-D view stands."""

    name: str = Field(min_length=1, max_length=40)
    """Displayed name."""
    axes: Axes
    """Directions of the picture."""
    center_mm: Point
    """Point about which the view turns."""
    distance_mm: Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
    """Distance of the camera from it."""


class ColourRange(Strict):
    """Range of a color scale that was chosen in place of the computed one."""

    scale: str = Field(min_length=1, max_length=60)
    """Key of the scale."""
    low: Annotated[float, Field(allow_inf_nan=False)]
    """Value of the first color, in the unit of the scale."""
    high: Annotated[float, Field(allow_inf_nan=False)]
    """Value of the last color."""

    @model_validator(mode="after")
    def _is_ascending(self) -> Self:
        """Return the range; ValueError is raised where its ends are not in order."""
        if not self.low < self.high:
            raise ValueError("the highest value of a color range must be above the lowest")
        return self


class Choices(Strict):
    """All choices of the user; missing values are proposed."""

    units: Literal["m", "cm", "mm"] | None = None
    """Length unit of a surface file."""
    frame: Literal["lps", "ras"] | None = None
    """Frame of a surface file; None: as it states, else LPS."""
    spacing_mm: tuple[Length, Length, Length] | None = None
    """Voxel spacing of a raw volume."""
    shape: tuple[Count, Count, Count] | None = None
    """Number of voxels of a raw volume."""
    crop_mm: tuple[Point, Point] | None = None
    """Opposite corners of the box to which a scan is cropped."""
    threshold: Annotated[float, Field(allow_inf_nan=False)] | None = None
    """Intensity at the lumen wall of a scan."""
    at_mm: Point | None = None
    """Point near the sac."""
    inlet_mm: Point | Annotated[tuple[Point, ...], Field(min_length=1, max_length=50)] | None = None
    """Point near the inlet, or near each inlet; the parent artery begins at the first."""
    outlet_mm: Point | None = None
    """Point near the outlet of the parent artery."""
    neck_mm: Annotated[tuple[Point, ...], Field(min_length=3, max_length=1000)] | None = None
    """Neck drawn by hand: a closed curve near the wall."""
    upstream_mm: Length | None = None
    """Length of artery to keep proximal to the sac."""
    downstream_mm: Length | None = None
    """Length of vessel to keep distal to the sac."""
    devices: tuple[DeviceChoice, ...] = Field(
        default=(DeviceChoice(name="silk"), DeviceChoice(name="enterprise")), max_length=3
    )
    """Devices with their sizes and positions."""
    flow: FlowChoice = FlowChoice()
    """Settings of the flow."""
    ranking_flows: Annotated[int, Field(ge=1, le=24)] | None = None
    """Number of best sizes of a ranking that get a flow; None: none."""
    uncertainty_samples: Annotated[int, Field(ge=8, le=256)] | None = None
    """Number of deployments with uncertain inputs varied; None: none."""
    views: Annotated[tuple[SavedView, ...], Field(max_length=12)] = ()
    """Views that were saved; no result depends on them."""
    ranges: Annotated[tuple[ColourRange, ...], Field(max_length=40)] = ()
    """Ranges of color scales that were chosen; no result depends on them."""

    @field_validator("devices")
    @classmethod
    def _each_once(cls, devices: tuple[DeviceChoice, ...]) -> tuple[DeviceChoice, ...]:
        """Return the devices; ValueError is raised where one is chosen twice."""
        if len({device.name for device in devices}) < len(devices):
            raise ValueError("a device can be chosen only once")
        return devices

    def settings(self, former: "Settings") -> "Settings":
        """Return the settings of the study; settings that the page cannot change are taken from `former`."""
        from vstent.flow.settings import FlowSettings
        from vstent.plan.uncertainty import Ranges
        from vstent.study.types import Placing

        samples = self.uncertainty_samples
        return replace(
            former,
            diameter_mm=None,  # every device gets its own below
            length_mm=None,
            center_mm=None,
            devices=tuple(device.name for device in self.devices),
            units=self.units,
            frame=self.frame,
            spacing_mm=self.spacing_mm,
            shape=self.shape,
            crop_mm=self.crop_mm,
            threshold=self.threshold,
            at_mm=self.at_mm,
            inlet_mm=self.inlet_mm,
            outlet_mm=self.outlet_mm,
            neck_mm=self.neck_mm,
            upstream_mm=self.upstream_mm,
            downstream_mm=self.downstream_mm,
            flow=self.flow.settings(former.flow or FlowSettings()),
            placings={device.name: placing for device in self.devices if (placing := placing_of(device)) != Placing()},
            uncertainty=None if samples is None else replace(former.uncertainty or Ranges(), samples=samples),
        )


def pulse_of(former: "FlowSettings") -> "Waveform":
    """Return the waveform that can be chosen: that of the study the case was opened from, or the published one."""
    from vstent.flow.waveform import OLDER_ADULT_ICA

    return former.waveform or OLDER_ADULT_ICA


def placing_of(device: DeviceChoice) -> "Placing":
    """Return size and position of a device for the study."""
    from vstent.study.types import Placing

    return Placing(device.diameter_mm, device.length_mm, device.center_mm)
