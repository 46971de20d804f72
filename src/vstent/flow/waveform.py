"""Inflow waveforms: the published one of the internal carotid artery, or a measured one.

Numpy is imported on use, so that the settings of a study can be read without it.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vstent.errors import InputError

if TYPE_CHECKING:
    from vstent.kernels.arrays import Complex, Floats

PUBLISHED: Final = "ica_older_adults"
"""Name of the waveform that is taken where none is named."""
LONGEST_CYCLE_S: Final = 3.0
"""Longest cardiac cycle accepted, in s: 20 beats a minute."""
SHORTEST_CYCLE_S: Final = 0.2
"""Shortest cardiac cycle accepted, in s: 300 beats a minute."""


@dataclass(frozen=True)
class Waveform:
    """A periodic flow rate as a Fourier series, in multiples of its mean.

    q(t) / mean = 1 + sum over k of a_k cos(k w t) + b_k sin(k w t), with w = 2 pi / period.
    """

    period_s: float
    """Length of a cycle."""
    cosine: tuple[float, ...]
    """a_k for k = 1, 2, ..."""
    sine: tuple[float, ...]
    """b_k for k = 1, 2, ..."""

    def factor(self, time_s: "Floats") -> "Floats":
        """Return the flow rate divided by its mean (t,) at times (t,)."""
        import numpy as np

        angle = 2 * np.pi / self.period_s * np.multiply.outer(time_s, np.arange(1, len(self.cosine) + 1))
        return 1 + np.cos(angle) @ np.array(self.cosine) + np.sin(angle) @ np.array(self.sine)

    @property
    def harmonics(self) -> "tuple[Floats, Complex]":
        """Angular frequencies (h,), 1/s, and complex amplitudes (h,) of all harmonics: the sum of Re(A exp(i w t))."""
        import numpy as np

        rate_per_s = 2 * np.pi / self.period_s * np.arange(1, len(self.cosine) + 1)
        return np.asarray(rate_per_s, dtype=np.float64), np.array(self.cosine) - 1j * np.array(self.sine)

    def curvature_per_s2(self, time_s: "Floats") -> "Floats":
        """Return the second time derivative (t,) of `factor` at times (t,)."""
        import numpy as np

        rate_per_s = 2 * np.pi / self.period_s * np.arange(1, len(self.cosine) + 1)
        harmonics = replace(self, cosine=tuple(rate_per_s**2 * self.cosine), sine=tuple(rate_per_s**2 * self.sine))
        return 1 - harmonics.factor(time_s)


def _numbers(text: str) -> tuple[float, ...]:
    """Return the numbers in a text."""
    return tuple(map(float, text.split()))


OLDER_ADULT_ICA = Waveform(
    period_s=0.951,
    cosine=_numbers(
        "0.04806 -0.18538 -0.19723 -0.04749 -0.14767 -0.06541 -0.00401 0.00251 0.02782 0.01079 -0.00106 -0.00165 "
        "-0.0071 -0.00319 -0.00202 -0.00101 0.00131 0.00064 0.00099 -0.00014"
    ),
    sine=_numbers(
        "0.57555 0.25049 0.0427 0.03531 0.02599 -0.07995 -0.04022 -0.03336 -0.01215 0.01444 0.00647 0.00751 "
        "0.00287 -0.00182 -0.00064 -0.0025 -0.00101 -5e-05 0.0004 0.00123"
    ),
)
"""Waveform of the internal carotid artery of older adults, 20 harmonics (Hoi et al. 2010, Physiol. Meas. 31, 291)."""
WAVEFORMS: Final = {PUBLISHED: OLDER_ADULT_ICA}
"""Published waveforms by name."""
SOURCES: Final = {PUBLISHED: "internal carotid artery, Hoi et al. 2010"}
"""Artery and reference of every published waveform."""
HARMONICS = 20
"""Number of harmonics kept of a measured waveform."""
RESAMPLED = 512
"""Number of equally spaced times at which the spline of a measured waveform is sampled."""


def read_waveform(source: str) -> Waveform:
    """Return the published waveform of a name, or the one in a CSV file, whose flow may be negative at times."""
    from vstent.io.tables import read_columns

    if source in WAVEFORMS:
        return WAVEFORMS[source]
    if not Path(source).exists():
        raise InputError(f"the waveform {source!r} is not {' or '.join(WAVEFORMS)}, and no such file exists")
    time_s, flow = read_columns(Path(source), 2).T
    waveform = waveform_of(time_s, flow)
    if not SHORTEST_CYCLE_S <= waveform.period_s <= LONGEST_CYCLE_S:
        raise InputError(
            f"the cycle in {source} lasts {waveform.period_s:g} s, a cardiac cycle {SHORTEST_CYCLE_S:g} to "
            f"{LONGEST_CYCLE_S:g} s: give one cycle with times in seconds"
        )
    return waveform


def waveform_of(time_s: "Floats", flow: "Floats") -> Waveform:
    """Fit a waveform to times and flow rates (n,) of a measured cycle."""
    import numpy as np
    from scipy.interpolate import CubicSpline

    time_s, flow = np.asarray(time_s, dtype=np.float64), np.array(flow, dtype=np.float64)
    if len(time_s) < 5 or len(time_s) != len(flow):
        raise InputError(
            f"the waveform has {len(time_s)} times and {len(flow)} flow rates: give at least 5 times, each with a flow "
            "rate"
        )
    if not (np.isfinite(time_s).all() and np.isfinite(flow).all() and (np.diff(time_s) > 0).all()):
        raise InputError(
            "the waveform's times do not increase, or a number is missing: correct the table of times and flow rates"
        )
    flow[-1] = flow[0]
    period_s = float(time_s[-1] - time_s[0])
    times = time_s[0] + period_s * np.arange(RESAMPLED) / RESAMPLED
    spectrum = np.fft.rfft(CubicSpline(time_s, flow, bc_type="periodic")(times)) / RESAMPLED
    mean = float(spectrum[0].real)
    if mean <= 0:
        raise InputError(f"the waveform's mean flow rate is {mean:.3g}, but inflow must be positive: reverse its sign")
    kept = 2 * spectrum[1 : 1 + HARMONICS] / mean
    return Waveform(period_s, tuple(map(float, kept.real)), tuple(map(float, -kept.imag)))
