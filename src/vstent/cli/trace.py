"""`vstent trace`: find the vessel wall, its openings and centerlines."""

import argparse

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands, "trace", "Find the vessel wall, its openings and its centerlines.", "trace artery.stl --out case"
    )
    options.add_case(parser)
    options.add_settings(parser, *options.VESSEL, without=("outlet", "neck", "upstream", "downstream"))
    parser.set_defaults(command=_trace)


def _trace(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, opening_table
    from vstent.study.pipeline import trace_vessel

    console, settings = Console(), options.given_settings(arguments)
    with console.live():
        vessel = trace_vessel(arguments.input, arguments.out, settings, console.progress, replaces=arguments.replace)
    console.print(opening_table(vessel.openings))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0
