"""`vstent angiogram`: carry contrast through the flows of a finished case."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vstent.cli import options
from vstent.fields import LENGTH, Limits

if TYPE_CHECKING:
    from vstent.angiography.angiogram import AngiogramSettings


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(
        commands,
        "angiogram",
        "Carry contrast through the flows of a case, film it, and measure how it fills and leaves the sac.",
        'angiogram case --rate 3 --amount 4 --view "LAO 30 CRA 10"',
    )
    parser.add_argument("case", type=Path, help="case folder of `vstent run` with flows")
    add_injection(parser)
    _add_film(parser)
    options.add_flag(parser, "no-report", "leave the report as it is")
    parser.set_defaults(command=_angiogram)


def add_injection(parser: argparse.ArgumentParser) -> None:
    """Add the options on the injection and on what is computed."""
    group = parser.add_argument_group("injection")
    options.add_number(group, "iodine", "iodine", 300.0, Limits("mg/mL", above=0.0))
    options.add_number(group, "amount", "injected volume", 3.0, Limits("mL", above=0.0))
    options.add_number(group, "rate", "injection rate", 3.0, Limits("mL/s", above=0.0))
    start = "start of the injection; with a pulsatile flow the time since the start of the cycle"
    options.add_number(group, "start", start, 0.0, Limits("s", 0.0, 60.0))
    shape = group.add_mutually_exclusive_group()
    options.add_flag(shape, "gamma", "gamma-variate injection curve (default: constant rate)")
    text = "time (s) and iodine concentration at the inlet (mg/mL), two columns"
    shape.add_argument("--curve", type=Path, metavar="CSV", help=text)
    window = "time to compute from the start of the injection"
    options.add_number(group, "window", window, 6.0, Limits("s", 0.1, 120.0))
    options.add_flag(group, "preview", "use a grid twice as coarse, for a first look")


def _add_film(parser: argparse.ArgumentParser) -> None:
    """Add the options on films."""
    group = parser.add_argument_group("film")
    text = 'C-arm direction, such as "LAO 30 CRA 10", AP or lateral (default: the neck in profile, proposed)'
    group.add_argument("--view", metavar="ANGLES", help=text)
    options.add_number(group, "frame-rate", "frames per second", 7.5, Limits("Hz", above=0.0))
    options.add_flag(group, "wires", "show the wires of the device (default: subtracted)")
    options.add_flag(group, "vessel", "show the vessel faintly (default: subtracted)")
    options.add_number(group, "pixel", "detector pixel", 0.154, LENGTH)
    options.add_number(group, "source-detector", "distance from source to detector", 1100.0, Limits("mm", above=0.0))
    to_vessel = "distance from source to isocenter, where the vessel is"
    options.add_number(group, "source-isocenter", to_vessel, 750.0, Limits("mm", above=0.0))
    options.add_number(group, "energy", "photon energy", 50.0, Limits("keV", above=0.0))
    text = "DICOM file whose patient and study the films are to belong to (default: no patient data)"
    group.add_argument("--dicom-like", type=Path, metavar="FILE", help=text)


def given_angiogram(arguments: argparse.Namespace) -> "AngiogramSettings":
    """Return the settings of the angiograms; InputError where a value cannot be used."""
    from vstent.angiography.angiogram import AngiogramSettings
    from vstent.angiography.bolus import Bolus
    from vstent.io.tables import read_columns

    curve = () if arguments.curve is None else tuple((t, c) for t, c in read_columns(arguments.curve, 2).tolist())
    bolus = Bolus(
        iodine_mg_mL=arguments.iodine,
        amount_mL=arguments.amount,
        rate_mL_s=arguments.rate,
        start_s=arguments.start,
        shape="gamma" if arguments.gamma else "constant",
        curve=curve,
    )
    return AngiogramSettings(bolus=bolus, window_s=arguments.window, is_preview=arguments.preview)


def _angiogram(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    import json

    from vstent.angiography.filming import FilmSettings
    from vstent.angiography.view import angles_of
    from vstent.cli.console import Console, angiogram_table
    from vstent.io.xa_writer import study_of
    from vstent.reporting.film_case import film_case, write_report_again
    from vstent.study.contrast import FOLDER
    from vstent.study.folder import METRICS

    film = FilmSettings(
        angles_rad=angles_of(arguments.view) if arguments.view else None,
        frame_rate_Hz=arguments.frame_rate,
        pixel_mm=arguments.pixel,
        source_detector_mm=arguments.source_detector,
        source_isocenter_mm=arguments.source_isocenter,
        energy_keV=arguments.energy,
        has_wires=arguments.wires,
        has_vessel=arguments.vessel,
    )
    study = study_of(arguments.dicom_like) if arguments.dicom_like else {}
    settings, console = given_angiogram(arguments), Console()
    with console.live():
        film_case(arguments.case, settings, film, console.progress, study)
        if not arguments.no_report:
            write_report_again(arguments.case, console.progress)
    console.print(angiogram_table(json.loads((arguments.case / METRICS).read_text(encoding="utf-8"))))
    console.print(f"Results in {arguments.case / FOLDER}. Research use only.")
    return 0
