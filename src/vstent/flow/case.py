"""Data classes of a flow computation: FlowCase with its Target and Sheets, Cells, Level and FlowField."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from vstent.deployment.struts import struts
from vstent.devices.stent import Coils, Stent
from vstent.flow.ends import End, FlowRate, Inflow, Resistance
from vstent.flow.forks import arm_impedance
from vstent.flow.settings import Blood, Numerics
from vstent.flow.waveform import Waveform
from vstent.geometry.surface import Surface, joined
from vstent.geometry.vessel import Vessel
from vstent.kernels.arrays import Bools, Floats, Ints, freeze, read_only
from vstent.kernels.directions import VELOCITIES

PHASES = 20
"""Number of equally spaced moments at which a cycle is stored."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """A porous medium: the flow resistance of an implant on the surface that its wires span, or in a region.

    A region resists alike in all directions. It has the normal 0, and every sample stands for a volume: for so many mm2
    of a sheet 1 mm thick.
    """

    points_mm: Floats
    """(p, 3) sample points, dense on the surface."""
    normals: Floats
    """(p, 3) unit normals of the surface, or 0 in a region."""
    area_mm2: Floats
    """(p,) surface area that each sample represents."""
    normal_resistance_Pa_s_m: Floats
    """(p,) pressure drop per normal velocity, Pa/(m/s)."""
    tangential_resistance_Pa_s_m: Floats
    """(p,) shear stress per tangential velocity, Pa/(m/s)."""
    inertial_loss: Floats
    """(p,) coefficient K of the pressure drop K rho |u| u_n / 2 and of the shear stress K rho |u| u_t / 4; in a region
    of the pressure drop K rho |u| u / 4."""
    wire_diameter_mm: Floats
    """(p,) diameter of the wire at the sample."""
    spacing_mm: Floats
    """(p,) distance between neighbouring wires; equal to the wire diameter in a sheet without gaps."""

    def __post_init__(self) -> None:
        n = len(self.points_mm)
        freeze(self, "points_mm normals", np.float64, (n, 3))
        freeze(self, " ".join(column.name for column in fields(self)[2:]), np.float64, (n,))

    def part(self, chosen: Bools) -> "Sheet":
        """Return the sheet at the chosen samples (p,)."""
        return Sheet(**{column.name: getattr(self, column.name)[chosen] for column in fields(self)})


@dataclass(frozen=True, eq=False)
class Target:
    """The sac for which a flow is computed."""

    sac: Surface
    """Its closed surface, for its indices and for judging convergence."""
    ostium: Surface | None
    """Surface through which blood passes between artery and sac, with normals into the sac; None: convergence is
    judged without the flow through it."""


@dataclass(frozen=True, eq=False)
class FlowCase:
    """One flow problem: a vessel with what is in it and what drives it, and how it is computed."""

    vessel: Vessel
    """The vessel that the blood flows through."""
    ends: tuple[End, ...]
    """Boundary condition at every opening of the vessel, in their order: inlets first."""
    target: Target | None = None
    """The sac, or None."""
    media: tuple[Sheet, ...] = ()
    """The implants as flow resistances, for engines that do not resolve their wires."""
    solids: tuple[Stent, ...] = ()
    """The implants' wires over necks and ostia, for engines that resolve them."""
    blood: Blood = field(default_factory=Blood)
    """The fluid."""
    waveform: Waveform | None = None
    """Course of all prescribed flow rates over a cycle; None: steady."""
    numerics: Numerics = field(default_factory=Numerics)
    """How the flow is computed."""

    @property
    def sac(self) -> Surface | None:
        """Closed surface of the sac, or None."""
        return None if self.target is None else self.target.sac

    @property
    def ostium(self) -> Surface | None:
        """Surface through which blood enters the sac, or None (see `Target`)."""
        return None if self.target is None else self.target.ostium

    @cached_property
    def wires(self) -> Surface | None:
        """Closed solids of the implants' wires over necks and ostia, which may overlap; None where there are none."""
        solids = [struts(stent) for stent in self.solids if len(stent.wire_points_mm)]
        return joined(solids) if solids else None

    @property
    def walls(self) -> Surface | None:
        """The wires where they are resolved; None where media stand for them."""
        return self.wires if self.numerics.wires == "resolved" else None

    @property
    def has_screen(self) -> bool:
        """Whether a neck or an ostium has wires over it other than those of coils, and they are media."""
        wires = (one for one in self.solids if not isinstance(one, Coils))
        return self.numerics.wires != "resolved" and any(len(one.wire_points_mm) for one in wires)

    @property
    def inlets_mL_s(self) -> Floats:
        """Mean flow rate (i,) into each inlet."""
        return np.array([end.mean_mL_s for end in self.ends if isinstance(end, Inflow)])

    @property
    def inflow_source(self) -> str:
        """Where the inflow comes from, for a user; empty where it was given."""
        return next(end.source for end in self.ends if isinstance(end, Inflow))

    @property
    def inlet_speeds_m_s(self) -> Floats:
        """Mean speed (i,) in each inlet."""
        return self.inlets_mL_s / np.array([inlet.area_mm2 for inlet in self.vessel.inlets])

    @property
    def inflow_mL_s(self) -> float:
        """Mean flow rate through all inlets together."""
        return float(self.inlets_mL_s.sum())

    @property
    def resistances(self) -> tuple[Resistance, ...]:
        """Resistances at the outlets, in their order; empty where these have other conditions."""
        return tuple(end for end in self.ends if isinstance(end, Resistance))

    @property
    def is_split_given(self) -> bool:
        """Whether the resistance of a branch hardly matters for its flow.

        The flow rate of all openings but one is given or follows from a resistance downstream, which is far larger. A
        single outlet always takes all.
        """
        return sum(not isinstance(end, Inflow | FlowRate | Resistance) for end in self.ends) < 2

    def resisted_as(self, bare: "FlowField") -> "FlowCase":
        """Return the case with the resistances that follow from the flow without a device."""
        if not self.resistances:
            return self
        at_outlets = zip(self.resistances, np.nan_to_num(bare.outlet_pressure_Pa).tolist(), strict=True)
        known = (replace(end, resistance_Pa_s_mL=end.at(pressure_Pa)) for end, pressure_Pa in at_outlets)
        return replace(self, ends=(*self.ends[: len(self.vessel.inlets)], *known))

    def followed(self, wrong_mL_s: Floats) -> Floats:
        """Return by how much (m, k) to change the flows through resistances over a cycle, of which so much is wrong.

        Every harmonic is the step of Newton's method for arms of the impedance of round tubes. A full step diverges
        where a harmonic meets more resistance in the vessel than downstream.
        """
        count, ends = len(wrong_mL_s), self.resistances
        rate_per_s = np.asarray(2 * np.pi / self.pulse.period_s * np.arange(count // 2 + 1), dtype=np.float64)
        downstream = np.stack([end.at(0.0) * end.relative_impedance(rate_per_s) for end in ends], axis=1)
        arms = arm_impedance(self.vessel, self.blood, rate_per_s)
        part = 1 / (1 + arms / (downstream + downstream[:, :1]))
        return np.fft.irfft(part * np.fft.rfft(wrong_mL_s, axis=0), count, axis=0)

    @property
    def pulse(self) -> Waveform:
        """Waveform of a pulsatile flow."""
        assert self.waveform is not None
        return self.waveform

    @property
    def settled_below(self) -> float:
        """Residual below which the flow has converged."""
        return self.numerics.tolerance if self.waveform is None else self.numerics.cycle_tolerance

    def inflow_factor(self, time_s: Floats) -> Floats:
        """Return the inflow divided by its mean (t,) at times (t,)."""
        return np.ones(len(time_s)) if self.waveform is None else self.waveform.factor(time_s)


@dataclass(frozen=True, eq=False)
class Cells:
    """Blood cells of a regular grid: the base of a `Domain`, which is computed on, and of a `Level`."""

    cells: Ints
    """(n, 3) integer coordinates, sorted; the outermost layer of the grid contains no blood."""
    origin_mm: Floats
    """(3,) centre of the cell (0, 0, 0)."""
    cell_size_mm: float
    """Grid spacing."""

    def __post_init__(self) -> None:
        freeze(self, "cells", np.int32, (-1, 3))
        freeze(self, "origin_mm", np.float64, (3,))

    @cached_property
    def centers_mm(self) -> Floats:
        """Cell centres (n, 3)."""
        return self.origin_mm + self.cells * self.cell_size_mm

    @cached_property
    def index(self) -> Ints:
        """Index of the cell at every grid point (i, j, k), -1 outside the blood."""
        index = np.full(self.cells.max(axis=0) + 2, -1, dtype=np.int32)
        index[tuple(self.cells.T)] = np.arange(len(self.cells), dtype=np.int32)
        return index

    def neighbours(self) -> Ints:
        """Return the cell indices (n, 19) of every cell's neighbours, -1 where they are not blood."""
        return np.stack([self.index[tuple((self.cells + c).T)] for c in VELOCITIES], axis=1)

    def places(self, points_mm: Floats) -> Floats:
        """Return the grid coordinates (m, 3) of points (m, 3)."""
        return (points_mm - self.origin_mm) / self.cell_size_mm

    def cells_at(self, points_mm: Floats) -> Ints:
        """Return the cell (m,) in which each point (m, 3) lies, -1 outside the blood."""
        place = np.rint(self.places(points_mm)).astype(int)
        is_near = ((place >= 0) & (place < self.index.shape)).all(axis=1)
        found = np.full(len(points_mm), -1, dtype=np.int32)
        found[is_near] = self.index[tuple(place[is_near].T)]
        return found


@dataclass(frozen=True, eq=False)
class Level(Cells):
    """One grid of a flow: its blood cells and the flow in them."""

    velocity_m_s: Floats
    """(n, 3) velocity at the cell centres."""
    pressure_Pa: Floats
    """(n,) pressure at the cell centres, relative to the outlets."""
    mean_speed_m_s: Floats | None = None
    """(n,) time-averaged speed of an unsteady flow at constant inflow, which the mean velocity does not contain because
    oscillations cancel; None for any other flow."""

    def __post_init__(self) -> None:
        super().__post_init__()
        freeze(self, "velocity_m_s", np.float64, (len(self.cells), 3))
        freeze(self, "pressure_Pa mean_speed_m_s", np.float64, (len(self.cells),))

    @staticmethod
    def of(cells: Cells, velocity_m_s: Floats, pressure_Pa: Floats, mean_speed_m_s: Floats | None = None) -> "Level":
        """Return the level of a flow in the cells of a grid."""
        return Level(cells.cells, cells.origin_mm, cells.cell_size_mm, velocity_m_s, pressure_Pa, mean_speed_m_s)

    @cached_property
    def speed_m_s(self) -> Floats:
        """Magnitude (n,) of the velocity; its time average in an unsteady flow at constant inflow."""
        return np.linalg.norm(self.velocity_m_s, axis=1) if self.mean_speed_m_s is None else self.mean_speed_m_s


@dataclass(frozen=True, eq=False)
class Phase:
    """One moment of a pulsatile flow."""

    time_s: float
    """Time since the start of the waveform."""
    inlets_mL_s: Floats
    """(i,) flow rate in through each inlet."""
    outlets_mL_s: Floats
    """(k,) flow rate out through each outlet."""
    velocity_m_s: tuple[Floats, ...]
    """(n, 3) velocity at the cell centres of every level."""
    pressure_Pa: tuple[Floats, ...]
    """(n,) pressure at the cell centres of every level."""
    wall_shear_stress_Pa: Floats
    """(v, 3) wall shear stress at the lumen's vertices."""
    neck_inflow_mL_s: float | None = None
    """Neck inflow at this moment, or None (see `FlowField.neck_inflow_mL_s`)."""

    def __post_init__(self) -> None:
        freeze(self, "inlets_mL_s outlets_mL_s", np.float64, (-1,))
        freeze(self, "wall_shear_stress_Pa", np.float32, (-1, 3))
        for name, shape in (("velocity_m_s", (-1, 3)), ("pressure_Pa", (-1,))):
            values = tuple(read_only(one, np.float32, shape, name) for one in getattr(self, name))
            object.__setattr__(self, name, values)

    @property
    def inflow_mL_s(self) -> float:
        """Flow rate in through all inlets together."""
        return float(self.inlets_mL_s.sum())


@dataclass(frozen=True, eq=False)
class FlowField:
    """A computed flow and its convergence: a steady state, or the time average of an unsteady or pulsatile flow."""

    levels: tuple[Level, ...]
    """Grids, coarse to fine; at a place where several have cells, the finest one counts. The first is the whole vessel
    or the only one."""
    wall: Surface
    """The lumen."""
    wall_shear_stress_Pa: Floats
    """(v, 3) tangential traction of the flow on the wall at the lumen's vertices."""
    wall_pressure_Pa: Floats
    """(v,) pressure at the lumen's vertices."""
    inlets_mL_s: Floats
    """(i,) flow rate in through each inlet."""
    outlets_mL_s: Floats
    """(k,) flow rate out through each outlet."""
    inlet_pressure_Pa: Floats
    """(i,) mean pressure over each inlet's section."""
    outlet_pressure_Pa: Floats
    """(k,) mean pressure over each outlet's section."""
    blood: Blood
    """The fluid."""
    is_converged: bool
    """Whether every monitored quantity, or its time average in an unsteady flow, is known to within the tolerance."""
    unsettled_fraction: float
    """Largest remaining error of convergence of any monitored quantity, as a fraction of it. Steady flow: the change
    still expected. Unsteady flow: three standard errors of the time average; with too few checks for that, the range
    of the quantity or the shift of its mean, whichever is larger. Pulsatile flow: the root-mean-square difference of
    the last two cycles, inf after a single cycle."""
    advice: str
    """One sentence for the user: the state of convergence and what to do about it."""
    residual: Floats
    """(r,) largest expected remaining change of any monitored quantity at every check, as a fraction."""
    steps: int
    """Number of time steps on the finest grid."""
    seconds: float
    """Run time (wall clock)."""
    updates_per_s: float
    """Cell updates per second in the main loop on the finest grid."""
    phases: tuple[Phase, ...] = ()
    """The last cycle of a pulsatile flow at equally spaced times; empty for a steady flow."""
    wire_force_N: Floats | None = None
    """(3,) force of the blood on wires over necks and ostia at the end of the run; None where they are no walls."""
    mean_shear_Pa: Floats | None = None
    """(v,) time-averaged magnitude of the wall shear stress of an unsteady flow at constant inflow, which the mean
    vectors do not contain because oscillations cancel; None for any other flow."""
    common_pressure_Pa: float = 0.0
    """Mean pressure that resistances at the outlets add to all pressures of this field; 0 without them."""
    neck_inflow_mL_s: float | None = None
    """Neck inflow where it cannot be computed from this field: the time average of an unsteady flow, or the value from
    cells that are finer around the wires than this grid (0 where there is no neck). None: it is computed from the
    field."""

    def __post_init__(self) -> None:
        v = len(self.wall.vertices_mm)
        freeze(self, "wall_shear_stress_Pa", np.float64, (v, 3))
        freeze(self, "wall_pressure_Pa mean_shear_Pa", np.float64, (v,))
        freeze(self, "inlets_mL_s inlet_pressure_Pa", np.float64, (len(self.inlets_mL_s),))
        freeze(self, "outlets_mL_s outlet_pressure_Pa", np.float64, (len(self.outlets_mL_s),))
        freeze(self, "residual", np.float64, (-1,))
        freeze(self, "wire_force_N", np.float64, (3,))

    @property
    def inflow_mL_s(self) -> float:
        """Flow rate in through all inlets together."""
        return float(self.inlets_mL_s.sum())

    @property
    def finest(self) -> Level:
        """The level with the finest grid."""
        return self.levels[-1]

    @cached_property
    def is_finest(self) -> tuple[Bools, ...]:
        """Whether each cell of every level contains no cell of a finer one: these (n,) cells fill the blood once."""
        result = tuple(np.ones(len(level.cells), dtype=bool) for level in self.levels)
        for k, level in enumerate(self.levels):
            for finer in self.levels[k + 1 :]:
                refined = level.cells_at(finer.centers_mm)
                result[k][refined[refined >= 0]] = False
        return result

    def _joined(self, values: Iterable[Floats]) -> Floats:
        """Return values of the cells of every level as one array of the cells that fill the blood once."""
        return np.concatenate([one[own] for one, own in zip(values, self.is_finest, strict=True)])

    @cached_property
    def centers_mm(self) -> Floats:
        """Centres (n, 3) of the cells that fill the blood once, as in the arrays below."""
        return self._joined(level.centers_mm for level in self.levels)

    @cached_property
    def sizes_mm(self) -> Floats:
        """Edge (n,) of these cells."""
        return self._joined(np.full(len(level.cells), level.cell_size_mm) for level in self.levels)

    @cached_property
    def velocity_m_s(self) -> Floats:
        """Velocity (n, 3) at the centres of these cells."""
        return self._joined(level.velocity_m_s for level in self.levels)

    @cached_property
    def pressure_Pa(self) -> Floats:
        """Pressure (n,) at the centres of these cells."""
        return self._joined(level.pressure_Pa for level in self.levels)

    @cached_property
    def speed_m_s(self) -> Floats:
        """Speed (n,) in these cells; its time average in an unsteady flow at constant inflow."""
        return self._joined(level.speed_m_s for level in self.levels)

    @cached_property
    def shear_Pa(self) -> Floats:
        """Magnitude (v,) of the wall shear stress; its time average (TAWSS) in an unsteady or pulsatile flow."""
        if self.mean_shear_Pa is not None:
            return self.mean_shear_Pa
        moments = self.phases or (self,)
        return np.mean([np.linalg.norm(now.wall_shear_stress_Pa, axis=1) for now in moments], axis=0, dtype=float)

    @cached_property
    def oscillatory_shear_index(self) -> Floats:
        """Oscillatory shear index (v,), 0 in steady flow.

        OSI = (1 - norm(mean stress) / mean norm) / 2 (He and Ku 1996, J. Biomech. Eng. 118, 74).
        """
        return 0.5 * (1 - np.linalg.norm(self.wall_shear_stress_Pa, axis=1) / np.maximum(self.shear_Pa, 1e-12))

    @cached_property
    def relative_residence_time_per_Pa(self) -> Floats:
        """Relative residence time (v,).

        RRT = 1 / ((1 - 2 OSI) TAWSS) (Himburg et al. 2004, Am. J. Physiol. Heart 286, H1916).
        """
        return 1 / np.maximum((1 - 2 * self.oscillatory_shear_index) * self.shear_Pa, 1e-12)

    def at_phase(self, phase: Phase) -> "FlowField":
        """Return the flow at one moment of the cycle."""
        parts = zip(self.levels, phase.velocity_m_s, phase.pressure_Pa, strict=True)
        return replace(
            self,
            levels=tuple(replace(level, velocity_m_s=u, pressure_Pa=p, mean_speed_m_s=None) for level, u, p in parts),
            wall_shear_stress_Pa=phase.wall_shear_stress_Pa,
            inlets_mL_s=phase.inlets_mL_s,
            outlets_mL_s=phase.outlets_mL_s,
            phases=(),
            mean_shear_Pa=None,
            neck_inflow_mL_s=phase.neck_inflow_mL_s,
        )

    def moments(self) -> "Iterator[FlowField]":
        """Yield the flow at every phase of the cycle, or a flow without phases itself."""
        yield from (self.at_phase(phase) for phase in self.phases) if self.phases else (self,)
