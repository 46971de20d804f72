"""`vstent flow`: compute the flow in any vessel, with or without sac and stent."""

import argparse

from vstent.cli import options
from vstent.errors import InputError


def add(commands: options.Commands) -> None:
    """Add the command."""
    text = "Compute the blood flow in any vessel, with or without devices."
    parser = options.add_command(commands, "flow", text, "flow artery.stl --grid-spacing 0.2 --out case")
    options.add_case(parser)
    text = "compare the flow without a device on three grids, with three time steps and in three orientations"
    options.add_flag(parser, "convergence", text)
    options.add_settings(parser, *options.VESSEL, "treatments", "flow", without=("no-flow",))
    parser.set_defaults(command=_flow)


def _flow(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, convergence_table, flow_table, positions_table
    from vstent.study.pipeline import refine_flow, run

    settings = options.given_settings(arguments, device=())
    if arguments.convergence and settings.treatments:
        raise InputError("--convergence compares flows without a device: leave out --device and --treatment.")
    console = Console()
    given = arguments.input, arguments.out, settings, console.progress
    with console.live():
        if arguments.convergence:
            found = refine_flow(*given, replaces=arguments.replace)
            tables = [*map(convergence_table, found.refinements), positions_table(found.positions)]
        else:
            tables = [flow_table(run(*given, replaces=arguments.replace).metrics)]
    for table in tables:
        console.print(table)
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0
