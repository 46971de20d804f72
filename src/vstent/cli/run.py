"""`vstent run`: from a scan or surface to the report."""

import argparse
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from vstent.cli import finished, options
from vstent.cli.angiogram import add_injection, given_angiogram
from vstent.errors import InputError

if TYPE_CHECKING:
    from vstent.angiography.angiogram import AngiogramSettings
    from vstent.cli.console import Console
    from vstent.study.pipeline import CaseResult
    from vstent.study.progress import OnProgress
    from vstent.study.settings import Settings


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "run",
        "Deploy stents in a patient's artery, compute the flow before and after, and write a report.",
        "run scan/ --device silk --device enterprise --out case",
    )
    options.add_case(parser)
    options.add_settings(parser, *options.VESSEL, *options.STUDY)
    parser.add_argument("--angiogram", action="store_true", help="also carry contrast through the flows and film it")
    add_injection(parser)
    add_pdf(parser)
    parser.add_argument(
        "--plan", action="store_true", help="write the plan of every device on one page, plan.pdf, without the flow"
    )
    parser.add_argument("--ro-crate", action="store_true", help="also describe the case folder as an RO-Crate")
    parser.add_argument(
        "--input", dest="moved_to", type=Path, metavar="PATH", help="present place of the input of a run.json to repeat"
    )
    parser.set_defaults(command=_run, answered=finished.answered)


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """Add the option to write the report as PDF."""
    parser.add_argument("--pdf", action="store_true", help="also write the report as report.pdf")


def study(
    path: Path,
    out: Path,
    settings: "Settings",
    console: "Console",
    *,
    is_printed: bool,
    replaces: bool,
    injected: "AngiogramSettings | None" = None,
) -> "CaseResult":
    """Run a study, show its progress, write its reports and print its tables.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings of the study.
    console : prints progress and tables.
    is_printed : whether the report is also written as PDF.
    replaces : whether results of another input or of other settings are replaced.
    injected : settings of the angiograms; None: none are computed.
    """
    from vstent.cli.console import (
        angiogram_table,
        comparison_table,
        device_sentences,
        uncertainty_table,
    )
    from vstent.reporting.drawing import Drawing
    from vstent.reporting.write import write_report
    from vstent.study.pipeline import run
    from vstent.study.progress import Progress

    def told(now: Progress) -> None:
        console.progress(now)
        if now.computed is not None:  # the pictures are drawn while the measures are computed
            drawing.begin(now.computed)

    with console.live(), Drawing() as drawing:
        case = run(path, out, settings, told, replaces=replaces)
        if injected is not None:
            _film(case, out, injected, console.progress)
        console.progress(Progress("report", 0.0))
        write_report(case, out, is_printed=is_printed, drawing=drawing)
        console.progress(Progress("report", 1.0, str(out / "report.html")))
    console.print(comparison_table(case.metrics))
    for sentence in device_sentences(case.metrics):
        console.print(sentence)
    if settings.uncertainty is not None:
        console.print(uncertainty_table(case.metrics))
    if injected is not None:
        console.print(angiogram_table(case.metrics))
    for name, sentence in case.failures.items():
        console.say(f"vstent: {name}: {sentence}")
    console.print(f"Results in {out}; open {out / 'report.html'}. Research use only.")
    return case


def _film(case: "CaseResult", out: Path, injected: "AngiogramSettings", progress: "OnProgress") -> None:
    """Carry contrast through the flows of a study and film it; add its measures to the metrics."""
    from vstent.angiography.filming import FilmSettings
    from vstent.reporting.film_case import film_case
    from vstent.study.contrast import add_measures

    found = film_case(out, injected, FilmSettings(), progress)
    add_measures(case.metrics, {name: one.measures for name, one in found.items()})


def _run(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console

    settings = options.given_settings(arguments)
    if arguments.plan:
        settings = replace(settings, flow=None)
    injected = given_angiogram(arguments) if arguments.angiogram else None
    if injected is not None and settings.flow is None:
        raise InputError("contrast moves with the flow: leave out --no-flow and --plan, or --angiogram.")
    if arguments.input.suffix == ".json":
        return _again(arguments, injected)
    given = {"is_printed": arguments.pdf, "replaces": arguments.replace, "injected": injected}
    console, before = Console(), finished.begun(arguments, arguments.input)
    case = study(arguments.input, arguments.out, settings, console, **given)
    code = _finish(arguments, case)
    if code == 0:
        finished.remember(arguments, before, case.provenance, console.printed)
    return code


def _again(arguments: argparse.Namespace, injected: "AngiogramSettings | None") -> int:
    """Repeat a run from its ``run.json`` and compare the results; return the exit code."""
    from vstent.cli.console import Console
    from vstent.study.repeat import agreement, read_record

    if options.given(arguments):
        raise InputError(
            f"{arguments.input} states all settings: give only --out, --input, --pdf, --replace and --ro-crate with it."
        )
    record = read_record(arguments.input, arguments.moved_to)
    if arguments.out.resolve() == record.folder.resolve():
        raise InputError(f"{arguments.out} is the folder of the run itself: give another --out for the repetition.")
    console = Console()
    for difference in record.differences:
        console.say(f"Changed since: {difference}.")
    asked = {"is_printed": arguments.pdf, "replaces": arguments.replace, "injected": injected}
    case = study(record.input, arguments.out, record.settings, console, **asked)
    code = _finish(arguments, case)
    console.print(agreement(record.folder, arguments.out))
    return code


def _finish(arguments: argparse.Namespace, case: "CaseResult") -> int:
    """Write plan and RO-Crate if requested; return the exit code: 1 where a device or a flow failed."""
    from vstent.study.crate import write_crate

    if arguments.plan:
        from vstent.reporting.write import write_plan

        write_plan(case, arguments.out, date.today().isoformat())
    if arguments.ro_crate:
        write_crate(arguments.out, case.provenance, date.today().isoformat())
    return 1 if case.failures else 0
