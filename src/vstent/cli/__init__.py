"""Command line: arguments in, a study run, tables and messages out; one module per command.

Open ``run.py`` first; ``options.py`` holds the options that several commands share.
"""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from typing import Final

from vstent.cli import angiogram, app, batch, demo, devices, export, flow, followup, rank, run, vessel
from vstent.cli.interrupt import borne_interrupts
from vstent.cli.options import EPILOG
from vstent.errors import InputError, VstentError

COMMANDS: Final = (run, app, vessel, rank, batch, flow, angiogram, followup, export, demo, devices)
"""Modules of the commands in the order of the help."""
BAD_INPUT: Final = 2
"""Exit code where an input or option cannot be used."""
FAILED: Final = 1
"""Exit code where a computation failed."""
INTERRUPTED: Final = 130
"""Exit code after Ctrl-C."""
OUT_OF_MEMORY: Final = (
    "out of memory. Finished results are kept: use a machine with more memory, a part of the scan, or a wider grid "
    "spacing (--grid-spacing)."
)
"""Message where the memory does not suffice."""
HELPER: Final = (sys.executable, "-c", "from vstent.cli.warm import last; last()")
"""Command of a second process that compiles the kernels needed last while this process compiles those needed first."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, or those of the process.

    The exit code is 0 where it is done, 1 failed, 2 input cannot be used, 130 interrupted.
    """
    # The linear systems are too small for several threads of the linear algebra library.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed, such as by 2>&-: a file opened later must not get its number
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a redirect on Windows has few characters; others become question marks
            stream.reconfigure(errors="replace")
    with borne_interrupts():
        return _done(_parser().parse_args(argv))


def _done(arguments: argparse.Namespace) -> int:
    """Run a command and return the exit code."""
    try:
        if "answered" in arguments and arguments.answered(arguments):
            return 0
        if arguments.command.__module__ in (app.__name__, devices.__name__):  # they need no kernels to start
            return int(arguments.command(arguments))
        from vstent.kernels.first_use import reporting_compilation

        with reporting_compilation(_first_use, helper=HELPER):
            return int(arguments.command(arguments))
    except VstentError as error:
        sentence, code = str(error), BAD_INPUT if isinstance(error, InputError) else FAILED
    except KeyboardInterrupt:
        sentence, code = "stopped. Finished results are kept: give the same command again to resume.", INTERRUPTED
    except MemoryError:
        sentence, code = OUT_OF_MEMORY, FAILED
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        remedy = "No half-written file is left: correct that and give the same command again."
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            remedy = "Finished results are kept: free disk space and give the same command again."
        sentence, code = f"{error.strerror or error}{where}. {remedy}", FAILED
    print(f"vstent: {sentence}", file=sys.stderr)
    return code


def _first_use() -> None:
    """Print a notice that the kernels are being compiled."""
    said = "first use of this version: compiling its numerical loops, which takes about half a minute once."
    print(f"vstent: {said}", file=sys.stderr, flush=True)


class _Version(argparse.Action):
    """Prints the version; it is looked up on request only, because that is slow."""

    def __call__(self, parser: argparse.ArgumentParser, *given: object) -> None:
        """Print the version and exit."""
        from importlib.metadata import version

        print(f"vstent {version('vstent')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="vstent",
        description="Virtual stenting of intracranial aneurysms.",
        epilog=f"Begin with: vstent demo --no-flow --out demo\n\n{EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser
