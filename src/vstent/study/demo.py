"""Demo: a synthetic 3DRA scan of a phantom, and a comparison of the study's results with the known truth."""

from pathlib import Path
from typing import Final

import numpy as np

from vstent.io.dicom_writer import write_dicom
from vstent.kernels import curves
from vstent.phantoms import demo_phantom, scan
from vstent.study.pipeline import CaseResult

SEED: Final = 20161  # seed of the scan's noise; the value is arbitrary
END_DIAMETERS: Final = 1.0
"""Length at each end of the artery that the comparison of radii leaves out, in diameters."""

Row = tuple[str, float, float, str]
"""Title, found value, true value and unit."""


def write_scan(folder: Path) -> Path:
    """Write the demo's scan as a DICOM series unless the folder exists, and return the folder."""
    if not folder.is_dir():
        image = scan(demo_phantom(), np.random.default_rng(SEED))
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_dicom(image, folder)
    return folder


def truth(case: CaseResult) -> list[Row]:
    """Compare a study of the scan of `write_scan` with the phantom; the ends of the artery are left out."""
    phantom, path = demo_phantom(), case.anatomy.parent
    margin = 2 * END_DIAMETERS * float(path.axis.inscribed_radius_mm.mean())
    inner = (path.axis.abscissa_mm > margin) & (path.axis.abscissa_mm < path.axis.length_mm - margin)
    place = curves.project(phantom.parent.points_mm, path.axis.points_mm[inner])[0]
    found_mm = path.section_radius_mm[inner]
    true_mm = np.interp(place, phantom.parent.abscissa_mm, phantom.parent.inscribed_radius_mm)
    rows = [("Artery radius, mean along the axis", float(found_mm.mean()), float(true_mm.mean()), "mm")]
    worst = np.argmax(np.abs(found_mm / true_mm - 1))
    rows.append(("Artery radius, worst place", float(found_mm[worst]), float(true_mm[worst]), "mm"))
    sacs = case.anatomy.aneurysms
    rows.append(("Sac volume", sacs[0].sac.volume_mm3 if sacs else 0.0, phantom.sac_volume_mm3, "mm3"))
    rows.append(("Neck surface", sacs[0].neck.area_mm2 if sacs else 0.0, phantom.neck_area_mm2, "mm2"))
    for treatment in case.metrics["treatments"].values():
        for name, measures in treatment.get("implants", {}).items():
            outside_mm = float(measures["max_outside_mm"])
            rows.append((f"Farthest node of {name} outside the landing surface", outside_mm, 0.0, "mm"))
    return rows
