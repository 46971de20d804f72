"""`vstent rank`: every size of the chosen devices, the best first."""

import argparse
from pathlib import Path
from typing import Final

from vstent.cli import options

SHOWN: Final = 15
"""Rows of the table on the terminal; the files hold all."""


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(commands, "rank", "scan or surface -> every size deployed, measured, ranked")
    options.add_outlet(options.add_geometry(parser))
    options.add_devices(parser)
    ranking = parser.add_argument_group("ranking")
    ranking.add_argument("--criteria", type=Path, metavar="TOML", help="criteria instead of vstent's own")
    ranking.add_argument(
        "--shift",
        type=options.numbers,
        default=[0.0],
        metavar="MM,MM,...",
        help="landing places to try, against the proposed one, distally",
    )
    options.add_jobs(ranking)
    parser.set_defaults(command=_rank)


def _rank(arguments: argparse.Namespace) -> int:
    from vstent.cli.console import Console, ranking_reasons, ranking_table
    from vstent.devices.catalogue import find_design
    from vstent.plan.criteria import default_criteria, read_criteria
    from vstent.plan.rank import rank
    from vstent.study.outputs import write_ranking
    from vstent.study.pipeline import restore_vessel
    from vstent.study.types import Settings

    designs = [find_design(name) for name in options.given_devices(arguments)]
    criteria = read_criteria(arguments.criteria) if arguments.criteria else default_criteria()
    console = Console()
    settings = Settings(devices=(), flow=None, **options.given_geometry(arguments))
    with console.live():
        anatomy, _ = restore_vessel(arguments.input, arguments.out, settings, console.progress)
        ranking = rank(
            anatomy,
            designs,
            criteria=criteria,
            shifts_mm=arguments.shift,
            jobs=arguments.jobs,
            progress=lambda done, total: console.progress("rank", done / total, f"{done} of {total}"),
        )
    write_ranking(arguments.out, ranking)
    console.print(ranking_table(ranking, SHOWN))
    console.print(ranking_reasons(ranking, SHOWN))
    console.print(f"All in {arguments.out / 'ranking.csv'} and ranking.json. Research use only.")
    return 0
