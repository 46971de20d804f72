"""`vstent rank`: deploy every size of the chosen devices and rank the results."""

import argparse
from pathlib import Path
from typing import Final

from vstent.cli import options

SHOWN: Final = 15
"""Number of rows of the table on the terminal; the files contain all candidates."""


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "rank",
        "Deploy every size of the chosen devices, measure each result and rank them.",
        "vstent rank scan.nii.gz --out case --device silk --shift -2,0,2",
    )
    options.add_geometry(parser)
    options.add_outlet(parser)
    options.add_devices(parser)
    ranking = options.group(parser, options.RANKING)
    ranking.add_argument(
        "--criteria", type=Path, metavar="TOML", help="file with your own ranking criteria (default: vstent's own)"
    )
    ranking.add_argument(
        "--shift",
        type=options.numbers,
        default=[0.0],
        metavar="MM,MM,...",
        help="shifts to try, mm from the proposed position, positive towards distal (default: 0)",
    )
    options.add_jobs(parser)
    parser.set_defaults(command=_rank)


def _rank(arguments: argparse.Namespace) -> int:
    """Rank all sizes, write the ranking and print the best."""
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
    console.print(f"All candidates are in {arguments.out / 'ranking.csv'} and ranking.json. Research use only.")
    return 0
