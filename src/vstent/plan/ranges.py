"""Ranges of an uncertainty study, as the user gives them.

This module imports no numpy, so that command-line options and settings of a study can be read without it.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from vstent.fields import Limits, check_all, setting, whole

if TYPE_CHECKING:
    from vstent.devices.design import Design, Range
    from vstent.geometry.vessel import Anatomy
    from vstent.kernels.arrays import Floats

TO_EITHER_SIDE: Final = Limits("mm", 0.0)
"""Limits of a range, which goes to either side."""
STIFFNESS: Final = "stiffness_to_wall"
"""Name of the stiffness of the device relative to wall and bed, which varies where the artery yields."""


@dataclass(frozen=True)
class Ranges:
    """Range of each cause to either side, and number of samples. The default ranges are vstent's own."""

    samples: int = setting(
        32, "uncertainty", "deploy N times with uncertain inputs varied", whole, Limits(low=2, high=4096), "off"
    )
    """Number of deployments, rounded up to a power of two."""
    flow_samples: int = setting(
        0, "uncertainty-flows", "also compute the flows of N of these deployments", whole, Limits(low=0)
    )
    """Number of deployments whose flow is computed without and with the device; each takes as long as a study."""
    threshold_mm: float | None = setting(
        None, "vary-threshold", "range of all diameters, to either side", limits=TO_EITHER_SIDE, usual="the scan's own"
    )
    """Range of all diameters, in mm; None uses `threshold_band_mm` of the vessel, 0 for a surface."""
    landing_mm: float = setting(
        1.0, "vary-landing", "range of the landing point, to either side", limits=TO_EITHER_SIDE
    )
    device_mm: float = setting(0.1, "vary-device", "range of the free diameter, to either side", limits=TO_EITHER_SIDE)
    """Range of the free diameter as made, in mm; the number of pieces of wire stays the same."""
    inflow_fraction: float = setting(
        0.2, "vary-inflow", "range of the mean inflow, relative", limits=Limits(low=0.0, high=0.99), metavar="FRACTION"
    )
    numbers_factor: float = setting(
        1.0,
        "vary-numbers",
        "factor of the ranges of the device's numbers",
        limits=Limits(low=0.0, high=1.0),
        metavar="FACTOR",
    )
    """Factor of the ranges of the device's numbers in the catalogue; 0 leaves them out."""

    def __post_init__(self) -> None:
        check_all(self)

    def of(self, anatomy: "Anatomy") -> "Floats":
        """Return the ranges (4,) of threshold, landing, device and inflow."""
        import numpy as np

        band_mm = anatomy.vessel.threshold_band_mm if self.threshold_mm is None else self.threshold_mm
        return np.array([band_mm, self.landing_mm, self.device_mm, self.inflow_fraction])

    def numbers_of(self, design: "Design") -> "tuple[Range, ...]":
        """Return the ranges of the numbers of a device that are varied."""
        from vstent.devices.ranges import uncertain

        factor = self.numbers_factor
        return tuple(
            replace(
                one, low=one.value + factor * (one.low - one.value), high=one.value + factor * (one.high - one.value)
            )
            for one in (uncertain(design) if factor else ())
        )
