"""A case as things to look at: layers with colours, scales and views, for the viewer and for the pictures alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from vstent.deployment.coverage import coverage_fractions
from vstent.devices.design import BARE
from vstent.devices.stent import Deployment, Stent
from vstent.flow.case import FlowField
from vstent.flow.streamlines import inlet_seeds_mm, neck_seeds_mm, streamlines
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats, Ints, freeze
from vstent.reporting.thinning import thin_frames, thin_lines, thin_surface

N_INLET, N_NECK = 70, 60
"""Streamlines through the inlets and through the neck."""
BESIDE_SAC_MM = 1.0
"""What is this near to the sac says how wide the scales of the flow are."""

if TYPE_CHECKING:
    from vstent.study.types import CaseResult

FRONTAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From the front: the patient's left is to the right, the head is up."""
LATERAL = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""From the left."""


@dataclass(frozen=True, eq=False)
class Scale:
    """A colour scale that every pane shares."""

    id: str
    """Name by which layers refer to it."""
    title: str
    """The quantity, for people."""
    unit: str
    """Unit of `low` and `high`."""
    low: float
    """Value of the first colour."""
    high: float
    """Value of the last colour; what is above is drawn in it."""
    colours: Floats
    """(256, 3) red, green and blue, 0 to 1; even in lightness and legible to the colour-blind."""

    def __post_init__(self) -> None:
        freeze(self, "colours", np.float64, (256, 3))

    def paint(self, values: Floats) -> Floats:
        """Return the colours (n, 3) of values (n,)."""
        place = (np.nan_to_num(values, nan=self.low) - self.low) / max(self.high - self.low, 1e-300)
        return self.colours[np.rint(255 * np.clip(place, 0.0, 1.0)).astype(int)]


@dataclass(frozen=True, eq=False)
class Layer:
    """What every layer has."""

    id: str
    """What it is: lumen, landing, sac, neck, axis, contour, coverage, wires, streamlines, shear."""
    pane: str
    """The pane that shows it; empty: every pane."""
    colour: tuple[float, float, float]
    """Red, green and blue, 0 to 1, where it has no values."""
    scale: str
    """Name of the scale that colours the values; empty: `colour`."""
    values: Floats
    """(n,) a value per vertex or point; empty without a scale."""


@dataclass(frozen=True, eq=False)
class MeshLayer(Layer):
    """Triangles."""

    surface: Surface
    """The triangles."""
    opacity: float = 1.0
    """1 hides what is behind; below, seen through, denser at the silhouette."""
    frames_mm: Floats | None = None
    """(f, n, 3) the vertices over time, the last one is `surface`; None: it does not move."""
    frame_values: Floats | None = None
    """(f, n) the values over time."""


@dataclass(frozen=True, eq=False)
class LineLayer(Layer):
    """Round lines: wires, streamlines, curves."""

    points_mm: Floats
    """(p, 3) points, one polyline after another."""
    starts: Ints
    """(w + 1,) first point of every polyline, and p at the end."""
    radius_mm: Floats
    """(w,) radius of every polyline."""


@dataclass(frozen=True, eq=False)
class View:
    """A direction to look from."""

    id: str
    """Name: profile, neck, frontal, lateral."""
    axes: Floats
    """(3, 3) unit rows in LPS: to the right on the screen, up, and towards the eye."""
    center_mm: Floats
    """(3,) what is in the middle."""
    radius_mm: float
    """Radius of the sphere about the middle that should fill the picture."""

    def __post_init__(self) -> None:
        freeze(self, "axes", np.float64, (3, 3))
        freeze(self, "center_mm", np.float64, (3,))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything there is to look at."""

    panes: tuple[tuple[str, str], ...]
    """(name, title): bare first, then every device."""
    layers: tuple[MeshLayer | LineLayer, ...]
    """What is drawn."""
    scales: tuple[Scale, ...]
    """The colour scales in use."""
    views: tuple[View, ...]
    """The directions offered, the best first."""
    fade_mm: float
    """Wires this far behind the middle of a picture are pale: the near side of a device stands out."""

    def scale(self, name: str) -> Scale:
        """Return the scale called `name`."""
        return next(scale for scale in self.scales if scale.id == name)

    def view(self, name: str) -> View:
        """Return the view called `name`."""
        return next(view for view in self.views if view.id == name)

    def pick(self, ids: tuple[str, ...], pane: str) -> tuple[MeshLayer | LineLayer, ...]:
        """Return the layers of these ids that `pane` shows."""
        return tuple(layer for layer in self.layers if layer.id in ids and layer.pane in ("", pane))


