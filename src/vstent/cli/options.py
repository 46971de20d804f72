"""Options that several commands share, and the settings that they make."""

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from vstent.errors import InputError

if TYPE_CHECKING:
    from vstent.flow.case import Blood, FlowSettings, Waveform
    from vstent.plan.uncertainty import Ranges

RENAMED: Final = {
    "--cell-size": "--grid-spacing",
    "--close-up": "--refine-sac",
    "--thinning": "--shear-thinning",
    "--device-gpu": "--gpu",
    "--uncertain-flows": "--uncertainty-flows",
    "--files": "--keep-files",
    "--crate": "--ro-crate",
}
"""Old names of options, still accepted, and their present names."""
REMOVED_IN: Final = "0.3"
"""Version that no longer accepts the old names."""

EPILOG: Final = (
    "Research use only: not cleared for diagnosis or treatment.\n"
    "Lengths and LPS coordinates are in mm, flow rates in mL/s."
)
"""Last lines of every help text."""
PUBLISHED: Final = "published"
"""Value of ``--pulsatile`` without a file: the published waveform of the internal carotid artery."""
LONGEST_CYCLE_S: Final = 3.0
"""Longest accepted cardiac cycle, s: 20 beats per minute."""
SHORTEST_CYCLE_S: Final = 0.2
"""Shortest accepted cardiac cycle, s: 300 beats per minute."""

INPUT: Final = "input"
OVERRIDES: Final = "override automatic choices"
DEVICES: Final = "devices"
RANKING: Final = "ranking"
FLOW: Final = "flow"
UNCERTAINTY: Final = "uncertainty"
OPENFOAM: Final = "OpenFOAM case"
PAGE: Final = "browser page"
OUTPUT: Final = "output"
PARALLEL: Final = "parallel work"
GROUPS: Final = (INPUT, OVERRIDES, DEVICES, RANKING, FLOW, UNCERTAINTY, OPENFOAM, PAGE, OUTPUT, PARALLEL)
"""Titles of the groups of options, in the order of the help text; groups without options are not shown."""
SCANS: Final = "DICOM folder, NIfTI, NRRD, MHA or raw volume; or a surface: STL, VTP, VTK, OBJ or PLY"
"""Supported inputs, for help texts."""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Collection of sub-commands to which a command adds itself."""
Group: TypeAlias = "argparse._ArgumentGroup"
"""Titled group of options in the help text."""


def with_present_names(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Replace old names of options by their present names.

    Parameters
    ----------
    words : the arguments of the command line. Nothing after ``--`` is replaced.

    Returns
    -------
    words : the same arguments with present names; ``--old=value`` becomes ``--new=value``.
    notices : one sentence for each old name that was replaced.
    """
    end = words.index("--") if "--" in words else len(words)
    present, used = [], []
    for word in words[:end]:
        name, equals, value = word.partition("=")
        used += [name] if name in RENAMED else []
        present.append(RENAMED.get(name, name) + equals + value)
    notices = [
        f"note: {name} is now {RENAMED[name]}; the old name will be removed in version {REMOVED_IN}."
        for name in dict.fromkeys(used)
    ]
    return [*present, *words[end:]], notices


def number(text: str) -> float:
    """Convert the text of an option to a finite number."""
    return _numbers(text, float, 1)[0]


def positive(text: str) -> float:
    """Convert the text of an option to a number greater than zero."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above zero")
    return value


def within(low: float, high: float, remark: str) -> Callable[[str], float]:
    """Return a converter that accepts numbers from `low` to `high`.

    Parameters
    ----------
    low, high : the accepted range.
    remark : the unit, and an example of the conversion from another unit; it ends the error message.
    """

    def read(text: str) -> float:
        value = number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is outside {low:g} to {high:g} {remark}")
        return value

    return read


def add_command(commands: Commands, name: str, summary: str, example: str) -> argparse.ArgumentParser:
    """Add a command.

    Parameters
    ----------
    commands : the collection of commands.
    name : name of the command.
    summary : one sentence that says what the command does.
    example : a complete command line, shown at the end of the help text.
    """
    parser = commands.add_parser(name, help=summary, description=summary, **appearance(example))
    # argparse takes only numbers such as -1 for values; points such as -1,2,3 are values too.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    for title in GROUPS:
        group(parser, title)
    return parser


def appearance(example: str) -> dict[str, Any]:
    """Return the arguments that every parser has: the layout of its help text, and the example at its end."""
    return {
        "epilog": f"example:\n  {example}\n\n{EPILOG}",
        "formatter_class": partial(argparse.RawDescriptionHelpFormatter, max_help_position=32),
        "allow_abbrev": False,
    }


def group(parser: argparse.ArgumentParser, title: str) -> Group:
    """Return the parser's group of options with this title; add it where there is none."""
    found = [one for one in parser._action_groups if one.title == title]
    return found[0] if found else parser.add_argument_group(title)


