"""`vstent demo`: run the whole workflow on a synthetic scan and compare the results with the known geometry."""

import argparse
from pathlib import Path

from vstent.cli import options, run


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "demo",
        "Run the workflow on a synthetic scan and compare with its known geometry.",
        "vstent demo --out demo",
    )
    options.group(parser, options.OUTPUT).add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="case folder to write (default: demo)"
    )
    run.add_study(parser)
    run.add_pdf(parser)
    parser.set_defaults(command=_demo)


def _demo(arguments: argparse.Namespace) -> int:
    """Write the scan, run the study and print the comparison."""
    from vstent.cli.console import Console, truth_table
    from vstent.study.demo import truth, write_scan

    scan, settings = write_scan(arguments.out / "scan"), run.given_study(arguments)
    case = run.study(scan, arguments.out, settings, is_printed=arguments.pdf)
    Console().print(truth_table(truth(case)))
    return 0
