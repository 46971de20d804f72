"""`vstent flow`: the flow alone, in any vessel, sac or not, stent or not."""

import argparse
from dataclasses import replace

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands, "flow", "scan or surface -> blood flow, in any vessel, with or without devices"
    )
    options.add_outlet(options.add_geometry(parser))
    parser.add_argument("--device", action="append", metavar="NAME", help="a device of the catalogue too; repeatable")
    flow = options.add_flow(parser)
    flow.add_argument("--steady", action="store_true", help="at the mean inflow, not pulsing (the default)")
    parser.set_defaults(command=_flow)


def _flow(arguments: argparse.Namespace) -> int:
    from vstent.console import Console, flow_table
    from vstent.study import Settings, run

    flow = options.given_flow(arguments)
    if arguments.steady:
        flow = replace(flow, waveform=None)
    devices = tuple(dict.fromkeys(arguments.device or ()))
    settings = Settings(devices=devices, flow=flow, **options.given_geometry(arguments))
    console = Console()
    with console.live():
        case = run(arguments.input, arguments.out, settings, console.progress)
    console.print(flow_table(case.metrics))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0
