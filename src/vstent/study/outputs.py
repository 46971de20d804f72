"""Write and remove the files of a case folder."""

import json
import shutil
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.deployment.struts import struts
from vstent.devices.stent import Deployment
from vstent.flow.case import FlowField
from vstent.flow.openfoam.folder import KEY
from vstent.geometry.vessel import Anatomy, Centerline, Vessel
from vstent.io import writers
from vstent.io.tables import columns_of, write_rows
from vstent.io.three_mf import write_3mf
from vstent.plan.rank import Ranking, order_of
from vstent.study.crate import NAME as CRATE
from vstent.study.folder import METRICS, RUN
from vstent.study.store import UNREADABLE
from vstent.units import MM_PER_UM

IMPLANT: Final = ("contour.vtp", "wires.vtp", "struts.stl", "struts.3mf")
"""Files of one implant."""
SACS: Final = ("sac.vtp", "sac_[0-9].vtp", "neck.vtp", "neck_[0-9].vtp")
"""Files of sacs and necks, as patterns."""
OF_FLOWS: Final = ("", "straightened/", "straightened/bare/")
"""Folders of the flows of a treatment."""
OF_STUDY: Final = (
    *(METRICS, RUN, "report.html", "report.pdf", "plan.pdf", CRATE),
    *(f"treatments/*/implants/*/{name}" for name in IMPLANT),
    *(f"treatments/*/{part}flow/{name}" for part in OF_FLOWS for name in ("field.vtu", "wall.vtp")),
    *(f"treatments/*/straightened/{name}" for name in ("*.vtp", "openings.json")),
    *("angiogram/*.*", "angiogram/*/frame_*.png"),
)
"""Files of devices, flows and reports, as patterns."""
FOLDERS: Final = (
    *(f"treatments/*/{part}" for part in ("implants/*/", "implants/", "straightened/bare/flow/", "straightened/bare/")),
    *(f"treatments/*/{part}" for part in ("straightened/flow/", "straightened/", "flow/", "")),
    "treatments/",
    *("convergence/", "angiogram/*/", "angiogram/"),
)
"""Folders of the case folder that are removed when they are empty, as patterns, the innermost first."""
OF_ANATOMY: Final = ("morphology.json", "convergence.json")
"""Files that describe an anatomy alone."""
RESULTS: Final = (
    *("vessel.vtp", "centerlines.vtp", "openings.json", "landing_surface.vtp", *SACS),
    *("ranking.csv", "ranking.json", *OF_ANATOMY, *OF_STUDY),
)
"""All files of a case folder except the cache and OpenFOAM's folders, as patterns."""


def take_away_results(out: Path) -> None:
    """Remove the results in a case folder; the cache and the user's own files stay."""
    _take_away(out, RESULTS, out.glob(f"**/{KEY}"))


def take_away_study(out: Path, engine_folders: Collection[Path]) -> None:
    """Remove the results of a study with other settings, except what an engine needs in these folders."""
    keys = out.glob(f"treatments/*/flow/*/{KEY}")
    _take_away(out, OF_STUDY, [key for key in keys if key.parent not in engine_folders])


def take_away_measures(out: Path) -> None:
    """Remove the results that describe a replaced anatomy alone."""
    _take_away(out, OF_ANATOMY, out.glob(f"convergence/**/{KEY}"))


def _take_away(out: Path, patterns: Iterable[str], keys: Iterable[Path]) -> None:
    """Remove files by pattern, OpenFOAM's folders by their key files, and folders that are then empty."""
    for key in list(keys):
        shutil.rmtree(key.parent)
    for file in [file for pattern in patterns for file in out.glob(pattern)]:
        file.unlink()
    for folder in [folder for pattern in FOLDERS for folder in out.glob(pattern)]:
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def write_vessel(out: Path, vessel: Vessel, *axes: Centerline) -> None:
    """Write the wall, the centerlines (and further axes) and the openings."""
    out.mkdir(parents=True, exist_ok=True)
    writers.write_surface(out / "vessel.vtp", vessel.lumen)
    writers.write_centerlines(out / "centerlines.vtp", (*vessel.centerlines, *axes))
    openings = [asdict(opening) | {"diameter_mm": opening.diameter_mm} for opening in vessel.openings]
    writers.write_json(out / "openings.json", {"openings": openings, "notes": vessel.notes})


