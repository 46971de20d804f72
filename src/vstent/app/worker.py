"""Worker process: ``python -m vstent.app.worker KIND FOLDER`` runs one job and reports it as lines of JSON.

The first line of its standard input is the state of the case when the job was started; later choices do not affect the
job. The input closes when the server ends for any reason. The worker then ends with all its processes, so that the case
folder is free when the server starts again.
"""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

from vstent.angiography.angiogram import AngiogramSettings
from vstent.app.cases import Case, State
from vstent.errors import VstentError
from vstent.study.keys import ANATOMY, anatomy_keys, hash_of
from vstent.study.pipeline import deploy_treatments, restore_vessel, run
from vstent.study.progress import Progress
from vstent.study.stages import ask_for_aneurysm

WINDOW_S: Final = 8.0
"""Time that the angiogram of the page covers, in s: five seconds after the peak of the usual injection, and more."""


def end_with_the_server() -> None:
    """Wait until the server has ended, then end this process and its children."""
    sys.stdin.read()
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def tell(**told: Any) -> None:
    """Send one message to the server."""
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()


def progress(now: Progress) -> None:
    """Send the progress of a stage, without what has been computed."""
    tell(**{field.name: getattr(now, field.name) for field in fields(now) if field.name != "computed"})


def find_anatomy(case: Case) -> None:
    """Find vessel, sac, neck and parent artery; VesselError is raised where the user must say where the sac is."""
    settings = case.state.settings()
    anatomy, _ = restore_vessel(case.input, case.folder, settings, progress, replaces=True)
    tell(anatomy=_anatomy_key(case))
    ask_for_aneurysm(anatomy, settings)


def place_implants(case: Case) -> None:
    """Deploy the chosen treatments with their coils, and store them for the page and the flow."""
    deploy_treatments(case.input, case.folder, case.state.settings(), progress, replaces=True)


def _anatomy_key(case: Case) -> str:
    """Return the key of the anatomy of a case."""
    return str(anatomy_keys(hash_of(case.input), case.state.settings())[ANATOMY])


def compute(case: Case) -> None:
    """Deploy, compute the flow if requested, and write the report, as `vstent run` does."""
    from vstent.reporting.write import write_report

    if _anatomy_key(case) != case.state.anatomy:
        find_anatomy(case)  # reported before the flow, since it has replaced the stored anatomy by then
    result = run(case.input, case.folder, case.state.settings(), progress, replaces=True)
    progress(Progress("report", 0.0))
    write_report(result, case.folder, is_printed=True)
    progress(Progress("report", 1.0))


def carry_contrast(case: Case) -> None:
    """Carry contrast through the flows, film it, and write the report again."""
    from vstent.angiography.filming import FilmSettings
    from vstent.reporting.film_case import film_case, write_report_again

    film_case(case.folder, AngiogramSettings(window_s=WINDOW_S), FilmSettings(), progress)
    write_report_again(case.folder, progress)


def rank(case: Case) -> None:
    """Deploy and rank all sizes of the chosen devices."""
    from vstent.app.ranking import rank_sizes

    rank_sizes(case, progress)


JOBS: Final[dict[str, Callable[[Case], None]]] = {
    "anatomy": find_anatomy,
    "rank": rank,
    "place": place_implants,
    "flow": compute,
    "angiogram": carry_contrast,
}
"""Function of each kind of job."""


def main(kind: str, folder: Path) -> int:
    """Run a job of a kind of `JOBS` on a case folder; return the exit code."""
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
