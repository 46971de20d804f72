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
from vstent.study.folder import METRICS

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

    `provenance` is the content of its ``run.json``, and `when` the date of the run (ISO 8601). ReadError: there is no
    finished case.
    """
    if not (folder / METRICS).exists():
        raise ReadError(f"{folder} holds no finished case. Run it first.")
    files: list[dict[str, Any]] = []
    for path in sorted(folder.rglob("*")):
        place = path.relative_to(folder)
        if not path.is_file() or path.name == NAME or any(part.startswith(".") for part in place.parts):
            continue
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256")
        files.append(
            _entity(
                place.as_posix(),
                "File",
                name=ABOUT.get(path.name, path.name),
                encodingFormat=FORMATS.get(path.suffix, "application/octet-stream"),
                contentSize=str(path.stat().st_size),
                sha256=digest.hexdigest(),
            )
        )
    given, version = provenance["input"], provenance["versions"]["vstent"]
    parts, links = [_link(file["@id"]) for file in files], {"instrument": _link("#vstent"), "object": _link("#input")}
    graph = [
        _entity(NAME, "CreativeWork", conformsTo=_link("https://w3id.org/ro/crate/1.1"), about=_link("./")),
        _entity(
            "./",
            "Dataset",
            name=f"Virtual stenting of {folder.resolve().name}",
            description="A virtual stenting by vstent. Research use only: not for diagnosis or treatment.",
            datePublished=when,
            license="Not for publication unless the holder of the rights in the scan agrees",
            hasPart=parts,
            mentions=_link("#run"),
        ),
        *files,
        _entity("#vstent", "SoftwareApplication", name="vstent", version=version, license=_link(LICENSE)),
        _entity(LICENSE, "CreativeWork", name="BSD 3-Clause"),
        _entity("#input", "CreativeWork", name=given["name"], sha256=given["sha256"]),
        _entity("#run", "CreateAction", name="vstent run", endTime=when, **links, result=parts),
    ]
    write_json(folder / NAME, {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph})


def _entity(id_: str, kind: str, **more: Any) -> dict[str, Any]:
    """Return an entity of the description."""
    return {"@id": id_, "@type": kind} | more


def _link(id_: str) -> dict[str, str]:
    """Return a link to an entity."""
    return {"@id": id_}
