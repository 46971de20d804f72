"""Boundary conditions at the openings of a vessel, and what the settings' word for the outlets means."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from vstent.errors import InputError
from vstent.flow.forks import shares_by_forks
from vstent.flow.measured import MeasuredProfile, Profile
from vstent.flow.profile import developed_profile, plug_profile, pulsating_profiles
from vstent.flow.registration import harmonics_of, registered
from vstent.flow.settings import RESISTING, Blood, FlowSettings
from vstent.flow.waveform import Waveform
from vstent.geometry.vessel import Opening, Vessel, murray_shares
from vstent.kernels.arrays import Complex, Floats
from vstent.units import PA_PER_MMHG, counted

MEAN_INLET_SPEED_M_S: Final = 0.27
"""Default mean speed in an inlet, m/s, for an internal carotid artery: that of VaMPy. Its companion VaSP has 0.31."""
ASSUMED: Final = f"assumed: mean inlet velocity {MEAN_INLET_SPEED_M_S} m/s"
"""Where an inflow comes from that is not given."""


@dataclass(frozen=True)
class Inflow:
    """A flow rate in, which follows the waveform in a pulsatile flow, with a velocity profile (see `profile`)."""

    mean_mL_s: float
    """Mean flow rate in."""
    source: str = ""
    """Where it comes from, for a user; empty: it was given."""
    profile: Profile | MeasuredProfile = "developed"
    """Velocity profile. A measured one over a cycle has the waveform of the case."""

    @property
    def is_pulsating(self) -> bool:
        """Whether the profile changes its shape over a cycle."""
        profile = self.profile
        return profile == "womersley" if isinstance(profile, str) else profile.period_s is not None

    def relative_velocity(self, section_mm: Floats, normal: Floats, points_mm: Floats) -> Floats:
        """Return the velocity over its mean (n, 3) in a section (k, 3) at points (n, 3), averaged over the cycle."""
        section = section_mm, normal, points_mm
        if isinstance(self.profile, MeasuredProfile):
            return registered(self.profile.section, *section).mean(axis=0)
        profile = plug_profile if self.profile == "plug" else developed_profile
        return np.asarray(-profile(*section)[:, None] * normal)

    def pulsating_velocity(
        self, pulse: Waveform, blood: Blood, time_s: Floats, section_mm: Floats, normal: Floats, points_mm: Floats
    ) -> tuple[Floats, Floats]:
        """Return the velocity over its mean at points (n, 3): its average (n, 3), and (t, n, 3) at times (t,)."""
        section = section_mm, normal, points_mm
        rate_per_s, amplitude = pulse.harmonics
        if isinstance(self.profile, MeasuredProfile):
            steady, waves = harmonics_of(registered(self.profile.section, *section), len(rate_per_s))
        else:
            steady = self.relative_velocity(*section)
            speed = amplitude[:, None] * pulsating_profiles(*section, rate_per_s, blood.kinematic_viscosity_m2_s)
            waves = -speed[..., None] * normal
        turned = np.exp(1j * np.outer(time_s, rate_per_s))
        return steady, steady + np.tensordot(turned, waves, 1).real


@dataclass(frozen=True)
class FlowRate:
    """A flow rate out, with any velocity profile. In a pulsatile flow it follows the waveform."""

    mean_mL_s: float
    """Mean flow rate out."""


@dataclass(frozen=True)
class Pressure:
    """A constant pressure."""

    pressure_Pa: float = 0.0
    """The pressure."""


@dataclass(frozen=True)
class Resistance:
    """A resistance downstream of an outlet, or a Windkessel: the flow rate out follows the pressure.

    The mean flow rate is (P + p) / R. Here p is the pressure at this outlet in the computed flow, and P is a pressure
    common to all outlets, with which as much leaves as enters (see `outflows`). Only p exists in the computed flow.

    In a pulsatile flow the blood passes a part of R, the compliance C and the rest of R: the three-element Windkessel.
    Without a compliance all of R acts at once.

    References
    ----------
    Westerhof, Lankhaar and Westerhof 2009, Med. Biol. Eng. Comput. 47, 131.
    """

    mean_mL_s: float
    """Mean flow rate out without a device."""
    pressure_Pa: float
    """Mean of the common pressure without a device."""
    compliance_time_s: float = 0.0
    """R C; 0: a plain resistance."""
    proximal_fraction: float = 1.0
    """Part of R before the compliance."""
    resistance_Pa_s_mL: float | None = None
    """R; None in the flow without a device, whose mean flow rate is `mean_mL_s` with the R that results."""

    def at(self, pressure_Pa: float) -> float:
        """Return R, Pa s/mL; where it is not known, that with which the flow at a mean pressure p is `mean_mL_s`."""
        return self.resistance_Pa_s_mL or (self.pressure_Pa + pressure_Pa) / self.mean_mL_s

    def relative_impedance(self, rate_per_s: Floats) -> Complex:
        """Return the complex impedance (n,) at angular frequencies (n,), divided by R."""
        distal = 1 - self.proximal_fraction
        return np.asarray(self.proximal_fraction + distal / (1 + 1j * rate_per_s * distal * self.compliance_time_s))


End: TypeAlias = Inflow | FlowRate | Pressure | Resistance
"""Boundary condition at one opening. Every engine decides by its type in one place."""


def ends_of(vessel: Vessel, settings: FlowSettings) -> tuple[End, ...]:
    """Return the boundary condition at every opening of a vessel, in their order.

    The inflow is shared among several inlets by Murray's law, or enters each with the default mean speed. Where the
    outlets have fixed shares, all but the widest get a flow rate, and the widest has zero pressure and takes the rest.
    """
    inlets, outlets = vessel.inlets, vessel.outlets
    inflow_mL_s, source = _inflow(inlets, settings)
    entering = [Inflow(mean_mL_s, source, settings.profile) for mean_mL_s in inflow_mL_s.tolist()]
    for word, given, usable in (
        ("shares of the outlets", settings.shares, ("split", *RESISTING)),
        ("resistances from a table", settings.elements, RESISTING),
    ):
        if given is not None and settings.outlets not in usable:
            choice = f"{', '.join(usable[:-1])} or {usable[-1]}"
            raise InputError(f"{word} have no effect with --outlets {settings.outlets}: choose {choice}")
    if settings.outlets == "zero_pressure":
        return (*entering, *(Pressure() for _ in outlets))
    shares = murray_shares(outlets) if settings.outlets == "murray" else _shares(vessel, settings)
    outflow_mL_s = (inflow_mL_s.sum() * shares).tolist()
    if settings.outlets in ("murray", "split"):
        return (*entering, Pressure(), *map(FlowRate, outflow_mL_s[1:]))
    if settings.elements is not None:
        return (*entering, *_tabled(outlets, settings, float(inflow_mL_s.sum())))
    pressure_Pa = PA_PER_MMHG * settings.mean_pressure_mmHg
    compliant = settings.compliance_time_s, settings.proximal_fraction
    stored = compliant if settings.outlets == "windkessel" else ()
    return (*entering, *(Resistance(mean_mL_s, pressure_Pa, *stored) for mean_mL_s in outflow_mL_s))


def _inflow(inlets: Sequence[Opening], settings: FlowSettings) -> tuple[Floats, str]:
    """Return the flow rate (i,) through every inlet, and where it comes from."""
    profile, speed_m_s = settings.profile, settings.inlet_speed_m_s
    is_given = settings.inflow_mL_s is not None or speed_m_s is not None
    by_speed_mL_s = (speed_m_s or MEAN_INLET_SPEED_M_S) * np.array([inlet.area_mm2 for inlet in inlets])
    given_mL_s = by_speed_mL_s if settings.inflow_mL_s is None else settings.inflow_mL_s * murray_shares(inlets)
    if not isinstance(profile, MeasuredProfile):
        return given_mL_s, "" if is_given else ASSUMED
    if len(inlets) > 1:
        raise InputError("a measured profile belongs to one inlet, and this vessel has several: give one of the words")
    if settings.waveform not in (None, profile.waveform) and profile.period_s is not None:
        raise InputError(
            "the inlet profile has times, and another waveform is given: leave out --pulsatile or the times"
        )
    measured_mL_s = np.array([profile.section.flow_mL_s.mean()])
    described = profile.section.described(inlets[0].normal)
    return (given_mL_s, f"profile {described}") if is_given else (measured_mL_s, described)


def _shares(vessel: Vessel, settings: FlowSettings) -> Floats:
    """Return the share (k,) of every outlet: as given, or by the diameters at every fork."""
    if settings.shares is None:
        return shares_by_forks(vessel, settings.outlet_exponent)
    _check_count(vessel.outlets, len(settings.shares), "share", "--outlet-shares")
    return np.array(settings.shares) / sum(settings.shares)


def _tabled(outlets: Sequence[Opening], settings: FlowSettings, inflow_mL_s: float) -> Iterator[Resistance]:
    """Yield the resistance or Windkessel of every outlet in a table."""
    elements = settings.elements or ()
    _check_count(outlets, len(elements), "row", "--outlet-table")
    pressure_Pa = inflow_mL_s / sum(1 / (proximal + distal) for proximal, _, distal in elements)
    for proximal, compliance, distal in elements:
        whole = proximal + distal
        stored = (whole * compliance, proximal / whole) if settings.outlets == "windkessel" else (0.0, 1.0)
        yield Resistance(pressure_Pa / whole, pressure_Pa, *stored, whole)


def _check_count(outlets: Sequence[Opening], count: int, what: str, option: str) -> None:
    """Raise InputError where there are not as many values as outlets."""
    if count != len(outlets):
        raise InputError(
            f"{counted(count, what)} for {counted(len(outlets), 'outlet')}: give one for each outlet, the widest first "
            f"({option})"
        )


def outflows(
    ends: Sequence[Resistance], inflow_mL_s: Floats, pressure_Pa: Floats, period_s: float = np.inf
) -> tuple[Floats, Floats]:
    """Return the flow rates (m, k) out through resistances, and the pressure (m,) common to their outlets.

    All values belong to m equally spaced times of a cycle in its periodic state; a single one is the mean. Inflow (m,)
    and the pressures (m, k) at the outlets are given. For every harmonic the flow rate is (P + p) / Z with the
    impedance Z of an outlet, and P follows from the sum of the flow rates.
    """
    spectrum = np.fft.rfft(pressure_Pa, axis=0)
    rate_per_s = np.asarray(2 * np.pi / period_s * np.arange(len(spectrum)), dtype=np.float64)
    means_Pa = pressure_Pa.mean(axis=0).tolist()
    impedances = [end.at(p) * end.relative_impedance(rate_per_s) for end, p in zip(ends, means_Pa, strict=True)]
    admittance = 1 / np.stack(impedances, axis=1)
    common = np.fft.rfft(inflow_mL_s) - (admittance * spectrum).sum(axis=1)
    common /= admittance.sum(axis=1)
    count = len(pressure_Pa)
    flows_mL_s = np.fft.irfft(admittance * (common[:, None] + spectrum), count, axis=0)
    return flows_mL_s, np.fft.irfft(common, count)
