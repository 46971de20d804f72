"""`vstent trace` and `vstent restore`: find and measure the vessel, its openings, sac, neck and parent artery."""

import argparse

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the commands."""
    text = "Find the vessel wall, its openings and its centerlines."
    tracing = options.add_command(commands, "trace", text, "trace artery.stl --out case")
    options.add_case(tracing)
    options.add_settings(tracing, *options.VESSEL, without=("outlet", "neck", "upstream", "downstream"))
    tracing.set_defaults(command=_trace)
    text = "Remove the sac, restore the parent artery, and measure both."
    restoring = options.add_command(commands, "restore", text, "restore scan/ --out case")
    options.add_case(restoring)
    options.add_settings(restoring, *options.VESSEL)
    restoring.set_defaults(command=_restore)


def _trace(arguments: argparse.Namespace) -> int:
    """Run ``trace``; return the exit code."""
    from vstent.cli.console import Console, opening_table
    from vstent.study.pipeline import trace_vessel

    console, settings = Console(), options.given_settings(arguments)
    with console.live():
        vessel = trace_vessel(arguments.input, arguments.out, settings, console.progress, replaces=arguments.replace)
    console.print(opening_table(vessel.openings))
    console.print(f"Results in {arguments.out}. Research use only.")
    return 0


def _restore(arguments: argparse.Namespace) -> int:
    """Run ``restore``; return the exit code."""
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
