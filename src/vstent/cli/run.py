"""`vstent run`: a patient's scan or surface, whole."""

import argparse
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from vstent.cli import options

if TYPE_CHECKING:
    from vstent.study.types import CaseResult, Settings


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands, "run", "scan or surface -> stented artery, flow compared, report; run.json -> the same again"
    )
    given = options.add_geometry(parser)
    options.add_outlet(given)
    options.add_neck(given)
    given.add_argument("--diameter", type=options.positive, metavar="MM", help="label diameter of the devices")
    given.add_argument("--length", type=options.positive, metavar="MM", help="label length of the devices")
    given.add_argument(
        "--center", type=options.number, metavar="MM", help="where on the parent axis the device's middle lies"
    )
    add_study(parser)
    add_pdf(parser)
    parser.add_argument("--crate", action="store_true", help="describe the folder as an RO-Crate besides")
    parser.add_argument(
        "--input", dest="moved_to", type=Path, metavar="PATH", help="where the input of a run.json lies now"
    )
    parser.set_defaults(command=_run)


def add_study(parser: argparse.ArgumentParser) -> None:
    """Add what every study may be told: the devices, and how to compute the flow, if at all."""
    options.add_devices(parser)
    flow = options.add_flow(parser)
    flow.add_argument("--no-flow", action="store_true", help="stop after the deployment")
    options.add_uncertainty(parser)


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """Add whether the report is to be printed."""
    parser.add_argument("--pdf", action="store_true", help="write the report as report.pdf besides")


def given_study(arguments: argparse.Namespace, **given: object) -> "Settings":
    """Collect what a study is told; `given` are further settings."""
    from vstent.study.types import Settings

    flow = None if arguments.no_flow else options.given_flow(arguments)
    devices, ranges = options.given_devices(arguments), options.given_ranges(arguments)
    return Settings(devices=devices, flow=flow, uncertainty=ranges, **given)  # type: ignore[arg-type]


def study(path: Path, out: Path, settings: "Settings", *, is_printed: bool) -> "CaseResult":
    """Run a study with its progress shown; write the report, as a PDF too where asked, and print the table."""
    from vstent.cli.console import Console, comparison_table, uncertainty_table
    from vstent.study.pipeline import run

    console = Console()
    with console.live():
        case = run(path, out, settings, console.progress)
        console.progress("report", 0.0, "")
        from vstent.reporting.write import write_report

        write_report(case, out, is_printed=is_printed)
        console.progress("report", 1.0, str(out / "report.html"))
    console.print(comparison_table(case.metrics))
    if settings.uncertainty is not None:
        console.print(uncertainty_table(case.metrics))
    console.print(f"Results in {out}; open {out / 'report.html'}. Research use only.")
    return case


def _run(arguments: argparse.Namespace) -> int:
    settings = given_study(
        arguments,
        **options.given_geometry(arguments),
        diameter_mm=arguments.diameter,
        length_mm=arguments.length,
        center_mm=arguments.center,
    )
    if arguments.input.suffix == ".json":
        return _again(arguments, settings)
    _finish(arguments, study(arguments.input, arguments.out, settings, is_printed=arguments.pdf))
    return 0


def _again(arguments: argparse.Namespace, given: "Settings") -> int:
    """Repeat a run from its run.json; say what is not as it was, and how far the results agree."""
    from vstent.cli.console import Console
    from vstent.errors import InputError
    from vstent.study.repeat import agreement, read_record
    from vstent.study.types import Settings

    if asdict(given) != asdict(Settings()):
        raise InputError(
            f"{arguments.input} says all settings: give no option but --out, --input, --pdf and --crate with it."
        )
    record = read_record(arguments.input, arguments.moved_to)
    if arguments.out.resolve() == record.folder.resolve():
        raise InputError(f"{arguments.out} is the folder of the run itself: give another --out to repeat it in.")
    console = Console()
    for difference in record.differences:
        console.say(f"Not as then: {difference}.")
    _finish(arguments, study(record.input, arguments.out, record.settings, is_printed=arguments.pdf))
    console.print(agreement(record.folder, arguments.out))
    return 0


def _finish(arguments: argparse.Namespace, case: "CaseResult") -> None:
    from vstent.study.crate import write_crate

    if arguments.crate:
        write_crate(arguments.out, case.provenance, date.today().isoformat())
