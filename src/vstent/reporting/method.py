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
from vstent.anatomy.restore.paths import on_path
from vstent.deployment.sketch import measured_wall, sketch
from vstent.devices.design import Basket, Coil, Design, Size, widest_mm
from vstent.devices.stent import Deployment, Landing, Stent, tube_faces
from vstent.devices.treatment import BARE
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Centerline, Opening, Path, Vessel
from vstent.kernels.arrays import Floats
from vstent.reporting.figures import Plate, Shot
from vstent.reporting.node_rule import NodeRule
from vstent.reporting.scene import (
    INK_COLOUR,
    WALL_COLOUR,
    Implants,
    LineLayer,
    MeshLayer,
    Scene,
    closed_layer,
    curves_layer,
    device_title,
    implant_titles,
    round_up,
    scales_of,
    titled,
    view_of,
    wires_of,
)
from vstent.reporting.thinning import some_frames, thin_frames, thin_surface
from vstent.units import counted

SPHERE_STEP: Final = 0.9
"""Distance between drawn spheres as a fraction of their radius."""
SPHERE_NODES: Final = (17, 32)
"""Number of nodes of a drawn sphere from pole to pole, and around."""
FRAMES: Final = 4
"""Number of contours drawn of an expansion."""
MESH_MM: Final = 3.0
"""Distance from the middle of the neck, in mm, within which the triangles of a contour are drawn."""
LARGER: Final = 1.02
"""Ratio of the wall's areas before and after trimming from which both are drawn."""
RINGS: Final = 28
"""Largest number of rows of the initial contour that are drawn as lines."""
ROOM: Final = 1.4
"""Diameter of the tube around a free device, as a multiple of the free diameter, so that no wire touches it."""
LONGER: Final = 2.0
"""Length of that tube as a multiple of the label length."""
COLUMNS: Final = 64
"""Number of nodes around that tube."""
TILT: Final = 0.25
"""Angle in rad by which a free device is turned toward the eye, so that its lumen is seen."""
_CONTOUR: Final = (0.58, 0.63, 0.68)
"""Color of contours: red, green and blue, 0 to 1."""

Layers = tuple[MeshLayer | LineLayer, ...]


def method_plates(
    anatomy: Anatomy, implants: Implants, scene: Scene, whole: Vessel | None = None
) -> list[Plate | NodeRule]:
    """Return the pictures of the steps from the patient's artery to the deployed devices, in that order."""
    found: list[Plate | NodeRule] = []
    if whole is not None and whole.lumen.areas_mm2.sum() > LARGER * anatomy.vessel.lumen.areas_mm2.sum():
        found.append(_trimming(whole, scene))
    found += [_restoration(scene), _spheres(anatomy, scene)]
    implants = {
        name: {key: one for key, one in deployed.items() if not isinstance(one.stent.design, Basket | Coil)}
        for name, deployed in implants.items()
    }
    deployments = [(title, deployment) for _, _, title, deployment in titled(implants)]
    if deployments:
        stents = {device_title(one): one.stent for _, one in deployments}
        found = [_free(stents, scene, anatomy), *found]
        found += [_first_contours(deployments, scene), _triangles(anatomy, deployments, scene), NodeRule()]
        for name, deployed in implants.items():
            found += [_expansion(name, number, deployed, anatomy, scene) for number in range(len(deployed))]
        found.append(_fitted(scene))
    return found


def _free(stents: Mapping[str, Stent], scene: Scene, anatomy: Anatomy) -> Plate:
    """Return the picture of devices outside an artery (fig. 1)."""
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
    """Return a device at its free diameter, along the x axis: in a straight tube so wide that it touches nothing."""
    radius_mm, length_mm = 0.5 * ROOM * widest_mm(design, size), LONGER * size.length_mm
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
    tube = Anatomy(Vessel(wall, ends, (axis,)), (parent,), ())
    return sketch(measured_wall(design, size, tube), Landing(0.5 * length_mm)).stent


def wire_layer(stent: Stent) -> LineLayer:
    """Return the wires of a device, colored by their diameter in um."""
    return wires_of("free", "", stent, scale="wire_diameter", values=stent.wire_diameter_um[stent.point_wires])


