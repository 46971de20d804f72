"""Pictures of the steps to a deployed device, in the order of Zhong et al. 2016.

They show the devices outside an artery, the vessel before it is trimmed, the parent artery with the sac removed, the
maximum inscribed spheres along its axis, the initial contour with its triangles, the rule for its nodes, its expansion,
and the wires in the parent artery and in the patient's own artery.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from vstent.anatomy.landing_zones import neck_span_mm
from vstent.devices.stent import Deployment, tube_faces
from vstent.devices.treatment import BARE
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.kernels.arrays import Floats, Ints
from vstent.reporting.figures import Plate, Shot
from vstent.reporting.freestanding import freestanding_plate
from vstent.reporting.node_rule import NodeRule
from vstent.reporting.scene import (
    Implants,
    LineLayer,
    MeshLayer,
    Scene,
    curves_layer,
    device_title,
    implant_titles,
    round_up,
    view_of,
)
from vstent.reporting.thinning import some_frames, thin_frames, thin_surface
from vstent.units import counted

SPHERE_STEP: Final = 0.9
"""Distance between drawn spheres as a fraction of their radius."""
FRAMES: Final = 4
"""Number of contours drawn of an expansion."""
MESH_MM: Final = 3.0
"""Distance from the middle of the neck, in mm, within which the triangles of a contour are drawn."""
LARGER: Final = 1.02
"""Ratio of the wall's areas before and after trimming from which both are drawn."""
RINGS: Final = 28
"""Largest number of rows of the initial contour that are drawn as lines."""
_SPHERE: Final = (0.36, 0.55, 0.72)
_STEEL: Final = (0.58, 0.63, 0.68)
_INK: Final = (0.10, 0.17, 0.20)
_WALL: Final = (0.62, 0.68, 0.73)
"""Colors of spheres, contours, lines and wall: red, green and blue, 0 to 1."""


def method_plates(
    anatomy: Anatomy, implants: Implants, scene: Scene, whole: Vessel | None = None
) -> list[Plate | NodeRule]:
    """Return the pictures of the steps from the patient's artery to the deployed devices, in that order."""
    found: list[Plate | NodeRule] = []
    if whole is not None and _is_trimmed(whole, anatomy):
        found.append(_trimming(whole, scene))
    found += [_restoration(scene), _spheres(anatomy, scene)]
    titled = [
        (title, deployed[key])
        for name, deployed in implants.items()
        for key, title in implant_titles(deployed, f"{name}: ").items()
    ]
    if titled:
        stents = {device_title(one): one.stent for _, one in titled}
        found = [freestanding_plate(stents, scene, anatomy), *found]
        found += [_first_contours(titled, scene), _triangles(anatomy, titled, scene), NodeRule()]
        for name, deployed in implants.items():
            found += [_expansion(name, number, deployed, anatomy, scene) for number in range(len(deployed))]
        found.append(_fitted(scene))
    return found


def _is_trimmed(whole: Vessel, anatomy: Anatomy) -> bool:
    """Return whether a part of the vessel was removed that is worth a picture."""
    return whole.lumen.areas_mm2.sum() > LARGER * anatomy.vessel.lumen.areas_mm2.sum()


def _trimming(whole: Vessel, scene: Scene) -> Plate:
    """Return the picture of the vessel before and after it is trimmed."""
    surface, _ = thin_surface(whole.lumen, 60_000)
    profile = scene.view("profile")
    view = view_of("whole", profile.axes, surface.vertices_mm)
    lumen = scene.pick(("lumen",), BARE)
    untrimmed = MeshLayer("untrimmed", "", _WALL, "", np.zeros(0), surface)
    shots = [
        Shot("The vessel before it is trimmed", (untrimmed,), view),
        Shot("The part that is kept", (replace(untrimmed, opacity=0.16), *_opaque(lumen)), view),
        Shot("Enlarged", _opaque(lumen), profile),
    ]
    caption = (
        "The vessel of the scan or surface before it is trimmed, and the part that is kept around the sac (Zhong et "
        "al. 2016, fig. 5). Arteries are cut square to their centerlines."
    )
    return Plate("untrimmed", "The vessel before it is trimmed", caption, scene, shots)


def _restoration(scene: Scene) -> Plate:
    """Return the picture of the removal of the sac."""
    profile = scene.view("profile")
    lumen, landing = scene.pick(("lumen",), BARE), scene.pick(("continued", "landing"), BARE)
    cut = scene.pick(("lumen", "sac", "neck"), BARE)
    shots = [
        Shot("The wall as found", _opaque(lumen), profile),
        Shot("The sac and its neck", cut, profile),
        Shot("The parent artery, with the sac removed", landing, profile),
    ]
    caption = (
        "The wall as found; the sac (red), cut off along its neck (red line); and the parent artery with sac "
        "and side branches closed, against which a device expands."
    )
    return Plate("restoration", "From the patient's artery to the parent artery", caption, scene, shots)


