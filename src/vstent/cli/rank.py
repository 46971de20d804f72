"""`vstent rank`: deploy every size of the chosen devices and rank them."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vstent.cli import options
from vstent.fields import Limits, Option, numbers, whole

if TYPE_CHECKING:
    from vstent.cli.console import Console
    from vstent.geometry.vessel import Anatomy
    from vstent.plan.rank import Ranking
    from vstent.study.settings import Settings

SHOWN: Final = 15
"""Number of rows shown on the terminal; the files hold all."""


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "rank",
        "Deploy every size of the chosen devices, measure them and rank them.",
        "rank artery.stl --device silk --device pipeline --out case",
    )
    options.add_case(parser)
    of_treatments = ("treatment", "diameter", "length", "center")
    options.add_settings(parser, *options.VESSEL, "treatments", "flow", without=("no-flow", *of_treatments))
    ranking = parser.add_argument_group("ranking")
    ranking.add_argument("--criteria", type=Path, metavar="TOML", help="ranking criteria (default: vstent's own)")
    shift = "shifts from the proposed landing to try, mm, positive distally"
    options.add_option(ranking, Option("shift", shift, numbers, usual="0", metavar="MM,MM,..."), default=(0.0,))
    flows = "compute the flow with the N best sizes, the best of each device among them"
    options.add_option(ranking, Option("flow", flows, whole, Limits(low=1), "none", "N"), dest="flow_count")
    ranking.add_argument(
        "--retention",
        action="store_true",
        help="carry contrast through these flows too; the time that it stays in the sac counts in their scores",
    )
    options.add_workers(ranking)
    parser.set_defaults(command=_rank)


def _rank(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, ranking_reasons, ranking_table
    from vstent.devices.catalogue import find_design
    from vstent.errors import InputError
    from vstent.plan.criteria import default_criteria, read_criteria
    from vstent.plan.rank import rank
    from vstent.study.outputs import write_ranking
    from vstent.study.pipeline import restore_vessel
    from vstent.study.progress import Progress

    if arguments.retention and not arguments.flow_count:
        raise InputError("Contrast moves with a flow. Give --flow N with --retention.")
    if (arguments.scheduler or arguments.slurm) and not arguments.flow_count:
        raise InputError("A cluster computes the flows of a ranking. Give --flow N with --scheduler or --slurm.")
    settings = options.given_settings(arguments)
    designs = [find_design(name) for name in settings.devices]
    criteria = read_criteria(arguments.criteria) if arguments.criteria else default_criteria()
    console = Console()
    with console.live():
        anatomy, _ = restore_vessel(
            arguments.input, arguments.out, settings, console.progress, replaces=arguments.replace
        )
        ranking = rank(
            anatomy,
            designs,
            criteria=criteria,
            shifts_mm=arguments.shift,
            jobs=arguments.jobs,
            progress=lambda done, total: console.progress(Progress("rank", done / total, f"{done} of {total}")),
        )
        if arguments.flow_count:
            ranking = _with_flows(arguments, settings, anatomy, ranking, console)
    write_ranking(arguments.out, ranking)
    console.print(ranking_table(ranking, SHOWN))
    console.print(ranking_reasons(ranking, SHOWN))
    console.print(f"All in {arguments.out / 'ranking.csv'} and ranking.json. Research use only.")
    return 0


def _with_flows(
    arguments: argparse.Namespace, settings: "Settings", anatomy: "Anatomy", ranking: "Ranking", console: "Console"
) -> "Ranking":
    """Return the ranking with the flows of its best sizes; an interrupted one goes on."""
    from vstent.flow.settings import FlowSettings
    from vstent.flow.simulation import check_engine
    from vstent.plan.rank_flow import chosen_of, rank_flows
    from vstent.study.keys import ANATOMY, anatomy_keys, hash_of
    from vstent.study.progress import Progress
    from vstent.study.ranking_flows import FlowStore, compute_missing, parallel_flows

    def told(done: int, total: int, name: str) -> None:
        console.progress(Progress("rank by flow", done / total, f"{done} of {total}: {name}"))

    flow = settings.flow or FlowSettings()
    check_engine(flow)
    has_contrast = arguments.retention
    key = anatomy_keys(hash_of(arguments.input), settings)[ANATOMY]
    stored, chosen = FlowStore(arguments.out, key, flow), chosen_of(ranking, arguments.flow_count)
    jobs, memory_MB = parallel_flows(anatomy, chosen, flow, min(arguments.jobs, len(chosen)))
    is_cluster = bool(arguments.scheduler or arguments.slurm)
    is_parallel = bool(anatomy.aneurysms and chosen) and (jobs > 1 or is_cluster)
    if is_parallel:
        workers = options.given_workers(arguments, jobs, memory_MB)
        threads = 1 if is_cluster else max(1, options.cores() // jobs)
        compute_missing(
            anatomy, chosen, flow, stored, workers, has_contrast=has_contrast, threads=threads, progress=told
        )
    return rank_flows(
        anatomy,
        ranking,
        flow,
        arguments.flow_count,
        has_contrast=has_contrast,
        stored=stored,
        progress=None if is_parallel else told,
    )