def _trimming(whole: Vessel, scene: Scene) -> Plate:
    """Return the picture of the vessel before and after it is trimmed."""
    surface, _ = thin_surface(whole.lumen, 60_000)
    profile = scene.view("profile")
    view = view_of("whole", profile.axes, surface.vertices_mm)
    lumen = _with_opacity(scene, ("lumen",), 1.0)
    untrimmed = MeshLayer("untrimmed", "", WALL_COLOUR, surface)
    shots = [
        Shot("The vessel before it is trimmed", (untrimmed,), view),
        Shot("The part that is kept", (replace(untrimmed, opacity=0.16), *lumen), view),
        Shot("Enlarged", lumen, profile),
    ]
    caption = (
        "The vessel of the scan or surface before it is trimmed, and the part that is kept around the sac (Zhong et "
        "al. 2016, fig. 5). Arteries are cut square to their centerlines."
    )
    return Plate("untrimmed", "The vessel before it is trimmed", caption, scene, shots)


def _restoration(scene: Scene) -> Plate:
    """Return the picture of the removal of the sac."""
    looks = (
        ("The wall as found", _with_opacity(scene, ("lumen",), 1.0)),
        ("The sac and its neck", scene.pick(("lumen", "sac", "neck"), BARE)),
        ("The parent artery, with the sac removed", scene.pick(("continued", "landing"), BARE)),
    )
    shots = [Shot(title, layers, scene.view("profile")) for title, layers in looks]
    caption = (
        "The wall as found; the sac (red), cut off along its neck (red line); and the parent artery with sac "
        "and side branches closed, against which a device expands."
    )
    return Plate("restoration", "From the patient's artery to the parent artery", caption, scene, shots)


