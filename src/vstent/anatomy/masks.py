"""Prepare masks and label maps: unite labels, and close the wall where a mask was cropped to the vessel."""

from dataclasses import replace
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from vstent.geometry.image import Image

MOST_LABELS: Final = 64
"""Largest number of labels of a label map; a scan has more values."""
LEAST_APART: Final = 0.5
"""Smallest fraction of the voxels of lower labels that touch no higher one; in a blurred mask nearly all do."""
DEPTH: Final = 3
"""Number of voxels below the border at which the vessel is compared with its section at the border."""
GRAZED: Final = 1.5
"""Ratio of the areas there and at the border above which the border grazes the side of a vessel."""
MARGIN: Final = 2
"""Number of empty voxels that are added where the border grazes the vessel."""


def prepared(image: Image, *, is_united: bool) -> Image:
    """Return a mask or label map ready for segmentation, with notes; any other image is returned as it is.

    The labels of a label map (few whole numbers from 0) are united, where requested. Where a mask of two values was
    cropped so that the border grazes the side of the vessel, empty voxels are added, so that its wall is closed there.
    Where a vessel passes through the border, it stays open.
    """
    voxels = image.voxels
    if len(np.unique(voxels[::4, ::4, ::4])) > MOST_LABELS + 1:
        return image
    values = np.unique(voxels)
    if is_united and 2 < len(values) <= MOST_LABELS + 1 and values[0] == 0 and (values == np.rint(values)).all():
        # Few values may also be levels of a blurred or resampled mask; these touch higher ones.
        is_lower = (voxels > 0) & (voxels < values[-1])
        touches = ndimage.maximum_filter(voxels, size=3)[is_lower] > voxels[is_lower]
        if touches.mean() < 1 - LEAST_APART:
            listed = ", ".join(f"{value:g}" for value in values[1:9]) + (", ..." if len(values) > 9 else "")
            note = f"The image is a label map: its {len(values) - 1} labels ({listed}) are united."
            united = (voxels > 0).astype(np.uint8)
            image, values = replace(image, voxels=united, notes=(*image.notes, note)), np.array([0, 1])
    return _closed(image, values) if len(values) == 2 else image


def _closed(image: Image, values: NDArray[Any]) -> Image:
    """Return a mask of two values with empty voxels at the sides where its border grazes the vessel."""
    inside = np.asarray(image.voxels == values[1])
    sections = {}  # by side: where vessels pass through the first layer of voxels
    for axis, end in product(range(3), (0, 1)):
        layers = np.moveaxis(inside, axis, 0)[:: -1 if end else 1][: DEPTH + 1]
        label, n = ndimage.label(layers)
        at_border, below = (np.bincount(layer.ravel(), minlength=n + 1) for layer in (label[0], label[-1]))
        is_grazed = below > GRAZED * at_border
        is_grazed[0] = False
        if (is_grazed & (at_border > 0)).any():
            sections[axis, end] = (label[0] > 0) & ~is_grazed[label[0]]
    if not sections:
        return image
    margins = np.array([[MARGIN if (axis, end) in sections else 0 for end in (0, 1)] for axis in range(3)])
    padded = np.pad(inside, margins)
    for (axis, end), section in sections.items():
        across = [k for k in range(3) if k != axis]
        core = tuple(slice(margins[k, 0], margins[k, 0] + inside.shape[k]) for k in across)
        np.moveaxis(padded, axis, 0)[:: -1 if end else 1][(slice(0, MARGIN), *core)] = section
    affine = np.array(image.affine_mm)
    affine[:3, 3] = image.to_mm(-margins[None, :, 0].astype(np.float64))[0]
    note = (
        "The border of the mask grazes the side of the vessel, as where a mask is cropped to its segment: empty voxels "
        "were added there, so that the wall is closed."
    )
    voxels = np.where(padded, values[1], values[0]).astype(image.voxels.dtype)
    return replace(image, voxels=voxels, affine_mm=affine, notes=(*image.notes, note))
