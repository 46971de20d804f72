"""Command line. The only place that prints, and that knows of files' names on a shell."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vstent.errors import InputError, VstentError

if TYPE_CHECKING:
    from vstent.flow.types import Waveform
    from vstent.study import CaseResult, Settings

BAD_INPUT: Final = 2
FAILED: Final = 1
INTERRUPTED: Final = 130

PUBLISHED: Final = "published"
"""The waveform where none is given."""
EPILOG = "Research use only: not cleared for diagnosis or treatment. Lengths in mm, flow in SI; coordinates are LPS."


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (0 done, 1 failed, 2 bad input, 130 interrupted)."""
    # Many small systems are solved, none large: threads of the linear algebra only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = _parser().parse_args(argv)
    try:
        return int(arguments.command(arguments))
    except InputError as error:
        return _fail(str(error), BAD_INPUT)
    except VstentError as error:
        return _fail(str(error), FAILED)
    except KeyboardInterrupt:
        return _fail("stopped. What was finished is kept: give the same command again to go on.", INTERRUPTED)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _fail(f"{error.strerror or error}{where}: nothing half-written was left", FAILED)


def _fail(sentence: str, code: int) -> int:
    print(f"vstent: {sentence}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vstent", description="Virtual stenting of intracranial aneurysms.", epilog=EPILOG
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_run(commands.add_parser("run", help="scan or surface -> stented artery, flow compared, report", epilog=EPILOG))
    _add_trace(commands.add_parser("trace", help="scan or surface -> wall, openings, centerlines", epilog=EPILOG))
    restore = commands.add_parser(
        "restore", help="scan or surface -> parent artery, sac, neck, measures", epilog=EPILOG
    )
    _add_restore(restore)
    _add_demo(commands.add_parser("demo", help="the same on a synthetic scan, beside its known truth", epilog=EPILOG))
    devices = commands.add_parser("devices", help="list the catalogue", epilog=EPILOG)
    devices.set_defaults(command=_devices)
    add = devices.add_subparsers(metavar="COMMAND").add_parser("add", help="add devices of your own", epilog=EPILOG)
    add.add_argument("file", type=Path, help="TOML, written like vstent's devices.toml: every number with its source")
    add.set_defaults(command=_devices_add)
    return parser


def _add_geometry(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """Add the input, the folder, and what may be said of the vessel; return the group of the latter."""
    parser.add_argument(
        "input", type=Path, help="DICOM folder, NIfTI, NRRD, MHA, raw volume, STL, VTP, VTK, OBJ or PLY"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="case folder to write, or to go on with")
    given = parser.add_argument_group("instead of what is guessed or proposed")
    given.add_argument("--units", choices=("m", "cm", "mm"), help="length unit of a surface file")
    given.add_argument("--spacing", type=_spacing, metavar="S|X,Y,Z", help="voxel edges of a raw volume, mm")
    given.add_argument("--shape", type=_shape, metavar="I,J,K", help="voxel counts of a raw volume")
    given.add_argument("--threshold", type=float, metavar="T", help="intensity of the lumen's wall in a scan")
    given.add_argument("--at", type=_point, metavar="X,Y,Z", help="a point near the sac, mm")
    given.add_argument("--inlet", type=_point, metavar="X,Y,Z", help="a point near the inlet, mm")
    return given


def _add_trace(parser: argparse.ArgumentParser) -> None:
    _add_geometry(parser)
    parser.set_defaults(command=_trace, outlet=None)


def _add_restore(parser: argparse.ArgumentParser) -> None:
    _add_outlet(_add_geometry(parser))
    parser.set_defaults(command=_restore)


def _add_outlet(given: "argparse._ArgumentGroup") -> None:
    given.add_argument("--outlet", type=_point, metavar="X,Y,Z", help="a point near the parent artery's outlet, mm")


def _add_run(parser: argparse.ArgumentParser) -> None:
    given = _add_geometry(parser)
    _add_outlet(given)
    given.add_argument("--diameter", type=float, metavar="MM", help="label diameter of the devices")
    given.add_argument("--length", type=float, metavar="MM", help="label length of the devices")
    given.add_argument("--center", type=float, metavar="MM", help="where on the parent axis the device's middle lies")
    _add_common(parser)
    parser.set_defaults(command=_run)


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="case folder (default: demo)")
    _add_common(parser)
    parser.set_defaults(command=_demo)


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device", action="append", metavar="NAME", help="a device of the catalogue; repeatable (silk, enterprise)"
    )
    flow = parser.add_argument_group("flow")
    flow.add_argument("--no-flow", action="store_true", help="stop after the deployment")
    flow.add_argument("--flow-rate", type=float, metavar="ML_S", help="mean inflow (0.27 m/s times the inlet's area)")
    flow.add_argument("--cell-size", type=float, metavar="MM", help="edge of a flow cell")
    flow.add_argument(
        "--pulsatile",
        nargs="?",
        const=PUBLISHED,
        metavar="CSV",
        help="follow a pulse: columns time in s and flow in any unit (the published one of the internal carotid)",
    )
    flow.add_argument("--outlets", choices=("zero_pressure", "murray"), default="zero_pressure", help="outlet law")


