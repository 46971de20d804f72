"""Geometry of a C-arm: direction, distances and detector of a projection."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import InputError
from vstent.kernels.arrays import Floats, freeze

SOURCE_DETECTOR_MM: Final = 1100.0
"""Default distance from the X-ray source to the detector, mm; within the range of angiography units, 900 to 1200."""
SOURCE_ISOCENTER_MM: Final = 750.0
"""Default distance from the X-ray source to the isocenter, mm; units have 720 to 810."""
PIXEL_MM: Final = 0.154
"""Default edge of a detector pixel, mm: the usual flat panel (Cowen et al. 2008, Clin. Radiol. 63:1073; not verified
against the original)."""
MAX_PIXELS: Final = 2048
"""Largest number of rows or columns of a detector."""
MARGIN: Final = 1.12
"""Width of the detector relative to the shadow of what it shows."""
_PRIMARY_DEG: Final = {"LAO": 1.0, "RAO": -1.0}
_SECONDARY_DEG: Final = {"CRA": 1.0, "CAU": -1.0}
_NAMED: Final = {"AP": (0.0, 0.0), "PA": (0.0, 0.0), "FRONTAL": (0.0, 0.0), "LATERAL": (np.pi / 2, 0.0)}
"""Directions with a name: primary and secondary angle in radians."""


@dataclass(frozen=True, eq=False)
class View:
    """A C-arm in position; angles as in DICOM (PS3.3 C.8.7.5), coordinates in LPS.

    At zero angles the detector is in front of the patient. The picture is seen from the detector: the head is up, and
    the patient's left is on the right of the picture.
    """

    primary_rad: float
    """Rotation about the axis from feet to head: positive LAO (detector to the patient's left), negative RAO."""
    secondary_rad: float
    """Tilt toward the head: positive CRA, negative CAU."""
    isocenter_mm: Floats
    """(3,) point about which the arm rotates; it is seen in the middle of the picture."""
    rows: int
    """Number of detector rows."""
    columns: int
    """Number of detector columns."""
    pixel_mm: float = PIXEL_MM
    """Edge of a detector pixel."""
    source_detector_mm: float = SOURCE_DETECTOR_MM
    """Distance from source to detector."""
    source_isocenter_mm: float = SOURCE_ISOCENTER_MM
    """Distance from source to isocenter."""

    def __post_init__(self) -> None:
        freeze(self, "isocenter_mm", np.float64, (3,))
        _check_angles(self.primary_rad, self.secondary_rad)
        check_range("source-detector distance", self.source_detector_mm, 300.0, 3000.0, "mm")
        check_range("source-isocenter distance", self.source_isocenter_mm, 100.0, self.source_detector_mm, "mm")
        check_range("detector pixel", self.pixel_mm, 0.02, 5.0, "mm")
        for name, count in (("rows", self.rows), ("columns", self.columns)):
            check_range(f"number of detector {name}", count, 8, MAX_PIXELS, "")

    @property
    def name(self) -> str:
        """Direction in words: ``LAO 30 CRA 10``, degrees rounded to integers."""
        primary, secondary = (round(float(np.degrees(angle))) for angle in (self.primary_rad, self.secondary_rad))
        return f"{'RAO' if primary < 0 else 'LAO'} {abs(primary)} {'CAU' if secondary < 0 else 'CRA'} {abs(secondary)}"

    @cached_property
    def axes(self) -> Floats:
        """(3, 3) unit rows in LPS: right in the picture, up in the picture, toward the detector."""
        return axes_of(self.primary_rad, self.secondary_rad)

    @property
    def magnification(self) -> float:
        """Magnification at the isocenter."""
        return self.source_detector_mm / self.source_isocenter_mm

    def pixels_of(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Return row and column (n, 2) and magnification (n,) of points (n, 3)."""
        seen = (points_mm - self.isocenter_mm) @ self.axes.T
        depth_mm = self.source_isocenter_mm + seen[:, 2]
        if len(depth_mm) and depth_mm.min() < 0.05 * self.source_isocenter_mm:
            raise InputError(
                f"The X-ray source at {self.source_isocenter_mm:g} mm from the isocenter lies within the vessel. "
                "Give a larger source-isocenter distance."
            )
        magnification = self.source_detector_mm / depth_mm
        across = seen[:, :2] * (magnification / self.pixel_mm)[:, None]
        return np.stack([0.5 * (self.rows - 1) - across[:, 1], 0.5 * (self.columns - 1) + across[:, 0]], axis=1), (
            magnification
        )


def axes_of(primary_rad: float, secondary_rad: float) -> Floats:
    """Return unit rows (3, 3) in LPS of a C-arm direction: right and up in the picture, toward the detector."""
    (sin_p, cos_p), (sin_s, cos_s) = ((np.sin(angle), np.cos(angle)) for angle in (primary_rad, secondary_rad))
    toward = np.array([sin_p * cos_s, -cos_p * cos_s, sin_s])
    right = np.array([cos_p, sin_p, 0.0])
    return np.stack([right, np.cross(toward, right), toward])


def angles_of(text: str) -> tuple[float, float]:
    """Return primary and secondary angle in radians of a direction such as ``LAO 30 CRA 10``, ``AP`` or ``lateral``."""
    words = text.upper().split()
    if len(words) == 1 and words[0] in _NAMED:
        return _NAMED[words[0]]
    given = re.findall(r"(LAO|RAO|CRA|CAU)\s*(\d+(?:\.\d+)?)", " ".join(words))
    rest = re.sub(r"(LAO|RAO|CRA|CAU)\s*\d+(?:\.\d+)?|[,/°]", "", " ".join(words)).strip()
    primary = [_PRIMARY_DEG[side] * float(angle) for side, angle in given if side in _PRIMARY_DEG]
    secondary = [_SECONDARY_DEG[side] * float(angle) for side, angle in given if side in _SECONDARY_DEG]
    if not given or rest or len(primary) > 1 or len(secondary) > 1:
        raise InputError(
            f'{text!r} is not a C-arm direction. Give one such as "LAO 30 CRA 10", "RAO 45", "AP" or "lateral".'
        )
    angles = float(np.radians(sum(primary))), float(np.radians(sum(secondary)))
    _check_angles(*angles)
    return angles


def fitted(
    points_mm: NDArray[np.floating[Any]],
    angles_rad: tuple[float, float],
    pixel_mm: float = PIXEL_MM,
    source_detector_mm: float = SOURCE_DETECTOR_MM,
    source_isocenter_mm: float = SOURCE_ISOCENTER_MM,
) -> View:
    """Return a view whose isocenter is the middle of points (n, 3) and whose detector shows them all."""
    middle_mm = 0.5 * (points_mm.min(axis=0) + points_mm.max(axis=0))
    distances_mm = pixel_mm, source_detector_mm, source_isocenter_mm
    aim = View(*angles_rad, middle_mm, 8, 8, *distances_mm)
    pixels = aim.pixels_of(np.asarray(points_mm, dtype=np.float64))[0] - 3.5
    rows, columns = (16 * int(np.ceil(MARGIN * 2 * half / 16)) for half in np.abs(pixels).max(axis=0))
    if max(rows, columns) > MAX_PIXELS:
        raise InputError(
            f"The vessel covers {max(rows, columns)} detector pixels of {pixel_mm:g} mm, more than {MAX_PIXELS}. "
            "Give a larger detector pixel."
        )
    return View(*angles_rad, middle_mm, max(rows, 16), max(columns, 16), *distances_mm)


def _check_angles(primary_rad: float, secondary_rad: float) -> None:
    """Raise InputError where an angle is outside the range that DICOM defines."""
    check_range("LAO or RAO angle", abs(float(np.degrees(primary_rad))), 0.0, 180.0, "degrees")
    check_range("CRA or CAU angle", abs(float(np.degrees(secondary_rad))), 0.0, 90.0, "degrees")


def check_range(name: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise InputError where a value is not a number from `low` to `high`."""
    if not low <= value <= high + 1e-9:
        of = f" {unit}" if unit else ""
        raise InputError(f"The {name} is {value:g}{of}. Give {low:g} to {high:g}{of}.")
