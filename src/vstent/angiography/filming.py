"""Film the stored contrast of several flows along one C-arm direction."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csc_array

from vstent.angiography.film import ENERGY_KEV, FRAME_RATES_HZ, iodine_cm2_g
from vstent.angiography.history import History
from vstent.angiography.projection import Projector, projector_of
from vstent.angiography.view import PIXEL_MM, SOURCE_DETECTOR_MM, SOURCE_ISOCENTER_MM, View, check_range, fitted

SOME: Final = 20_000
"""Number of cells that determine the size of the detector."""


@dataclass(frozen=True)
class FilmSettings:
    """How films are taken."""

    angles_rad: tuple[float, float] | None = None
    """Primary (LAO) and secondary (CRA) angle; None: the working projection."""
    frame_rate_Hz: float = 7.5
    """Frames per second."""
    pixel_mm: float = PIXEL_MM
    """Edge of a detector pixel."""
    source_detector_mm: float = SOURCE_DETECTOR_MM
    """Distance from source to detector."""
    source_isocenter_mm: float = SOURCE_ISOCENTER_MM
    """Distance from source to isocenter."""
    energy_keV: float = ENERGY_KEV
    """Photon energy."""
    has_wires: bool = False
    """Whether the wires of a device are shown; a subtracted film shows none."""
    has_vessel: bool = False
    """Whether the lumen is shown faintly."""

    def __post_init__(self) -> None:
        check_range("frame rate", self.frame_rate_Hz, *FRAME_RATES_HZ, "per second")
        iodine_cm2_g(self.energy_keV)
        View(*(self.angles_rad or (0.0, 0.0)), np.zeros(3), 16, 16, *self.distances_mm)

    @property
    def distances_mm(self) -> tuple[float, float, float]:
        """Detector pixel, source-detector and source-isocenter distance."""
        return self.pixel_mm, self.source_detector_mm, self.source_isocenter_mm


def view_for(histories: Mapping[str, History], settings: FilmSettings) -> View:
    """Return the view of films, with a detector that shows all cells; without a direction it is frontal."""
    points = np.concatenate([one.points_mm[:: max(1, len(one.points_mm) // SOME)] for one in histories.values()])
    return fitted(points, settings.angles_rad or (0.0, 0.0), *settings.distances_mm)


def projectors_of(view: View, histories: Mapping[str, History]) -> dict[str, Projector]:
    """Return the projector of every flow's stored values; flows on equal cells share one."""
    projectors: dict[str, Projector] = {}
    for name, history in histories.items():
        for other in projectors:
            same = histories[other]
            if np.array_equal(same.points_mm, history.points_mm) and np.array_equal(same.block, history.block):
                projectors[name] = projectors[other]
                break
        else:
            cells = projector_of(view, history.points_mm, np.full(len(history.points_mm), history.spacing_mm))
            # The footprints of all cells that share a stored value are added.
            m, n = len(history.block), history.stored.shape[1]
            shared = csc_array((np.ones(m, np.float32), (np.arange(m), history.block)), shape=(m, n))
            projectors[name] = Projector(view, cells.matrix @ shared)
    return projectors