def _numbers(text: str, kind: type) -> list[float]:
    try:
        return [kind(part) for part in text.replace("x", ",").split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers such as 1,2,3") from None


def _three(text: str, kind: type) -> tuple[float, float, float]:
    numbers = _numbers(text, kind)
    if len(numbers) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} has {len(numbers)} numbers, not 3")
    return numbers[0], numbers[1], numbers[2]


def _point(text: str) -> tuple[float, float, float]:
    return _three(text, float)


def _shape(text: str) -> tuple[float, float, float]:
    return _three(text, int)


def _spacing(text: str) -> tuple[float, float, float]:
    return _three(text if "," in text else ",".join([text] * 3), float)


def _settings(arguments: argparse.Namespace, **given: object) -> "Settings":
    from vstent.flow import FlowSettings
    from vstent.study import Settings

    flow = FlowSettings(
        inflow_mL_s=arguments.flow_rate,
        waveform=_waveform(arguments.pulsatile),
        outlets=arguments.outlets,
        cell_size_mm=arguments.cell_size,
    )
    devices = tuple(dict.fromkeys(arguments.device or ("silk", "enterprise")))
    return Settings(devices=devices, flow=None if arguments.no_flow else flow, **given)  # type: ignore[arg-type]


def _geometry(arguments: argparse.Namespace) -> dict[str, Any]:
    """Collect what was said of the vessel, under the names of the settings."""
    return {
        "units": arguments.units,
        "spacing_mm": arguments.spacing,
        "shape": arguments.shape,
        "threshold": arguments.threshold,
        "at_mm": arguments.at,
        "inlet_mm": arguments.inlet,
        "outlet_mm": arguments.outlet,
    }


def _waveform(source: str | None) -> "Waveform | None":
    from vstent.flow.waveform import OLDER_ADULT_ICA, waveform_of
    from vstent.io.tables import read_columns

    if source is None or source == PUBLISHED:
        return OLDER_ADULT_ICA if source else None
    time_s, flow = read_columns(Path(source), 2).T
    return waveform_of(time_s, flow)


def _run(arguments: argparse.Namespace) -> int:
    settings = _settings(
        arguments,
        **_geometry(arguments),
        diameter_mm=arguments.diameter,
        length_mm=arguments.length,
        center_mm=arguments.center,
    )
    _study(arguments.input, arguments.out, settings)
    return 0


def _study(path: Path, out: Path, settings: "Settings") -> "CaseResult":
    """Run a study with its progress shown; write the report and print the table."""
    from vstent.console import Console, comparison_table
    from vstent.study import run

    console = Console()
    with console.live():
        case = run(path, out, settings, console.progress)
        console.progress("report", 0.0, "")
        from vstent.io.writers import write_text
        from vstent.report import report

        write_text(out / "report.html", report(case))
        console.progress("report", 1.0, str(out / "report.html"))
    console.print(comparison_table(case.metrics))
    console.print(f"Results in {out}; open {out / 'report.html'}. Research use only.")
    return case


def _trace(arguments: argparse.Namespace) -> int:
    from vstent.console import Console, opening_table
    from vstent.study import Settings, trace_vessel

    console = Console()
    settings = Settings(devices=(), flow=None, **_geometry(arguments))
    with console.live():
        vessel = trace_vessel(arguments.input, arguments.out, settings, console.progress)
    console.print(opening_table(vessel.openings))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0


def _restore(arguments: argparse.Namespace) -> int:
    from vstent.console import Console, morphology_table
    from vstent.study import Settings, restore_vessel

    console = Console()
    settings = Settings(devices=(), flow=None, **_geometry(arguments))
    with console.live():
        _, measures = restore_vessel(arguments.input, arguments.out, settings, console.progress)
    console.print(morphology_table(measures))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from vstent.console import Console, truth_table
    from vstent.demo import truth, write_scan

    case = _study(write_scan(arguments.out / "scan"), arguments.out, _settings(arguments))
    Console().print(truth_table(truth(case)))
    return 0


def _devices(arguments: argparse.Namespace) -> int:
    from vstent.console import Console, device_table
    from vstent.device import catalogue

    Console().print(device_table(catalogue()))
    return 0


def _devices_add(arguments: argparse.Namespace) -> int:
    from vstent.console import Console, device_table
    from vstent.device import add_devices

    Console().print(device_table(add_devices(arguments.file)))
    return 0
