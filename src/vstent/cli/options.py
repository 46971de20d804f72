"""Options that several commands share, and what they say to a study."""

import argparse
import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from vstent.errors import InputError

if TYPE_CHECKING:
    from vstent.flow.case import Blood, FlowSettings, Waveform
    from vstent.plan.uncertainty import Ranges

EPILOG: Final = (
    "Research use only: not cleared for diagnosis or treatment. Lengths in mm, flow in SI; coordinates are LPS."
)
PUBLISHED: Final = "published"
"""The waveform where none is given."""
LONGEST_CYCLE_S: Final = 3.0
SHORTEST_CYCLE_S: Final = 0.2
"""Cycles of hearts: 20 to 300 beats a minute."""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""What a command adds itself to."""


def number(text: str) -> float:
    """Read a number; argparse makes a sentence of the complaint."""
    return _numbers(text, float, 1)[0]


def positive(text: str) -> float:
    """Read a number above zero."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above zero")
    return value


def within(low: float, high: float, remark: str) -> Callable[[str], float]:
    """Return what reads a number between two; `remark` names the unit, and how another is turned into it."""

    def read(text: str) -> float:
        value = number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not {low:g} to {high:g} {remark}")
        return value

    return read


def add_command(commands: Commands, name: str, text: str) -> argparse.ArgumentParser:
    """Add a command with its line of help."""
    parser = commands.add_parser(name, help=text, description=text, epilog=EPILOG)
    # What begins with a digit behind the minus is a number or a point, no option; argparse knows -1 alone.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    return parser


