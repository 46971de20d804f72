"""What a study is told, and what it finds."""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from vstent.devices.stent import Deployment
from vstent.flow.case import FlowField, FlowSettings
from vstent.geometry.vessel import Anatomy
from vstent.plan.uncertainty import Ranges

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Placing:
    """Size and place of one device; None means that it is proposed."""

    diameter_mm: float | None = None
    """Label diameter."""
    length_mm: float | None = None
    """Label length."""
    center_mm: float | None = None
    """Abscissa on the parent axis where the middle of the device is to lie."""


@dataclass(frozen=True, eq=False)
class Settings:
    """Everything that a study may be told; None means that it is proposed."""

    devices: tuple[str, ...] = ("silk", "enterprise")
    """Names in the catalogue."""
    units: Literal["m", "cm", "mm"] | None = None
    """Length unit of a surface file."""
    frame: Literal["lps", "ras"] | None = None
    """Frame of a surface file and of the points given; None: as the file states, and LPS points."""
    acquisition: int | None = None
    """Acquisition of a DICOM series that holds several, counted from 1."""
    spacing_mm: Point | None = None
    """Voxel edges of a raw volume."""
    shape: tuple[int, int, int] | None = None
    """Voxel counts of a raw volume."""
    threshold: float | None = None
    """Intensity of the lumen's wall in a scan."""
    at_mm: Point | None = None
    """A point near the sac."""
    inlet_mm: Point | tuple[Point, ...] | None = None
    """A point near the inlet; or one near each opening that brings blood, first that where the parent artery begins."""
    outlet_mm: Point | None = None
    """A point near the outlet that the parent artery leads to."""
    neck_mm: tuple[Point, ...] | None = None
    """A neck drawn by hand: a closed curve near the wall around the sac's mouth."""
    upstream_mm: float | None = None
    """Length of artery to keep before the sac's middle."""
    downstream_mm: float | None = None
    """Length to keep of every way beyond the sac's middle."""
    diameter_mm: float | None = None
    """Label diameter of the devices."""
    length_mm: float | None = None
    """Label length of the devices."""
    center_mm: float | None = None
    """Abscissa on the parent axis where the middle of the device is to lie."""
    flow: FlowSettings | None = field(default_factory=FlowSettings)
    """How to compute the flow; None: not at all."""
    without_flow: tuple[str, ...] = ()
    """Devices whose flow is not computed."""
    placings: dict[str, Placing] = field(default_factory=dict)
    """Sizes and places of single devices, by name, instead of those above that hold for all."""

    uncertainty: Ranges | None = None
    """What of the deployment is varied, and how far; None: nothing."""

    def placing(self, device: str) -> Placing:
        """Return what is given of the size and the place of a device."""
        return self.placings.get(device) or Placing(self.diameter_mm, self.length_mm, self.center_mm)


class Progress(Protocol):
    """Told what a study does."""

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """`stage` has come to `fraction` (1: done); `detail` says what was found, or how long is left."""


@dataclass(frozen=True, eq=False)
class CaseResult:
    """All that a study found."""

    name: str
    """The case folder's name (a scan's own name may be the patient's)."""
    anatomy: Anatomy
    """Vessel, parent artery, sacs."""
    deployments: dict[str, Deployment]
    """By device name."""
    fields: dict[str, FlowField]
    """``bare``, then by device name; empty where flow was not asked for."""
    metrics: dict[str, Any]
    """``vessel``, ``bare``, ``stents.NAME.{deployment,flow,ratios}``; every number's key ends in its unit."""
    provenance: dict[str, Any]
    """Versions, inputs with hashes, settings, seconds per stage."""
    failures: dict[str, str]
    """Sentence on every device that was not deployed, or whose flow was not computed, by device name."""
    notes: tuple[str, ...]
    """What was found, guessed or repaired, and how far every flow is to be relied on."""
