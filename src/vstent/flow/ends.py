"""Boundary conditions at the openings of a vessel, and what the settings' word for the outlets means."""

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Vessel, murray_shares

MEAN_INLET_SPEED_M_S: Final = 0.27
"""Default mean speed in an inlet, m/s, for an internal carotid artery."""


@dataclass(frozen=True)
class Inflow:
    """A flow rate in, with the fully developed velocity profile of the opening's section (see `profile`).

    In a pulsatile flow the flow rate follows the waveform.
    """

    mean_mL_s: float
    """Mean flow rate in."""


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


End: TypeAlias = Inflow | FlowRate | Pressure
"""Boundary condition at one opening. Every engine decides by its type in one place."""


def ends_of(vessel: Vessel, settings: FlowSettings) -> tuple[End, ...]:
    """Return the boundary condition at every opening of a vessel, in their order.

    The inflow is shared among several inlets by Murray's law, or enters each with the default mean speed. With Murray's
    law at the outlets too, all but the widest get a flow rate, and the widest has zero pressure and takes the rest.
    """
    inlets, outlets = vessel.inlets, vessel.outlets
    inflow_mL_s = MEAN_INLET_SPEED_M_S * np.array([inlet.area_mm2 for inlet in inlets])
    if settings.inflow_mL_s is not None:
        inflow_mL_s = settings.inflow_mL_s * murray_shares(inlets)
    entering = map(Inflow, inflow_mL_s.tolist())
    if settings.outlets == "zero_pressure":
        return (*entering, *(Pressure() for _ in outlets))
    outflow_mL_s = inflow_mL_s.sum() * murray_shares(outlets)
    return (*entering, Pressure(), *map(FlowRate, outflow_mL_s[1:].tolist()))
