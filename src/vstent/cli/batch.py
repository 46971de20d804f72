"""`vstent batch`: many cases with every device, in one table."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    text = "Run many cases with every device, and write one table and a cohort report."
    parser = options.add_command(commands, "batch", text, "batch cohort/ --device silk --no-flow --out study --jobs 2")
    text = "folder of scans or surfaces, or a CSV file with a column `input`, and columns named like options"
    parser.add_argument("cohort", type=Path, help=text)
    text = "output folder; a folder that exists is continued"
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=text)
    options.add_settings(parser, *options.VESSEL, *options.STUDY)
    working = parser.add_argument_group("parallel work")
    options.add_workers(working)
    options.add_flag(working, "keep-files", "keep all files of every case (default: the table only)")
    parser.set_defaults(command=_batch)


def _batch(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from vstent.cli.console import Console, cohort_table
    from vstent.cohort.batch import collect, left_to_do, pictures_of, run_cohort, write_table
    from vstent.cohort.cases import find_cases
    from vstent.cohort.estimate import estimate
    from vstent.io.writers import write_text
    from vstent.reporting.cohort import cohort_report

    console, out = Console(), arguments.out
    cases = find_cases(arguments.cohort, options.given(arguments))
    tasks = left_to_do(cases, out, keeps_files=arguments.keep_files)
    foreseen = estimate([task.case for task in tasks], arguments.jobs)
    n_rows = sum(len(case.settings.treatments) for case in cases)
    console.print(f"{len(cases)} cases, {n_rows} rows; {len(tasks)} cases to do: {foreseen.sentence}.")

    def told(done: int, total: int, name: str, rows: Sequence[dict[str, Any]]) -> None:
        failed = [row for row in rows if row["outcome"] != "done"]
        faults = "".join(f" {row['treatment']}, {row['outcome']}: {row['sentence']}" for row in failed)
        took = ", ".join(sorted({f"{row['case_s']:.0f} s" for row in rows if "case_s" in row}))
        console.say(f"{done}/{total} {name} {took}{faults}")

    with console.live():
        run_cohort(tasks, out, options.given_workers(arguments, foreseen.jobs, foreseen.memory_MB), told)
    rows = collect(cases, out)
    written = write_table(out, rows)
    write_text(out / "cohort.html", cohort_report(out.resolve().name, rows, pictures_of(rows, out)))
    console.print(cohort_table(rows))
    console.print(f"Results in {', '.join(str(path) for path in [*written, out / 'cohort.html'])}.")
    if len(written) == 1:
        console.say("No Parquet file was written: it needs pyarrow (pip install 'vstent[parquet]').")
    n_failed = sum(row["outcome"] != "done" for row in rows)
    if n_failed:
        console.say(f"{n_failed} of {len(rows)} rows are not done; the table states the reasons.")
    console.print("Research use only.")
    return 1 if n_failed else 0
