"""Velocity profile of an inlet as it was measured, for example with phase-contrast MRI.

Numpy is imported on use, so that the settings of a study can be read without it.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

from vstent.errors import InputError
from vstent.flow.waveform import HARMONICS, Waveform

if TYPE_CHECKING:
    from vstent.flow.registration import MeasuredSection

Profile = Literal["developed", "plug", "womersley"]
"""Velocity profile at the inlets."""
Vector = tuple[float, float, float]
"""A point in mm or a velocity in m/s, in LPS."""
FEWEST: Final = 8
"""Fewest points at which blood moves."""
FASTEST_M_S: Final = 5.0
"""Highest speed that is read as m/s."""
UNEVEN: Final = 0.05
"""Largest difference of the time between two moments from the mean, as a fraction."""
COLUMNS: Final = {3: "x, y, speed", 4: "t, x, y, speed", 6: "x, y, z, u, v, w", 7: "t, x, y, z, u, v, w"}
"""Columns of a table by their number."""


@dataclass(frozen=True)
class MeasuredProfile:
    """Velocities at points of a section, at one moment or at equally spaced moments of a cycle.

    `flow.registration.registered` carries them over to an inlet.
    """

    points_mm: tuple[Vector, ...]
    """Points where the blood moves."""
    velocity_m_s: tuple[tuple[Vector, ...], ...]
    """Velocity at every point, of every moment."""
    period_s: float | None = None
    """Length of the cycle; None: a single moment."""

    @cached_property
    def section(self) -> "MeasuredSection":
        """The velocities in the frame of their plane; InputError where there is none."""
        import numpy as np

        from vstent.flow.registration import section_of

        return section_of(np.array(self.points_mm), np.array(self.velocity_m_s))

    @property
    def waveform(self) -> Waveform | None:
        """Waveform of the flow through the section; None: a single moment."""
        import numpy as np

        if self.period_s is None:
            return None
        spectrum = np.fft.rfft(self.section.flow_mL_s)
        waves = 2 * spectrum[1 : min(HARMONICS, (len(self.velocity_m_s) - 1) // 2) + 1] / spectrum[0].real
        return Waveform(self.period_s, tuple(waves.real.tolist()), tuple((-waves.imag).tolist()))


def read_profile(source: str) -> Profile | MeasuredProfile:
    """Return a word for a profile as it is, or the profile in a CSV file."""
    import numpy as np

    from vstent.io.tables import read_columns

    words, path = get_args(Profile), Path(source)
    if source in words:
        return source  # type: ignore[return-value]
    if not path.exists():
        raise InputError(f"the inlet profile {source!r} is none of {', '.join(words)}, and no such file exists")
    table = read_columns(path, *COLUMNS)
    wrong = f"the inlet profile in {source}"
    if table.shape[1] < 6:  # a flat picture: its plane is that of x and y
        still = np.zeros((len(table), 1))
        table = np.hstack([table[:, :-1], still, still, still, table[:, -1:]])
    times_s, moment = np.unique(table[:, 0] if table.shape[1] == 7 else np.zeros(len(table)), return_inverse=True)
    by_moment = [table[moment == k, -6:] for k in range(len(times_s))]
    points_mm = by_moment[0][:, :3]
    for time_s, rows in zip(times_s, by_moment, strict=True):
        if rows.shape != by_moment[0].shape or not np.allclose(rows[:, :3], points_mm):
            raise InputError(
                f"{wrong} has other points at {time_s:g} s than at {times_s[0]:g} s: give the same points, in the same "
                "order, at every time"
            )
    velocity_m_s = np.stack([rows[:, 3:] for rows in by_moment])
    fastest_m_s = float(np.linalg.norm(velocity_m_s, axis=2).max())
    if fastest_m_s > FASTEST_M_S:
        raise InputError(f"{wrong} has a speed of {fastest_m_s:.3g} m/s: give m/s (27 cm/s are 0.27 m/s)")
    is_moving = np.any(velocity_m_s, axis=(0, 2))
    if is_moving.sum() < FEWEST:
        raise InputError(f"blood moves at {is_moving.sum()} points of {wrong}: give at least {FEWEST}")
    step_s = np.diff(times_s)
    if len(step_s) and (len(step_s) < 4 or np.abs(step_s / step_s.mean() - 1).max() > UNEVEN):
        raise InputError(
            f"{wrong} has {len(times_s)} times: give at least 5 of one cycle, equally spaced, and do not repeat the "
            "first at the end"
        )
    measured = MeasuredProfile(
        tuple(map(tuple, points_mm[is_moving].tolist())),
        tuple(tuple(map(tuple, rows)) for rows in velocity_m_s[:, is_moving].tolist()),
        float(len(times_s) * step_s.mean()) if len(step_s) else None,
    )
    _ = measured.section  # an impossible one is refused here
    return measured
