"""RO-Crate: machine-readable description of a case folder, its files and their origin.

Version 1.1, https://w3id.org/ro/crate/1.1 (Soiland-Reyes et al. 2022, Data Science 5:97).
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from vstent.errors import ReadError
from vstent.io.writers import write_json

NAME: Final = "ro-crate-metadata.json"
"""File name prescribed by RO-Crate."""
LICENSE: Final = "https://spdx.org/licenses/BSD-3-Clause"
"""Licence of vstent."""
FORMATS: Final = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".html": "text/html",
    ".vtp": "application/vnd.vtk.polydata+xml",
    ".vtu": "application/vnd.vtk.unstructuredgrid+xml",
    ".stl": "model/stl",
    ".3mf": "model/3mf",
    ".png": "image/png",
    ".pdf": "application/pdf",
}
"""Media type of each file suffix."""
ABOUT: Final = {
    "metrics.json": "All metrics; the unit is part of each key",
    "run.json": "Versions, SHA-256 of the input and settings, sufficient to repeat the run",
    "report.html": "Interactive 3-D report: without and with the device, and the difference",
    "report.pdf": "Report for printing",
    "vessel.vtp": "Wall of the lumen",
    "centerlines.vtp": "Centerlines, with the array names of VMTK",
    "landing_surface.vtp": "Parent artery with the neck and branch ostia closed; the device expands against it",
    "sac.vtp": "Sac",
    "neck.vtp": "Neck curve",
    "openings.json": "Openings, and notes on repairs and automatic choices",
    "contour.vtp": "Contour of the deployed device, with its gap to the wall",
    "wires.vtp": "Centerlines of the wires",
    "struts.stl": "Solid wires",
    "field.vtu": "Velocity and pressure",
    "wall.vtp": "Wall shear stress",
}
"""Description of each file."""


def write_crate(folder: Path, provenance: Mapping[str, Any], when: str) -> None:
    """Describe every file of a finished case folder in ``ro-crate-metadata.json``; hidden files are not listed.

    Parameters
    ----------
    folder : the case folder.
    provenance : contents of its ``run.json``.
    when : date, ISO 8601.

    Raises
    ------
    ReadError
        The folder contains no finished case.
    """
    if not (folder / "metrics.json").exists():
        raise ReadError(f"{folder} contains no finished case: run it first.")
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and _is_shown(path.relative_to(folder))]
    files = [_file(folder, path) for path in paths]
    write_json(
        folder / NAME,
        {
            "@context": "https://w3id.org/ro/crate/1.1/context",
            "@graph": [*_crate(folder, files, when), *files, *_making(provenance, files, when)],
        },
    )


def _is_shown(path: Path) -> bool:
    """Return whether a file is listed, given its path inside the folder."""
    return path.name != NAME and not any(part.startswith(".") for part in path.parts)


def _file(folder: Path, path: Path) -> dict[str, Any]:
    """Return the entity of one file."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256")
    return {
        "@id": path.relative_to(folder).as_posix(),
        "@type": "File",
        "name": ABOUT.get(path.name, path.name),
        "encodingFormat": FORMATS.get(path.suffix, "application/octet-stream"),
        "contentSize": str(path.stat().st_size),
        "sha256": digest.hexdigest(),
    }


def _crate(folder: Path, files: list[dict[str, Any]], when: str) -> list[dict[str, Any]]:
    """Return the entities of the metadata file and of the folder."""
    return [
        {
            "@id": NAME,
            "@type": "CreativeWork",
            "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
            "about": {"@id": "./"},
        },
        {
            "@id": "./",
            "@type": "Dataset",
            "name": f"Virtual stenting of {folder.resolve().name}",
            "description": "Virtual stenting with vstent. Research use only: not for diagnosis or treatment.",
            "datePublished": when,
            "license": "Not for publication without the permission of the holder of the rights in the scan",
            "hasPart": [{"@id": file["@id"]} for file in files],
            "mentions": {"@id": "#run"},
        },
    ]


def _making(provenance: Mapping[str, Any], files: list[dict[str, Any]], when: str) -> list[dict[str, Any]]:
    """Return the entities of the program, its input and the run that wrote the files."""
    given = provenance["input"]
    return [
        {
            "@id": "#vstent",
            "@type": "SoftwareApplication",
            "name": "vstent",
            "version": provenance["versions"]["vstent"],
            "license": {"@id": LICENSE},
        },
        {"@id": LICENSE, "@type": "CreativeWork", "name": "BSD 3-Clause"},
        {"@id": "#input", "@type": "CreativeWork", "name": given["name"], "sha256": given["sha256"]},
        {
            "@id": "#run",
            "@type": "CreateAction",
            "name": "vstent run",
            "endTime": when,
            "instrument": {"@id": "#vstent"},
            "object": {"@id": "#input"},
            "result": [{"@id": file["@id"]} for file in files],
        },
    ]