def _spheres(anatomy: Anatomy, scene: Scene) -> Plate:
    """Return the picture of the axis and its maximum inscribed spheres."""
    spheres = _bead_layer(anatomy)
    shots = [
        Shot("In profile", (*scene.pick(("lumen", "axis"), BARE), spheres), scene.view("profile")),
        Shot("Frontal", (*scene.pick(("lumen", "axis"), BARE), spheres), scene.view("frontal")),
    ]
    caption = (
        "The axis of the parent artery (blue line) with its maximum inscribed spheres, which set the diameter "
        "of the initial contour."
    )
    return Plate("spheres", "Centerline and maximum inscribed spheres", caption, scene, shots)


def _bead_layer(anatomy: Anatomy) -> MeshLayer:
    """Return the maximum inscribed spheres along the axis as one translucent layer."""
    axis = anatomy.parent.axis
    at_mm = [0.0]
    while at_mm[-1] < axis.length_mm:
        radius_mm = float(np.interp(at_mm[-1], axis.abscissa_mm, axis.inscribed_radius_mm))
        at_mm.append(at_mm[-1] + SPHERE_STEP * radius_mm)
    stations = np.array(at_mm[:-1])
    centers, radii = axis.at(stations), np.interp(stations, axis.abscissa_mm, axis.inscribed_radius_mm)
    points, faces = _unit_sphere()
    n = len(points)
    vertices = (centers[:, None] + radii[:, None, None] * points).reshape(-1, 3)
    beads = Surface(vertices, np.concatenate([faces + k * n for k in range(len(centers))]))
    return MeshLayer("spheres", "", _SPHERE, "", np.zeros(0), beads, 0.30)


def _unit_sphere(rows: int = 17, columns: int = 32) -> tuple[Floats, Ints]:
    """Return points (n, 3) and triangles (m, 3) of a sphere of radius 1, open at the poles."""
    polar, turn = np.meshgrid(
        np.linspace(0.01, np.pi - 0.01, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    return points.reshape(-1, 3), tube_faces(rows, columns)[:, ::-1]


def _first_contours(titled: Sequence[tuple[str, Deployment]], scene: Scene) -> Plate:
    """Return the picture of the contour of each device before the first iteration."""
    shots = []
    for title, deployment in titled:
        layers = (*scene.pick(("axis",), BARE), *_contour_layers(deployment.history_mm[0]))
        shots.append(Shot(title, (*_glass(scene), *layers), scene.view("profile")))
    caption = (
        "The contour before the first iteration, in the parent artery (glass): rows of nodes on planes across "
        "the axis, each as wide as the maximum inscribed sphere. Some rows are drawn as lines."
    )
    return Plate("first", "The initial contour", caption, scene, shots)


def _triangles(anatomy: Anatomy, titled: Sequence[tuple[str, Deployment]], scene: Scene) -> Plate:
    """Return the picture of the triangle mesh of each contour near the neck, before and after the expansion."""
    profile, shots = scene.view("profile"), []
    middle_mm = _middle_mm(anatomy)
    for title, deployment in titled:
        history_mm = deployment.history_mm
        for words, nodes_mm in (("initial", history_mm[0]), ("deployed", history_mm[-1])):
            near = np.linalg.norm(nodes_mm.mean(axis=1) - middle_mm, axis=1) < MESH_MM
            rows = nodes_mm[near] if near.sum() > 2 else nodes_mm
            view = view_of("mesh", profile.axes, rows.reshape(-1, 3))
            shots.append(Shot(f"{title}: {words}", (*_glass(scene), *mesh_layers(rows)), view))
    caption = (
        f"The triangles of the contour within {MESH_MM:g} mm of the neck, before the first iteration and deployed, in "
        "the parent artery (glass; Zhong et al. 2016, fig. 6). Nodes are the corners of the triangles."
    )
    return Plate("mesh", "The triangle mesh of the contour", caption, scene, shots)


def _middle_mm(anatomy: Anatomy) -> Floats:
    """Return the point (3,) of the axis at the middle of the neck, or without a sac of the artery."""
    return anatomy.parent.axis.at(np.array([np.mean(neck_span_mm(anatomy))]))[0]


def mesh_layers(nodes_mm: Floats) -> tuple[MeshLayer | LineLayer, ...]:
    """Return a contour as a surface and the edges of its triangles as lines.

    Shapes: `nodes_mm` (rows, columns, 3).
    """
    rows, columns = nodes_mm.shape[:2]
    surface = Surface(nodes_mm.reshape(-1, 3), tube_faces(rows, columns))
    corners = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    edges = np.unique(np.sort(corners, axis=1), axis=0)
    lines = curves_layer("edges", list(surface.vertices_mm[edges]), 0.008, _INK)
    return MeshLayer("mesh", "", _STEEL, "", np.zeros(0), surface), lines


def _contour_layers(nodes_mm: Floats) -> tuple[MeshLayer | LineLayer, ...]:
    """Return a contour (rows, columns, 3) as a surface and some of its rows as lines."""
    rows, columns = nodes_mm.shape[:2]
    surface = Surface(nodes_mm.reshape(-1, 3), tube_faces(rows, columns))
    some = np.unique(np.linspace(0, rows - 1, min(rows, RINGS)).astype(int))
    rings = [np.concatenate([nodes_mm[row], nodes_mm[row, :1]]) for row in some]
    return MeshLayer("first", "", _STEEL, "", np.zeros(0), surface), curves_layer("rings", rings, 0.02, _INK)


def _expansion(name: str, number: int, deployed: Mapping[str, Deployment], anatomy: Anatomy, scene: Scene) -> Plate:
    """Return the picture of the expansion of one implant of a treatment, colored by the gap to the wall."""
    key, deployment = list(deployed.items())[number]
    frames_mm, gaps_mm = thin_frames(deployment, anatomy.parent.landing_surface, FRAMES)
    contour = [layer for layer in scene.pick(("contour",), name) if isinstance(layer, MeshLayer)][number]
    reached = np.concatenate([[0.0], deployment.terminated_fraction])
    shots = []
    for count, nodes_mm, gap_mm in zip(some_frames(deployment, FRAMES), frames_mm, gaps_mm, strict=True):
        surface = replace(contour.surface, vertices_mm=nodes_mm)
        layer = replace(contour, surface=surface, values=gap_mm, frames_mm=None, frame_values=None)
        words = (
            f"after {counted(count, 'iteration')}, {100 * reached[count]:.0f} % of the nodes terminated"
            if count
            else "initial contour"
        )
        shots.append(Shot(words[:1].upper() + words[1:], (*_glass(scene), layer), scene.view("profile")))
    # Earlier contours have larger gaps than the deployed device, so its scale would be too narrow.
    gap = scene.scale("wall_gap")
    wide = replace(gap, high=round_up(max(gap.high, float(np.percentile(gaps_mm[0], 98)))))
    shown = replace(scene, scales=tuple(wide if scale is gap else scale for scale in scene.scales))
    title = f"Expansion of {implant_titles(deployed, f'{name}: ')[key]}"
    caption = (
        "Expansion of the active contour to the wall of the parent artery (glass) in "
        f"{counted(len(deployment.history_mm) - 1, 'iteration')}, colored by the remaining gap."
    )
    plate = f"expansion-{name}" if number == 0 else f"expansion-{name}-{number + 1}"
    return Plate(plate, title, caption, shown, shots, "wall_gap")


def _fitted(scene: Scene) -> Plate:
    """Return the picture of the wires in the parent artery and in the patient's own artery."""
    profile = scene.view("profile")
    shots = [
        shot
        for pane, title in scene.panes[1:]
        for shot in (
            Shot(f"{title}: in the parent artery", (*_glass(scene), *scene.pick(("wires",), pane)), profile),
            Shot(
                f"{title}: in the patient's artery", scene.pick(("lumen", "continued", "wires", "neck"), pane), profile
            ),
        )
    ]
    caption = "The wires on the expanded contour, and in the patient's own artery with its sac (neck: red line)."
    return Plate("fitted", "The deployed devices", caption, scene, shots)


def _glass(scene: Scene) -> tuple[MeshLayer | LineLayer, ...]:
    """Return the layers of the parent artery, translucent."""
    layers = (layer for layer in scene.pick(("landing",), BARE) if isinstance(layer, MeshLayer))
    return tuple(replace(layer, opacity=0.18) for layer in layers)


def _opaque(layers: tuple[MeshLayer | LineLayer, ...]) -> tuple[MeshLayer | LineLayer, ...]:
    """Return layers with their meshes made opaque."""
    return tuple(replace(layer, opacity=1.0) if isinstance(layer, MeshLayer) else layer for layer in layers)
