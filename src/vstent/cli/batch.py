"""`vstent batch`: many cases with every device, in one table."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "batch",
        "Run many cases with every device, and write one table and a cohort report.",
        "batch cohort/ --device silk --no-flow --out study --jobs 2",
    )
    parser.add_argument(
        "cohort",
        type=Path,
        help="folder of scans or surfaces, or a CSV file with a column `input`, and columns named like options",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="output folder; a folder that exists is continued"
    )
    options.add_settings(parser, *options.VESSEL, *options.STUDY)
    working = parser.add_argument_group("parallel work")
    options.add_workers(working)
    working.add_argument(
        "--keep-files", action="store_true", help="keep all files of every case (default: the table only)"
    )
    parser.set_defaults(command=_batch)


def _batch(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, cohort_table
    from vstent.cohort.batch import collect, left_to_do, pictures_of, run_cohort, write_table
    from vstent.cohort.cases import find_cases, row_count
    from vstent.cohort.estimate import estimate

    console = Console()
    cases = find_cases(arguments.cohort, options.given(arguments))
    tasks = left_to_do(cases, arguments.out, keeps_files=arguments.keep_files)
    foreseen = estimate([task.case for task in tasks], arguments.jobs)
    console.print(f"{len(cases)} cases, {row_count(cases)} rows; {len(tasks)} cases to do: {foreseen.sentence}.")
    with console.live():
        run_cohort(
            tasks, arguments.out, options.given_workers(arguments, foreseen.jobs, foreseen.memory_MB), _teller(console)
        )
    rows = collect(cases, arguments.out)
    written = write_table(arguments.out, rows)
    _report(arguments.out, rows, pictures_of(rows, arguments.out))
    console.print(cohort_table(rows))
    console.print(f"Results in {', '.join(str(path) for path in [*written, arguments.out / 'cohort.html'])}.")
    if len(written) == 1:
        console.say("No Parquet file was written: it needs pyarrow (pip install 'vstent[parquet]').")
    console.print("Research use only.")
    return 0


def _teller(console: Any) -> Any:
    """Return a function that prints a line for every finished case."""

    def tell(done: int, total: int, name: str, rows: Sequence[dict[str, Any]]) -> None:
        faults = [
            f" {row['treatment']}, {row['outcome']}: {row['sentence']}" for row in rows if row["outcome"] != "done"
        ]
        console.say(f"{done}/{total} {name} {_seconds(rows)}{''.join(faults)}")

    return tell


def _seconds(rows: Sequence[dict[str, Any]]) -> str:
    """Return the run time of a case as text."""
    return ", ".join(sorted({f"{row['case_s']:.0f} s" for row in rows if "case_s" in row}))


def _report(out: Path, rows: Sequence[dict[str, Any]], pictures: dict[tuple[str, str], bytes]) -> None:
    """Write the report of the cohort."""
    from vstent.io.writers import write_text
    from vstent.reporting.cohort import cohort_report

    write_text(out / "cohort.html", cohort_report(out.resolve().name, rows, pictures))
