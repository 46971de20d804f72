"""Angiographic films: absorption by iodine along the rays of a view, frame by frame, and its grey levels."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.angiography.projection import Projector, projector_of
from vstent.angiography.view import View, check_range
from vstent.devices.stent import Stent
from vstent.errors import InputError
from vstent.flow.media import cut
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, freeze

ENERGY_KEV: Final = 50.0
"""Default photon energy: about the mean of a filtered spectrum of 80 kV."""
IODINE_CM2_G: Final = np.array(
    [(33.17, 35.82), (40.0, 22.10), (50.0, 12.32), (60.0, 7.579), (80.0, 3.510), (100.0, 1.942), (150.0, 0.6978)]
)
"""Photon energy in keV and mass attenuation coefficient of iodine in cm2/g, from the K edge upwards (Hubbell & Seltzer
2004, NISTIR 5632, table 3, element 53)."""
CM2_G_PER: Final = 1e-4
"""Grams per cm2 in one mg/mL mm."""
WIRE_PER_MM: Final = 14.9
"""Attenuation of platinum at 50 keV, 1/mm (Hubbell & Seltzer 2004: 6.954 cm2/g; 21.45 g/cm3). All wires are shown with
it: the alloys of a device are not in the catalogue, and nitinol or cobalt chromium absorb about a tenth of it."""
WIRE_STEP_MM: Final = 0.02
"""Distance between the points that represent a wire."""
FAINT: Final = 0.06
"""Absorption of the faint vessel relative to the film's window, where the vessel is thickest."""
PAPER: Final = 0.82
"""Grey level without absorption, 0 (black) to 1 (white)."""
FRAME_RATES_HZ: Final = (0.5, 60.0)
"""Smallest and largest frame rate."""


@dataclass(frozen=True, eq=False)
class Film:
    """A subtracted film: what the contrast agent absorbs at every time."""

    view: View
    """The C-arm."""
    time_s: Floats
    """(f,) time of every frame."""
    absorption: NDArray[np.float32]
    """(f, rows, columns) -ln(I / I0) by the contrast agent."""

    def __post_init__(self) -> None:
        freeze(self, "time_s", np.float64, (-1,))
        # The frames may take hundreds of MB; they are frozen where they are.
        if self.absorption.shape != (len(self.time_s), self.view.rows, self.view.columns):
            raise ValueError(f"absorption has the shape {self.absorption.shape}")
        self.absorption.flags.writeable = False

    @property
    def frame_rate_Hz(self) -> float:
        """Frames per second."""
        return (len(self.time_s) - 1) / float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) > 1 else 1.0

    def at(self, time_s: float) -> int:
        """Return the number of the frame nearest to a time."""
        return int(np.argmin(np.abs(self.time_s - time_s)))


def iodine_cm2_g(energy_keV: float) -> float:
    """Return the mass attenuation coefficient of iodine, linear between logarithms of the table."""
    energies, values = IODINE_CM2_G.T
    if not energies[0] <= energy_keV <= energies[-1]:
        raise InputError(
            f"A photon energy of {energy_keV:g} keV is outside the table of iodine. "
            f"Give {energies[0]:g} to {energies[-1]:g} keV."
        )
    return float(np.exp(np.interp(np.log(energy_keV), np.log(energies), np.log(values))))


def film_of(
    frames: Iterable[tuple[float, NDArray[Any]]],
    projector: Projector,
    *,
    frame_rate_Hz: float,
    energy_keV: float = ENERGY_KEV,
) -> Film:
    """Return the film of the cells of a projector, from times in s and their concentration of iodine (n,) in mg/mL.

    Frames between two given times are interpolated linearly.
    """
    check_range("frame rate", frame_rate_Hz, *FRAME_RATES_HZ, "per second")
    per_mg_mL_mm = iodine_cm2_g(energy_keV) * CM2_G_PER
    shadows = ((time_s, projector(values) * np.float32(per_mg_mL_mm)) for time_s, values in frames)
    found = list(_resampled(shadows, 1.0 / frame_rate_Hz))
    return Film(projector.view, np.array([time_s for time_s, _ in found]), np.stack([one for _, one in found]))


def _resampled(
    frames: Iterator[tuple[float, NDArray[np.float32]]], step_s: float
) -> Iterator[tuple[float, NDArray[np.float32]]]:
    """Yield frames at multiples of a step after the first time, linear between the frames given."""
    before = next(frames, None)
    if before is None:
        return
    start_s, n = before[0], 0
    for after in frames:
        while start_s + n * step_s <= after[0] + 1e-9:
            share = (start_s + n * step_s - before[0]) / max(after[0] - before[0], 1e-12)
            yield start_s + n * step_s, before[1] + np.float32(share) * (after[1] - before[1])
            n += 1
        before = after
    if n == 0:
        yield before


def wire_shadow(view: View, stent: Stent) -> NDArray[np.float32]:
    """Return the absorption (rows, columns) by the wires of a deployed device."""
    first_mm, last_mm, half_mm = stent.pieces_mm
    vectors = last_mm - first_mm
    lengths = curves.lengths(vectors)
    count, piece, part = cut(lengths, WIRE_STEP_MM)
    points_mm = first_mm[piece] + part[:, None] * vectors[piece]
    volume_mm3 = np.pi / 4 * (2 * half_mm[piece]) ** 2 * lengths[piece] / count[piece]
    projector = projector_of(view, points_mm, np.cbrt(volume_mm3))
    return projector(np.full(len(piece), WIRE_PER_MM))


def levels_of(
    film: Film, window: float, *, wires: Sequence[NDArray[np.float32]] = (), vessel: NDArray[np.float32] | None = None
) -> Iterator[NDArray[np.float32]]:
    """Yield the grey levels (rows, columns) of every frame, 0 (black) to 1 (white).

    As on a subtracted film, the level falls linearly with the logarithm of the intensity. The absorption `window` is
    shown black. The absorption by every device's wires, and faintly the path length within the lumen, are added where
    they are given.
    """
    still = np.zeros(film.absorption.shape[1:], np.float32)
    for shadow in wires:
        still += shadow
    if vessel is not None:
        still += np.float32(FAINT * window / max(float(vessel.max()), 1e-9)) * vessel
    for frame in film.absorption:
        yield np.clip(PAPER * (1.0 - (frame + still) / np.float32(window)), 0.0, 1.0).astype(np.float32)


def window_of(films: Sequence[Film]) -> float:
    """Return the absorption that is shown black: the largest of all films, so that they can be compared."""
    return max([1e-3, *(float(film.absorption.max(initial=0.0)) for film in films)])
