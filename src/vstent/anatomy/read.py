"""Read a vessel from any input: a scan is segmented, a surface is taken as it is, and both are repaired."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vstent.anatomy.repair import repair
from vstent.anatomy.segment import segment
from vstent.geometry.vessel import Vessel
from vstent.io.files import is_surface_file
from vstent.io.images import read_image
from vstent.io.surfaces import Frame, Unit, read_surface
from vstent.kernels.arrays import Floats


def read_vessel(  # noqa: PLR0913 one keyword for each property that a file may not state
    path: Path | str,
    *,
    units: Unit | None = None,
    frame: Frame | None = None,
    acquisition: int | None = None,
    spacing_mm: Sequence[float] | None = None,
    shape: Sequence[int] | None = None,
    crop_mm: Floats | Sequence[Sequence[float]] | None = None,
    threshold: float | None = None,
    at_mm: Floats | Sequence[float] | None = None,
) -> Vessel:
    """Read the wall of a vessel from a scan, a segmentation mask or a surface, and repair it.

    Parameters
    ----------
    path : DICOM folder, image file (NIfTI, NRRD, MHA, VTI, raw) or surface file (STL, VTP, VTU, VTM, VTK, OBJ, PLY).
    units : length unit of a surface file; None: derived from its size.
    frame : frame of a surface file; None: the one that the file states, else LPS.
    acquisition : acquisition of a DICOM series that holds several, counted from 1; None: the brightest.
    spacing_mm : (1,) or (3,) voxel edges in mm, for files that do not state them.
    shape : (3,) number of voxels of a raw volume, the fastest axis first.
    crop_mm : (2, 3) opposite corners in LPS mm of the box along the image axes to which a scan is cropped; None: the
        whole scan.
    threshold : intensity at the lumen wall of a scan; None: half way between tissue and lumen.
    at_mm : (3,) point in LPS mm near the requested vessel; None: the largest with a bulge, or the largest one.

    Returns
    -------
    vessel : repaired wall in LPS mm, without openings and centerlines, as `vstent.trace` needs it. Its ``notes`` hold
        one sentence for every assumption and repair.

    Raises
    ------
    ReadError
        The input is missing, damaged or of an unknown kind.
    UnitError
        The voxel spacing is not known, or the size is that of no intracranial vessel.
    VesselError
        No lumen is found.
    InputError
        The crop box holds too few voxels.
    """
    path = Path(path)
    near_mm = None if at_mm is None else np.asarray(at_mm, dtype=np.float64)
    if path.is_file() and is_surface_file(path):
        surface, notes = read_surface(path, units=units, frame=frame)
        vessel = Vessel(surface, notes=notes)
    else:
        image = read_image(path, spacing_mm=spacing_mm, shape=shape, acquisition=acquisition)
        if crop_mm is not None:
            image = image.cropped(np.asarray(crop_mm, dtype=np.float64))
        vessel = segment(image, threshold=threshold, at_mm=near_mm)
    lumen, repairs = repair(vessel.lumen, at_mm=near_mm)
    return replace(vessel, lumen=lumen, notes=(*vessel.notes, *repairs))
