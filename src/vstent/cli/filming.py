"""Options on the films of an angiogram."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vstent.cli import options
from vstent.fields import LENGTH, Limits

if TYPE_CHECKING:
    from vstent.angiography.filming import FilmSettings


def add_film(parser: argparse.ArgumentParser) -> None:
    """Add the options on films."""
    group = parser.add_argument_group("film")
    group.add_argument(
        "--view",
        metavar="ANGLES",
        help='C-arm direction, such as "LAO 30 CRA 10", AP or lateral (default: the neck in profile, proposed)',
    )

    options.add_number(group, "frame-rate", "frames per second", 7.5, Limits("Hz", above=0.0))
    group.add_argument("--wires", action="store_true", help="show the wires of the device (default: subtracted)")
    group.add_argument("--vessel", action="store_true", help="show the vessel faintly (default: subtracted)")
    options.add_number(group, "pixel", "detector pixel", 0.154, LENGTH)
    options.add_number(group, "source-detector", "distance from source to detector", 1100.0, Limits("mm", above=0.0))
    to_vessel = "distance from source to isocenter, where the vessel is"
    options.add_number(group, "source-isocenter", to_vessel, 750.0, Limits("mm", above=0.0))
    options.add_number(group, "energy", "photon energy", 50.0, Limits("keV", above=0.0))
    group.add_argument(
        "--dicom-like",
        type=Path,
        metavar="FILE",
        help="DICOM file whose patient and study the films are to belong to (default: no patient data)",
    )


def given_film(arguments: argparse.Namespace) -> "FilmSettings":
    """Return the settings of the films.

    Raises
    ------
    InputError
        A direction, distance, frame rate or energy is out of range.
    """
    from vstent.angiography.filming import FilmSettings
    from vstent.angiography.view import angles_of

    return FilmSettings(
        angles_rad=angles_of(arguments.view) if arguments.view else None,
        frame_rate_Hz=arguments.frame_rate,
        pixel_mm=arguments.pixel,
        source_detector_mm=arguments.source_detector,
        source_isocenter_mm=arguments.source_isocenter,
        energy_keV=arguments.energy,
        has_wires=arguments.wires,
        has_vessel=arguments.vessel,
    )


def given_study(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of patient and study that the DICOM films get; empty unless a file is given.

    Raises
    ------
    ReadError
        The file does not exist or is not DICOM.
    """
    from vstent.io.xa_writer import study_of

    return study_of(arguments.dicom_like) if arguments.dicom_like else {}
