"""`vstent export`: write a case for other solvers."""

import argparse
from pathlib import Path

from vstent.cli import options
from vstent.errors import InputError
from vstent.fields import Limits, Option, whole


def add(commands: options.Commands) -> None:
    """Add the command and its subcommands."""
    text = "Write a case for other flow solvers."
    parser = options.add_command(commands, "export", text, "export openfoam case --out foam")
    kinds = parser.add_subparsers(required=True, metavar="WHAT")
    text = "Write an OpenFOAM case folder: mesh settings, boundary conditions and scripts (lengths in m)."
    foam = options.add_command(kinds, "openfoam", text, "export openfoam case --device silk --out foam")
    _add_input(foam)
    unsupported = ("no-flow", "engine", "refine", "gpu")
    options.add_settings(foam, *options.VESSEL, "treatments", "flow", without=unsupported)
    group = foam.add_argument_group("OpenFOAM")
    text = "openfoam.com or openfoam.org (default: the one installed, else com)"
    group.add_argument("--flavour", choices=("com", "org"), help=text)
    layers = Option("layers", "prism layers along the wall", whole, Limits(low=0), "2", "N")
    options.add_option(group, layers, default=2)
    foam.set_defaults(command=_openfoam)
    text = "Write the boundary of the lumen as watertight named patches (STL, VTP, JSON; lengths in mm)."
    patches = options.add_command(kinds, "patches", text, "export patches case --out patches")
    _add_input(patches)
    options.add_settings(patches, *options.VESSEL)
    patches.set_defaults(command=_patches)


def _add_input(parser: argparse.ArgumentParser) -> None:
    """Add input and output folder."""
    parser.add_argument("input", type=Path, help="case folder of `vstent run`, scan or surface")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder")


def _openfoam(arguments: argparse.Namespace) -> int:
    """Run ``export openfoam``; return the exit code."""
    from vstent.cli.console import Console
    from vstent.study.exports import export_openfoam

    settings = options.given_settings(arguments, device=())
    if len(settings.treatments) > 1:
        raise InputError(
            "A case folder of OpenFOAM holds the wires of one treatment: give one --device or --treatment."
        )
    foam = {"layers": arguments.layers}
    if arguments.flavour:
        foam["flavour"] = arguments.flavour
    console = Console()
    with console.live():
        export_openfoam(arguments.input, arguments.out, settings, foam, console.progress)
    console.print(f"OpenFOAM case in {arguments.out}: {arguments.out / 'Allrun'} runs it. Research use only.")
    return 0


def _patches(arguments: argparse.Namespace) -> int:
    """Run ``export patches``; return the exit code."""
    from vstent.cli.console import Console
    from vstent.study.exports import export_patches

    console, settings = Console(), options.given_settings(arguments)
    with console.live():
        patches = export_patches(arguments.input, arguments.out, settings, console.progress)
    for patch in patches:
        console.print(f"{patch['patch_id']:3d}  {patch['name']:10s} {patch['area_mm2']:9.2f} mm²")
    console.print(f"Patches in {arguments.out}, lengths in mm. Research use only.")
    return 0
