"""Command-line options that several commands share, and the settings that they fill."""

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from vstent.errors import InputError
from vstent.flow.settings import Numerics

if TYPE_CHECKING:
    from vstent.devices.treatment import Treatment
    from vstent.flow.settings import Blood, FlowSettings, Waveform
    from vstent.plan.uncertainty import Ranges
    from vstent.study.crews import AbstractCrew

EPILOG: Final = "Lengths are in mm, coordinates are LPS. Research use only: not cleared for diagnosis or treatment."
"""Last line of every help text."""
DEVICES: Final = ("silk", "enterprise")
"""Devices where none is given: those of the paper."""
PUBLISHED: Final = "published"
"""Value of ``--pulsatile`` without a file: the published waveform."""
LONGEST_CYCLE_S: Final = 3.0
"""Longest cardiac cycle accepted, in s: 20 beats a minute."""
SHORTEST_CYCLE_S: Final = 0.2
"""Shortest cardiac cycle accepted, in s: 300 beats a minute."""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Parser to which every command adds itself."""


def number(text: str) -> float:
    """Return a number read from text."""
    return _numbers(text, float, 1)[0]


def positive(text: str) -> float:
    """Return a number above zero read from text."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above zero")
    return value


def within(low: float, high: float, remark: str) -> Callable[[str], float]:
    """Return a function that reads a number and rejects it outside a range.

    Parameters
    ----------
    low, high : ends of the range.
    remark : unit and an example of a conversion into it, for the error message.
    """

    def read(text: str) -> float:
        value = number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not {low:g} to {high:g} {remark}")
        return value

    return read


