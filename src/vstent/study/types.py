"""Settings and result of a study."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from vstent.devices.stent import Deployment
from vstent.devices.treatment import Treatment, with_device
from vstent.errors import InputError
from vstent.flow.case import FlowField
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.plan.uncertainty import Ranges
from vstent.study.store import Key

Point = tuple[float, float, float]
"""Three lengths in mm: a point or voxel edges."""


@dataclass(frozen=True)
class InputSettings:
    """How the input is read; None means that the value is found or proposed."""

    units: Literal["m", "cm", "mm"] | None = None
    """Length unit of a surface file."""
    frame: Literal["lps", "ras"] | None = None
    """Frame of a surface file and of the points given; None: as the file states, and LPS points."""
    acquisition: int | None = None
    """Acquisition of a DICOM series that holds several, counted from 1."""
    spacing_mm: Point | None = None
    """Voxel spacing of a raw volume, in mm."""
    shape: tuple[int, int, int] | None = None
    """Number of voxels of a raw volume."""
    crop_mm: tuple[Point, Point] | None = None
    """Opposite corners, LPS mm, of the box along the image axes to which a scan is cropped."""
    threshold: float | None = None
    """Intensity at the lumen wall of a scan."""


@dataclass(frozen=True)
class AnatomySettings:
    """What of the anatomy is given; None means that it is found."""

    at_mm: Point | None = None
    """Point near the sac, LPS mm."""
    inlet_mm: Point | tuple[Point, ...] | None = None
    """Point near the inlet, or near each inlet; the parent artery begins at the first."""
    outlet_mm: Point | None = None
    """Point near the outlet of the parent artery."""
    neck_mm: tuple[Point, ...] | None = None
    """Neck drawn by hand: a closed curve near the wall around the mouth of the sac."""
    upstream_mm: float | None = None
    """Length of artery to keep proximal to the middle of the sac, in mm."""
    downstream_mm: float | None = None
    """Length of vessel to keep distal to the middle of the sac, in mm."""


@dataclass(frozen=True)
class Settings:
    """All settings of a study."""

    input: InputSettings = InputSettings()
    """How the input is read."""
    anatomy: AnatomySettings = AnatomySettings()
    """What of the anatomy is given."""
    treatments: tuple[Treatment, ...] = (with_device("silk"), with_device("enterprise"))
    """Treatments to compare with the bare artery, each under a name of its own."""
    flow: FlowSettings | None = field(default_factory=FlowSettings)
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


@dataclass(frozen=True, eq=False)
class Computed:
    """What a study has computed before it is measured; enough to draw it."""

    anatomy: Anatomy
    """Vessel, sacs and paths."""
    implants: Mapping[str, Mapping[str, Deployment]]
    """Deployed implants by treatment and id."""
    fields: Mapping[str, FlowField]
    """Flows by treatment, ``bare`` first; empty where no flow was requested."""
    whole: Vessel | None
    """The vessel before it was trimmed; None where it is not stored."""


@dataclass(frozen=True, eq=False)
class CaseResult(Computed):
    """Result of a study."""

    name: str
    """Name of the case folder (the name of a scan may be the patient's)."""
    metrics: dict[str, Any]
    """Metrics: ``vessel``, ``treatments.NAME.{implants.ID,flow,change,quality}``; the end of each key is its unit."""
    provenance: dict[str, Any]
    """Versions, input with hash, settings, seconds per stage."""
    failures: dict[str, str]
    """Reason why a treatment was not deployed or its flow not computed, by treatment."""
    notes: tuple[str, ...]
    """Findings, assumptions and repairs, and the reliability of every flow, one sentence each."""
    keys: dict[str, Key]
    """Keys of the stages by name."""
