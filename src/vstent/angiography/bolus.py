"""The injection: concentration of iodine in the blood that enters the vessel, over time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import exp, gamma
from typing import Final, Literal

import numpy as np

from vstent.errors import InputError

GAMMA_EXPONENT: Final = 3.0
"""Exponent of the gamma-variate curve (Thompson et al. 1964, Circ. Res. 14, 502, fit 1.5 to 5 to dilution curves)."""
RAMP_S: Final = 0.05
"""Time in which a constant injection rises and falls, in s."""
SMALLEST_ML_S: Final = 1e-6
"""Smallest flow rate with which the agent mixes; an inlet without inflow holds the pure agent."""
WAITING_STEP_S: Final = 0.002
"""Time step for agent that waits at the inlet."""
LONGEST_S: Final = 60.0
"""Time after which agent that still waits is left out."""


OverTime = Callable[[float], float]
"""A rate in mL/s or a concentration in mg/mL as a function of time in s."""


@dataclass(frozen=True)
class Bolus:
    """An injection of contrast agent into the parent artery, mixed with the blood of the inlet.

    The blood that enters carries iodine_mg_mL times rate / flow rate of the inlets at that moment, at most
    iodine_mg_mL. Agent that the flow of the moment cannot carry waits at the inlet and enters next. The flow itself
    does not change.
    """

    iodine_mg_mL: float = 300.0
    """Iodine in the agent."""
    amount_mL: float = 3.0
    """Volume injected."""
    rate_mL_s: float = 3.0
    """Mean injection rate; the injection lasts amount / rate."""
    start_s: float = 0.0
    """Start of the injection; in a pulsatile flow, time since the start of the waveform."""
    shape: Literal["constant", "gamma"] = "constant"
    """A constant rate, or a gamma-variate curve that peaks after amount / rate."""
    curve: tuple[tuple[float, float], ...] = ()
    """Times in s and iodine concentrations at the inlet in mg/mL, linear in between; they replace the values above."""

    def __post_init__(self) -> None:
        """Raise InputError where a value cannot be used."""
        if self.curve:
            times, values = np.array(self.curve, dtype=np.float64).T
            if not np.isfinite(self.curve).all() or (np.diff(times) <= 0).any() or times[0] < 0:
                raise InputError("the times of the injection curve do not increase from 0 s or later: sort the rows")
            if values.min() < 0 or values.max() <= 0:
                raise InputError(
                    "the injection curve has no or negative concentrations: give mg/mL of iodine, 0 or more"
                )
            return
        for name, value in (
            ("iodine concentration", self.iodine_mg_mL),
            ("injected amount", self.amount_mL),
            ("injection rate", self.rate_mL_s),
        ):
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"the {name} is {value:g}: give a positive number")
        if not (np.isfinite(self.start_s) and self.start_s >= 0):
            raise InputError(f"the injection starts at {self.start_s:g} s: give 0 s or later")

    @property
    def duration_s(self) -> float:
        """Time from the start to the end of the injection (gamma-variate: to its peak)."""
        return self.curve[-1][0] - self.curve[0][0] if self.curve else self.amount_mL / self.rate_mL_s

    @property
    def begin_s(self) -> float:
        """Time at which contrast starts to enter."""
        return self.curve[0][0] if self.curve else self.start_s

    def inflow(
        self, flow_mL_s: Sequence[float], time_s: Sequence[float] = (0.0,), period_s: float | None = None
    ) -> tuple[OverTime, float]:
        """Return the iodine concentration of the entering blood in mg/mL as a function of time in s, and its maximum.

        The flow rates through the inlets (p,) at times (p,) of a cycle are linear in between; a steady flow has one.
        """
        if self.curve:
            times, values = np.array(self.curve, dtype=np.float64).T
            return (lambda time_s: float(np.interp(time_s, times, values, left=0.0, right=0.0))), float(values.max())
        rate, top_mL_s = self._gamma() if self.shape == "gamma" else self._constant()

        def through(now_s: float) -> float:
            return max(float(np.interp(now_s, time_s, flow_mL_s, period=period_s)), SMALLEST_ML_S)

        least_mL_s = max(min(flow_mL_s), SMALLEST_ML_S)
        enters = self._waiting(rate, through) if top_mL_s > least_mL_s else rate
        most = self.iodine_mg_mL * min(top_mL_s / least_mL_s, 1.0)
        return lambda now_s: min(self.iodine_mg_mL * enters(now_s) / through(now_s), most), most

    def _waiting(self, rate: OverTime, through: OverTime) -> OverTime:
        """Return the rate in mL/s at which agent enters if what the flow cannot carry at once enters next."""
        times, entering, waiting_mL, now_s = [self.start_s], [0.0], 0.0, self.start_s + 0.5 * WAITING_STEP_S
        while now_s <= self.start_s + LONGEST_S and (waiting_mL > 0 or rate(now_s) > 0):
            waiting_mL += rate(now_s) * WAITING_STEP_S
            enters_mL = min(through(now_s) * WAITING_STEP_S, waiting_mL)
            waiting_mL -= enters_mL
            times.append(now_s)
            entering.append(enters_mL / WAITING_STEP_S)
            now_s += WAITING_STEP_S
        return lambda now_s: float(np.interp(now_s, times, entering, left=0.0, right=0.0))

    def _constant(self) -> tuple[OverTime, float]:
        """Return the rate in mL/s of a trapezoid whose integral is that of the constant rate, and its maximum."""
        end_s = self.start_s + self.duration_s
        ramp_s = min(RAMP_S, 0.5 * self.duration_s)
        times = [self.start_s, self.start_s + ramp_s, end_s, end_s + ramp_s]

        def at(now_s: float) -> float:
            return self.rate_mL_s * float(np.interp(now_s, times, [0.0, 1.0, 1.0, 0.0]))

        return at, self.rate_mL_s

    def _gamma(self) -> tuple[OverTime, float]:
        """Return the rate in mL/s of a gamma-variate curve with the integral of the constant rate, and its maximum."""
        a, peak_s = GAMMA_EXPONENT, self.duration_s
        top_mL_s = self.rate_mL_s * a ** (a + 1) / (exp(a) * gamma(a + 1))

        def at(now_s: float) -> float:
            x = max(now_s - self.start_s, 0.0) / peak_s
            return float(top_mL_s * x**a * exp(a * (1 - x)))

        return at, top_mL_s
