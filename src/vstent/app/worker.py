"""Worker process: `python -m vstent.app.worker KIND FOLDER` runs one job and reports it, one JSON line per message.

The first line of its standard input is the case's state when the job was started; later choices do not affect the job.
The input closes when the server ends for any reason. The worker then ends with all its processes, so that the case
folder is free when the server starts again.
"""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from vstent.app.cases import Case, State
from vstent.errors import VstentError
from vstent.study.ledger import anatomy_key, hash_of
from vstent.study.pipeline import run


def end_with_the_server() -> None:
    """Wait until the server has ended, and end."""
    sys.stdin.read()
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def tell(**told: Any) -> None:
    """Send one message to the server."""
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()


def progress(stage: str, fraction: float, detail: str) -> None:
    """Report the progress of a stage."""
    tell(stage=stage, fraction=fraction, detail=detail)


def find_anatomy(case: Case) -> None:
    """Find vessel, sac, neck and parent artery."""
    from vstent.study.pipeline import restore_vessel

    restore_vessel(case.input, case.folder, case.state.settings(), progress, replaces=True)
    tell(anatomy=_anatomy_key(case))


def _anatomy_key(case: Case) -> str:
    return anatomy_key(hash_of(case.input), case.state.settings())


def compute(case: Case) -> None:
    """Deploy, compute the flow if requested, and write the report, as `vstent run` does."""
    from vstent.reporting.write import write_report

    if _anatomy_key(case) != case.state.anatomy:
        find_anatomy(case)  # reported before the flow: a job that is stopped there has replaced the former anatomy
    result = run(case.input, case.folder, case.state.settings(), progress, replaces=True)
    progress("report", 0.0, "")
    write_report(result, case.folder, is_printed=True)
    progress("report", 1.0, "")


def rank(case: Case) -> None:
    """Deploy all sizes of the devices chosen and rank them."""
    from vstent.app.ranking import rank_sizes

    rank_sizes(case, progress)


JOBS: Final[dict[str, Callable[[Case], None]]] = {"anatomy": find_anatomy, "rank": rank, "flow": compute}


def main(kind: str, folder: Path) -> int:
    """Do a job; return the exit code."""
    given = State.model_validate_json(sys.stdin.readline())
    threading.Thread(target=end_with_the_server, daemon=True).start()
    try:
        JOBS[kind](Case(folder.name, folder, given))
    except VstentError as error:
        tell(error=str(error))
        return 1
    except OSError as error:
        tell(error=f"{error.strerror or error}. Finished results are kept.")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
