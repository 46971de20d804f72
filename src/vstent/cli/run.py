"""`vstent run`: from a scan or surface to the report."""

import argparse
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vstent.cli import finished, options
from vstent.cli.angiogram import add_injection, given_angiogram
from vstent.errors import InputError

if TYPE_CHECKING:
    from vstent.angiography.angiogram import AngiogramSettings
    from vstent.cli.console import Console
    from vstent.study.pipeline import CaseResult
    from vstent.study.repeat import Record
    from vstent.study.settings import Settings

PDF: Final = "also write the report as report.pdf"
"""Help of the option `--pdf`."""


def add(commands: options.Commands) -> None:
    """Add the command."""
    text = "Deploy stents in a patient's artery, compute the flow before and after, and write a report."
    parser = options.add_command(commands, "run", text, "run scan/ --device silk --device enterprise --out case")
    options.add_case(parser)
    options.add_settings(parser, *options.VESSEL, *options.STUDY)
    options.add_flag(parser, "angiogram", "also carry contrast through the flows and film it")
    add_injection(parser)
    options.add_flag(parser, "pdf", PDF)
    options.add_flag(parser, "plan", "write the plan of every device on one page, plan.pdf, without the flow")
    options.add_flag(parser, "ro-crate", "also describe the case folder as an RO-Crate")
    text = "present place of the input of a run.json to repeat"
    parser.add_argument("--input", dest="moved_to", type=Path, metavar="PATH", help=text)
    parser.set_defaults(command=_run, answered=finished.answered)


def study(
    path: Path,
    settings: "Settings",
    console: "Console",
    arguments: argparse.Namespace,
    injected: "AngiogramSettings | None" = None,
) -> "CaseResult":
    """Run a study, show its progress, write its reports and print its tables; angiograms too where `injected`.

    The arguments state the case folder, and whether results are replaced and the report is printed.
    """
    from vstent.angiography.filming import FilmSettings
    from vstent.cli.console import (
        angiogram_table,
        comparison_table,
        device_sentences,
        treatment_reasons,
        treatments_table,
        uncertainty_table,
    )
    from vstent.reporting.drawing import Drawing
    from vstent.reporting.film_case import film_case
    from vstent.reporting.write import write_report
    from vstent.study.contrast import add_measures
    from vstent.study.pipeline import run
    from vstent.study.progress import Progress
    from vstent.study.stages import straightening_notes

    out = arguments.out

    def told(now: Progress) -> None:
        console.progress(now)
        if now.computed is not None:  # the pictures are drawn while the measures are computed
            drawing.begin(now.computed)

    with console.live(), Drawing() as drawing:
        case = run(path, out, settings, told, replaces=arguments.replace)
        if injected is not None:
            angiograms = film_case(out, injected, FilmSettings(), console.progress)
            add_measures(case.metrics, {name: one.measures for name, one in angiograms.items()})
        console.progress(Progress("report", 0.0))
        write_report(case, out, is_printed=arguments.pdf, drawing=drawing)
        console.progress(Progress("report", 1.0, str(out / "report.html")))
    console.print(comparison_table(case.metrics))
    if ranked := case.metrics.get("ranking"):
        console.print(treatments_table(ranked))
        console.print(treatment_reasons(ranked))
    for sentence in (*device_sentences(case.metrics), *straightening_notes(case.metrics)):
        console.print(sentence)
    if any("uncertainty" in found for found in case.metrics["treatments"].values()):
        console.print(uncertainty_table(case.metrics))
    if injected is not None:
        console.print(angiogram_table(case.metrics))
    for name, sentence in case.failures.items():
        console.say(f"vstent: {name}: {sentence}")
    console.print(f"Results in {out}; open {out / 'report.html'}. Research use only.")
    return case


def _run(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code: 1 where a device or a flow failed."""
    from vstent.cli.console import Console
    from vstent.reporting.write import write_plan
    from vstent.study.crate import write_crate
    from vstent.study.repeat import agreement

    path, out, settings = arguments.input, arguments.out, options.given_settings(arguments)
    if arguments.plan:
        settings = replace(settings, flow=None)
    injected = given_angiogram(arguments) if arguments.angiogram else None
    if injected is not None and settings.flow is None:
        raise InputError("contrast moves with the flow: leave out --no-flow and --plan, or --angiogram.")
    console, record = Console(), None
    if path.suffix == ".json":
        record = _recorded(arguments)
        for difference in record.differences:
            console.say(f"Changed since: {difference}.")
        path, settings = record.input, record.settings
    before = finished.begun(arguments, path)
    case = study(path, settings, console, arguments, injected)
    if arguments.plan:
        write_plan(case, out, date.today().isoformat())
    if arguments.ro_crate:
        write_crate(out, case.provenance, date.today().isoformat())
    if record is not None:
        console.print(agreement(record.folder, out))
    elif not case.failures:
        finished.remember(arguments, before, case.provenance, console.printed)
    return 1 if case.failures else 0


def _recorded(arguments: argparse.Namespace) -> "Record":
    """Return the record of a run to repeat."""
    from vstent.study.repeat import read_record

    path, out = arguments.input, arguments.out
    if options.given(arguments):
        raise InputError(
            f"{path} states all settings: give only --out, --input, --pdf, --replace and --ro-crate with it."
        )
    record = read_record(path, arguments.moved_to)
    if out.resolve() == record.folder.resolve():
        raise InputError(f"{out} is the folder of the run itself: give another --out for the repetition.")
    return record
