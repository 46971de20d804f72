"""`vstent demo`: run a study of a synthetic scan and compare it with the known truth."""

import argparse
from pathlib import Path

from vstent.cli import finished, options, run


def add(commands: options.Commands) -> None:
    """Add the command."""
    text = "Run a study of a synthetic scan and compare it with the known truth."
    parser = options.add_command(commands, "demo", text, "demo --no-flow --out demo")
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="case folder (default: demo)")
    options.add_flag(parser, "replace", "replace results in the folder that belong to other settings (default: refuse)")
    options.add_settings(parser, *options.STUDY)
    options.add_flag(parser, "pdf", run.PDF)
    parser.set_defaults(command=_demo, answered=finished.answered)


def _demo(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, truth_table
    from vstent.study.demo import truth, write_scan

    scan, settings = write_scan(arguments.out / "scan"), options.given_settings(arguments)
    before = finished.begun(arguments, scan)
    console = Console()
    case = run.study(scan, settings, console, arguments)
    console.print(truth_table(truth(case)))
    if case.failures:
        return 1
    finished.remember(arguments, before, case.provenance, console.printed)
    return 0
