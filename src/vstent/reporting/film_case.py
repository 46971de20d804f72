"""Carry contrast through the flows of a case folder, film it, and put the films into the report."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vstent.angiography.angiogram import Angiogram, AngiogramSettings
from vstent.angiography.filming import FilmSettings
from vstent.angiography.working_projection import working_projection
from vstent.devices.catalogue import find_design
from vstent.devices.treatment import BARE
from vstent.reporting.films import shown_of, write_films
from vstent.reporting.write import write_report
from vstent.study.contrast import FOLDER, angiograms, stents_of
from vstent.study.folder import RUN, claimed
from vstent.study.pipeline import run
from vstent.study.progress import OnProgress, Progress
from vstent.study.repeat import finished_run, read_record


def film_case(
    out: Path,
    settings: AngiogramSettings,
    film: FilmSettings,
    progress: OnProgress,
    study: Mapping[str, Any] | None = None,
) -> dict[str, Angiogram]:
    """Carry contrast through the flows of a case folder, and film it into the subfolder ``angiogram``.

    The run has flows. As many frames are computed as the films need. `study` has the fields of patient and study for
    the DICOM files. Returns angiograms by name of the flow, ``bare`` first.

    Raises ReadError: the folder holds no finished run of this version.
    Raises InputError: the run has no flow, the window is too short, or the vessel needs a larger detector than there
    are.
    Raises FlowError: a flow does not fit in the free memory.
    """
    settings = replace(settings, frames_per_s=max(settings.frames_per_s, film.frame_rate_Hz))
    found, histories = angiograms(out, settings, progress)
    progress(Progress("film", 0.0))
    anatomy, stents = stents_of(out, found if film.has_wires else ())
    treatments = finished_run(out)[1].treatments
    titles = {BARE: "Before"} | {
        one.name: " + ".join(find_design(key).name for key in one.devices) for one in treatments
    }
    aimed = film if film.angles_rad else replace(film, angles_rad=working_projection(anatomy))
    shown = shown_of(histories, stents, titles, aimed)
    curves = {titles[name]: one.curves for name, one in found.items()}
    with claimed(out):
        write_films(out / FOLDER, shown, curves, study=study)
    view = shown[BARE].film.view
    told = f"{view.name}, {view.columns} x {view.rows} pixels of {view.pixel_mm:g} mm."
    progress(Progress("film", 1.0, told))
    return found


def write_report_again(out: Path, progress: OnProgress) -> None:
    """Write the report of a finished case folder with its films; the PDF too where there is one.

    Raises ReadError: the input of the case has been moved.
    """
    record = read_record(out / RUN)
    case = run(record.input, out, record.settings, progress)
    progress(Progress("report", 0.0))
    write_report(case, out, is_printed=(out / "report.pdf").is_file())
    progress(Progress("report", 1.0))
