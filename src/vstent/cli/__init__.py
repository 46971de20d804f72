"""Command line: one module a command. The only place that prints, and that knows of files' names on a shell."""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from typing import Final

from vstent.cli import app, batch, demo, devices, export, flow, rank, restore, run, trace
from vstent.cli.interrupt import borne_interrupts
from vstent.cli.options import EPILOG
from vstent.errors import InputError, VstentError

COMMANDS: Final = (run, app, trace, restore, rank, batch, flow, export, demo, devices)
"""In the order of the help."""
BAD_INPUT: Final = 2
FAILED: Final = 1
INTERRUPTED: Final = 130
HELPER: Final = (sys.executable, "-m", "vstent.cli.warm")
"""Compiles the kernels that are needed last, while this process compiles those that it needs now."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (0 done, 1 failed, 2 bad input, 130 interrupted)."""
    # Many small systems are solved, none large: threads of the linear algebra only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with borne_interrupts():
        return _done(_parser().parse_args(argv))


def _done(arguments: argparse.Namespace) -> int:
    """Do what was asked; return the exit code."""
    try:
        if arguments.command.__module__ in (app.__name__, devices.__name__):  # they begin without kernels
            return int(arguments.command(arguments))
        from vstent.kernels.first_use import telling

        with telling(_first_use, helper=HELPER):
            return int(arguments.command(arguments))
    except InputError as error:
        return _fail(str(error), BAD_INPUT)
    except VstentError as error:
        return _fail(str(error), FAILED)
    except KeyboardInterrupt:
        return _fail("stopped. What was finished is kept: give the same command again to go on.", INTERRUPTED)
    except MemoryError:
        return _fail(
            "there is not enough memory for this. What was finished is kept: give the same command on a machine with "
            "more of it, or a part of the scan, or a larger --cell-size.",
            FAILED,
        )
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _fail(f"{error.strerror or error}{where}. {_remedy(error)}", FAILED)


def _remedy(error: OSError) -> str:
    """One thing to do about what the system refused."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "What was finished is kept, and nothing half-written: make room and give the same command again."
    return "Nothing half-written was left: mend that and give the same command again."


def _first_use() -> None:
    said = "first use of this version: its kernels are compiled, once, which takes about half a minute."
    print(f"vstent: {said}", file=sys.stderr, flush=True)


def _fail(sentence: str, code: int) -> int:
    print(f"vstent: {sentence}", file=sys.stderr)
    return code


class _Version(argparse.Action):
    """Tells the version; to know it takes a while, so only when asked."""

    def __call__(self, parser: argparse.ArgumentParser, *given: object) -> None:
        """Print it and end."""
        from importlib.metadata import version

        print(f"vstent {version('vstent')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vstent", description="Virtual stenting of intracranial aneurysms.", epilog=EPILOG
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="tell the version, and end")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser
