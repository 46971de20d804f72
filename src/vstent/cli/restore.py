"""`vstent restore`: find sac, neck and parent artery, and measure them."""

import argparse

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands, "restore", "Remove the sac, restore the parent artery, and measure both.", "restore scan/ --out case"
    )
    options.add_case(parser)
    options.add_settings(parser, *options.VESSEL)
    parser.set_defaults(command=_restore)


def _restore(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, morphology_table
    from vstent.study.pipeline import restore_vessel

    console, settings = Console(), options.given_settings(arguments)
    with console.live():
        _, measures = restore_vessel(
            arguments.input, arguments.out, settings, console.progress, replaces=arguments.replace
        )
    console.print(morphology_table(measures))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0
