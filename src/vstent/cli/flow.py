"""`vstent flow`: compute the flow in any vessel, with or without sac and stent."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vstent.cli import options
from vstent.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from vstent.cli.console import Console
    from vstent.study.settings import Settings


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "flow",
        "Compute the blood flow in any vessel, with or without devices.",
        "flow artery.stl --grid-spacing 0.2 --out case",
    )
    options.add_case(parser)
    parser.add_argument(
        "--convergence",
        action="store_true",
        help="compare the flow without a device on three grids, with three time steps and in three orientations",
    )
    options.add_settings(parser, *options.VESSEL, "treatments", "flow", without=("no-flow",))
    parser.set_defaults(command=_flow)


def _flow(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console

    settings = options.given_settings(arguments, device=())
    if arguments.convergence and settings.treatments:
        raise InputError("--convergence compares flows without a device: leave out --device and --treatment.")
    console = Console()
    compute = _converge if arguments.convergence else _compute
    for table in compute(arguments.input, arguments.out, settings, console, arguments.replace):
        console.print(table)
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0


def _compute(path: Path, out: Path, settings: "Settings", console: "Console", replaces: bool) -> "list[Table]":
    """Compute the flows and return their table."""
    from vstent.cli.console import flow_table
    from vstent.study.pipeline import run

    with console.live():
        case = run(path, out, settings, console.progress, replaces=replaces)
    return [flow_table(case.metrics)]


def _converge(path: Path, out: Path, settings: "Settings", console: "Console", replaces: bool) -> "list[Table]":
    """Compute the flow on several grids, time steps and orientations and return the tables."""
    from vstent.cli.console import convergence_table, positions_table
    from vstent.study.pipeline import refine_flow

    with console.live():
        found = refine_flow(path, out, settings, console.progress, replaces=replaces)
    return [*map(convergence_table, found.refinements), positions_table(found.positions)]
