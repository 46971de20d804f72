"""`vstent devices`: the catalogue, and devices of one's own."""

import argparse
from pathlib import Path

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command and its own."""
    parser = options.add_command(commands, "devices", "list the catalogue")
    parser.set_defaults(command=_devices)
    adding = options.add_command(parser.add_subparsers(metavar="COMMAND"), "add", "add devices of your own")
    adding.add_argument(
        "file", type=Path, help="TOML, written like vstent's catalogue.toml: every number with its source"
    )
    adding.set_defaults(command=_add)


def _devices(arguments: argparse.Namespace) -> int:
    from vstent.cli.console import Console, device_table
    from vstent.devices.catalogue import catalogue

    Console().print(device_table(catalogue()))
    return 0


def _add(arguments: argparse.Namespace) -> int:
    from vstent.cli.console import Console, device_table
    from vstent.devices.catalogue import add_devices

    Console().print(device_table(add_devices(arguments.file)))
    return 0
