"""`vstent rank`: deploy every size of the chosen devices and rank them, or rank whole treatments by their flows."""

import argparse
from pathlib import Path
from typing import Final

from vstent.cli import options
from vstent.fields import Limits, Option, numbers, whole

SHOWN: Final = 15
"""Number of rows shown on the terminal; the files hold all."""


def add(commands: options.Commands) -> None:
    """Add the command."""
    text = "Deploy every size of the chosen devices and rank them; or rank whole treatments by their flows."
    parser = options.add_command(commands, "rank", text, "rank artery.stl --device silk --device pipeline --out case")
    options.add_case(parser)
    of_treatments = ("diameter", "length", "center")
    options.add_settings(parser, *options.VESSEL, "treatments", "flow", without=("no-flow", *of_treatments))
    ranking = parser.add_argument_group("ranking")
    ranking.add_argument("--criteria", type=Path, metavar="TOML", help="ranking criteria (default: vstent's own)")
    shift = "shifts from the proposed landing to try, mm, positive distally"
    options.add_option(ranking, Option("shift", shift, numbers, usual="0", metavar="MM,MM,..."), default=(0.0,))
    flows = "compute the flow with the N best sizes, the best of each device among them"
    options.add_option(ranking, Option("flow", flows, whole, Limits(low=1), "none", "N"), dest="flow_count")
    retention = "carry contrast through these flows too; the time that it stays in the sac counts in their scores"
    options.add_flag(ranking, "retention", retention)
    options.add_workers(ranking)
    parser.set_defaults(command=lambda given: (_rank_treatments if given.treatment else _rank_sizes)(given))


def _rank_treatments(arguments: argparse.Namespace) -> int:
    """Compute the flows of treatments, and rank these; return the exit code: 1 where one failed."""
    from vstent.cli.console import Console, treatment_reasons, treatments_table
    from vstent.errors import InputError
    from vstent.io.writers import write_json
    from vstent.study.pipeline import run

    of_sizes = arguments.criteria or arguments.flow_count or arguments.retention or arguments.shift != (0.0,)
    if of_sizes or arguments.scheduler or arguments.slurm:
        raise InputError("With --treatment, whole treatments are ranked by their flows: give only settings of those.")
    console, out = Console(), arguments.out
    with console.live():
        case = run(
            arguments.input, out, options.given_settings(arguments), console.progress, replaces=arguments.replace
        )
    ranked = case.metrics.get("ranking", [])
    if ranked:
        write_json(out / "treatments.json", ranked)
        console.print(treatments_table(ranked))
        console.print(treatment_reasons(ranked))
        console.print(f"All in {out / 'treatments.json'} and metrics.json. Research use only.")
    for name, sentence in case.failures.items():
        console.say(f"vstent: {name}: {sentence}")
    if not ranked:
        console.say("vstent: there is nothing to rank: give at least two treatments whose flows can be computed.")
    return 1 if case.failures or not ranked else 0


def _rank_sizes(arguments: argparse.Namespace) -> int:
    """Rank sizes of devices; return the exit code."""
    from vstent.cli.console import Console, ranking_reasons, ranking_tables
    from vstent.devices.catalogue import find_design
    from vstent.errors import InputError
    from vstent.flow.settings import FlowSettings
    from vstent.flow.simulation import check_engine
    from vstent.plan.criteria import default_criteria, read_criteria
    from vstent.plan.rank import rank
    from vstent.plan.rank_flow import chosen_of, rank_flows
    from vstent.study.keys import ANATOMY, anatomy_keys, hash_of
    from vstent.study.outputs import write_ranking
    from vstent.study.pipeline import restore_vessel
    from vstent.study.progress import Progress
    from vstent.study.ranking_flows import FlowStore, compute_missing, parallel_flows
    from vstent.study.stages import ask_for_aneurysm

    is_cluster, count = bool(arguments.scheduler or arguments.slurm), arguments.flow_count
    if arguments.retention and not count:
        raise InputError("Contrast moves with a flow. Give --flow N with --retention.")
    if is_cluster and not count:
        raise InputError("A cluster computes the flows of a ranking. Give --flow N with --scheduler or --slurm.")
    settings, out = options.given_settings(arguments), arguments.out
    designs = [find_design(name) for name in settings.devices]
    criteria = read_criteria(arguments.criteria) if arguments.criteria else default_criteria()
    console = Console()

    def told_sizes(done: int, total: int) -> None:
        console.progress(Progress("rank", done / total, f"{done} of {total}"))

    def told_flows(done: int, total: int, name: str) -> None:
        console.progress(Progress("rank by flow", done / total, f"{done} of {total}: {name}"))

    with console.live():
        anatomy, _ = restore_vessel(arguments.input, out, settings, console.progress, replaces=arguments.replace)
        ask_for_aneurysm(anatomy, settings)
        tried = {"criteria": criteria, "shifts_mm": arguments.shift, "jobs": arguments.jobs}
        ranking = rank(anatomy, designs, **tried, progress=told_sizes)
        if count:
            flow = settings.flow or FlowSettings()
            check_engine(flow)
            key, chosen = anatomy_keys(hash_of(arguments.input), settings)[ANATOMY], chosen_of(ranking, count)
            stored = FlowStore(out, key, flow)
            jobs, memory_MB = parallel_flows(anatomy, chosen, flow, min(arguments.jobs, len(chosen)))
            is_parallel = bool(anatomy.aneurysms and chosen) and (jobs > 1 or is_cluster)
            has_contrast = {"has_contrast": arguments.retention}
            if is_parallel:
                workers = options.given_workers(arguments, jobs, memory_MB)
                threads = 1 if is_cluster else max(1, options.cores() // jobs)
                given = anatomy, chosen, flow, stored, workers
                compute_missing(*given, **has_contrast, threads=threads, progress=told_flows)
            told = None if is_parallel else told_flows
            ranking = rank_flows(anatomy, ranking, flow, count, **has_contrast, stored=stored, progress=told)
    write_ranking(out, ranking)
    for table in ranking_tables(ranking, SHOWN):
        console.print(table)
    console.print(ranking_reasons(ranking, SHOWN))
    console.print(f"All in {out / 'ranking.csv'} and ranking.json. Research use only.")
    return 0
