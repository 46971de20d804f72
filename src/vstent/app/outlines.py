"""Outlines on a slice of the scan: where its plane cuts the surfaces and the wires that were found."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vstent.app.scans import Grid
from vstent.devices.stent import Stent
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats
from vstent.reporting.packing import Packer


def outlines(image: Image | Grid, anatomy: Anatomy, stents: Sequence[Stent], axis: int, index: int) -> bytes:
    """Return the exact sections of all surfaces and wires by the plane of a slice, as a message for the page.

    Positions are voxel indices (column, row) in the slice. Surfaces give segments, wires give the points where their
    axis crosses the plane.
    """
    packer = Packer()
    surfaces = {
        "lumen": [anatomy.vessel.lumen],
        "parent": [anatomy.parent.landing_surface],
        "sac": [aneurysm.sac for aneurysm in anatomy.aneurysms],
        "neck": [aneurysm.neck for aneurysm in anatomy.aneurysms],
    }
    curves = {
        name: packer.add_numbers(np.concatenate([section(image, one, axis, index) for one in some]).reshape(-1, 4))
        for name, some in surfaces.items()
        if some
    }
    told: dict[str, Any] = {"segments": curves}
    if stents:
        told["wires"] = packer.add_numbers(np.concatenate([crossings(image, one, axis, index) for one in stents]))
    return packer.framed(told)


def section(image: Image | Grid, surface: Surface, axis: int, index: int) -> Floats:
    """Return the segments (s, 2, 2) in which the plane of a slice cuts a surface, as voxel indices in the slice."""
    place = image.to_index(surface.vertices_mm)
    found = triangles.section(place, surface.faces, place[:, axis] - index)
    return np.delete(found, axis, axis=2)


def crossings(image: Image | Grid, stent: Stent, axis: int, index: int) -> Floats:
    """Return where wires cross the plane of a slice (n, 3): column, row and diameter of the wire in mm."""
    place = image.to_index(stent.wire_points_mm)
    offset, first = place[:, axis] - index, stent.piece_starts
    first = first[(offset[first] > 0) != (offset[first + 1] > 0)]
    share = (offset[first] / (offset[first] - offset[first + 1]))[:, None]
    points = np.delete(place[first] + share * (place[first + 1] - place[first]), axis, axis=1)
    return np.column_stack([points, stent.wire_diameter_um[stent.point_wires[first]] / 1000])
