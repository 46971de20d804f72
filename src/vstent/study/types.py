"""Settings and result of a study."""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from vstent.devices.stent import Deployment
from vstent.flow.case import FlowField, FlowSettings
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.plan.uncertainty import Ranges
from vstent.study.store import Key

Point = tuple[float, float, float]
"""Three lengths in mm: a point or voxel edges."""


@dataclass(frozen=True)
class Placing:
    """Size and position of one device; missing values are proposed."""

    diameter_mm: float | None = None
    """Label diameter in mm."""
    length_mm: float | None = None
    """Label length in mm."""
    center_mm: float | None = None
    """Position of the device's middle along the parent axis, in mm."""


@dataclass(frozen=True, eq=False)
class Settings:
    """All settings of a study; None means that the value is proposed."""

    devices: tuple[str, ...] = ("silk", "enterprise")
    """Names of the devices in the catalogue."""
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
    diameter_mm: float | None = None
    """Label diameter of all devices, in mm."""
    length_mm: float | None = None
    """Label length of all devices, in mm."""
    center_mm: float | None = None
    """Position of the middle of all devices along the parent axis, in mm."""
    flow: FlowSettings | None = field(default_factory=FlowSettings)
    """Flow settings; None: no flow is computed."""
    without_flow: tuple[str, ...] = ()
    """Devices whose flow is not computed."""
    placings: dict[str, Placing] = field(default_factory=dict)
    """Size and position by device; they replace the settings above that apply to all devices."""

    uncertainty: Ranges | None = None
    """Ranges of the uncertainty study; None: no uncertainty study."""

    def placing(self, device: str) -> Placing:
        """Return size and position given for a device."""
        return self.placings.get(device) or Placing(self.diameter_mm, self.length_mm, self.center_mm)


class Progress(Protocol):
    """Called at every stage of a study."""

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """Report that `stage` is complete to `fraction` (1: done); `detail` is its result, or the remaining time."""


@dataclass(frozen=True, eq=False)
class CaseResult:
    """Result of a study."""

    name: str
    """Name of the case folder (the name of a scan may be the patient's)."""
    anatomy: Anatomy
    """Vessel, parent artery and sacs."""
    deployments: dict[str, Deployment]
    """Deployments by device name."""
    fields: dict[str, FlowField]
    """Flows by name: ``bare``, then devices; empty where no flow was requested."""
    metrics: dict[str, Any]
    """Metrics: ``vessel``, ``bare``, ``stents.NAME.{deployment,flow,ratios}``; the end of each key is its unit."""
    provenance: dict[str, Any]
    """Versions, input with hash, settings, seconds per stage."""
    failures: dict[str, str]
    """Reason why a device was not deployed or its flow not computed, by device name."""
    notes: tuple[str, ...]
    """Findings, assumptions and repairs, and the reliability of every flow, one sentence each."""
    whole: Vessel | None = None
    """The vessel before it was trimmed; None where it is not stored."""
    keys: dict[str, Key] = field(default_factory=dict)
    """Keys of the stages by name."""