def add_command(commands: Commands, name: str, text: str, example: str) -> argparse.ArgumentParser:
    """Add a command.

    Parameters
    ----------
    commands : parser to which the command is added.
    name : name of the command.
    text : summary, one sentence.
    example : arguments of an example, after ``vstent``.
    """
    parser = commands.add_parser(
        name,
        help=text[0].lower() + text[1:].rstrip("."),
        description=text,
        epilog=f"Example:\n  vstent {example}\n\n{EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    # A minus before a digit begins a number or a point; argparse recognizes single numbers only.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    return parser


def add_geometry(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add input, case folder and the options on the vessel; return the group of these options."""
    parser.add_argument(
        "input",
        type=Path,
        help="scan (DICOM folder, NIfTI, NRRD, MHA, VTI, raw) or surface (STL, VTP, VTU, VTK, OBJ, PLY)",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="case folder; a folder that exists is continued"
    )
    parser.add_argument(
        "--replace",
        action="store_true",
        help="replace results in the case folder that belong to another input or other settings (default: refuse)",
    )
    return add_given(parser)


def add_given(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add the options on the vessel; return their group."""
    given = parser.add_argument_group("override automatic choices")
    given.add_argument(
        "--units", choices=("m", "cm", "mm"), help="length unit of a surface file (default: derived from its size)"
    )
    given.add_argument(
        "--frame",
        choices=("lps", "ras"),
        help="frame of a surface file and of points (default: as stated in the file, else lps)",
    )
    given.add_argument(
        "--acquisition",
        type=_count,
        metavar="N",
        help="acquisition of a DICOM series with several (default: the brightest)",
    )
    given.add_argument("--spacing", type=_spacing, metavar="S|X,Y,Z", help="voxel spacing of a raw volume, mm")
    given.add_argument(
        "--shape", type=_shape, metavar="I,J,K", help="number of voxels of a raw volume, fastest axis first"
    )
    given.add_argument(
        "--crop",
        type=_box,
        metavar="X,Y,Z,X,Y,Z",
        help="opposite corners, mm, of the box along the image axes to which a scan is cropped (default: whole scan)",
    )
    given.add_argument(
        "--threshold",
        type=number,
        metavar="T",
        help="intensity at the lumen wall of a scan (default: half way between tissue and lumen)",
    )
    given.add_argument(
        "--at", type=_point, metavar="X,Y,Z", help="point in or near the aneurysm, mm (default: the largest sac)"
    )
    given.add_argument(
        "--inlet",
        type=_point,
        action="append",
        metavar="X,Y,Z",
        help="point near the inlet, mm (default: the widest opening); repeat for further inlets",
    )
    return given


def add_outlet(given: "argparse._ArgumentGroup") -> None:
    """Add the outlet of the parent artery and the lengths of vessel to keep."""
    given.add_argument("--outlet", type=_point, metavar="X,Y,Z", help="point near the outlet of the parent artery, mm")
    given.add_argument(
        "--upstream", type=positive, metavar="MM", help="length of artery kept proximal to the sac, mm (default: 35)"
    )
    given.add_argument(
        "--downstream", type=positive, metavar="MM", help="length of vessel kept distal to the sac, mm (default: 25)"
    )


def add_neck(given: "argparse._ArgumentGroup") -> None:
    """Add the option for a neck drawn by hand."""
    given.add_argument(
        "--neck",
        type=Path,
        metavar="CSV",
        help="neck drawn by hand: columns x, y, z in mm of points along a closed curve",
    )


def add_devices(parser: argparse.ArgumentParser) -> None:
    """Add the choice of devices."""
    parser.add_argument(
        "--device",
        action="append",
        metavar="NAME",
        help="device of the catalogue; repeat for several, each a treatment (default: silk and enterprise)",
    )


def add_treatments(parser: argparse.ArgumentParser) -> None:
    """Add the choice of treatments: devices alone, and several devices together."""
    add_devices(parser)
    parser.add_argument(
        "--treatment",
        type=_treatment,
        action="append",
        metavar="TEXT",
        help="treatment of several devices in the order of their deployment, each inside those before it, such as "
        "'silk 4x20 + silk@-4': with a size, or with a shift of the proposed place in mm; NAME= before it names it",
    )


def add_problem(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add the options of the flow problem; return their group."""
    flow = parser.add_argument_group("flow")
    flow.add_argument(
        "--flow-rate",
        type=positive,
        metavar="ML_S",
        help="mean inflow of all inlets, mL/s (default: 0.27 m/s times their area)",
    )
    flow.add_argument(
        "--grid-spacing",
        type=positive,
        metavar="MM",
        help="spacing of the flow grid, mm (default: 29 cells per diameter)",
    )
    pulse = flow.add_mutually_exclusive_group()
    pulse.add_argument("--steady", action="store_true", help="constant mean inflow (the default)")
    pulse.add_argument(
        "--pulsatile",
        nargs="?",
        const=PUBLISHED,
        metavar="CSV",
        help="pulsatile inflow: a CSV file with columns time (s) and flow (any "
        "unit); without a file the published waveform of "
        "the internal carotid artery (Hoi et al. 2010)",
    )
    density, viscosity = within(900, 1200, "kg/m3: 1.06 g/mL are 1060"), within(0.001, 0.1, "Pa s: 4 mPa s are 0.004")
    flow.add_argument(
        "--density", type=density, default=1060.0, metavar="KG_M3", help="density of blood, kg/m3 (default: 1060)"
    )
    flow.add_argument(
        "--viscosity",
        type=viscosity,
        metavar="PA_S",
        help="viscosity of blood, Pa s (default: 0.004; with --shear-thinning 0.00345 at high shear)",
    )
    flow.add_argument(
        "--shear-thinning", action="store_true", help="shear-thinning blood (Carreau-Yasuda; default: Newtonian)"
    )
    flow.add_argument(
        "--outlets",
        choices=("zero_pressure", "murray"),
        default="zero_pressure",
        help="zero pressure at the outlets (default), or flow split by Murray's law (diameter cubed)",
    )
    return flow


def add_processes(group: "argparse._ArgumentGroup") -> None:
    """Add the number of OpenFOAM processes."""
    group.add_argument(
        "-j", "--processes", type=_jobs, default=1, metavar="N", help="number of OpenFOAM processes (default: 1)"
    )


def add_flow(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add the flow problem and how it is computed; return the group."""
    flow = add_problem(parser)
    flow.add_argument(
        "--engine",
        default="lattice_boltzmann",
        metavar="NAME",
        help="flow engine: lattice_boltzmann (default), openfoam, or a plug-in",
    )
    add_processes(flow)
    flow.add_argument(
        "--refine-sac",
        action="store_true",
        help="use the grid spacing only in and near the sac, and twice it elsewhere",
    )
    flow.add_argument("--gpu", action="store_true", help="compute the flow on an NVIDIA GPU (needs the extra gpu)")
    return flow


def add_jobs(group: "argparse._ArgumentGroup") -> None:
    """Add the number of parallel processes."""
    group.add_argument(
        "--jobs", type=_jobs, default=cores(), metavar="N", help="parallel processes (default: one per core)"
    )


def add_crew(group: "argparse._ArgumentGroup") -> None:
    """Add the number of parallel processes, and the clusters that may be used in their place."""
    add_jobs(group)
    crew = group.add_mutually_exclusive_group()
    crew.add_argument("--scheduler", metavar="ADDRESS", help="use the workers of this Dask scheduler")
    crew.add_argument("--slurm", action="store_true", help="use --jobs jobs of a Slurm queue (needs the extra cluster)")


def given_crew(arguments: argparse.Namespace, jobs: int, memory_MB: float) -> "AbstractCrew":
    """Return the processes or the cluster that the options request.

    Parameters
    ----------
    arguments : the parsed options.
    jobs : number of parallel processes for which this machine's memory suffices.
    memory_MB : estimated memory of one task; 0: unknown.

    Raises
    ------
    InputError
        A Slurm job is requested whose memory is unknown.
    """
    from vstent.study.crews import DaskCluster, Processes, Slurm

    if arguments.scheduler:
        return DaskCluster(arguments.scheduler)
    if arguments.slurm and not memory_MB:
        raise InputError("The memory of a flow with this engine is unknown. Use --scheduler instead of --slurm.")
    if arguments.slurm:
        return Slurm(arguments.jobs, memory_MB)
    return Processes(jobs)


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def whole(text: str) -> int:
    """Return a whole number above zero read from text."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return int(text)


def _jobs(text: str) -> int:
    """Return a number of processes read from text."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes: give a whole number such as 2")
    return int(text)


def numbers(text: str) -> list[float]:
    """Return numbers separated by commas, read from text."""
    return _numbers(text, float)


def add_uncertainty(parser: argparse.ArgumentParser) -> None:
    """Add the options of the uncertainty study."""
    group = parser.add_argument_group("uncertainty")
    group.add_argument(
        "--uncertainty", type=int, metavar="N", help="deploy N times with uncertain inputs varied (default: off)"
    )
    group.add_argument(
        "--uncertainty-flows",
        type=int,
        default=0,
        metavar="M",
        help="also compute the flows of M of these deployments (default: 0)",
    )
    group.add_argument(
        "--vary",
        type=_cause,
        action="append",
        default=[],
        metavar="CAUSE=RANGE",
        help="range to either side: threshold=MM (change of diameters; "
        "default: the scan's own), landing=MM (default: 1), "
        "device=MM (default: 0.1), inflow=FRACTION (default: 0.2), numbers=FACTOR (of the ranges of the device's "
        "numbers in the catalogue, 0 to 1; default: 1)",
    )


RANGES: Final = {
    "threshold": "threshold_mm",
    "landing": "landing_mm",
    "device": "device_mm",
    "inflow": "inflow_fraction",
    "numbers": "numbers_factor",
}
"""Causes of uncertainty on the command line, and the fields that hold their ranges."""


def _cause(text: str) -> tuple[str, float]:
    """Return field and range of a cause of uncertainty read from text."""
    name, _, value = text.partition("=")
    try:
        return RANGES[name], float(value)
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r} is not one of {'=, '.join(RANGES)}= with a number") from None


def given_ranges(arguments: argparse.Namespace) -> "Ranges | None":
    """Return the ranges of the uncertainty study; None where it is off."""
    if arguments.uncertainty is None:
        if arguments.vary or arguments.uncertainty_flows:
            raise InputError("--vary and --uncertainty-flows need --uncertainty N: give that too")
        return None
    from vstent.plan.uncertainty import Ranges

    return Ranges(arguments.uncertainty, arguments.uncertainty_flows, **dict(arguments.vary))


def _numbers(text: str, kind: type, count: int | None = None) -> list[float]:
    """Return numbers separated by commas, `count` of them unless that is None."""
    try:
        numbers = [kind(part) for part in text.replace("x", ",").split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not {'a number' if count == 1 else 'like 1,2,3'}") from None
    if count is not None and len(numbers) != count:
        raise argparse.ArgumentTypeError(f"{text!r} has {len(numbers)} numbers, not {count}")
    if not all(math.isfinite(value) for value in numbers):
        raise argparse.ArgumentTypeError(f"{text!r} is not finite")
    return numbers


def _three(text: str, kind: type) -> tuple[float, float, float]:
    """Return three numbers read from text."""
    first, second, third = _numbers(text, kind, 3)
    return first, second, third


def _count(text: str) -> int:
    """Return a whole number above zero read from text."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return int(text)


def _point(text: str) -> tuple[float, float, float]:
    """Return a point read from text."""
    return _three(text, float)


def _box(text: str) -> tuple["Point", "Point"]:
    """Return two points read from text."""
    a, b, c, d, e, f = _numbers(text, float, 6)
    return (a, b, c), (d, e, f)


def _shape(text: str) -> tuple[float, float, float]:
    """Return the numbers of voxels read from text."""
    return _three(text, int)


def _spacing(text: str) -> tuple[float, float, float]:
    """Return three voxel edges read from text; one number stands for all three."""
    return _three(text if "," in text else ",".join([text] * 3), float)


def given_geometry(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options on input and anatomy as sections of the settings, with points in LPS mm."""
    from vstent.study.types import AnatomySettings, InputSettings

    given: dict[str, Any] = {name: getattr(arguments, name, None) for name in GEOMETRY}
    in_lps = _from_ras if given["frame"] == "ras" else _as_given
    at, outlet, neck, crop = given["at"], given["outlet"], _neck(given["neck"]), given["crop"]
    return {
        "input": InputSettings(
            units=given["units"],
            frame=given["frame"],
            acquisition=given["acquisition"],
            spacing_mm=given["spacing"],
            shape=given["shape"],
            crop_mm=crop and tuple(map(in_lps, crop)),
            threshold=given["threshold"],
        ),
        "anatomy": AnatomySettings(
            at_mm=at and in_lps(at),
            inlet_mm=tuple(map(in_lps, given["inlet"])) if given["inlet"] else None,
            outlet_mm=outlet and in_lps(outlet),
            neck_mm=neck and tuple(map(in_lps, neck)),
            upstream_mm=given["upstream"],
            downstream_mm=given["downstream"],
        ),
    }


GEOMETRY: Final = (
    *("units", "frame", "acquisition", "spacing", "shape", "crop", "threshold"),
    *("at", "inlet", "outlet", "neck", "upstream", "downstream"),
)
"""Options on input and anatomy; a command may lack some."""
Point: TypeAlias = tuple[float, float, float]
"""Coordinates in mm."""


def _as_given(point_mm: Point) -> Point:
    """Return a point unchanged."""
    return point_mm


def _from_ras(point_mm: Point) -> Point:
    """Return a RAS point in LPS."""
    return -point_mm[0], -point_mm[1], point_mm[2]


def _neck(path: Path | None) -> tuple[tuple[float, float, float], ...] | None:
    """Return the points of a CSV file; None without a file."""
    from vstent.io.tables import read_columns

    return None if path is None else tuple((x, y, z) for x, y, z in read_columns(path, 3).tolist())


def given_treatments(arguments: argparse.Namespace, usual: Sequence[str] = DEVICES) -> "tuple[Treatment, ...]":
    """Return the treatments that the options state; where none is, those of the usual devices."""
    from vstent.devices.treatment import with_device

    size = {
        "diameter_mm": getattr(arguments, "diameter", None),
        "length_mm": getattr(arguments, "length", None),
        "center_mm": getattr(arguments, "center", None),
    }
    several = tuple(getattr(arguments, "treatment", None) or ())
    devices = arguments.device or (() if several else usual)
    return (*(with_device(name, **size) for name in devices), *several)


def _treatment(text: str) -> "Treatment":
    """Return a treatment read from text."""
    from vstent.devices.treatment import read_treatment

    try:
        return read_treatment(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def given_problem(arguments: argparse.Namespace) -> "FlowSettings":
    """Return the settings of the flow problem."""
    from vstent.flow.settings import FlowSettings

    return FlowSettings(
        inflow_mL_s=arguments.flow_rate,
        blood=_blood(arguments),
        waveform=_waveform(arguments.pulsatile),
        outlets=arguments.outlets,
        numerics=Numerics(cell_size_mm=arguments.grid_spacing),
    )


def given_flow(arguments: argparse.Namespace) -> "FlowSettings":
    """Return the settings of the flow problem and of its computation."""
    from vstent.flow.lattice.gpu import require_gpu
    from vstent.flow.simulation import engine_class

    settings = given_problem(arguments)
    numerics = replace(
        settings.numerics,
        close_up=arguments.refine_sac,
        engine=arguments.engine,
        processes=arguments.processes,
        device_gpu=arguments.gpu,
    )
    # An unknown engine is reported before anything is computed.
    engine_class(numerics, is_pulsatile=settings.waveform is not None)
    if numerics.device_gpu:
        require_gpu()
    return replace(settings, numerics=numerics)


def _blood(arguments: argparse.Namespace) -> "Blood":
    """Return the blood properties that the options state."""
    from vstent.flow.settings import HIGH_SHEAR_VISCOSITY_PA_S, Blood, CarreauYasuda

    if not arguments.shear_thinning:
        return Blood(arguments.density, arguments.viscosity or Blood.viscosity_Pa_s)
    return Blood(arguments.density, arguments.viscosity or HIGH_SHEAR_VISCOSITY_PA_S, CarreauYasuda())


def _waveform(source: str | None) -> "Waveform | None":
    """Return the inflow waveform; None for a steady flow."""
    from vstent.flow.waveform import OLDER_ADULT_ICA, waveform_of
    from vstent.io.tables import read_columns

    if source is None or source == PUBLISHED:
        return OLDER_ADULT_ICA if source else None
    time_s, flow = read_columns(Path(source), 2).T
    waveform = waveform_of(time_s, flow)
    if not SHORTEST_CYCLE_S <= waveform.period_s <= LONGEST_CYCLE_S:
        raise InputError(
            f"the cycle in {source} lasts {waveform.period_s:g} s, a cardiac cycle {SHORTEST_CYCLE_S:g} to "
            f"{LONGEST_CYCLE_S:g} s: give one cycle with times in seconds"
        )
    return waveform
