"""`vstent flow`: compute the blood flow in any vessel, with or without a sac or a device."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vstent.cli import options

if TYPE_CHECKING:
    from rich.table import Table

    from vstent.cli.console import Console
    from vstent.study.types import Settings


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "flow",
        "Compute the blood flow in any vessel, with or without devices.",
        "vstent flow artery.stl --units mm --out case --flow-rate 4.2 --grid-spacing 0.15",
    )
    options.add_geometry(parser)
    options.add_outlet(parser)
    what = options.group(parser, options.FLOW).add_mutually_exclusive_group()
    what.add_argument(
        "--device",
        action="append",
        metavar="NAME",
        help="also compute the flow with this device of the catalogue; repeatable (default: no device)",
    )
    what.add_argument(
        "--convergence",
        action="store_true",
        help="compare the flow without a device for three grid spacings, three time steps and three positions on the "
        "grid (default: off)",
    )
    options.add_flow(parser)
    parser.set_defaults(command=_flow)


def _flow(arguments: argparse.Namespace) -> int:
    """Compute the flow, or its convergence, and print the tables."""
    from vstent.cli.console import Console
    from vstent.study.types import Settings

    devices = tuple(dict.fromkeys(arguments.device or ()))
    settings = Settings(devices=devices, flow=options.given_flow(arguments), **options.given_geometry(arguments))
    console = Console()
    compute = _converge if arguments.convergence else _compute
    for table in compute(arguments.input, arguments.out, settings, console):
        console.print(table)
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0


def _compute(path: Path, out: Path, settings: "Settings", console: "Console") -> "list[Table]":
    """Compute the flow and return its table."""
    from vstent.cli.console import flow_table
    from vstent.study.pipeline import run

    with console.live():
        case = run(path, out, settings, console.progress)
    return [flow_table(case.metrics)]


def _converge(path: Path, out: Path, settings: "Settings", console: "Console") -> "list[Table]":
    """Run the convergence study and return its tables."""
    from vstent.cli.console import convergence_table, positions_table
    from vstent.study.pipeline import refine_flow

    with console.live():
        found = refine_flow(path, out, settings, console.progress)
    return [*map(convergence_table, found.refinements), positions_table(found.positions)]
