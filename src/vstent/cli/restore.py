"""`vstent restore`: find the sac and its neck, reconstruct the parent artery and measure them."""

import argparse

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "restore",
        "Find the sac and its neck, reconstruct the parent artery and measure them.",
        "vstent restore artery.stl --units mm --out case",
    )
    options.add_geometry(parser)
    options.add_outlet(parser)
    options.add_neck(parser)
    parser.set_defaults(command=_restore)


def _restore(arguments: argparse.Namespace) -> int:
    """Reconstruct the artery and print its morphology."""
    from vstent.cli.console import Console, morphology_table
    from vstent.study.pipeline import restore_vessel
    from vstent.study.types import Settings

    console = Console()
    settings = Settings(devices=(), flow=None, **options.given_geometry(arguments))
    with console.live():
        _, measures = restore_vessel(arguments.input, arguments.out, settings, console.progress)
    console.print(morphology_table(measures))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0
