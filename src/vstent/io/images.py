"""Read scans: DICOM, NIfTI, NRRD, MetaImage, VTK images and raw voxels, as an `Image` in LPS mm."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from vstent.geometry.image import Image
from vstent.io import dicom
from vstent.io.apart import read_apart
from vstent.io.files import existing, is_surface_file
from vstent.io.nifti import pair_of
from vstent.io.text_headers import voxel_files


def read_image(
    path: Path,
    *,
    spacing_mm: Sequence[float] | None = None,
    shape: Sequence[int] | None = None,
    dtype: DTypeLike | None = None,
    acquisition: int | None = None,
) -> Image:
    """Read a scan, in a child process.

    Parameters
    ----------
    path : DICOM folder or file, NIfTI or Analyze (also as .hdr and .img), NRRD, MHA, MHD, VTI, VTR, legacy VTK image
        or raw (also .gz).
    spacing_mm : voxel edges along i, j, k, or one number for cubes. Required for raw voxels and for headers without
        spacing; it replaces the spacing in the header.
    shape : number of voxels along i, j, k of raw voxels; i runs fastest.
    dtype : type of raw voxels; None: derived from the file size and reported in a note.
    acquisition : number of the acquisition in a DICOM series that holds several, counted from 1; None: the one with the
        brightest vessels.

    Returns
    -------
    image : Image
        Voxels (i, j, k) and the affine from voxel to LPS mm.

    Raises
    ------
    ReadError
        The file is missing, damaged, or not what its name says; a slice is missing, duplicated or misplaced.
    UnitError
        The voxel spacing is unknown or implausible.
    """
    path = existing(path)
    options = {
        "spacing_mm": None if spacing_mm is None else np.ravel(spacing_mm).tolist(),
        "shape": None if shape is None else [int(n) for n in shape],
        "dtype": None if dtype is None else np.dtype(dtype).str,
        "acquisition": acquisition,
    }
    with read_apart("scan", path, options, files_of(path)) as (arrays, words):
        return Image(
            arrays["voxels"], arrays["affine_mm"], words["modality"], tuple(words["notes"]), words["is_oriented"]
        )


def files_of(path: Path) -> list[Path]:
    """Return all files that are read when a folder, or one file of a scan or surface, is given.

    These include separate voxel files and the other files of a DICOM series. Missing ones are left out.
    """
    if path.is_dir() or dicom.is_directory(path):
        return dicom.candidates(path)
    if is_surface_file(path):
        return [path]
    if dicom.is_dicom(path):
        return dicom.series_of(path)
    return [
        *dict.fromkeys(pair_of(path)),
        *(file for file in voxel_files(path) if os.path.isfile(file)),
    ]  # accepts too long names
