"""The user's choices as the page and the REST interface state them, and their conversion to settings of a study."""

from dataclasses import fields, replace
from math import isfinite
from typing import Annotated, Any, Final, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model, field_validator, model_validator

from vstent.devices.catalogue import find_design
from vstent.devices.design import Basket, Coil
from vstent.devices.treatment import Treatment, read_straightening
from vstent.fields import POSITION, Option, check_all
from vstent.flow.measured import MeasuredProfile
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.waveform import OLDER_ADULT_ICA, Waveform
from vstent.plan.ranges import Ranges
from vstent.study.settings import AnatomySettings, InputSettings, Settings

Section = TypeVar("Section", InputSettings, AnatomySettings, FlowSettings, Numerics)
NECK_HANDLES: Final = 12
"""Number of evenly spaced handles on a neck."""
Coordinate = Annotated[float, Field(ge=POSITION.low, le=POSITION.high, allow_inf_nan=False)]
"""A coordinate in mm."""
Point = tuple[Coordinate, Coordinate, Coordinate]
"""A point in LPS mm."""


class Strict(BaseModel):
    """A model that rejects unknown fields and numbers that are not finite, also in data classes of its fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def offered(kind: type, *without: str) -> dict[str, Any]:
    """Return the fields of a model that state the settings of a data class with an option, `without` some names."""
    found = {}
    for one in fields(kind):
        if "option" in one.metadata and one.name not in without:
            option: Option = one.metadata["option"]
            low, above, high = option.limits.low, option.limits.above, option.limits.high
            ends = {"minimum": low, "exclusiveMinimum": above, "maximum": high}
            stated: dict[str, Any] = {name: end for name, end in ends.items() if isfinite(end)}
            about = Field(description=f"{option.help}; {option.limits}".rstrip("; "), json_schema_extra=stated)
            found[one.name] = Annotated[one.type, AfterValidator(option.checked), about], one.default
    return found


def changed(former: Section, model: BaseModel) -> Section:
    """Return a section of the settings with the values that a model states."""
    names = {one.name for one in fields(former)} & type(model).model_fields.keys()
    return replace(former, **{name: getattr(model, name) for name in names})


def told(model: type[BaseModel], *sections: Any) -> dict[str, Any]:
    """Return the settings of sections that a model states."""
    return {name: getattr(one, name) for one in sections for name in model.model_fields if hasattr(one, name)}


OfFlow: Any = create_model(
    "OfFlow",
    __base__=Strict,
    **offered(FlowSettings, "waveform"),
    **offered(Numerics, "refine", "engine", "processes", "device_gpu"),
)
"""Settings of the flow that can be changed on the page."""
OfVessel: Any = create_model(
    "OfVessel", __base__=Strict, **offered(InputSettings, "acquisition"), **offered(AnatomySettings)
)
"""Settings of input and anatomy that can be changed on the page."""


Samples: Any = offered(Ranges)["samples"][0]
"""Number of samples of an uncertainty study."""


class FlowChoice(OfFlow):
    """How the blood flow is computed."""

    is_wanted: bool = True
    """Whether a flow is computed."""
    is_pulsatile: bool = False
    """Whether the inflow is pulsatile."""

    def settings(self, former: FlowSettings) -> FlowSettings | None:
        """Return the flow settings of the study; settings that the page cannot change are taken from `former`."""
        if not self.is_wanted:
            return None
        waveform = pulse_of(former) if self.is_pulsatile else None
        return replace(changed(former, self), waveform=waveform, numerics=changed(former.numerics, self))


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


class Choices(OfVessel):
    """All choices of the user; missing values are proposed."""

    treatments: tuple[Treatment, ...] = Field(default=Settings.treatments, max_length=3)
    """Treatments to compare, each under a name of its own; one of a single device has the name of the device."""
    flow: FlowChoice = FlowChoice()
    """Settings of the flow."""
    straightening: Annotated[str, AfterValidator(read_straightening)] = Settings.straightening
    """How much the artery yields to its devices."""
    ranking_flows: Annotated[int, Field(ge=1, le=24)] | None = None
    """Number of best sizes of a ranking that get a flow; None: none."""
    uncertainty_samples: Samples | None = None
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
        for treatment in treatments:
            if not treatment.implants:
                raise ValueError("a treatment needs an implant")
            for implant in treatment.implants:
                check_all(implant)
        return treatments

    @property
    def ranked(self) -> list[str]:
        """Keys of the chosen devices whose sizes are ranked: all but baskets and coils."""
        chosen = sorted({device for treatment in self.treatments for device in treatment.devices})
        return [device for device in chosen if not isinstance(find_design(device), Basket | Coil)]

    def settings(self, former: Settings) -> Settings:
        """Return the settings of the study; settings that the page cannot change are taken from `former`."""
        samples = self.uncertainty_samples
        return replace(
            former,
            input=changed(former.input, self),
            anatomy=changed(former.anatomy, self),
            treatments=self.treatments,
            straightening=self.straightening,
            flow=self.flow.settings(former.flow or FlowSettings()),
            uncertainty=None if samples is None else replace(former.uncertainty or Ranges(), samples=samples),
        )

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return the settings of a study that can be changed on the page.

        Raises ValidationError or InputError: the page does not support a setting.
        """
        flow, varied = settings.flow, settings.uncertainty
        chosen = told(cls, settings.input, settings.anatomy)
        chosen |= {"treatments": settings.treatments, "straightening": settings.straightening}
        chosen |= {"flow": {"is_wanted": False}}
        if flow is not None:
            chosen["flow"] = told(FlowChoice, flow, flow.numerics) | {"is_pulsatile": flow.waveform is not None}
        return cls.model_validate(chosen | {"uncertainty_samples": None if varied is None else varied.samples})


def pulse_of(former: FlowSettings) -> Waveform:
    """Return the waveform that can be chosen: that of the study the case was opened from, or the published one."""
    measured = former.profile if isinstance(former.profile, MeasuredProfile) else None
    return former.waveform or (measured and measured.waveform) or OLDER_ADULT_ICA
