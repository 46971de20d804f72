"""Film the stored contrast of several flows along one C-arm direction."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.sparse import csc_array

from vstent.angiography.film import ENERGY_KEV, Film, check_frame_rate, film_of, iodine_cm2_g
from vstent.angiography.history import History
from vstent.angiography.projection import Projector, projector_of
from vstent.angiography.view import PIXEL_MM, SOURCE_DETECTOR_MM, SOURCE_ISOCENTER_MM, View, fitted
from vstent.angiography.working_projection import working_projection
from vstent.geometry.vessel import Anatomy

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
        check_frame_rate(self.frame_rate_Hz)
        iodine_cm2_g(self.energy_keV)
        View(*(self.angles_rad or (0.0, 0.0)), np.zeros(3), 16, 16, *self.distances_mm)

    @property
    def distances_mm(self) -> tuple[float, float, float]:
        """Detector pixel, source-detector and source-isocenter distance."""
        return self.pixel_mm, self.source_detector_mm, self.source_isocenter_mm


def aimed(settings: FilmSettings, anatomy: Anatomy) -> FilmSettings:
    """Return settings with a direction: the one given, or the working projection."""
    return settings if settings.angles_rad else replace(settings, angles_rad=working_projection(anatomy))


def view_for(histories: Mapping[str, History], settings: FilmSettings) -> View:
    """Return the view of films, with a detector that shows all cells; without a direction it is frontal.

    Parameters
    ----------
    histories : contrast by name of the flow.
    settings : how films are taken.

    Raises
    ------
    InputError
        The vessel needs a larger detector than there are.
    """
    points = np.concatenate([one.points_mm[:: max(1, len(one.points_mm) // SOME)] for one in histories.values()])
    return fitted(points, settings.angles_rad or (0.0, 0.0), *settings.distances_mm)


def projectors_of(view: View, histories: Mapping[str, History]) -> dict[str, Projector]:
    """Return the projector of every flow's stored values; flows on equal cells share one."""
    found: dict[str, Projector] = {}
    made: list[tuple[History, Projector]] = []
    for name, history in histories.items():
        same = [projector for one, projector in made if _has_equal_cells(one, history)]
        found[name] = same[0] if same else _projector(view, history)
        made.append((history, found[name]))
    return found


def _projector(view: View, history: History) -> Projector:
    """Return the projector of the stored values of a history: the footprints of all cells that share each."""
    cells = projector_of(view, history.points_mm, np.full(len(history.points_mm), history.spacing_mm))
    m, n = len(history.block), history.stored.shape[1]
    shared = csc_array((np.ones(m, np.float32), (np.arange(m), history.block)), shape=(m, n))
    return Projector(view, cells.matrix @ shared)


def _has_equal_cells(one: History, other: History) -> bool:
    """Return whether two histories are of the same cells in the same blocks."""
    return np.array_equal(one.points_mm, other.points_mm) and np.array_equal(one.block, other.block)


def films_of(
    histories: Mapping[str, History], projectors: Mapping[str, Projector], settings: FilmSettings
) -> dict[str, Film]:
    """Return the film of every flow by name.

    Parameters
    ----------
    histories : contrast by name of the flow.
    projectors : projectors by name of the flow.
    settings : how films are taken.
    """
    how: dict[str, Any] = {"frame_rate_Hz": settings.frame_rate_Hz, "energy_keV": settings.energy_keV}
    return {name: film_of(history.frames(), projectors[name], **how) for name, history in histories.items()}
