"""Options of the command line: those of the settings, made from their fields, and what several commands share."""

import argparse
import os
import re
from collections.abc import Container
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from vstent import fields
from vstent.errors import InputError
from vstent.study.settings import OPTIONS, Settings, in_section, settings_of

if TYPE_CHECKING:
    from vstent.study.workers import AbstractWorkers

EPILOG: Final = "Lengths are in mm, coordinates are LPS.\nResearch use only: not cleared for diagnosis or treatment."
"""Last lines of every help text."""
STUDY: Final = ("treatments", "straightening", "flow", "uncertainty")
"""Sections of the settings that concern a study of a vessel."""
VESSEL: Final = ("input", "anatomy")
"""Sections of the settings that concern the vessel."""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Parser to which every command adds itself."""


def add_option(group: "argparse._ActionsContainer", option: fields.Option, **more: Any) -> None:
    """Add an option, and the one that states its opposite."""
    about = f"{option.help}, {option.limits.unit}" if option.limits.unit else option.help
    about += f" (default: {option.usual})" if option.usual else ""
    about += "; repeat for several" if option.separators else ""
    names = [one for one in (option.short, f"--{option.name}") if one]
    names.sort(key=lambda one: one.startswith("--") and one != f"--{option.name}")
    if option.off[0]:
        group = group.add_mutually_exclusive_group()
        add_flag(group, *option.off)
    if option.read is fields.flag:
        group.add_argument(*names, action="store_true", default=None, help=about, **more)
        return

    def read(text: str) -> Any:
        try:
            return option.value(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    kind: dict[str, Any] = {"type": read, "help": about}
    kind |= {"choices": option.choices} if option.choices and not option.is_file else {"metavar": option.placeholder}
    if option.separators:
        kind["action"] = "append"
    if option.alone:
        kind |= {"nargs": "?", "const": option.alone}
    group.add_argument(*names, **kind | more)


def add_number(
    group: "argparse._ActionsContainer", name: str, text: str, default: float, limits: fields.Limits
) -> None:
    """Add an option that is a number, with its default."""
    add_option(group, fields.Option(name, text, limits=limits, usual=f"{default:g}"), default=default)


def add_flag(group: "argparse._ActionsContainer", name: str, text: str) -> None:
    """Add an option without a value."""
    group.add_argument(f"--{name}", action="store_true", help=text)


def add_settings(parser: argparse.ArgumentParser, *sections: str, without: Container[str] = ()) -> None:
    """Add the options of sections of the settings, each section a group of the help."""
    for section in sections:
        group = parser.add_argument_group(section)
        for name, option in in_section(section).items():
            if name not in without:
                add_option(group, option)


def given(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options of the settings, by name; only those that are given."""
    names = (*OPTIONS, *(option.off[0] for option in OPTIONS.values() if option.off[0]))
    values = {name: getattr(arguments, name.replace("-", "_"), None) for name in names}
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if value is not None and value is not False
    }


def given_settings(arguments: argparse.Namespace, **usual: Any) -> Settings:
    """Return the settings that the options state."""
    return settings_of(usual | given(arguments))


def add_command(commands: Commands, name: str, text: str, example: str) -> argparse.ArgumentParser:
    """Add a command."""
    parser = commands.add_parser(
        name,
        help=text[0].lower() + text[1:].rstrip("."),
        description=fill(text, 80),
        epilog=f"Example:\n  vstent {example}\n\n{EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    # A minus before a digit begins a number or a point; argparse recognizes single numbers only.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    return parser


def add_case(parser: argparse.ArgumentParser) -> None:
    """Add input and case folder."""
    text = "scan (DICOM folder, NIfTI, NRRD, MHA, VTI, raw) or surface (STL, VTP, VTU, VTM, VTK, OBJ, PLY)"
    parser.add_argument("input", type=Path, help=text)
    text = "case folder; a folder that exists is continued"
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=text)
    text = "replace results in the case folder that belong to another input or other settings (default: refuse)"
    add_flag(parser, "replace", text)


def add_workers(group: "argparse._ArgumentGroup") -> None:
    """Add the number of parallel processes, and the clusters that may be used in their place."""
    jobs = fields.Option("jobs", "parallel processes", fields.whole, fields.Limits(low=1), "one per core", "N")
    add_option(group, jobs, default=cores())
    workers = group.add_mutually_exclusive_group()
    workers.add_argument("--scheduler", metavar="ADDRESS", help="use the workers of this Dask scheduler")
    add_flag(workers, "slurm", "use --jobs jobs of a Slurm queue (needs the extra cluster)")


def given_workers(arguments: argparse.Namespace, jobs: int, memory_MB: float) -> "AbstractWorkers":
    """Return the processes or the cluster that the options request; InputError for Slurm jobs of unknown memory."""
    from vstent.study.workers import DaskCluster, Processes, Slurm

    if arguments.scheduler:
        return DaskCluster(arguments.scheduler)
    if arguments.slurm and not memory_MB:
        raise InputError("The memory of a flow with this engine is unknown. Use --scheduler instead of --slurm.")
    if arguments.slurm:
        return Slurm(arguments.jobs, memory_MB)
    return Processes(jobs)


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