def scene_of(case: "CaseResult") -> Scene:
    """Return the scene of a case, thinned to what a screen can show."""
    anatomy: Anatomy = case.anatomy
    devices = tuple((name, device_title(deployment)) for name, deployment in case.deployments.items())
    layers: list[MeshLayer | LineLayer] = anatomy_layers(anatomy)
    for name, deployment in case.deployments.items():
        layers += [*device_layers(name, deployment, anatomy), coverage_layer(name, deployment.stent)]
    for name, field in case.fields.items():
        layers += flow_layers(name, field, anatomy)
    return Scene(
        panes=((BARE, "Before (no device)"), *devices),
        layers=tuple(layers),
        scales=scales_of(layers, anatomy),
        views=views_of(anatomy, case.deployments),
        fade_mm=1.2 * float(np.median(anatomy.section_radius_mm)),
    )


def device_title(deployment: Deployment) -> str:
    """Return what a device is called, with its size: ``Silk 4.0 × 20 mm``."""
    size = deployment.stent.size
    return f"{deployment.stent.design.name} {size.diameter_mm:g} × {size.length_mm:g} mm"


_PLAIN: dict[str, Any] = {"scale": "", "values": np.zeros(0)}
_WALL = (0.62, 0.68, 0.73)
_SAC = (0.80, 0.42, 0.36)
_INK = (0.10, 0.17, 0.20)
_STEEL = (0.33, 0.38, 0.43)


def anatomy_layers(anatomy: Anatomy) -> list[MeshLayer | LineLayer]:
    """Return lumen, landing surface, axes, sacs and necks."""
    lumen, _ = thin_surface(anatomy.vessel.lumen, 40_000)
    landing, _ = thin_surface(anatomy.landing_surface, 24_000)
    layers: list[MeshLayer | LineLayer] = [
        MeshLayer(id="lumen", pane="", colour=_WALL, surface=lumen, opacity=0.16, **_PLAIN),
        MeshLayer(id="landing", pane="", colour=(0.80, 0.74, 0.66), surface=landing, **_PLAIN),
        curves_layer("centerlines", [line.points_mm for line in anatomy.vessel.centerlines], 0.05, (0.45, 0.36, 0.58)),
        curves_layer("axis", [anatomy.axis.points_mm], 0.06, (0.17, 0.32, 0.55)),
    ]
    if anatomy.aneurysms:
        sacs = [thin_surface(aneurysm.sac, 12_000)[0] for aneurysm in anatomy.aneurysms]
        rings = [np.vstack([aneurysm.neck_mm, aneurysm.neck_mm[:1]]) for aneurysm in anatomy.aneurysms]
        layers += [MeshLayer(id="sac", pane="", colour=_SAC, surface=sac, opacity=0.45, **_PLAIN) for sac in sacs]
        layers += [curves_layer("neck", rings, 0.08, (0.72, 0.20, 0.16))]
    return layers


def curves_layer(name: str, curves: list[Floats], radius_mm: float, colour: tuple[float, float, float]) -> LineLayer:
    """Return plain curves (n, 3) as one layer of every pane."""
    starts = np.concatenate([[0], np.cumsum([len(curve) for curve in curves])]).astype(np.int32)
    points = np.concatenate([np.zeros((0, 3)), *curves])
    radii = np.full(len(curves), radius_mm)
    return LineLayer(id=name, pane="", colour=colour, points_mm=points, starts=starts, radius_mm=radii, **_PLAIN)


