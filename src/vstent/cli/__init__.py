"""Command line: one module for each command. Only this package prints, and only it reads command-line arguments."""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from typing import Final

from vstent.cli import app, batch, demo, devices, export, flow, options, rank, restore, run, trace
from vstent.cli.interrupt import borne_interrupts
from vstent.errors import InputError, VstentError

COMMANDS: Final = (run, app, trace, restore, rank, batch, flow, export, demo, devices)
"""Modules of the commands, in the order of the help text."""
BAD_INPUT: Final = 2
"""Exit code: the input or an option cannot be used."""
FAILED: Final = 1
"""Exit code: the computation or the machine failed."""
INTERRUPTED: Final = 130
"""Exit code: the user pressed Ctrl-C."""
HELPER: Final = (sys.executable, "-m", "vstent.cli.warm")
"""Command of a second process that compiles the kernels needed later, while this process compiles those needed now."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Parameters
    ----------
    argv : the arguments; None: those of this process.

    Returns
    -------
    code : 0 done, 1 failed, 2 the input cannot be used, 130 interrupted.
    """
    # The linear systems are many and small: threads of the linear algebra library would only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with borne_interrupts():
        return _done(parse(sys.argv[1:] if argv is None else argv))


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of the command line; a notice on standard error reports old names of options."""
    present, notices = options.with_present_names(words)
    for notice in notices:
        print(f"vstent: {notice}", file=sys.stderr)
    return _parser().parse_args(present)


def _done(arguments: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    try:
        if arguments.command.__module__ in (app.__name__, devices.__name__):  # these start without kernels
            return int(arguments.command(arguments))
        from vstent.kernels.first_use import telling

        with telling(_first_use, helper=HELPER):
            return int(arguments.command(arguments))
    except InputError as error:
        return _fail(str(error), BAD_INPUT)
    except VstentError as error:
        return _fail(str(error), FAILED)
    except KeyboardInterrupt:
        return _fail("stopped. Finished stages are kept: run the same command again to continue.", INTERRUPTED)
    except MemoryError:
        return _fail(
            "not enough memory. Finished stages are kept: set a larger grid spacing (--grid-spacing), give a part of "
            "the scan, or run the same command on a machine with more memory.",
            FAILED,
        )
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _fail(f"{error.strerror or error}{where}. {_remedy(error)}", FAILED)


def _remedy(error: OSError) -> str:
    """Return a sentence on what to do about an error of the operating system."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (
            "Finished stages are kept and no file is incomplete: free some disk space and run the same command again."
        )
    return "No file is incomplete: correct the cause and run the same command again."


def _first_use() -> None:
    """Report that kernels are being compiled."""
    said = "first use of this version: compiling its kernels, which happens once and takes about half a minute."
    print(f"vstent: {said}", file=sys.stderr, flush=True)


def _fail(sentence: str, code: int) -> int:
    """Print an error and return the exit code."""
    print(f"vstent: {sentence}", file=sys.stderr)
    return code


class _Version(argparse.Action):
    """Option that prints the version; it is looked up only on request, because that takes time."""

    def __call__(self, parser: argparse.ArgumentParser, *given: object) -> None:
        """Print the version and exit."""
        from importlib.metadata import version

        print(f"vstent {version('vstent')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="vstent",
        description="Plan and simulate the stenting of brain aneurysms, from scan to blood flow.",
        **options.appearance("vstent demo --out demo"),
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser
