"""Picture of the devices outside an artery, at their free diameter, with wires colored by their diameter (fig. 1)."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from vstent.deployment.sketch import bed, sketch
from vstent.devices.design import Design, Size, widest_mm
from vstent.devices.stent import Landing, Stent, tube_faces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Centerline, Opening, Path, Vessel
from vstent.reporting.figures import Plate, Shot
from vstent.reporting.scene import LineLayer, Scene, scales_of, view_of

ROOM: Final = 1.4
"""Diameter of the tube around a free device, as a multiple of the free diameter, so that no wire touches it."""
LONGER: Final = 2.0
"""Length of that tube as a multiple of the label length."""
COLUMNS: Final = 64
"""Number of nodes around that tube."""
TILT: Final = 0.25
"""Angle in rad by which the device is turned toward the eye, so that its lumen is seen."""


def freestanding_plate(stents: Mapping[str, Stent], scene: Scene, anatomy: Anatomy) -> Plate:
    """Return the picture of devices outside an artery, to be drawn."""
    layers = [wire_layer(free_device(stent.design, stent.size)) for stent in stents.values()]
    axes = np.array([[1.0, 0, 0], [0, np.cos(TILT), np.sin(TILT)], [0, -np.sin(TILT), np.cos(TILT)]])
    axes = axes @ np.array([[np.cos(TILT), 0, np.sin(TILT)], [0, 1, 0], [-np.sin(TILT), 0, np.cos(TILT)]])
    shots = [
        Shot(title, (layer,), view_of("free", axes, layer.points_mm))
        for title, layer in zip(stents, layers, strict=True)
    ]
    caption = (
        "The devices outside an artery, at their free diameter, colored by the diameter of their wires or the width of "
        "their struts (Zhong et al. 2016, fig. 1)."
    )
    shown = replace(scene, scales=scales_of(layers, anatomy))
    return Plate("free", "The devices outside an artery", caption, shown, shots, "wire_diameter")


def free_device(design: Design, size: Size) -> Stent:
    """Return a device at its free diameter, along the x axis."""
    length_mm = LONGER * size.length_mm
    tube = straight_tube(0.5 * ROOM * widest_mm(design, size), length_mm)
    return sketch(bed(design, size, tube), Landing(0.5 * length_mm)).stent


def straight_tube(radius_mm: float, length_mm: float) -> Anatomy:
    """Return a straight tube along the x axis, without a sac."""
    along = np.linspace(0.0, length_mm, max(8, round(length_mm / 0.2)))
    turn = np.linspace(0.0, 2 * np.pi, COLUMNS, endpoint=False)
    ring = radius_mm * np.stack([0 * turn, np.cos(turn), np.sin(turn)], axis=1)
    points = np.stack([along, 0 * along, 0 * along], axis=1)
    wall = Surface((points[:, None] + ring).reshape(-1, 3), tube_faces(len(along), COLUMNS))
    way, area_mm2 = np.array([1.0, 0.0, 0.0]), float(np.pi * radius_mm**2)
    ends = Opening(points[0], -way, area_mm2, "inlet"), Opening(points[-1], way, area_mm2, "outlet_1")
    axis = Centerline(points, np.full(len(along), radius_mm))
    is_restored = np.zeros(len(wall.vertices_mm), dtype=bool)
    parent = Path(PARENT, axis, axis.inscribed_radius_mm, wall, is_restored)
    return Anatomy(Vessel(wall, ends, (axis,)), (parent,), ())


def wire_layer(stent: Stent) -> LineLayer:
    """Return the wires of a device, colored by their diameter in um."""
    return LineLayer(
        id="free",
        pane="",
        colour=(0.33, 0.38, 0.43),
        scale="wire_diameter",
        values=stent.wire_diameter_um[stent.point_wires],
        points_mm=stent.wire_points_mm,
        starts=stent.wire_starts,
        radius_mm=stent.wire_diameter_um / 2000,
    )