def add_geometry(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add the input, the case folder, and the options that describe the vessel; `more` names further inputs."""
    group(parser, INPUT).add_argument("input", type=Path, help=SCANS + more)
    group(parser, OUTPUT).add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="case folder to write; finished stages in it are reused (required)",
    )
    add_given(parser)


def add_given(parser: argparse.ArgumentParser) -> None:
    """Add the options that describe the input, and those that override how the vessel is found."""
    source = group(parser, INPUT)
    source.add_argument(
        "--units",
        choices=("m", "cm", "mm"),
        help="length unit of a surface file (default: the one that gives the size of an intracranial vessel)",
    )
    source.add_argument(
        "--spacing",
        type=_spacing,
        metavar="S|X,Y,Z",
        help="voxel size, mm, one number or three: of a raw volume, or instead of that in the header (default: header)",
    )
    source.add_argument(
        "--shape",
        type=_shape,
        metavar="I,J,K",
        help="number of voxels of a raw volume along each axis (no default: a raw volume needs it)",
    )
    given = group(parser, OVERRIDES)
    given.add_argument(
        "--threshold",
        type=number,
        metavar="T",
        help="intensity of the vessel wall in a scan, in its own unit (default: half way between tissue and lumen)",
    )
    given.add_argument(
        "--at",
        type=_point,
        metavar="X,Y,Z",
        help="a point near the sac, mm (default: the largest vessel, and every sac on its parent artery)",
    )
    given.add_argument(
        "--inlet",
        type=_point,
        action="append",
        metavar="X,Y,Z",
        help="a point near the inlet, mm; repeat the option for further inlets (default: the widest opening)",
    )


def add_outlet(parser: argparse.ArgumentParser) -> None:
    """Add the outlet of the parent artery, and the lengths of vessel that are kept."""
    given = group(parser, OVERRIDES)
    given.add_argument(
        "--outlet",
        type=_point,
        metavar="X,Y,Z",
        help="a point near the outlet of the parent artery, mm (default: the end of the widest continuation)",
    )
    given.add_argument(
        "--upstream",
        type=positive,
        metavar="MM",
        help="length of artery to keep upstream of the middle of the sac, mm (default: 35)",
    )
    given.add_argument(
        "--downstream",
        type=positive,
        metavar="MM",
        help="length of vessel to keep downstream of the middle of the sac, mm (default: 25)",
    )


def add_neck(parser: argparse.ArgumentParser) -> None:
    """Add a neck drawn by hand."""
    group(parser, OVERRIDES).add_argument(
        "--neck",
        type=Path,
        metavar="CSV",
        help="closed curve around the neck: columns x, y, z in mm (default: the neck is found automatically)",
    )


def add_devices(parser: argparse.ArgumentParser) -> None:
    """Add the choice of devices."""
    group(parser, DEVICES).add_argument(
        "--device",
        action="append",
        metavar="NAME",
        help="a device of the catalogue, see `vstent devices`; repeatable (default: silk and enterprise)",
    )


def add_problem(parser: argparse.ArgumentParser) -> None:
    """Add the options that define the flow problem, whichever engine solves it."""
    flow = group(parser, FLOW)
    flow.add_argument(
        "--flow-rate",
        type=positive,
        metavar="ML_S",
        help="mean flow rate through all inlets together, mL/s (default: 0.27 m/s times the inlet area)",
    )
    flow.add_argument(
        "--grid-spacing",
        type=positive,
        metavar="MM",
        help="grid spacing, mm (default: 29 cells across the mean vessel diameter, at most 480,000 cells)",
    )
    pulse = flow.add_mutually_exclusive_group()
    pulse.add_argument(
        "--steady", action="store_true", help="constant inflow at the mean flow rate (this is the default)"
    )
    pulse.add_argument(
        "--pulsatile",
        nargs="?",
        const=PUBLISHED,
        metavar="CSV",
        help="pulsatile inflow: columns time in s and flow in any unit; without a file, the published waveform of the "
        "internal carotid artery (default: steady)",
    )
    density, viscosity = within(900, 1200, "kg/m3: 1.06 g/mL are 1060"), within(0.001, 0.1, "Pa s: 4 mPa s are 0.004")
    flow.add_argument(
        "--density", type=density, default=1060.0, metavar="KG_M3", help="density of blood, kg/m3 (default: 1060)"
    )
    flow.add_argument(
        "--viscosity",
        type=viscosity,
        metavar="PA_S",
        help="dynamic viscosity of blood, Pa s; with --shear-thinning, at high shear rate "
        "(default: 0.004; shear-thinning 0.00345)",
    )
    flow.add_argument(
        "--shear-thinning",
        action="store_true",
        help="use the shear-thinning viscosity of Carreau and Yasuda (default: constant viscosity)",
    )
    flow.add_argument(
        "--outlets",
        choices=("zero_pressure", "murray"),
        default="zero_pressure",
        help="boundary condition at the outlets: zero pressure at each, or outflow in proportion to the radius cubed "
        "(default: zero_pressure)",
    )


def add_processes(parser: argparse.ArgumentParser) -> None:
    """Add the number of processes of OpenFOAM."""
    group(parser, PARALLEL).add_argument(
        "-j", "--processes", type=_jobs, default=1, metavar="N", help="number of OpenFOAM processes (default: 1)"
    )


def add_flow(parser: argparse.ArgumentParser) -> None:
    """Add the options that define the flow problem, and those that say how it is solved."""
    add_problem(parser)
    flow = group(parser, FLOW)
    flow.add_argument(
        "--engine",
        default="lattice_boltzmann",
        metavar="NAME",
        help="flow solver: lattice_boltzmann, openfoam or the name of a plug-in (default: lattice_boltzmann)",
    )
    flow.add_argument(
        "--refine-sac",
        action="store_true",
        help="use this grid spacing only in and near the sac, and twice it elsewhere (default: the same everywhere)",
    )
    flow.add_argument(
        "--gpu",
        action="store_true",
        help="compute the flow on an NVIDIA GPU; needs pip install 'vstent[gpu]' (default: on the processor)",
    )
    add_processes(parser)


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add the number of simultaneous processes."""
    group(parser, PARALLEL).add_argument(
        "--jobs", type=_jobs, default=_cores(), metavar="N", help="number of parallel processes (default: one per core)"
    )


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _jobs(text: str) -> int:
    """Convert text to a number of processes."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes such as 2")
    return int(text)


def numbers(text: str) -> list[float]:
    """Convert the text of an option, such as ``-2,0,2``, to a list of numbers."""
    return _numbers(text, float)


def add_uncertainty(parser: argparse.ArgumentParser) -> None:
    """Add the options of an uncertainty study."""
    varied = group(parser, UNCERTAINTY)
    varied.add_argument(
        "--uncertainty",
        type=int,
        metavar="N",
        help="repeat the deployment N times with varied inputs, N rounded up to a power of two (default: off)",
    )
    varied.add_argument(
        "--uncertainty-flows",
        type=int,
        default=0,
        metavar="M",
        help="compute the flow without and with the device for M of them (default: 0)",
    )
    varied.add_argument(
        "--vary",
        type=_cause,
        action="append",
        default=[],
        metavar="CAUSE=RANGE",
        help="half-width of the range of one input; repeatable. threshold=MM changes all diameters (default: the band "
        "found in the scan, 0 for a surface); landing=MM, position along the artery (default: 1); device=MM, device "
        "diameter (default: 0.1); inflow=FRACTION of the flow rate (default: 0.2)",
    )


RANGES: Final = {
    "threshold": "threshold_mm",
    "landing": "landing_mm",
    "device": "device_mm",
    "inflow": "inflow_fraction",
}
"""Names of the varied inputs on the command line, and the fields of `Ranges` that hold them."""


def _cause(text: str) -> tuple[str, float]:
    """Convert text such as ``landing=1`` to a field of `Ranges` and its value."""
    name, _, value = text.partition("=")
    try:
        return RANGES[name], float(value)
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r} is not one of {'=, '.join(RANGES)}= with a number") from None


def given_ranges(arguments: argparse.Namespace) -> "Ranges | None":
    """Return the ranges of an uncertainty study; None without one."""
    if arguments.uncertainty is None:
        if arguments.vary or arguments.uncertainty_flows:
            raise InputError(
                "--vary and --uncertainty-flows have no effect without an uncertainty study: add --uncertainty N"
            )
        return None
    from vstent.plan.uncertainty import Ranges

    return Ranges(arguments.uncertainty, arguments.uncertainty_flows, **dict(arguments.vary))


def _numbers(text: str, kind: type, count: int | None = None) -> list[float]:
    """Convert text to numbers separated by commas; `count` of them where it is given."""
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
    """Convert text to three numbers."""
    first, second, third = _numbers(text, kind, 3)
    return first, second, third


def _point(text: str) -> tuple[float, float, float]:
    """Convert text to a point, mm."""
    return _three(text, float)


def _shape(text: str) -> tuple[float, float, float]:
    """Convert text to three voxel counts."""
    return _three(text, int)


def _spacing(text: str) -> tuple[float, float, float]:
    """Convert text to three voxel sizes, mm; one number stands for three equal ones."""
    return _three(text if "," in text else ",".join([text] * 3), float)


def given_geometry(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options that describe the vessel, under the names of the fields of `Settings`."""
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
    """Return the points of a neck drawn by hand, read from a CSV file."""
    from vstent.io.tables import read_columns

    return None if path is None else tuple((x, y, z) for x, y, z in read_columns(path, 3).tolist())


def given_devices(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the names of the chosen devices, each once; without a choice, the two of Zhong et al. 2016."""
    return tuple(dict.fromkeys(arguments.device or ("silk", "enterprise")))


def given_problem(arguments: argparse.Namespace) -> "FlowSettings":
    """Return the settings that define the flow problem."""
    from vstent.flow.case import FlowSettings

    return FlowSettings(
        inflow_mL_s=arguments.flow_rate,
        blood=_blood(arguments),
        waveform=_waveform(arguments.pulsatile),
        outlets=arguments.outlets,
        cell_size_mm=arguments.grid_spacing,
    )


def given_flow(arguments: argparse.Namespace) -> "FlowSettings":
    """Return the settings of the flow problem and of its solver.

    Raises
    ------
    InputError
        The engine does not exist or does not support an option.
    FlowError
        A GPU is requested and cannot be used.
    """
    from vstent.flow.lattice.gpu import require_gpu
    from vstent.flow.simulation import engine_class

    settings = replace(
        given_problem(arguments),
        close_up=arguments.refine_sac,
        engine=arguments.engine,
        processes=arguments.processes,
        device_gpu=arguments.gpu,
    )
    engine_class(settings)  # raises before any input is read
    if settings.device_gpu:
        require_gpu()
    return settings


def _blood(arguments: argparse.Namespace) -> "Blood":
    """Return the properties of blood."""
    from vstent.flow.case import HIGH_SHEAR_VISCOSITY_PA_S, Blood, CarreauYasuda

    if not arguments.shear_thinning:
        return Blood(arguments.density, arguments.viscosity or Blood.viscosity_Pa_s)
    return Blood(arguments.density, arguments.viscosity or HIGH_SHEAR_VISCOSITY_PA_S, CarreauYasuda())


def _waveform(source: str | None) -> "Waveform | None":
    """Return the inflow waveform: the published one or that of a file; None for steady flow."""
    from vstent.flow.waveform import OLDER_ADULT_ICA, waveform_of
    from vstent.io.tables import read_columns

    if source is None or source == PUBLISHED:
        return OLDER_ADULT_ICA if source else None
    time_s, flow = read_columns(Path(source), 2).T
    waveform = waveform_of(time_s, flow)
    if not SHORTEST_CYCLE_S <= waveform.period_s <= LONGEST_CYCLE_S:
        raise InputError(
            f"{source}: the cardiac cycle lasts {waveform.period_s:g} s; vstent accepts {SHORTEST_CYCLE_S:g} to "
            f"{LONGEST_CYCLE_S:g} s. Give one cycle, with its times in seconds."
        )
    return waveform
