"""The nouns of blood flow: Blood, FlowSettings, Screen, FlowCase, FlowField."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from vstent.kernels import voxels
from vstent.kernels.arrays import Floats, Ints, freeze
from vstent.surface import Surface
from vstent.vessel import Vessel


@dataclass(frozen=True, eq=False)
class Blood:
    """A Newtonian fluid (design.md section 5: the paper's values)."""

    density_kg_m3: float = 1060.0
    """Mass density."""
    viscosity_Pa_s: float = 0.004
    """Dynamic viscosity."""

    @property
    def kinematic_viscosity_m2_s(self) -> float:
        """Viscosity divided by density."""
        return self.viscosity_Pa_s / self.density_kg_m3


@dataclass(frozen=True, eq=False)
class FlowSettings:
    """How the flow is to be computed."""

    inflow_mL_s: float | None = None
    """Mean flow through the inlet; None: 0.27 m/s times the inlet's area."""
    outlets: Literal["zero_pressure", "murray"] = "zero_pressure"
    """Zero pressure at every outlet, or the flow split as radius cubed (Murray 1926, PNAS 12, 207)."""
    cell_size_mm: float | None = None
    """Edge of a grid cell; None: `cells_per_diameter` across the vessel, but no more than `cell_budget` cells."""
    cells_per_diameter: float = 24.0
    """Cells across the vessel's mean (hydraulic) diameter 4 V / A, where no cell size is given."""
    cell_budget: float = 320_000.0
    """Most cells of the vessel, where no cell size is given."""
    tolerance: float = 0.01
    """Converged when every monitored quantity has less than this fraction of itself left to go."""
    max_steps: int = 24_000
    """Most time steps on the fine grid."""
    lattice_speed: float = 0.15
    """Peak speed in cells per time step: sets the time step."""


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
    """(p,) K of the pressure drop K rho u_n^2 / 2."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        for name in ("area_mm2", "normal_resistance_Pa_s_m", "tangential_resistance_Pa_s_m", "inertial_loss"):
            freeze(self, name, np.float64, (len(self.points_mm),))
        freeze(self, "normals", np.float64, (len(self.points_mm), 3))


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
    """The stent, or None."""
    blood: Blood = field(default_factory=Blood)
    """The fluid."""
    settings: FlowSettings = field(default_factory=FlowSettings)
    """How to compute it."""

    @property
    def inflow_mL_s(self) -> float:
        """Flow through the inlet: the one set, or 0.27 m/s times the inlet's area (design.md section 5)."""
        if self.settings.inflow_mL_s is not None:
            return self.settings.inflow_mL_s
        return MEAN_INLET_SPEED_M_S * self.vessel.inlet.area_mm2


MEAN_INLET_SPEED_M_S = 0.27
"""Mean speed in an internal carotid artery (design.md section 5)."""


@dataclass(frozen=True, eq=False)
class FlowField:
    """A computed steady flow, or the mean of one that does not settle, and how it was reached."""

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
    inlet_mL_s: float
    """Flow in through the inlet."""
    outlets_mL_s: Floats
    """(k,) flow out through each outlet."""
    inlet_pressure_Pa: float
    """Mean pressure on the inlet's section."""
    outlet_pressure_Pa: Floats
    """(k,) mean pressure on each outlet's section."""
    blood: Blood
    """The fluid."""
    is_converged: bool
    """Whether every monitored quantity has settled to within the tolerance."""
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

    def __post_init__(self) -> None:
        freeze(self, "cells", np.int32, (-1, 3))
        n, v = len(self.cells), len(self.wall.vertices_mm)
        freeze(self, "origin_mm", np.float64, (3,))
        freeze(self, "velocity_m_s", np.float64, (n, 3))
        freeze(self, "pressure_Pa", np.float64, (n,))
        freeze(self, "wall_shear_stress_Pa", np.float64, (v, 3))
        freeze(self, "wall_pressure_Pa", np.float64, (v,))
        freeze(self, "outlets_mL_s", np.float64, (-1,))
        freeze(self, "outlet_pressure_Pa", np.float64, (len(self.outlets_mL_s),))
        freeze(self, "residual", np.float64, (-1,))

    @cached_property
    def centers_mm(self) -> Floats:
        """(n, 3) cell centres."""
        return self.origin_mm + self.cells * self.cell_size_mm

    @cached_property
    def speed_m_s(self) -> Floats:
        """(n,) magnitude of the velocity."""
        return np.linalg.norm(self.velocity_m_s, axis=1)

    @cached_property
    def index(self) -> Ints:
        """(i, j, k) number of the cell at every grid point, -1 outside the blood."""
        return voxels.index_of(self.cells)

    @property
    def cell_volume_mm3(self) -> float:
        """Volume of a cell."""
        return self.cell_size_mm**3
