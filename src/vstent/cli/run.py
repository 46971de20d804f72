"""`vstent run`: run the whole workflow on one case, or repeat an earlier run."""

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
        commands,
        "run",
        "Deploy devices in one case, compare the blood flow, and write a report.",
        "vstent run scan.nii.gz --out case --device silk",
    )
    options.add_geometry(parser, "; or the run.json of an earlier run, to repeat it")
    options.group(parser, options.INPUT).add_argument(
        "--input",
        dest="moved_to",
        type=Path,
        metavar="PATH",
        help="with a run.json: where its scan or surface is now (default: where it was)",
    )
    options.add_outlet(parser)
    options.add_neck(parser)
    given = options.group(parser, options.OVERRIDES)
    given.add_argument(
        "--diameter",
        type=options.positive,
        metavar="MM",
        help="label diameter of the devices, mm (default: proposed from the artery)",
    )
    given.add_argument(
        "--length",
        type=options.positive,
        metavar="MM",
        help="label length of the devices, mm (default: proposed from the neck)",
    )
    given.add_argument(
        "--center",
        type=options.number,
        metavar="MM",
        help="position of the middle of the devices along the parent artery, mm from the inlet (default: proposed)",
    )
    add_study(parser)
    add_pdf(parser)
    options.group(parser, options.OUTPUT).add_argument(
        "--ro-crate", action="store_true", help="also describe the case folder as an RO-Crate (default: off)"
    )
    parser.set_defaults(command=_run)


def add_study(parser: argparse.ArgumentParser) -> None:
    """Add the options of a study: devices, flow, uncertainty."""
    options.add_devices(parser)
    options.add_flow(parser)
    options.group(parser, options.FLOW).add_argument(
        "--no-flow", action="store_true", help="deploy the devices without computing the flow (default: compute it)"
    )
    options.add_uncertainty(parser)


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """Add the option that writes the report as a PDF too."""
    options.group(parser, options.OUTPUT).add_argument(
        "--pdf", action="store_true", help="also write the report as report.pdf (default: report.html only)"
    )


def given_study(arguments: argparse.Namespace, **given: object) -> "Settings":
    """Return the settings of a study; `given` are further fields of `Settings`."""
    from vstent.study.types import Settings

    flow = None if arguments.no_flow else options.given_flow(arguments)
    devices, ranges = options.given_devices(arguments), options.given_ranges(arguments)
    return Settings(devices=devices, flow=flow, uncertainty=ranges, **given)  # type: ignore[arg-type]


def study(path: Path, out: Path, settings: "Settings", *, is_printed: bool) -> "CaseResult":
    """Run a study, write its report and print the tables.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings of the study.
    is_printed : whether to write the report as a PDF too.
    """
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
    """Run a study, or repeat one from its run.json."""
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
    """Repeat a run from its run.json; report differences in the environment, and how well the results agree."""
    from vstent.cli.console import Console
    from vstent.errors import InputError
    from vstent.study.repeat import agreement, read_record
    from vstent.study.types import Settings

    if asdict(given) != asdict(Settings()):
        raise InputError(
            f"{arguments.input} already contains all settings: give only --out, --input, --pdf and --ro-crate with it."
        )
    record = read_record(arguments.input, arguments.moved_to)
    if arguments.out.resolve() == record.folder.resolve():
        raise InputError(
            f"{arguments.out} is the folder of the run itself: give another folder for the repetition (--out)."
        )
    console = Console()
    for difference in record.differences:
        console.say(f"Differs from the original run: {difference}.")
    _finish(arguments, study(record.input, arguments.out, record.settings, is_printed=arguments.pdf))
    console.print(agreement(record.folder, arguments.out))
    return 0


def _finish(arguments: argparse.Namespace, case: "CaseResult") -> None:
    """Write the RO-Crate where it is requested."""
    from vstent.study.crate import write_crate

    if arguments.ro_crate:
        write_crate(arguments.out, case.provenance, date.today().isoformat())
