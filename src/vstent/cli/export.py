"""`vstent export`: write a case for other solvers."""

import argparse
from pathlib import Path

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command and its sub-commands."""
    parser = options.add_command(
        commands, "export", "Write a case for other solvers.", "vstent export patches case --out patches"
    )
    kinds = parser.add_subparsers(required=True, metavar="WHAT")
    foam = options.add_command(
        kinds,
        "openfoam",
        "Write an OpenFOAM case folder: mesh settings, boundary conditions, run scripts.",
        "vstent export openfoam case --out foam --device silk --processes 4",
    )
    _add_input(foam)
    options.group(foam, options.DEVICES).add_argument(
        "--device",
        metavar="NAME",
        help="mesh the struts of this device over the neck and the branch ostia (default: no device)",
    )
    options.add_problem(foam)
    options.add_processes(foam)
    mesh = options.group(foam, options.OPENFOAM)
    mesh.add_argument(
        "--flavour",
        choices=("com", "org"),
        help="distribution of OpenFOAM: openfoam.com or openfoam.org (default: the installed one, otherwise com)",
    )
    mesh.add_argument(
        "--layers",
        type=_layers,
        default=2,
        metavar="N",
        help="number of boundary layers of flat cells along the wall (default: 2)",
    )
    foam.set_defaults(command=_openfoam)
    patches = options.add_command(
        kinds,
        "patches",
        "Write the boundary of the blood volume as watertight, named surface patches.",
        "vstent export patches case --out patches",
    )
    _add_input(patches)
    patches.set_defaults(command=_patches)


def _add_input(parser: argparse.ArgumentParser) -> None:
    """Add the input, the folder to write, and the options that describe the vessel."""
    options.group(parser, options.INPUT).add_argument(
        "input", type=Path, help=f"case folder of `vstent run`, {options.SCANS}"
    )
    options.group(parser, options.OUTPUT).add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write (required)"
    )
    options.add_given(parser)
    options.add_outlet(parser)


def _layers(text: str) -> int:
    """Convert text to a number of layers."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of layers: give 0 or more")
    return int(text)


def _openfoam(arguments: argparse.Namespace) -> int:
    """Write an OpenFOAM case folder."""
    from vstent.cli.console import Console
    from vstent.study.exports import export_openfoam
    from vstent.study.types import Settings

    devices = (arguments.device,) if arguments.device else ()
    settings = Settings(devices=devices, flow=options.given_problem(arguments), **options.given_geometry(arguments))
    foam = {"processes": arguments.processes, "layers": arguments.layers}
    if arguments.flavour:
        foam["flavour"] = arguments.flavour
    console = Console()
    with console.live():
        export_openfoam(arguments.input, arguments.out, settings, foam, console.progress)
    console.print(f"OpenFOAM case in {arguments.out}; run it with {arguments.out / 'Allrun'}. Research use only.")
    return 0


def _patches(arguments: argparse.Namespace) -> int:
    """Write the patches and list them."""
    from vstent.cli.console import Console
    from vstent.study.exports import export_patches
    from vstent.study.types import Settings

    settings = Settings(devices=(), flow=None, **options.given_geometry(arguments))
    console = Console()
    with console.live():
        patches = export_patches(arguments.input, arguments.out, settings, console.progress)
    for patch in patches:
        console.print(f"{patch['patch_id']:3d}  {patch['name']:10s} {patch['area_mm2']:9.2f} mm2")
    console.print(f"Patches in {arguments.out}, lengths in mm. Research use only.")
    return 0