def add_geometry(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add the input, the folder, and what may be said of the vessel; return the group of the latter."""
    parser.add_argument(
        "input", type=Path, help="DICOM folder, NIfTI, NRRD, MHA, raw volume, STL, VTP, VTK, OBJ or PLY"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="case folder to write, or to go on with")
    return add_given(parser)


def add_given(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add what may be said of the vessel; return the group."""
    given = parser.add_argument_group("instead of what is guessed or proposed")
    given.add_argument("--units", choices=("m", "cm", "mm"), help="length unit of a surface file")
    given.add_argument("--spacing", type=_spacing, metavar="S|X,Y,Z", help="voxel edges of a raw volume, mm")
    given.add_argument("--shape", type=_shape, metavar="I,J,K", help="voxel counts of a raw volume")
    given.add_argument("--threshold", type=number, metavar="T", help="intensity of the lumen's wall in a scan")
    given.add_argument("--at", type=_point, metavar="X,Y,Z", help="a point near the sac, mm")
    given.add_argument(
        "--inlet",
        type=_point,
        action="append",
        metavar="X,Y,Z",
        help="a point near the inlet, mm; again for each further opening that brings blood",
    )
    return given


def add_outlet(given: "argparse._ArgumentGroup") -> None:
    """Add the point that picks the parent artery's outlet, and how much of the vessel is kept."""
    given.add_argument("--outlet", type=_point, metavar="X,Y,Z", help="a point near the parent artery's outlet, mm")
    given.add_argument("--upstream", type=positive, metavar="MM", help="artery to keep before the sac's middle (35)")
    given.add_argument("--downstream", type=positive, metavar="MM", help="vessel to keep beyond the sac's middle (25)")


def add_neck(given: "argparse._ArgumentGroup") -> None:
    """Add a neck that was drawn."""
    given.add_argument(
        "--neck", type=Path, metavar="CSV", help="the neck: columns x, y, z in mm of points along a closed curve"
    )


def add_devices(parser: argparse.ArgumentParser) -> None:
    """Add the choice of devices."""
    parser.add_argument(
        "--device", action="append", metavar="NAME", help="a device of the catalogue; repeatable (silk, enterprise)"
    )


def add_problem(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add which flow it is, whatever computes it; return the group."""
    flow = parser.add_argument_group("flow")
    flow.add_argument(
        "--flow-rate", type=positive, metavar="ML_S", help="mean inflow, all inlets' (0.27 m/s times their area)"
    )
    flow.add_argument("--cell-size", type=positive, metavar="MM", help="edge of a flow cell")
    pulse = flow.add_mutually_exclusive_group()
    pulse.add_argument("--steady", action="store_true", help="at the mean inflow, not pulsing (the default)")
    pulse.add_argument(
        "--pulsatile",
        nargs="?",
        const=PUBLISHED,
        metavar="CSV",
        help="follow a pulse: columns time in s and flow in any unit (the published one of the internal carotid)",
    )
    density, viscosity = within(900, 1200, "kg/m3: 1.06 g/mL are 1060"), within(0.001, 0.1, "Pa s: 4 mPa s are 0.004")
    flow.add_argument("--density", type=density, default=1060.0, metavar="KG_M3", help="of blood (1060)")
    flow.add_argument("--viscosity", type=viscosity, metavar="PA_S", help="of blood (0.004; at high shear 0.00345)")
    flow.add_argument(
        "--thinning", action="store_true", help="blood thins with the shear rate, as Carreau and Yasuda's law has it"
    )
    flow.add_argument("--outlets", choices=("zero_pressure", "murray"), default="zero_pressure", help="outlet law")
    return flow


def add_processes(group: "argparse._ArgumentGroup") -> None:
    """Add how many processes OpenFOAM is given."""
    group.add_argument("-j", "--processes", type=_jobs, default=1, metavar="N", help="processes for OpenFOAM (1)")


def add_flow(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add which flow it is and how it is computed; return the group."""
    flow = add_problem(parser)
    flow.add_argument(
        "--engine", default="lattice_boltzmann", metavar="NAME", help="openfoam, or a plug-in that computes the flow"
    )
    add_processes(flow)
    flow.add_argument(
        "--close-up",
        action="store_true",
        help="cells of that size only in the sac and near it, twice as wide elsewhere",
    )
    flow.add_argument("--device-gpu", action="store_true", help="compute the flow on an NVIDIA GPU (the extra gpu)")
    return flow


def add_jobs(group: "argparse._ArgumentGroup") -> None:
    """Add how many processes work at once."""
    group.add_argument("--jobs", type=_jobs, default=_cores(), metavar="N", help="processes at once (one a core)")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _jobs(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes such as 2")
    return int(text)


def numbers(text: str) -> list[float]:
    """Read numbers parted by commas."""
    return _numbers(text, float)


def add_uncertainty(parser: argparse.ArgumentParser) -> None:
    """Add what is varied to tell how sure the results are."""
    group = parser.add_argument_group("uncertainty")
    group.add_argument("--uncertainty", type=int, metavar="N", help="deploy N times with what is not sure varied")
    group.add_argument(
        "--uncertain-flows",
        type=int,
        default=0,
        metavar="M",
        help="compute the flows of M of them too, before and after",
    )
    group.add_argument(
        "--vary",
        type=_cause,
        action="append",
        default=[],
        metavar="CAUSE=RANGE",
        help="how far to either side: threshold=MM (of all diameters; the scan's own band), landing=MM (1), "
        "device=MM (0.1), inflow=FRACTION (0.2)",
    )


RANGES: Final = {
    "threshold": "threshold_mm",
    "landing": "landing_mm",
    "device": "device_mm",
    "inflow": "inflow_fraction",
}
"""Causes of uncertainty on the command line, and the fields that hold their ranges."""


def _cause(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return RANGES[name], float(value)
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r} is none of {'=, '.join(RANGES)}= with a number") from None


def given_ranges(arguments: argparse.Namespace) -> "Ranges | None":
    """Collect what is to be varied, and how far."""
    if arguments.uncertainty is None:
        if arguments.vary or arguments.uncertain_flows:
            raise InputError(
                "--vary and --uncertain-flows say how --uncertainty is to be done: give --uncertainty N too"
            )
        return None
    from vstent.plan.uncertainty import Ranges

    return Ranges(arguments.uncertainty, arguments.uncertain_flows, **dict(arguments.vary))


def _numbers(text: str, kind: type, count: int | None = None) -> list[float]:
    """Read numbers parted by commas, `count` of them where that is said."""
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
    first, second, third = _numbers(text, kind, 3)
    return first, second, third


def _point(text: str) -> tuple[float, float, float]:
    return _three(text, float)


def _shape(text: str) -> tuple[float, float, float]:
    return _three(text, int)


def _spacing(text: str) -> tuple[float, float, float]:
    return _three(text if "," in text else ",".join([text] * 3), float)


def given_geometry(arguments: argparse.Namespace) -> dict[str, Any]:
    """Collect what was said of the vessel, under the names of the settings."""
    return {
        "units": arguments.units,
        "spacing_mm": arguments.spacing,
        "shape": arguments.shape,
        "threshold": arguments.threshold,
        "at_mm": arguments.at,
        "inlet_mm": tuple(arguments.inlet) if arguments.inlet else None,
        "outlet_mm": getattr(arguments, "outlet", None),
        "upstream_mm": getattr(arguments, "upstream", None),
        "downstream_mm": getattr(arguments, "downstream", None),
        "neck_mm": _neck(getattr(arguments, "neck", None)),
    }


def _neck(path: Path | None) -> tuple[tuple[float, float, float], ...] | None:
    from vstent.io.tables import read_columns

    return None if path is None else tuple((x, y, z) for x, y, z in read_columns(path, 3).tolist())


def given_devices(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Names of the devices, each once; the paper's two where none is given."""
    return tuple(dict.fromkeys(arguments.device or ("silk", "enterprise")))


def given_problem(arguments: argparse.Namespace) -> "FlowSettings":
    """Collect which flow it is."""
    from vstent.flow.case import FlowSettings

    return FlowSettings(
        inflow_mL_s=arguments.flow_rate,
        blood=_blood(arguments),
        waveform=_waveform(arguments.pulsatile),
        outlets=arguments.outlets,
        cell_size_mm=arguments.cell_size,
    )


def given_flow(arguments: argparse.Namespace) -> "FlowSettings":
    """Collect which flow it is and how it is computed."""
    from vstent.flow.lattice.gpu import require_gpu
    from vstent.flow.simulation import engine_class

    settings = replace(
        given_problem(arguments),
        close_up=arguments.close_up,
        engine=arguments.engine,
        processes=arguments.processes,
        device_gpu=arguments.device_gpu,
    )
    engine_class(settings)  # what cannot be is told before anything is computed
    if settings.device_gpu:
        require_gpu()
    return settings


def _blood(arguments: argparse.Namespace) -> "Blood":
    from vstent.flow.case import HIGH_SHEAR_VISCOSITY_PA_S, Blood, CarreauYasuda

    if not arguments.thinning:
        return Blood(arguments.density, arguments.viscosity or Blood.viscosity_Pa_s)
    return Blood(arguments.density, arguments.viscosity or HIGH_SHEAR_VISCOSITY_PA_S, CarreauYasuda())


def _waveform(source: str | None) -> "Waveform | None":
    from vstent.flow.waveform import OLDER_ADULT_ICA, waveform_of
    from vstent.io.tables import read_columns

    if source is None or source == PUBLISHED:
        return OLDER_ADULT_ICA if source else None
    time_s, flow = read_columns(Path(source), 2).T
    waveform = waveform_of(time_s, flow)
    if not SHORTEST_CYCLE_S <= waveform.period_s <= LONGEST_CYCLE_S:
        raise InputError(
            f"the cycle in {source} takes {waveform.period_s:g} s, and a heart's {SHORTEST_CYCLE_S:g} to "
            f"{LONGEST_CYCLE_S:g}: give one cycle, its times in seconds"
        )
    return waveform
