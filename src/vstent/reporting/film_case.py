"""Film a case folder whose contrast is stored, and put the films into its report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vstent.angiography.angiogram import Angiogram
from vstent.angiography.filming import FilmSettings, aimed
from vstent.devices.catalogue import find_design
from vstent.devices.design import BARE
from vstent.reporting.films import FOLDER, Density, shown_of, write_films
from vstent.reporting.write import write_report
from vstent.study.films import Recording, stents_of
from vstent.study.folder import claimed
from vstent.study.pipeline import run
from vstent.study.provenance import RUN
from vstent.study.repeat import read_record
from vstent.study.types import Progress


def film_case(
    out: Path,
    recording: Recording,
    found: Mapping[str, Angiogram],
    settings: FilmSettings,
    progress: Progress,
    study: Mapping[str, Any] | None = None,
) -> str:
    """Write the films of all flows into the subfolder ``angiogram`` of a case folder; return their direction in words.

    Parameters
    ----------
    out : the case folder.
    recording : contrast of every flow.
    found : angiograms by name of the flow.
    settings : how films are taken.
    progress : called at the start and at the end.
    study : fields of patient and study for the DICOM files; None: none.

    Raises
    ------
    InputError
        The vessel needs a larger detector than there are.
    """
    progress("film", 0.0, "")
    devices = [name for name in found if name != BARE]
    anatomy, stents = stents_of(out, devices if settings.has_wires else ())
    titles = {name: "Before" if name == BARE else find_design(name).name for name in found}
    histories = {name: recording.histories[name] for name in found}
    shown = shown_of(histories, stents, titles, aimed(settings, anatomy))
    curves = {titles[name]: one.curves for name, one in found.items()}
    densities = [Density(title, one.time_s, one.sac_mg_mL, one.parent_mg_mL) for title, one in curves.items()]
    with claimed(out):
        write_films(out / FOLDER, shown, densities, study=study)
    view = shown[BARE].film.view
    progress("film", 1.0, f"{view.name}, {view.columns} x {view.rows} pixels of {view.pixel_mm:g} mm.")
    return view.name


def write_report_again(out: Path, progress: Progress) -> None:
    """Write the report of a finished case folder with its films; the PDF too where there is one.

    Parameters
    ----------
    out : the case folder.
    progress : called at every stage.

    Raises
    ------
    ReadError
        The input of the case has been moved.
    """
    record = read_record(out / RUN)
    case = run(record.input, out, record.settings, progress)
    progress("report", 0.0, "")
    write_report(case, out, is_printed=(out / "report.pdf").is_file())
    progress("report", 1.0, "")
