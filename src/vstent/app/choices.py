"""What a user has chosen, as the page and the REST interface say it, and as a study understands it."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

if TYPE_CHECKING:  # a study's modules are loaded when it is to be told something: the page must be there at once
    from vstent.flow.case import FlowSettings, Waveform
    from vstent.study.types import Placing, Settings

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000, allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0, le=100_000)]
NECK_HANDLES: Final = 12
"""Points of a neck that can be pulled, evenly spaced."""
Point = tuple[Coordinate, Coordinate, Coordinate]


class Strict(BaseModel):
    """A model that refuses names it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DeviceChoice(Strict):
    """A device, its size and where its middle lies; what is not given is proposed."""

    name: str = Field(max_length=60)
    diameter_mm: Length | None = None
    length_mm: Length | None = None
    center_mm: Coordinate | None = None


class FlowChoice(Strict):
    """How the blood flow is to be computed."""

    is_wanted: bool = True
    cell_size_mm: Annotated[float, Field(ge=0.04, le=1.0)] | None = None
    inflow_mL_s: Annotated[float, Field(gt=0, le=50)] | None = None
    is_pulsatile: bool = False
    outlets: Literal["zero_pressure", "murray"] = "zero_pressure"

    def settings(self, former: "FlowSettings") -> "FlowSettings | None":
        """Return what a study is told of the flow; what cannot be chosen here stays as it was in `former`."""
        if not self.is_wanted:
            return None
        return replace(
            former,
            inflow_mL_s=self.inflow_mL_s,
            waveform=pulse_of(former) if self.is_pulsatile else None,
            outlets=self.outlets,
            cell_size_mm=self.cell_size_mm,
        )


class Choices(Strict):
    """Everything a user may choose; what is left out is proposed."""

    units: Literal["m", "cm", "mm"] | None = None
    spacing_mm: tuple[Length, Length, Length] | None = None
    shape: tuple[Count, Count, Count] | None = None
    threshold: Annotated[float, Field(allow_inf_nan=False)] | None = None
    at_mm: Point | None = None
    inlet_mm: Point | Annotated[tuple[Point, ...], Field(min_length=1, max_length=50)] | None = None
    """Near the inlet; or near each opening that brings blood, first near that where the parent artery begins."""
    outlet_mm: Point | None = None
    neck_mm: Annotated[tuple[Point, ...], Field(min_length=3, max_length=1000)] | None = None
    """A neck drawn by hand: a closed curve near the wall."""
    upstream_mm: Length | None = None
    """Artery to keep before the sac's middle."""
    downstream_mm: Length | None = None
    """Of every way beyond the sac's middle, what is to be kept."""
    devices: tuple[DeviceChoice, ...] = Field(
        default=(DeviceChoice(name="silk"), DeviceChoice(name="enterprise")), max_length=3
    )
    flow: FlowChoice = FlowChoice()
    uncertainty_samples: Annotated[int, Field(ge=8, le=256)] | None = None
    """Deployments with what is not sure varied; None: none."""

    @field_validator("devices")
    @classmethod
    def _each_once(cls, devices: tuple[DeviceChoice, ...]) -> tuple[DeviceChoice, ...]:
        if len({device.name for device in devices}) < len(devices):
            raise ValueError("a device can be chosen only once")
        return devices

    def settings(self, former: "Settings") -> "Settings":
        """Return what a study is told; what cannot be chosen here stays as it was in `former`."""
        from vstent.flow.case import FlowSettings
        from vstent.plan.uncertainty import Ranges
        from vstent.study.types import Placing

        samples = self.uncertainty_samples
        return replace(
            former,
            diameter_mm=None,  # every device is told its own below
            length_mm=None,
            center_mm=None,
            devices=tuple(device.name for device in self.devices),
            units=self.units,
            spacing_mm=self.spacing_mm,
            shape=self.shape,
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
    """Return the pulse that can be chosen: the former one, or the published one where there was none."""
    from vstent.flow.waveform import OLDER_ADULT_ICA

    return former.waveform or OLDER_ADULT_ICA


def placing_of(device: DeviceChoice) -> "Placing":
    """Return what a study is told of a device's size and place."""
    from vstent.study.types import Placing

    return Placing(device.diameter_mm, device.length_mm, device.center_mm)
