"""Data classes of a study: its settings and its result."""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from vstent.devices.stent import Deployment
from vstent.flow.case import FlowField, FlowSettings
from vstent.geometry.vessel import Anatomy
from vstent.plan.uncertainty import Ranges

Point = tuple[float, float, float]
"""LPS coordinates, mm."""


@dataclass(frozen=True)
class Placing:
    """Size and position of one device; None: proposed automatically."""

    diameter_mm: float | None = None
    """Label diameter of the device."""
    length_mm: float | None = None
    """Label length of the device."""
    center_mm: float | None = None
    """Position of the middle of the device along the parent artery."""


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings of a study; None: chosen automatically."""

    devices: tuple[str, ...] = ("silk", "enterprise")
    """Names of devices in the catalogue."""
    units: Literal["m", "cm", "mm"] | None = None
    """Length unit of a surface file."""
    spacing_mm: Point | None = None
    """Voxel size of a raw volume, or instead of that in the header of a scan."""
    shape: tuple[int, int, int] | None = None
    """Number of voxels of a raw volume along each axis."""
    threshold: float | None = None
    """Intensity of the vessel wall in a scan."""
    at_mm: Point | None = None
    """A point near the sac."""
    inlet_mm: Point | tuple[Point, ...] | None = None
    """A point near the inlet, or one near each inlet, that of the parent artery first."""
    outlet_mm: Point | None = None
    """A point near the outlet of the parent artery."""
    neck_mm: tuple[Point, ...] | None = None
    """A neck drawn by hand: points of a closed curve near the wall around the neck."""
    upstream_mm: float | None = None
    """Length of artery to keep upstream of the middle of the sac."""
    downstream_mm: float | None = None
    """Length of vessel to keep downstream of the middle of the sac, on every branch."""
    diameter_mm: float | None = None
    """Label diameter of the devices."""
    length_mm: float | None = None
    """Label length of the devices."""
    center_mm: float | None = None
    """Position of the middle of the device along the parent artery."""
    flow: FlowSettings | None = field(default_factory=FlowSettings)
    """Settings of the flow computation; None: no flow is computed."""
    placings: dict[str, Placing] = field(default_factory=dict)
    """Size and position of single devices, by name; they replace the values above, which apply to all devices."""

    uncertainty: Ranges | None = None
    """Ranges of the uncertainty study; None: no such study."""

    def placing(self, device: str) -> Placing:
        """Return the given size and position of a device."""
        return self.placings.get(device) or Placing(self.diameter_mm, self.length_mm, self.center_mm)


class Progress(Protocol):
    """Function that a study calls to report its progress."""

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """Report the progress of a stage.

        Parameters
        ----------
        stage : name of the stage.
        fraction : completed fraction: 0 at its start, 1 at its end.
        detail : a sentence on the result or on the remaining run time.
        """


@dataclass(frozen=True, eq=False)
class CaseResult:
    """Result of a study."""

    name: str
    """Name of the case folder (the name of the scan may be that of the patient)."""
    anatomy: Anatomy
    """Vessel, parent artery and sacs."""
    deployments: dict[str, Deployment]
    """Deployed devices, by name."""
    fields: dict[str, FlowField]
    """Flow fields: ``bare``, then by device name; empty where no flow is requested."""
    metrics: dict[str, Any]
    """Metrics: ``vessel``, ``bare``, ``stents.NAME.{deployment,flow,ratios}``; every key ends in the unit."""
    provenance: dict[str, Any]
    """Versions, input with hash, settings, and run time of every stage in s."""
    notes: tuple[str, ...]
    """Notes on repairs, automatic choices and the reliability of every flow."""