def _spheres(anatomy: Anatomy, scene: Scene) -> Plate:
    """Return the picture of the axis and its maximum inscribed spheres, which are one translucent layer."""
    axis = anatomy.parent.axis
    at_mm = [0.0]
    while at_mm[-1] < axis.length_mm:
        radius_mm = float(np.interp(at_mm[-1], axis.abscissa_mm, axis.inscribed_radius_mm))
        at_mm.append(at_mm[-1] + SPHERE_STEP * radius_mm)
    centers, radii = axis.at(np.array(at_mm[:-1])), np.interp(at_mm[:-1], axis.abscissa_mm, axis.inscribed_radius_mm)
    rows, columns = SPHERE_NODES
    polar = np.linspace(0.01, np.pi - 0.01, rows)  # open at the poles
    polar, turn = np.meshgrid(polar, np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    vertices = (centers[:, None] + radii[:, None, None] * unit.reshape(-1, 3)).reshape(-1, 3)
    faces = tube_faces(rows, columns)[:, ::-1]
    beads = Surface(vertices, np.concatenate([faces + k * rows * columns for k in range(len(centers))]))
    layers = (*scene.pick(("lumen", "axis"), BARE), MeshLayer("spheres", "", (0.36, 0.55, 0.72), beads, 0.30))
    shots = [Shot("In profile", layers, scene.view("profile")), Shot("Frontal", layers, scene.view("frontal"))]
    caption = (
        "The axis of the parent artery (blue line) with its maximum inscribed spheres, which set the diameter "
        "of the initial contour."
    )
    return Plate("spheres", "Centerline and maximum inscribed spheres", caption, scene, shots)


def _first_contours(deployments: Sequence[tuple[str, Deployment]], scene: Scene) -> Plate:
    """Return the picture of the contour of each device before the first iteration, with some of its rows as lines."""
    shots = []
    for title, deployment in deployments:
        nodes_mm = deployment.history_mm[0]
        rows, columns = nodes_mm.shape[:2]
        some = np.unique(np.linspace(0, rows - 1, min(rows, RINGS)).astype(int))
        contour = MeshLayer("first", "", _CONTOUR, Surface(nodes_mm.reshape(-1, 3), tube_faces(rows, columns)))
        rings = closed_layer("rings", nodes_mm[some], 0.02, INK_COLOUR)
        layers = (*_glass(scene), *scene.pick(("axis",), BARE), contour, rings)
        shots.append(Shot(title, layers, scene.view("profile")))
    caption = (
        "The contour before the first iteration, in the parent artery (glass): rows of nodes on planes across "
        "the axis, each as wide as the maximum inscribed sphere. Some rows are drawn as lines."
    )
    return Plate("first", "The initial contour", caption, scene, shots)


def _triangles(anatomy: Anatomy, deployments: Sequence[tuple[str, Deployment]], scene: Scene) -> Plate:
    """Return the picture of the triangle mesh of each contour near the neck, before and after the expansion."""
    profile, shots = scene.view("profile"), []
    middle_mm = anatomy.parent.axis.at(np.array([np.mean(neck_span_mm(anatomy))]))[0]
    for title, deployment in deployments:
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


def mesh_layers(nodes_mm: Floats) -> tuple[MeshLayer, LineLayer]:
    """Return a contour (rows, columns, 3) as a surface and the edges of its triangles as lines."""
    surface = Surface(nodes_mm.reshape(-1, 3), tube_faces(*nodes_mm.shape[:2]))
    corners = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    edges = np.unique(np.sort(corners, axis=1), axis=0)
    lines = curves_layer("edges", surface.vertices_mm[edges], 0.008, INK_COLOUR)
    return MeshLayer("mesh", "", _CONTOUR, surface), lines


def _expansion(name: str, number: int, deployed: Mapping[str, Deployment], anatomy: Anatomy, scene: Scene) -> Plate:
    """Return the picture of the expansion of one implant of a treatment, colored by the gap to the wall."""
    key, deployment = list(deployed.items())[number]
    wall = on_path(anatomy, deployment.stent.path).parent.landing_surface
    frames_mm, gaps_mm = thin_frames(deployment, wall, FRAMES)
    contour = [layer for layer in scene.pick(("contour",), name) if isinstance(layer, MeshLayer)][number]
    reached = np.concatenate([[0.0], deployment.terminated_fraction])
    shots = []
    for count, nodes_mm, gap_mm in zip(some_frames(deployment, FRAMES), frames_mm, gaps_mm, strict=True):
        surface = replace(contour.surface, vertices_mm=nodes_mm)
        layer = replace(contour, surface=surface, values=gap_mm, frames_mm=None, frame_values=None)
        words = "Initial contour"
        if count:
            words = f"After {counted(count, 'iteration')}: {100 * reached[count]:.0f} % of the nodes on the wall"
        shots.append(Shot(words, (*_glass(scene), layer), scene.view("profile")))
    # Earlier contours have larger gaps than the deployed device, so its scale would be too narrow.
    gap = scene.scale("wall_gap")
    wide = replace(gap, high=round_up(max(gap.high, float(np.percentile(gaps_mm[0], 98)))))
    shown = replace(scene, scales=tuple(wide if scale is gap else scale for scale in scene.scales))
    title = f"Expansion of {implant_titles(deployed)[key]}"
    caption = "Expansion of the active contour to the wall of the parent artery (glass), colored by the remaining gap."
    plate = f"expansion-{name}" if number == 0 else f"expansion-{name}-{number + 1}"
    return Plate(plate, title, caption, shown, shots, "wall_gap")


def _fitted(scene: Scene) -> Plate:
    """Return the picture of the wires in the parent artery and in the patient's own artery."""
    shots = []
    for pane, title in scene.panes[1:]:
        own = scene.pick(("lumen", "continued", "wires", "neck"), pane)
        parent = (*_glass(scene), *scene.pick(("wires",), pane))
        shots.append(Shot(f"{title}: in the parent artery", parent, scene.view("profile")))
        shots.append(Shot(f"{title}: in the patient's artery", own, scene.view("profile")))
    caption = "The wires on the expanded contour, and in the patient's own artery with its sac (neck: red line)."
    return Plate("fitted", "The deployed devices", caption, scene, shots)


def _glass(scene: Scene) -> Layers:
    """Return the parent artery, translucent."""
    return _with_opacity(scene, ("landing",), 0.18)


def _with_opacity(scene: Scene, ids: tuple[str, ...], opacity: float) -> Layers:
    """Return the surfaces among the layers with these ids, with another opacity."""
    return tuple(replace(layer, opacity=opacity) for layer in scene.pick(ids, BARE) if isinstance(layer, MeshLayer))
