"""`vstent devices`: list the catalogue, or add devices to it."""

import argparse
from pathlib import Path

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command and its subcommand ``add``."""
    parser = options.add_command(commands, "devices", "List the devices of the catalogue, or add your own.", "devices")
    parser.set_defaults(command=_devices)
    adding = options.add_command(
        parser.add_subparsers(metavar="COMMAND"),
        "add",
        "Add devices of your own to the catalogue.",
        "devices add mine.toml",
    )
    adding.add_argument(
        "file", type=Path, help="TOML file in the form of vstent's catalogue.toml: every number with its source"
    )
    adding.set_defaults(command=_add)


def _devices(arguments: argparse.Namespace) -> int:
    """Print the catalogue; return the exit code."""
    from vstent.cli.console import Console, device_table
    from vstent.devices.catalogue import catalogue

    Console().print(device_table(catalogue()))
    return 0


def _add(arguments: argparse.Namespace) -> int:
    """Add the devices of a file to the catalogue and print them; return the exit code."""
    from vstent.cli.console import Console, device_table
    from vstent.devices.catalogue import add_devices

    Console().print(device_table(add_devices(arguments.file)))
    return 0
