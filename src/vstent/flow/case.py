"""The nouns of blood flow: Blood, FlowSettings, Screen, FlowCase, FlowField."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np

from vstent.devices.stent import Stent
from vstent.geometry.murray import murray_shares
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.kernels import voxels
from vstent.kernels.arrays import Floats, Ints, freeze

LATTICE: Final = "lattice_boltzmann"
"""Name of the engine that vstent brings along."""
OPENFOAM: Final = "openfoam"
"""Name of the engine that hands the flow to OpenFOAM, a program of its own."""


HIGH_SHEAR_VISCOSITY_PA_S: Final = 0.00345
"""Viscosity that goes with the numbers of `CarreauYasuda`."""


@dataclass(frozen=True)
class CarreauYasuda:
    """Blood that thins with the shear rate g: mu = m + (m0 - m) (1 + (t g)^a)^((n - 1) / a), m being at high shear.

    Bird, Armstrong and Hassager 1987, Dynamics of Polymeric Liquids 1, eq. 4.1-8; values of blood, with m = 0.00345
    Pa s, as Cho and Kensey 1991 (Biorheology 28, 241) fit them.
    """

    rest_viscosity_Pa_s: float = 0.056
    """m0, viscosity at rest."""
    time_s: float = 1.902
    """t."""
    a: float = 1.25
    """a."""
    n: float = 0.22
    """n."""


@dataclass(frozen=True)
class Blood:
    """A fluid (design.md section 5: the paper's values), Newtonian unless its thinning is given."""

    density_kg_m3: float = 1060.0
    """Mass density."""
    viscosity_Pa_s: float = 0.004
    """Dynamic viscosity; that at high shear where blood thins."""
    thinning: CarreauYasuda | None = None
    """How the viscosity falls with the shear rate; None: it does not."""

    @property
    def kinematic_viscosity_m2_s(self) -> float:
        """Viscosity divided by density."""
        return self.viscosity_Pa_s / self.density_kg_m3

    def viscosity_at_Pa_s(self, rate_per_s: Floats) -> Floats:
        """Dynamic viscosity (n,) at shear rates (n,)."""
        law = self.thinning
        if law is None:
            return np.full_like(rate_per_s, self.viscosity_Pa_s)
        falling = (1 + (law.time_s * rate_per_s) ** law.a) ** ((law.n - 1) / law.a)
        return self.viscosity_Pa_s + (law.rest_viscosity_Pa_s - self.viscosity_Pa_s) * falling


@dataclass(frozen=True)
class Waveform:
    """A periodic flow, as multiples of its mean: 1 + sum of a_k cos(k w t) + b_k sin(k w t), w = 2 pi / period."""

    period_s: float
    """Length of a cycle."""
    cosine: tuple[float, ...]
    """a_k, from k = 1."""
    sine: tuple[float, ...]
    """b_k, from k = 1."""

    def factor(self, time_s: Floats) -> Floats:
        """Flow over mean flow at times (t,)."""
        angle = 2 * np.pi / self.period_s * np.multiply.outer(time_s, np.arange(1, len(self.cosine) + 1))
        return 1 + np.cos(angle) @ np.array(self.cosine) + np.sin(angle) @ np.array(self.sine)

    def curvature_per_s2(self, time_s: Floats) -> Floats:
        """Second time derivative (t,) of the flow over the mean flow."""
        rate_per_s = 2 * np.pi / self.period_s * np.arange(1, len(self.cosine) + 1)
        harmonics = replace(self, cosine=tuple(rate_per_s**2 * self.cosine), sine=tuple(rate_per_s**2 * self.sine))
        return 1 - harmonics.factor(time_s)


@dataclass(frozen=True)
class FlowSettings:
    """How the flow is to be computed."""

    inflow_mL_s: float | None = None
    """Mean flow through all inlets; None: 0.27 m/s times the area of each."""
    blood: Blood = field(default_factory=Blood)
    """The fluid."""
    waveform: Waveform | None = None
    """The pulse; None: steady flow at the mean."""
    max_cycles: int = 4
    """Most cycles of pulsatile flow."""
    cycle_tolerance: float = 0.02
    """Pulsatile flow has converged when a cycle differs by less than this from the one before."""
    outlets: Literal["zero_pressure", "murray"] = "zero_pressure"
    """Zero pressure at every outlet, or the flow split as radius cubed (Murray 1926, PNAS 12, 207)."""
    cell_size_mm: float | None = None
    """Edge of a grid cell; None: `cells_per_diameter` across the vessel, but no more than `cell_budget` cells."""
    close_up: bool = False
    """Whether cells are of that size only in the sac and near it (`lattice.close_up`), twice as wide elsewhere."""
    cells_per_diameter: float = 29.0
    """Cells across the vessel's mean (hydraulic) diameter 4 V / A, where no cell size is given."""
    cell_budget: float = 480_000.0
    """Most cells of the vessel, where no cell size is given."""
    tolerance: float = 0.01
    """Converged when every monitored quantity has less than this fraction of itself left to go, and the sac's velocity
    less than twice that (root mean square); where they swing, when the standard error of every mean is less."""
    max_steps: int = 96_000
    """Most time steps of a steady flow on the fine grid; a close-up makes a sixth of them, what surrounds it half."""
    lattice_speed: float = 0.15
    """Peak speed in cells per time step: sets the time step, a third longer in a steady close-up. Of steady flow the
    grid's error, not the time step's, is what it changes, through the relaxation times."""
    engine: str = LATTICE
    """What computes the flow: ``lattice_boltzmann``, ``openfoam``, or the name of a plug-in (`vstent.plugins`)."""
    processes: int = 1
    """Processes on this machine, for OpenFOAM."""
    device_gpu: bool = False
    """Whether vstent's own engine computes on a GPU (the extra ``gpu``): results differ in the last bits."""

    @property
    def settled_below(self) -> float:
        """What the residual has to fall below."""
        return self.tolerance if self.waveform is None else self.cycle_tolerance

    def inflow_factor(self, time_s: Floats) -> Floats:
        """Inflow over mean inflow at times (t,)."""
        return np.ones(len(time_s)) if self.waveform is None else self.waveform.factor(time_s)


@dataclass(frozen=True, eq=False)
class Screen:
    """A stent as a thin resistance on the surface that its wires span."""

    points_mm: Floats
    """(p, 3) sample points, dense on the surface."""
    normals: Floats
    """(p, 3) unit normals of the surface."""
    area_mm2: Floats
    """(p,) area that each sample stands for."""
    normal_resistance_Pa_s_m: Floats
    """(p,) pressure drop per normal velocity, Pa/(m/s)."""
    tangential_resistance_Pa_s_m: Floats
    """(p,) shear stress per tangential velocity, Pa/(m/s)."""
    inertial_loss: Floats
    """(p,) K of the pressure drop K rho |u| u_n / 2, and of the shear stress K rho |u| u_t / 4."""
    wire_diameter_mm: Floats
    """(p,) diameter of the wire that the sample is of."""
    spacing_mm: Floats
    """(p,) how far such wires lie apart; as far as they are thick in a sheet without gaps."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        freeze(self, "normals", np.float64, (len(self.points_mm), 3))
        for one in fields(self)[2:]:
            freeze(self, one.name, np.float64, (len(self.points_mm),))


@dataclass(frozen=True, eq=False)
class FlowCase:
    """One flow to compute."""

    vessel: Vessel
    """What blood flows through."""
    sac: Surface | None = None
    """The closed sac, for its indices and for judging convergence."""
    ostium: Surface | None = None
    """What blood crosses between artery and sac, its normals into the sac."""
    screen: Screen | None = None
    """The stent as a resistance, or None."""
    stent: Stent | None = None
    """The stent's wires over necks and ostia, for engines that resolve them, or None."""
    settings: FlowSettings = field(default_factory=FlowSettings)
    """How to compute it."""

    @property
    def blood(self) -> Blood:
        """The fluid."""
        return self.settings.blood

    @property
    def inlets_mL_s(self) -> Floats:
        """(i,) mean flow through each inlet: Murray's part of the one set, or 0.27 m/s times its area (design.md)."""
        inlets = self.vessel.inlets
        if self.settings.inflow_mL_s is not None:
            return self.settings.inflow_mL_s * murray_shares(inlets)
        return MEAN_INLET_SPEED_M_S * np.array([inlet.area_mm2 for inlet in inlets])

    @property
    def inlet_speeds_m_s(self) -> Floats:
        """(i,) mean speed in each inlet."""
        return self.inlets_mL_s / np.array([inlet.area_mm2 for inlet in self.vessel.inlets])

    @property
    def inflow_mL_s(self) -> float:
        """Mean flow through all inlets."""
        return float(self.inlets_mL_s.sum())

    @property
    def held_mL_s(self) -> Floats:
        """(k,) mean flow that each outlet is held to by Murray's law; nan at zero pressure: the widest, or all."""
        outlets = self.vessel.outlets
        held = self.inflow_mL_s * murray_shares(outlets)
        held[: 1 if self.settings.outlets == "murray" else len(outlets)] = np.nan
        return held


MEAN_INLET_SPEED_M_S = 0.27
"""Mean speed in an internal carotid artery (design.md section 5)."""


PHASES = 20
"""Moments at which a cycle is kept."""


@dataclass(frozen=True, eq=False)
class Phase:
    """A moment of a pulsatile flow."""

    time_s: float
    """Time since the waveform's beginning."""
    inlets_mL_s: Floats
    """(i,) flow in through each inlet."""
    outlets_mL_s: Floats
    """(k,) flow out through each outlet."""
    velocity_m_s: Floats
    """(n, 3) velocity at the cell centres."""
    pressure_Pa: Floats
    """(n,) pressure at the cell centres."""
    wall_shear_stress_Pa: Floats
    """(v, 3) at the lumen's vertices."""
    neck_inflow_mL_s: float | None = None
    """Into the sac, as `FlowField` has it."""

    def __post_init__(self) -> None:
        freeze(self, "inlets_mL_s", np.float64, (-1,))
        freeze(self, "outlets_mL_s", np.float64, (-1,))
        freeze(self, "velocity_m_s", np.float32, (-1, 3))
        freeze(self, "pressure_Pa", np.float32, (len(self.velocity_m_s),))
        freeze(self, "wall_shear_stress_Pa", np.float32, (-1, 3))

    @property
    def inflow_mL_s(self) -> float:
        """Flow in through all inlets."""
        return float(self.inlets_mL_s.sum())


@dataclass(frozen=True, eq=False)
class Swing:
    """What the mean of a steady flow that moves does not tell: what goes to and fro cancels in it."""

    speed_m_s: Floats
    """(n,) mean speed at the cell centres."""
    shear_Pa: Floats
    """(v,) mean magnitude of the wall shear stress at the lumen's vertices."""

    def __post_init__(self) -> None:
        freeze(self, "speed_m_s", np.float64, (-1,))
        freeze(self, "shear_Pa", np.float64, (-1,))


@dataclass(frozen=True, eq=False)
class FlowField:
    """A computed flow and how it was reached: steady, or the mean of one that swings or pulses."""

    cells: Ints
    """(n, 3) integer grid coordinates of the blood cells, sorted."""
    origin_mm: Floats
    """(3,) centre of the cell (0, 0, 0)."""
    cell_size_mm: float
    """Edge of a cell."""
    velocity_m_s: Floats
    """(n, 3) velocity at the cell centres."""
    pressure_Pa: Floats
    """(n,) pressure above that of the outlets."""
    wall: Surface
    """The lumen."""
    wall_shear_stress_Pa: Floats
    """(v, 3) traction of the flow along the wall at the lumen's vertices."""
    wall_pressure_Pa: Floats
    """(v,) pressure at the lumen's vertices."""
    inlets_mL_s: Floats
    """(i,) flow in through each inlet."""
    outlets_mL_s: Floats
    """(k,) flow out through each outlet."""
    inlet_pressure_Pa: Floats
    """(i,) mean pressure on each inlet's section."""
    outlet_pressure_Pa: Floats
    """(k,) mean pressure on each outlet's section."""
    blood: Blood
    """The fluid."""
    is_converged: bool
    """Whether every monitored quantity, or the mean that it swings about, has settled to within the tolerance."""
    unsettled_fraction: float
    """What any monitored quantity has left to go at most, as a fraction of it. Where it swings, three standard errors
    of its mean; after too few checks to tell, what it ranges over, or how far its mean has moved, if that is more. Of a
    pulse, what its last two cycles differ by (rms); inf where there is a single one."""
    advice: str
    """One plain sentence: what to know or do about this result."""
    residual: Floats
    """(r,) largest fraction that any monitored quantity has left to go, at every check."""
    steps: int
    """Time steps made, on the finest grid."""
    seconds: float
    """Wall time."""
    updates_per_s: float
    """Cell updates per second, the finest grid's loop alone."""
    phases: tuple[Phase, ...] = ()
    """The last cycle of a pulsatile flow, at equal times; empty for a steady one."""
    swing: Swing | None = None
    """Of a steady flow that moves about its mean; None of any other."""
    neck_inflow_mL_s: float | None = None
    """Into the sac, where these cells do not tell it: the mean where the flow moves, and what a mesh with cells finer
    than these about wires lets through (0 where there is no neck). None: as they tell."""

    def __post_init__(self) -> None:
        freeze(self, "cells", np.int32, (-1, 3))
        n, v = len(self.cells), len(self.wall.vertices_mm)
        freeze(self, "origin_mm", np.float64, (3,))
        freeze(self, "velocity_m_s", np.float64, (n, 3))
        freeze(self, "pressure_Pa", np.float64, (n,))
        freeze(self, "wall_shear_stress_Pa", np.float64, (v, 3))
        freeze(self, "wall_pressure_Pa", np.float64, (v,))
        freeze(self, "inlets_mL_s", np.float64, (-1,))
        freeze(self, "outlets_mL_s", np.float64, (-1,))
        freeze(self, "inlet_pressure_Pa", np.float64, (len(self.inlets_mL_s),))
        freeze(self, "outlet_pressure_Pa", np.float64, (len(self.outlets_mL_s),))
        freeze(self, "residual", np.float64, (-1,))

    @property
    def inflow_mL_s(self) -> float:
        """Flow in through all inlets."""
        return float(self.inlets_mL_s.sum())

    @cached_property
    def centers_mm(self) -> Floats:
        """(n, 3) cell centres."""
        return self.origin_mm + self.cells * self.cell_size_mm

    @cached_property
    def speed_m_s(self) -> Floats:
        """(n,) magnitude of the velocity; its mean where a steady flow moves."""
        return np.linalg.norm(self.velocity_m_s, axis=1) if self.swing is None else self.swing.speed_m_s

    @cached_property
    def index(self) -> Ints:
        """(i, j, k) number of the cell at every grid point, -1 outside the blood."""
        return voxels.index_of(self.cells)

    @cached_property
    def shear_Pa(self) -> Floats:
        """(v,) magnitude of the wall shear stress; its time average (TAWSS) where the flow pulses or moves."""
        if self.swing is not None:
            return self.swing.shear_Pa
        moments = self.phases or (self,)
        return np.mean([np.linalg.norm(now.wall_shear_stress_Pa, axis=1) for now in moments], axis=0, dtype=float)

    @cached_property
    def oscillatory_shear_index(self) -> Floats:
        """(v,) (1 - norm(mean stress) / mean norm) / 2 (He and Ku 1996, J. Biomech. Eng. 118, 74); 0 in steady flow."""
        return 0.5 * (1 - np.linalg.norm(self.wall_shear_stress_Pa, axis=1) / np.maximum(self.shear_Pa, 1e-12))

    @cached_property
    def relative_residence_time_per_Pa(self) -> Floats:
        """(v,) 1 / ((1 - 2 OSI) TAWSS) (Himburg et al. 2004, Am. J. Physiol. Heart 286, H1916)."""
        return 1 / np.maximum((1 - 2 * self.oscillatory_shear_index) * self.shear_Pa, 1e-12)

    def at_phase(self, phase: Phase) -> "FlowField":
        """The flow at a moment of the cycle."""
        return replace(
            self,
            velocity_m_s=phase.velocity_m_s,
            pressure_Pa=phase.pressure_Pa,
            wall_shear_stress_Pa=phase.wall_shear_stress_Pa,
            inlets_mL_s=phase.inlets_mL_s,
            outlets_mL_s=phase.outlets_mL_s,
            phases=(),
            swing=None,
            neck_inflow_mL_s=phase.neck_inflow_mL_s,
        )
