"""Prepare masks and label maps: unite labels, and close the wall where a mask was cropped to the vessel."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from vstent.geometry.image import Image
from vstent.kernels.arrays import Bools

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

    Parameters
    ----------
    image : any scan, mask or label map.
    is_united : whether labels are united.
    """
    values = _few_values(image.voxels)
    if is_united and len(values) > 2 and _is_label_map(image.voxels, values):
        listed = ", ".join(f"{value:g}" for value in values[1:9]) + (", ..." if len(values) > 9 else "")
        note = f"The image is a label map: its {len(values) - 1} labels ({listed}) are united."
        united = (image.voxels > 0).astype(np.uint8)
        image, values = replace(image, voxels=united, notes=(*image.notes, note)), np.array([0, 1])
    return _closed(image, values) if len(values) == 2 else image


def _few_values(voxels: NDArray[Any]) -> NDArray[Any]:
    """Return the values of an image in ascending order; empty where there are too many for a label map."""
    none = np.zeros(0)
    if len(np.unique(voxels[::4, ::4, ::4])) > MOST_LABELS + 1:
        return none
    values = np.unique(voxels)
    return values if len(values) <= MOST_LABELS + 1 else none


def _is_label_map(voxels: NDArray[Any], values: NDArray[Any]) -> bool:
    """Return whether few values are labels, and not levels of a blurred or resampled mask."""
    if values[0] != 0 or (values != np.rint(values)).any():
        return False
    is_lower = (voxels > 0) & (voxels < values[-1])
    touches = ndimage.maximum_filter(voxels, size=3)[is_lower] > voxels[is_lower]
    return bool(touches.mean() < 1 - LEAST_APART)


def _closed(image: Image, values: NDArray[Any]) -> Image:
    """Return a mask of two values with empty voxels at the sides where its border grazes the vessel."""
    inside = np.asarray(image.voxels == values[1])
    through = {(axis, end): _through(_seen(inside, axis, end)) for axis in range(3) for end in (0, 1)}
    margins = [[MARGIN if through[axis, end] is not None else 0 for end in (0, 1)] for axis in range(3)]
    if not np.any(margins):
        return image
    low = np.array(margins)[:, 0]
    padded = np.pad(inside, margins)
    for (axis, end), section in through.items():
        if section is not None:
            core = tuple(slice(a, a + n) for k, (a, n) in enumerate(zip(low, inside.shape, strict=True)) if k != axis)
            _seen(padded, axis, end)[(slice(0, MARGIN), *core)] = section
    affine = np.array(image.affine_mm)
    affine[:3, 3] = image.to_mm(-low[None].astype(np.float64))[0]
    note = (
        "The border of the mask grazes the side of the vessel, as where a mask is cropped to its segment: empty voxels "
        "were added there, so that the wall is closed."
    )
    voxels = np.where(padded, values[1], values[0]).astype(image.voxels.dtype)
    return replace(image, voxels=voxels, affine_mm=affine, notes=(*image.notes, note))


def _seen(inside: Bools, axis: int, end: int) -> Bools:
    """Return a view of a volume from one of its six sides: the first axis leads inward."""
    turned = np.moveaxis(inside, axis, 0)
    return turned[::-1] if end else turned


def _through(inside: Bools) -> Bools | None:
    """Return where vessels pass through the first layer; None where the border grazes none."""
    label, n = ndimage.label(inside[: DEPTH + 1])
    at_border, below = (np.bincount(layer.ravel(), minlength=n + 1) for layer in (label[0], label[-1]))
    is_grazed = below > GRAZED * at_border
    is_grazed[0] = False
    return (label[0] > 0) & ~is_grazed[label[0]] if (is_grazed & (at_border > 0)).any() else None
