"""The user's choices as the page and the REST interface state them, and their conversion to settings of a study."""

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from vstent.devices.treatment import Treatment, with_device

if TYPE_CHECKING:  # imported only when the settings of a study are needed, so that the page appears at once
    from vstent.flow.settings import FlowSettings
    from vstent.flow.waveform import Waveform
    from vstent.study.settings import AnatomySettings, InputSettings, Settings

Part = TypeVar("Part", "InputSettings", "AnatomySettings")

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
    """A model that rejects unknown fields and numbers that are not finite, also in data classes of its fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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
    treatments: tuple[Treatment, ...] = Field(default=(with_device("silk"), with_device("enterprise")), max_length=3)
    """Treatments to compare, each under a name of its own; one of a single device has the name of the device."""
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

    @field_validator("treatments")
    @classmethod
    def _each_once(cls, treatments: tuple[Treatment, ...]) -> tuple[Treatment, ...]:
        """Return the treatments; ValueError is raised where two have the same name, or one has no implant."""
        if len({treatment.name for treatment in treatments}) < len(treatments):
            raise ValueError("a device can be chosen only once")
        if not all(treatment.implants for treatment in treatments):
            raise ValueError("a treatment needs an implant")
        return treatments

    def settings(self, former: "Settings") -> "Settings":
        """Return the settings of the study; settings that the page cannot change are taken from `former`."""
        from vstent.flow.settings import FlowSettings
        from vstent.plan.ranges import Ranges

        samples = self.uncertainty_samples
        return replace(
            former,
            input=self._changed(former.input),
            anatomy=self._changed(former.anatomy),
            treatments=self.treatments,
            flow=self.flow.settings(former.flow or FlowSettings()),
            uncertainty=None if samples is None else replace(former.uncertainty or Ranges(), samples=samples),
        )

    def _changed(self, former: Part) -> Part:
        """Return a part of the settings with the fields that can be chosen on the page."""
        names = {field.name for field in fields(former)} & type(self).model_fields.keys()
        return replace(former, **{name: getattr(self, name) for name in names})


def pulse_of(former: "FlowSettings") -> "Waveform":
    """Return the waveform that can be chosen: that of the study the case was opened from, or the published one."""
    from vstent.flow.waveform import OLDER_ADULT_ICA

    return former.waveform or OLDER_ADULT_ICA
