"""Describe a case folder as an RO-Crate: what each file contains, and which program made it from which input.

References
----------
RO-Crate 1.1, https://w3id.org/ro/crate/1.1 (Soiland-Reyes et al. 2022, Data Science 5:97).
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from vstent.errors import ReadError
from vstent.io.writers import write_json

NAME: Final = "ro-crate-metadata.json"
"""File name of the description."""
LICENSE: Final = "https://spdx.org/licenses/BSD-3-Clause"
"""License of vstent."""
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
    ".webp": "image/webp",
    ".dcm": "application/dicom",
}
"""Media type of a file by its suffix."""
ABOUT: Final = {
    "metrics.json": "All results as numbers, with the unit in each key",
    "run.json": "Versions, input with SHA-256, settings: enough to repeat the run",
    "report.html": "The case in 3-D, before, after and change",
    "report.pdf": "The report as PDF, with its pictures",
    "vessel.vtp": "The lumen",
    "centerlines.vtp": "Centerlines with VMTK's array names",
    "landing_surface.vtp": (
        "The parent artery with sac and side branches closed: the surface the device expands against"
    ),
    "sac.vtp": "The sac",
    "neck.vtp": "The neck",
    "openings.json": "Every opening, and what was repaired or assumed",
    "contour.vtp": "Contour of the deployed device with its gap to the wall",
    "wires.vtp": "Axes of the wires",
    "struts.stl": "Solids of the wires",
    "field.vtu": "Velocity and pressure",
    "wall.vtp": "Wall shear stress",
    "angiogram.webp": "Films of the contrast agent before and after, side by side",
    "key_frames.png": "Early, peak and late frame of every film",
    "density.png": "Contrast in sac and parent artery over time",
    "films.json": "Titles and captions of the films",
}
"""Description of a file by its name."""


def write_crate(folder: Path, provenance: Mapping[str, Any], when: str) -> None:
    """Describe every file of a finished case folder in ``ro-crate-metadata.json``; hidden files are left out.

    Parameters
    ----------
    folder : the case folder.
    provenance : content of its ``run.json``.
    when : date of the run, ISO 8601.

    Raises
    ------
    ReadError
        The folder holds no finished case.
    """
    if not (folder / "metrics.json").exists():
        raise ReadError(f"{folder} holds no finished case. Run it first.")
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
    """Return whether a file is described: it is neither hidden nor the description itself."""
    return path.name != NAME and not any(part.startswith(".") for part in path.parts)


def _file(folder: Path, path: Path) -> dict[str, Any]:
    """Return the entry of a file, with its size and SHA-256."""
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
    """Return the entries of the description itself and of the case folder."""
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
            "description": "A virtual stenting by vstent. Research use only: not for diagnosis or treatment.",
            "datePublished": when,
            "license": "Not for publication unless the holder of the rights in the scan agrees",
            "hasPart": [{"@id": file["@id"]} for file in files],
            "mentions": {"@id": "#run"},
        },
    ]


def _making(provenance: Mapping[str, Any], files: list[dict[str, Any]], when: str) -> list[dict[str, Any]]:
    """Return the entries of program, input and run."""
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
