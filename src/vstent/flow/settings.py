"""Settings of a flow as the user gives them: blood, waveform, outlets, and the numerical settings of an engine.

This module imports no numpy, so that command-line options and settings of a study can be read without it.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

from vstent.errors import InputError
from vstent.fields import POSITION, Limits, flag, flow_rate, numbers, setting, whole
from vstent.flow.measured import MeasuredProfile, Profile, read_profile
from vstent.flow.waveform import PUBLISHED, SOURCES, Waveform, read_waveform
from vstent.units import PA_PER_MMHG

if TYPE_CHECKING:
    from vstent.kernels.arrays import Floats

Outlets = Literal["zero_pressure", "murray", "split", "resistance", "windkessel"]
"""Condition at the outlets."""
Wires = Literal["auto", "screen", "calibrated", "resolved"]
"""How a flow takes the wires over necks and branches."""
Region = Literal["sac", "inlet", "branches"] | tuple[float, float, float, float]
"""Part of a vessel: a word, or center, LPS, and radius of a ball, mm."""
RESISTING: Final = ("resistance", "windkessel")
"""Conditions with which the flow out follows the pressure."""
Elements = tuple[float, float, float]
"""Windkessel of an outlet: proximal resistance, Pa s/mL, compliance, mL/Pa, and distal resistance, Pa s/mL."""
PER_UNIT: Final = {"pa s/m3": 1e-6, "mmhg s/ml": PA_PER_MMHG, "dyn s/cm5": 0.1}
"""Resistances in Pa s/mL of each unit that a table of outlets may have."""
LATTICE: Final = "lattice_boltzmann"
"""Name of the embedded lattice-Boltzmann engine."""
OPENFOAM: Final = "openfoam"
"""Name of the engine that runs OpenFOAM, a separate program."""
HIGH_SHEAR_VISCOSITY_PA_S: Final = 0.00345
"""Viscosity at high shear rate, Pa s, that belongs to the default values of `CarreauYasuda` (Cho and Kensey 1991)."""


def read_region(text: str) -> str | tuple[float, ...]:
    """Return a `Region` read from text."""
    if (word := text.strip()) in ("sac", "inlet", "branches"):
        return word
    with suppress(InputError):
        if len(found := numbers(word)) == 4 and found[-1] > 0:
            return found
    raise InputError(
        f"{text!r} is no part of a vessel: give sac, inlet, branches, or center and radius of a ball in mm, such as "
        "3,-12,8,2"
    )


def read_elements(source: str) -> tuple[Elements, ...]:
    """Return the Windkessel of every row of a CSV file; a resistance alone is one without a compliance."""
    from vstent.io.tables import read_columns

    rows = read_columns(Path(source), 1, 3)
    titles = " ".join(Path(source).read_text("utf-8-sig", "replace").lower().replace("*", " ").split())
    units = [factor for unit, factor in PER_UNIT.items() if unit in titles]
    if len(units) != 1:
        raise InputError(
            f"the titles of {source} state no unit of the resistances: write 'R_p (mmHg s/mL), C, R_d' above the "
            "numbers, or the same with Pa s/m3 or dyn s/cm5"
        )
    if (rows < 0).any() or (rows[:, [0, -1]] <= 0).any():
        raise InputError(f"{source} has a resistance that is not positive, or a negative compliance: correct it")
    wide = rows if rows.shape[1] == 3 else rows @ [[1.0, 0.0, 0.0]]
    return tuple((p * units[0], c / units[0], d * units[0]) for p, c, d in wide.tolist())


@dataclass(frozen=True)
class CarreauYasuda:
    """Shear-thinning viscosity after Carreau and Yasuda.

    mu = m + (m0 - m) (1 + (t g)^a)^((n - 1) / a), where g is the shear rate and m the viscosity at high shear rate.

    References
    ----------
    Bird, Armstrong and Hassager 1987, Dynamics of Polymeric Liquids 1, eq. 4.1-8.
    Cho and Kensey 1991, Biorheology 28, 241: the default values, for blood with m = 0.00345 Pa s.
    """

    rest_viscosity_Pa_s: float = 0.056
    """m0, viscosity at zero shear rate."""
    time_s: float = 1.902
    """t, time constant."""
    a: float = 1.25
    """a, exponent of the transition from m0 to m."""
    n: float = 0.22
    """n, power-law index."""


@dataclass(frozen=True)
class Blood:
    """Blood as a fluid: Newtonian unless a shear-thinning law is given.

    The defaults are those of Zhong et al. 2016, Sci. Rep. 6:21724.
    """

    density_kg_m3: float = setting(
        1060.0, "density", "density of blood", limits=Limits("kg/m3", 900.0, 1200.0, remark="1.06 g/mL are 1060 kg/m3")
    )
    """Mass density."""
    viscosity_Pa_s: float = setting(
        0.004,
        "viscosity",
        "viscosity of blood",
        limits=Limits("Pa s", 0.001, 0.1, remark="4 mPa s are 0.004 Pa s"),
        usual=f"0.004; with --shear-thinning {HIGH_SHEAR_VISCOSITY_PA_S:g} at high shear",
    )
    """Dynamic viscosity; with a shear-thinning law, its value at high shear rate."""
    thinning: CarreauYasuda | None = setting(
        None,
        "shear-thinning",
        "shear-thinning blood after Carreau and Yasuda",
        flag,
        usual="Newtonian",
        load=lambda is_thinning: CarreauYasuda() if is_thinning else None,
    )
    """Shear-thinning law; None: Newtonian."""

    @property
    def kinematic_viscosity_m2_s(self) -> float:
        """Kinematic viscosity: dynamic viscosity divided by density."""
        return self.viscosity_Pa_s / self.density_kg_m3

    def viscosity_at_Pa_s(self, rate_per_s: "Floats") -> "Floats":
        """Return the dynamic viscosity (n,) at shear rates (n,)."""
        import numpy as np

        law = self.thinning
        if law is None:
            return np.full_like(rate_per_s, self.viscosity_Pa_s)
        falling = (1 + (law.time_s * rate_per_s) ** law.a) ** ((law.n - 1) / law.a)
        return self.viscosity_Pa_s + (law.rest_viscosity_Pa_s - self.viscosity_Pa_s) * falling


@dataclass(frozen=True)
class Numerics:
    """How a flow is computed; its physics is in the other `FlowSettings`."""

    cell_size_mm: float | None = setting(
        None, "grid-spacing", "spacing of the flow grid", limits=Limits("mm", 0.002, 1.0), usual="29 cells per diameter"
    )
    """Grid spacing; None: `cells_per_diameter` cells across the vessel, but at most `cell_budget` cells in all."""
    refine: tuple[Region, ...] = setting(
        (),
        "refine",
        "where the grid is refined: with sac (and artery near it), inlet (and its jet) or a ball X,Y,Z,R the spacing "
        "holds only there, and twice it elsewhere; with branches, those below six cells across have down to a quarter",
        read_region,
        POSITION,
        metavar="WHERE",
        separators=";",
    )
    """Where the grid is refined (see `lattice.levels`)."""
    wires: Wires = setting(
        "screen",
        "wires",
        "wires over necks and branches: a flow resistance (screen), one read off wires that are walls in a piece of "
        "the neck (calibrated), walls on finer grids around them (resolved), or the best that takes less than ten "
        "minutes (auto)",
        str,
        choices=get_args(Wires),
        metavar="WORD",
    )
    """How the embedded engine takes the wires over necks and ostia: as media, or as walls on as many finer levels as
    they need for two to four cells across. Coarser levels have the media where wires are too thin for them. Calibrated
    media resist as the wires do (see `lattice.calibration`)."""
    cells_per_diameter: float = 29.0
    """Number of cells across the mean (hydraulic) diameter 4 V / A of the vessel, where no grid spacing is given."""
    cells_across_neck: float = 32.0
    """Least number of cells across a neck with a screen, on a finer level around it where no grid spacing is given."""
    cell_budget: float = 480_000.0
    """Maximum number of cells in the vessel, where no grid spacing is given; 4.6 times as many if wires are walls."""
    tolerance: float = 0.01
    """A flow has converged when every monitored quantity is expected to change by less than this fraction of itself,
    and the velocity in the sac by less than twice this fraction (root mean square). An unsteady flow has converged
    when the standard error of every time average is smaller than this fraction."""
    max_steps: int = 96_000
    """Maximum number of time steps of a steady flow on the finest grid kept. With a coarser level at most a third of
    them, with wires as walls of finer levels an eighth."""
    max_cycles: int = 4
    """Maximum number of cycles of a pulsatile flow."""
    cycle_tolerance: float = 0.02
    """A pulsatile flow has converged when two consecutive cycles differ by less than this fraction (root mean
    square)."""
    lattice_speed: float = 0.15
    """Peak speed in cells per time step. It sets the time step. In steady flow it affects the result through the
    relaxation times, that is through the spatial error, not through the error in time."""
    engine: str = setting(
        LATTICE, "engine", "flow engine: lattice_boltzmann, openfoam, or a plug-in", str, metavar="NAME"
    )
    """Flow engine: ``lattice_boltzmann``, ``openfoam``, or the name of a plug-in (`vstent.plugins`)."""
    processes: int = setting(1, "processes", "number of OpenFOAM processes", whole, Limits(low=1), short="-j")
    """Number of processes on this machine (OpenFOAM only)."""
    device_gpu: bool = setting(False, "gpu", "compute the flow on an NVIDIA GPU (needs the extra gpu)", flag)
    """Whether the embedded engine computes on a GPU (needs the extra ``gpu``); results differ in the last bits."""

    @property
    def coarser_levels(self) -> int:
        """Number of levels coarser than the grid spacing: one where it holds only in a part of the vessel."""
        return int(any(where != "branches" for where in self.refine))


@dataclass(frozen=True)
class FlowSettings:
    """Settings of a flow computation."""

    inflow_mL_s: float | None = setting(
        None,
        "flow-rate",
        "mean inflow of all inlets, such as '245 mL/min', '4.1 mL/s' or '0.27 m/s'; without a unit",
        flow_rate,
        Limits("mL/s", above=0.0, high=50.0, remark="240 mL/min are 4 mL/s"),
        usual="assumed: 0.27 m/s times their area, as in VaMPy",
        short="--inflow",
    )
    """Mean flow rate through all inlets together; None: that of `inlet_speed_m_s`."""
    inlet_speed_m_s: float | None = setting(
        None,
        "inlet-speed",
        "mean speed in every inlet, in place of --flow-rate",
        limits=Limits("m/s", above=0.0, high=2.0, remark="27 cm/s are 0.27 m/s"),
        usual="0.27",
    )
    """Mean speed in every inlet, where no flow rate is given; None: the flow that a measured profile has, or an assumed
    speed of 0.27 m/s."""
    profile: Profile | MeasuredProfile = setting(
        "developed",
        "inlet-profile",
        "velocity profile at the inlets: fully developed (developed), uniform (plug), that of a pulse in a long "
        "straight artery (womersley), or a measured one: a CSV file with columns x, y, z (mm), u, v, w (m/s)",
        str,
        choices=get_args(Profile),
        metavar="WORD|CSV",
        load=read_profile,
        is_file=True,
    )
    """Velocity profile at every inlet; that of Womersley is the developed one in steady flow. A measured one needs a
    single inlet."""
    blood: Blood = Blood()
    """The fluid."""
    waveform: Waveform | None = setting(
        None,
        "pulsatile",
        "pulsatile inflow: a CSV file with columns time (s) and flow (any unit), or the name of a published waveform: "
        + "; ".join(f"{name} ({source})" for name, source in SOURCES.items()),
        str,
        metavar="NAME|CSV",
        choices=tuple(SOURCES),
        alone=PUBLISHED,
        short="--waveform",
        load=read_waveform,
        is_file=True,
        off=("steady", "constant mean inflow (the default)"),
    )
    """Inflow waveform; None: steady inflow at the mean."""
    outlets: Outlets = setting(
        "zero_pressure",
        "outlets",
        "zero pressure; fixed shares of the flow, by Murray's law (diameter cubed of all outlets) or fork by fork or "
        "as given (split); or a "
        "resistance or Windkessel at each outlet, so that a covered branch loses flow",
        str,
        choices=get_args(Outlets),
    )
    """Zero pressure at every outlet; outflow in proportion to radius cubed (Murray 1926, PNAS 12, 207); outflow in
    shares (`shares`); or a `Resistance` at every outlet with which these are the shares without a device."""
    shares: tuple[float, ...] | None = setting(
        None,
        "outlet-shares",
        "shares of the flow of all outlets in their order, such as 3,2,1 (any unit)",
        numbers,
        Limits(above=0.0, high=1e6),
        usual="by diameter, see --outlet-exponent",
        metavar="S,S,...",
    )
    """Shares of the flow of all outlets, with ``split``, ``resistance`` and ``windkessel``; None: by diameter."""
    outlet_exponent: float = setting(
        3.0,
        "outlet-exponent",
        "power of the diameter by which every fork divides the flow",
        limits=Limits(low=1.0, high=4.0),
    )
    """Power of the diameter by which every fork divides the flow, where no shares are given."""
    elements: tuple[Elements, ...] | None = setting(
        None,
        "outlet-table",
        "resistances and compliance of all outlets in their order: a CSV file with columns R_p, C, R_d, or R alone, "
        "and the unit of the resistances in its title (mmHg s/mL, Pa s/m3 or dyn s/cm5)",
        str,
        metavar="CSV",
        load=read_elements,
        is_file=True,
        usual="from shares and mean pressure",
    )
    """Windkessel of every outlet, with ``resistance`` and ``windkessel``; None: from shares and mean pressure."""
    mean_pressure_mmHg: float = setting(
        93.0,
        "mean-pressure",
        "mean arterial pressure, from which the resistances of the outlets follow",
        limits=Limits("mmHg", 20.0, 200.0),
    )
    """Mean pressure at the outlets without a device, with resistances and Windkessels."""
    compliance_time_s: float = setting(
        0.69,
        "windkessel-time",
        "resistance times compliance of the Windkessel at every outlet",
        limits=Limits("s", 0.05, 5.0),
    )
    """Resistance times compliance of every Windkessel: 0.69-0.70 s at all terminal arteries of the circle of Willis in
    Alastruey et al. 2007, J. Biomech. 40, 1794."""
    proximal_fraction: float = setting(
        0.44,
        "windkessel-proximal",
        "share of the resistance of a Windkessel that lies before its compliance",
        limits=Limits(low=0.01, high=0.99),
    )
    """Part of the resistance of a Windkessel before its compliance: 0.44 is the characteristic impedance over the
    terminal resistance of all cerebral arteries there."""
    numerics: Numerics = Numerics()
    """How it is computed."""
