"""`vstent devices`: list the catalogue, or add devices to it."""

import argparse
from pathlib import Path
from typing import Final

from vstent.cli import options

USES: Final = {
    "flow diverter": "Flow diverters; sizes are diameter x length",
    "stent for coils": "Stents for coils; sizes are diameter x length",
    "basket": "Baskets for the sac; sizes are width x height",
    "coils": "Coils for the sac; sizes are diameter of the loops x length",
}
"""Title of every use of devices."""


def add(commands: options.Commands) -> None:
    """Add the command and its subcommand ``add``."""
    parser = options.add_command(commands, "devices", "List the devices of the catalogue, or add your own.", "devices")
    parser.add_argument("--find", metavar="TEXT", default="", help="list only devices with this in name, maker or use")
    parser.set_defaults(command=_devices)
    commands_of_devices = parser.add_subparsers(metavar="COMMAND")
    text = "Print the entry of a device: copy it to make one of your own."
    showing = options.add_command(commands_of_devices, "entry", text, "devices entry silk")
    showing.add_argument("device", help="key or name of the device")
    showing.set_defaults(command=_entry)
    text = "Add devices of your own to the catalogue."
    adding = options.add_command(commands_of_devices, "add", text, "devices add mine.toml")
    text = "TOML file in the form of vstent's catalogue.toml: every number with its source"
    adding.add_argument("file", type=Path, help=text)
    adding.set_defaults(command=_add)
    fitting = options.add_command(
        commands_of_devices,
        "fit",
        "Fit the numbers of a device to measurements, and write a catalogue entry and a picture.",
        "devices fit measurements.csv --like pipeline --out mine.toml",
    )
    text = "measured values, one row per tube"
    fitting.add_argument("file", type=Path, nargs="?", metavar="MEASUREMENTS.csv", help=text)
    fitting.add_argument("--like", metavar="DEVICE", help="similar device: its numbers are the first guess")
    text = "entry to write (.toml); the picture has its name (.png)"
    fitting.add_argument("--out", type=Path, metavar="FILE", help=text)
    text = "name of the device (default: that of the similar device, followed by measured)"
    fitting.add_argument("--name", help=text)
    options.add_flag(fitting, "all-sizes", "offer the device in all sizes of the similar one")
    options.add_flag(fitting, "template", "print an example of the CSV file")
    fitting.set_defaults(command=_fit)


def _devices(arguments: argparse.Namespace) -> int:
    """Print the catalogue by use, or the devices that match; return the exit code."""
    from vstent.cli.console import Console, device_table
    from vstent.devices.catalogue import baskets, catalogue
    from vstent.errors import DeviceError

    console, wanted, is_found = Console(), arguments.find.casefold(), False
    for use, title in USES.items():
        some = {
            key: design
            for key, design in (catalogue() | baskets()).items()
            if design.use == use and wanted in f"{key} {design.name} {design.maker} {use}".casefold()
        }
        if some:
            console.print(f"{title}:")
            console.print(device_table(some))
            is_found = True
    if not is_found:
        raise DeviceError(f"No device has {arguments.find!r} in its name, maker or use. Leave out --find to list all.")
    return 0


def _entry(arguments: argparse.Namespace) -> int:
    """Print the entry of a device; return the exit code."""
    from vstent.devices.catalogue import entry_of

    print(entry_of(arguments.device))
    return 0


def _add(arguments: argparse.Namespace) -> int:
    """Add the devices of a file to the catalogue and print them; return the exit code."""
    from vstent.cli.console import Console, device_table
    from vstent.devices.catalogue import add_devices

    Console().print(device_table(add_devices(arguments.file)))
    return 0


def _fit(arguments: argparse.Namespace) -> int:
    """Fit a device to measurements, write its entry and its picture, and print the numbers; return the exit code."""
    from vstent.cli.console import Console, correlation_table, fit_table
    from vstent.devices.catalogue import find_design
    from vstent.devices.entry import entry, key_of_name
    from vstent.devices.fit import fit
    from vstent.devices.measurements import TEMPLATE, read_measurements
    from vstent.devices.schema import parse
    from vstent.errors import InputError
    from vstent.io.files import write_bytes
    from vstent.io.writers import write_text
    from vstent.reporting.device_fit import picture

    console = Console()
    if arguments.template:
        print(TEMPLATE, end="")
        return 0
    if arguments.file is None or arguments.like is None or arguments.out is None:
        raise InputError(
            "Give the measurements, --like with a similar device, and --out. --template prints an example."
        )
    like = find_design(arguments.like)
    fitted = fit(read_measurements(arguments.file, like), like)
    name = arguments.name or f"{like.name} measured"
    text = entry(fitted, like, name, source=arguments.file.name, has_all_sizes=arguments.all_sizes)
    parse(text, "The fitted entry")  # refuses a device that cannot be made
    write_text(arguments.out, text)
    write_bytes(arguments.out.with_suffix(".png"), picture(fitted, name))
    console.print(fit_table(fitted))
    console.print(correlation_table(fitted))
    console.print(
        f"Entry in {arguments.out}, picture in {arguments.out.with_suffix('.png')}. "
        f"`vstent devices add {arguments.out}` adds it to the catalogue; then give --device {key_of_name(name)}."
    )
    return 0
