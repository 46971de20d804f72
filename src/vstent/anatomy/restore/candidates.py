"""Classify a bulge as saccular aneurysm, branch stump, infundibulum, bleb or artifact.

The classes and their criteria are vstent's own. An infundibulum is a funnel of at most 3 mm that is widest at its base
(Saltzman 1959, Acta Radiol. 51; not verified against the original). A stump is a tube. A saccular aneurysm is about as
wide as it is high.
"""

from typing import Final

import numpy as np

from vstent.geometry.vessel import Aneurysm, Candidate, Vessel
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.units import counted

HEIGHTS: Final = np.linspace(0.1, 0.95, 12)
"""Heights above the neck plane at which the width of a sac is measured, as fractions of its height."""
SLENDER: Final = 2.2
"""A sac longer than this many of its largest widths is a tube; the sacs of real cases have 0.7 to 1.7."""
STRAIGHT: Final = 1.15
"""A sac whose largest width is below this many neck widths has no dome."""
NARROW: Final = 0.75
"""A sac narrower than this fraction of the artery may be a branch."""
FUNNEL_MM: Final = 3.0
"""Largest height of an infundibulum in mm (Saltzman 1959)."""
BLEB: Final = 0.4
"""A sac is a bleb if the sphere of its volume is smaller than this fraction of the artery's diameter."""
FEWEST_VOXELS: Final = 4.0
"""Fewest voxels across a sac that can be distinguished from noise and blur."""


def classified(vessel: Vessel, aneurysm: Aneurysm, artery_diameter_mm: float) -> Candidate:
    """Classify a sac that was cut off."""
    plane, dome_mm = aneurysm.mean_plane, aneurysm.sac.vertices_mm
    neck_mm = 2 * float(np.sqrt(plane.area_mm2 / np.pi))
    reach_mm = float(curves.lengths(dome_mm - plane.center_mm).max())
    height_mm = (dome_mm - plane.center_mm) @ plane.normal
    widths_mm = np.array([_width_mm(aneurysm, fraction * height_mm.max() - height_mm) for fraction in HEIGHTS])
    widest_mm = float(widths_mm.max())
    tapers = (np.diff(widths_mm) < 0.05 * widest_mm).all() and widths_mm.argmax() <= len(widths_mm) // 4
    sphere_mm = float(np.cbrt(6 * abs(aneurysm.sac.volume_mm3) / np.pi))
    slenderness = reach_mm / max(widest_mm, 1e-9)
    is_narrow = widest_mm < NARROW * artery_diameter_mm
    size = f"{widest_mm:.1f} mm wide and {reach_mm:.1f} mm long"
    kind, reasons = "saccular aneurysm", [f"its dome is {widest_mm / neck_mm:.1f} times as wide as its neck", size]
    if slenderness > SLENDER:
        kind, reasons = "branch stump", [f"it is {slenderness:.1f} times as long as wide", size]
    elif vessel.voxel_mm is not None and widest_mm < FEWEST_VOXELS * vessel.voxel_mm:
        kind, reasons = "artifact", ["it is too small for the voxels of the scan", size]
    elif widest_mm < STRAIGHT * neck_mm and is_narrow and tapers and reach_mm <= FUNNEL_MM:
        kind, reasons = "infundibulum", ["it tapers from its base", size]
    elif widest_mm < STRAIGHT * neck_mm and is_narrow and slenderness > 1.0:
        kind, reasons = "branch stump", ["it is a tube no wider than its neck", size]
    elif sphere_mm < BLEB * artery_diameter_mm:
        kind, reasons = "bleb", [f"it is small beside the artery of {artery_diameter_mm:.1f} mm", size]
    if vessel.voxel_mm is not None and kind != "artifact":
        reasons.append(f"{counted(round(widest_mm / vessel.voxel_mm), 'voxel')} across")
    return Candidate(kind, dome_mm.mean(axis=0), tuple(reasons))


def _width_mm(aneurysm: Aneurysm, below_mm: Floats) -> float:
    """Return the width of a sac's largest section where the field `below_mm` (n,) at its vertices is zero."""
    vertices, faces, _ = triangles.clip(aneurysm.sac.vertices_mm, aneurysm.sac.faces, below_mm)
    loops = triangles.boundary_loops(vertices, faces)
    areas = [float(np.linalg.norm(triangles.polygon_area_vector(vertices[loop]))) for loop in loops]
    return 2 * float(np.sqrt(max(areas, default=0.0) / np.pi))