def device_layers(name: str, deployment: Deployment, anatomy: Anatomy) -> list[MeshLayer | LineLayer]:
    """Return the contour with its expansion, and the wires, for the pane `name`."""
    frames_mm, gaps_mm = thin_frames(deployment, anatomy.landing_surface, n_frames=24)
    stent = deployment.stent
    points, starts, _ = thin_lines(stent.wire_points_mm, stent.wire_starts, np.zeros(0), 60_000)
    contour = MeshLayer(
        id="contour",
        pane=name,
        colour=_STEEL,
        scale="wall_gap",
        values=gaps_mm[-1],
        surface=stent.contour,
        frames_mm=frames_mm,
        frame_values=gaps_mm,
    )
    radius_mm = stent.wire_diameter_um / 2000
    wires = LineLayer(
        id="wires", pane=name, colour=_STEEL, points_mm=points, starts=starts, radius_mm=radius_mm, **_PLAIN
    )
    return [contour, wires]


def coverage_layer(name: str, stent: Stent) -> MeshLayer:
    """Return the contour coloured by how much metal is about, for the pane `name`."""
    values = 100 * node_coverage(stent).ravel()
    return MeshLayer(id="coverage", pane=name, colour=_STEEL, scale="coverage", values=values, surface=stent.contour)


def node_coverage(stent: Stent) -> Floats:
    """Coverage (rows, columns) as measured on the wires in the quads around every node, smoothed over a few cells."""
    from scipy.ndimage import uniform_filter

    quads = coverage_fractions(stent)
    smooth = uniform_filter(quads, size=(7, 7), mode=("nearest", "wrap"))
    return np.concatenate([smooth, smooth[-1:]])


def flow_layers(name: str, field: FlowField, anatomy: Anatomy) -> list[MeshLayer | LineLayer]:
    """Return the wall coloured by its shear stress, and streamlines, for the pane `name`."""
    wall, origin = thin_surface(field.wall, 40_000)
    shear = MeshLayer(
        id="shear",
        pane=name,
        colour=_WALL,
        scale="shear",
        values=field.shear_Pa[origin],
        surface=wall,
    )
    lines = streamlines(field, _seeds_mm(field, anatomy))
    points, starts, speed = thin_lines(lines.points_mm, lines.starts, lines.speed_m_s, 24_000)
    stream = LineLayer(
        id="streamlines",
        pane=name,
        colour=_INK,
        scale="speed",
        values=speed,
        points_mm=points,
        starts=starts,
        radius_mm=np.full(len(starts) - 1, 0.025),
    )
    return [shear, stream]


def _seeds_mm(field: FlowField, anatomy: Anatomy) -> Floats:
    """Points (s, 3) on the inlets' sections and on the neck."""
    seeds = [inlet_seeds_mm(field, anatomy.vessel, N_INLET)]
    seeds += [neck_seeds_mm(field, sac.neck, N_NECK) for sac in anatomy.aneurysms[:1]]
    return np.concatenate(seeds)


_SCALES = {
    "speed": ("Speed", "m/s", "viridis", 0.05),
    "shear": ("Wall shear stress", "Pa", "plasma", 1.0),
    "wall_gap": ("Gap between device and wall", "mm", "cividis", 0.1),
    "coverage": ("Metal coverage", "%", "viridis", 40.0),
    "diameter": ("Deployed diameter", "mm", "viridis", 1.0),
}
"""Name -> title, unit, colour map and the smallest range worth a scale."""
_OF_FLOW = ("speed", "shear")


def scales_of(layers: Sequence[MeshLayer | LineLayer], anatomy: Anatomy) -> tuple[Scale, ...]:
    """Return the scales that the layers use, each wide enough for all of them.

    Those of the flow are as wide as what it has about the sac without a device, which is its first layer.
    """
    scales = []
    for name, (title, unit, colour_map, least) in _SCALES.items():
        used = [layer for layer in layers if layer.scale == name and len(layer.values)]
        if used:
            near = _about_the_sac(used[0], anatomy) if name in _OF_FLOW else np.zeros(0)
            highs = [least, *(float(np.percentile(layer.values, 98)) for layer in used)]
            high = float(np.percentile(near, 98)) if near.any() else max(highs)
            scales.append(Scale(name, title, unit, 0.0, round_up(high), _colours(colour_map)))
    return tuple(scales)