def write_anatomy(out: Path, anatomy: Anatomy) -> None:
    """Write the vessel, the parent artery and the sacs; files of sacs that no longer exist are removed."""
    write_vessel(out, anatomy.vessel, anatomy.parent.axis)
    restored = {"is_restored": anatomy.parent.is_restored.astype(np.uint8)}
    writers.write_surface(out / "landing_surface.vtp", anatomy.parent.landing_surface, restored)
    written = set()
    for number, aneurysm in enumerate(anatomy.aneurysms, start=1):
        sac, neck = (f"{part}.vtp" if number == 1 else f"{part}_{number}.vtp" for part in ("sac", "neck"))
        writers.write_surface(out / sac, aneurysm.sac)
        closed = np.concatenate([aneurysm.neck_mm, aneurysm.neck_mm[:1]])
        writers.write_lines(out / neck, closed, np.array([0, len(closed)], dtype=np.int32))
        written |= {sac, neck}
    for pattern in SACS:
        for stale in {file.name for file in out.glob(pattern)} - written:  # left by other settings
            (out / stale).unlink()


def write_implant(folder: Path, deployment: Deployment) -> str:
    """Write contour, wires and struts of a deployed implant."""
    stent = deployment.stent
    folder.mkdir(parents=True, exist_ok=True)
    if len(stent.nodes_mm):  # coils have none
        writers.write_surface(folder / "contour.vtp", stent.contour, {"wall_gap_mm": deployment.wall_gap_mm.ravel()})
    wire_id = np.arange(len(stent.wire_diameter_um), dtype=np.int32)
    of_wire: dict[str, NDArray[Any]] = {"wire_id": wire_id, "diameter_um": stent.wire_diameter_um}
    radius_mm = np.repeat(0.5 * MM_PER_UM * stent.wire_diameter_um, np.diff(stent.wire_starts))
    lines = (stent.wire_points_mm, stent.wire_starts, {"radius_mm": radius_mm}, of_wire)
    writers.write_lines(folder / "wires.vtp", *lines)
    solid = struts(stent)
    writers.write_stl(folder / "struts.stl", solid)
    write_3mf(folder / "struts.3mf", solid)
    return f"{len(wire_id)} wires, {len(solid.faces)} triangles."


def write_field(folder: Path, field: FlowField) -> None:
    """Write a flow: velocity and pressure in its cells, each place once, wall shear stress and pressure on the wall."""
    folder.mkdir(parents=True, exist_ok=True)
    of_cell = {"velocity_m_s": field.velocity_m_s, "pressure_Pa": field.pressure_Pa}
    if field.mean_shear_Pa is not None:
        of_cell["mean_speed_m_s"] = field.speed_m_s
    writers.write_cells(folder / "field.vtu", field.centers_mm, field.sizes_mm, of_cell)
    of_vertex = {"wall_shear_stress_Pa": field.wall_shear_stress_Pa, "pressure_Pa": field.wall_pressure_Pa}
    if field.phases or field.mean_shear_Pa is not None:
        of_vertex |= {
            "time_averaged_wall_shear_stress_Pa": field.shear_Pa,
            "oscillatory_shear_index": field.oscillatory_shear_index,
            "relative_residence_time_per_Pa": field.relative_residence_time_per_Pa,
        }
    writers.write_surface(folder / "wall.vtp", field.wall, of_vertex)


def write_ranking(out: Path, ranking: Ranking) -> None:
    """Write a ranking as ``ranking.csv`` and, with its criteria, as ``ranking.json``.

    Stored rows of other devices are kept if they have the same criteria.
    """
    criteria = [item.model_dump(exclude_none=True) for item in ranking.criteria.items]
    devices = {candidate.design.key for candidate in ranking.candidates}
    rows = ranking.rows()
    columns = columns_of(rows)
    with suppress(*UNREADABLE):
        former = json.loads((out / "ranking.json").read_text(encoding="utf-8"))
        if former["criteria"] == json.loads(json.dumps(criteria)):
            kept = [row for row in former["candidates"] if row["device"] not in devices]
            # JSON files have sorted keys: a former row in first place must not order the columns of the table.
            rows += [{name: row[name] for name in columns if name in row} | row for row in kept]
    rows = [row | {"rank": number} for number, row in enumerate(sorted(rows, key=order_of), start=1)]
    write_rows(out / "ranking.csv", rows)
    writers.write_json(out / "ranking.json", {"criteria": criteria, "candidates": rows, "research_use_only": True})