def _about_the_sac(layer: MeshLayer | LineLayer, anatomy: Anatomy) -> Floats:
    """Values (k,) of a layer's points near the wall of the first sac; none without one."""
    if not anatomy.aneurysms:
        return np.zeros(0)
    points_mm = layer.points_mm if isinstance(layer, LineLayer) else layer.surface.vertices_mm
    tree = cKDTree(anatomy.aneurysms[0].sac.vertices_mm)
    return layer.values[tree.query(points_mm, distance_upper_bound=BESIDE_SAC_MM)[0] < BESIDE_SAC_MM]


def round_up(value: float) -> float:
    """Return the next round number: 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 or 10 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step >= value / power - 1e-9) * power)


def _colours(name: str) -> Floats:
    import matplotlib

    # The lightest tenth of a map is lost on a light background.
    return matplotlib.colormaps[name](np.linspace(0.0, 0.93, 256))[:, :3]


def views_of(anatomy: Anatomy, deployments: dict[str, Deployment]) -> tuple[View, ...]:
    """Return the directions to look from, the profile of the largest sac first."""
    points = [deployment.stent.nodes_mm.reshape(-1, 3) for deployment in deployments.values()]
    points += [aneurysm.sac.vertices_mm for aneurysm in anatomy.aneurysms[:1]]
    treated = np.concatenate(points or [anatomy.axis.points_mm])
    whole = anatomy.vessel.lumen.vertices_mm
    right, up, toward = _profile(anatomy)
    profile = view_of("profile", np.stack([right, up, toward]), treated)
    opposite = view_of("profile", np.stack([-right, up, -toward]), treated)
    views = [profile if _hidden(whole, profile) <= _hidden(whole, opposite) else opposite]
    if anatomy.aneurysms:
        right, up, toward = views[0].axes
        views.append(view_of("neck", np.stack([right, -toward, up]), anatomy.aneurysms[0].neck_mm, 1.3))
    views += [view_of("frontal", FRONTAL, whole), view_of("lateral", LATERAL, whole)]
    return tuple(views)


def view_of(name: str, axes: Floats, points_mm: Floats, room: float = 1.0) -> View:
    """Frame points (n, 3) as they show from there, with some room."""
    seen = points_mm @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    radius_mm = room * float(np.linalg.norm((seen - middle)[:, :2], axis=1).max())
    return View(name, axes, middle @ axes, radius_mm)


def _profile(anatomy: Anatomy) -> Floats:
    """Rows right, up, toward: the artery at the neck runs to the right, the sac stands up."""
    axis = anatomy.axis
    if not anatomy.aneurysms:
        plane = np.linalg.svd(axis.points_mm - axis.points_mm.mean(axis=0))[2]
        return np.stack([plane[0], plane[1], np.cross(plane[0], plane[1])])
    aneurysm = anatomy.aneurysms[0]
    ends = np.array([aneurysm.proximal_abscissa_mm, aneurysm.distal_abscissa_mm])
    start, end = axis.at(np.clip(ends + np.array([-1.0, 1.0]), 0.0, axis.length_mm))
    right = (end - start) / np.linalg.norm(end - start)
    up = aneurysm.sac.vertices_mm.mean(axis=0) - 0.5 * (start + end)
    up = up - (up @ right) * right
    up = up / np.linalg.norm(up)
    return np.stack([right, up, np.cross(right, up)])


def _hidden(points_mm: Floats, view: View) -> int:
    """Count the points (n, 3) that stand between the eye and what the view is of."""
    offset = (points_mm - view.center_mm) @ view.axes.T
    aside_mm = np.linalg.norm(offset[:, :2], axis=1)
    return int(np.count_nonzero((aside_mm < view.radius_mm) & (offset[:, 2] > view.radius_mm)))
