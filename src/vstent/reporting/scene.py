"""Scene of a case: layers with colors, color scales and views, shared by the viewer and the pictures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.restore.paths import on_path
from vstent.deployment.coverage import coverage_fractions
from vstent.deployment.straightening import Straightening
from vstent.devices.stent import Coils, Deployment, Stent
from vstent.devices.treatment import BARE
from vstent.flow.case import FlowField
from vstent.flow.indices import on_sac
from vstent.flow.streamlines import inlet_seeds_mm, neck_seeds_mm, streamlines
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats, Ints, freeze
from vstent.reporting.thinning import thin_frames, thin_lines, thin_surface

N_INLET, N_NECK = 70, 60
"""Number of streamlines through the inlets and through the neck."""
BESIDE_SAC_MM = 1.0
"""Distance from the sac, in mm, within which values set the range of the flow's color scales."""

FRONTAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Axes (3, 3) of the frontal view, rows in LPS: the patient's left is on the right, the head is up."""
LATERAL = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""Axes (3, 3) of the view from the patient's left, rows in LPS."""


@dataclass(frozen=True, eq=False)
class Scale:
    """A color scale shared by all panes."""

    id: str
    """Name by which layers refer to it."""
    title: str
    """Display name of the quantity."""
    unit: str
    """Unit of `low` and `high`."""
    low: float
    """Value of the first color."""
    high: float
    """Value of the last color; values above have this color too."""
    colours: Floats
    """(256, 3) red, green and blue, 0 to 1; perceptually uniform and readable with color vision deficiency."""

    def __post_init__(self) -> None:
        freeze(self, "colours", np.float64, (256, 3))

    def paint(self, values: Floats) -> Floats:
        """Return the colors (n, 3) of values (n,); NaN has the first color."""
        place = (np.nan_to_num(values, nan=self.low) - self.low) / max(self.high - self.low, 1e-300)
        return self.colours[np.rint(255 * np.clip(place, 0.0, 1.0)).astype(int)]


@dataclass(frozen=True, eq=False)
class Layer:
    """Properties common to all layers."""

    id: str
    """Name of what it shows: lumen, landing, sac, neck, axis, contour, coverage, wires, streamlines, shear."""
    pane: str
    """Name of the pane that shows it; empty: all panes."""
    colour: tuple[float, float, float]
    """Red, green and blue, 0 to 1, used where the layer has no scale."""
    scale: str = field(default="", kw_only=True)
    """Name of the color scale of the values; empty: `colour` is used."""
    values: Floats = field(default_factory=lambda: np.zeros(0), kw_only=True)
    """(n,) value per vertex or point; empty without a scale."""


@dataclass(frozen=True, eq=False)
class MeshLayer(Layer):
    """A layer of triangles."""

    surface: Surface
    """The triangles."""
    opacity: float = 1.0
    """1: opaque; below 1: translucent, denser at the silhouette."""
    frames_mm: Floats | None = None
    """(f, n, 3) vertices over time, the last frame equal to `surface`; None: static."""
    frame_values: Floats | None = None
    """(f, n) values over time; None: static."""

    @property
    def vertices_mm(self) -> Floats:
        """(n, 3) points that the values belong to."""
        return self.surface.vertices_mm


@dataclass(frozen=True, eq=False)
class LineLayer(Layer):
    """A layer of round lines: wires, streamlines, curves."""

    points_mm: Floats
    """(p, 3) points of all polylines, one after another."""
    starts: Ints
    """(w + 1,) index of the first point of every polyline, and p at the end."""
    radius_mm: Floats
    """(w,) radius of every polyline."""

    @property
    def vertices_mm(self) -> Floats:
        """(p, 3) points that the values belong to."""
        return self.points_mm


Layers = list[MeshLayer | LineLayer]
"""Layers of a picture."""


@dataclass(frozen=True, eq=False)
class View:
    """A direction of view."""

    id: str
    """Name: profile, neck, frontal, lateral."""
    axes: Floats
    """(3, 3) unit rows in LPS: right on the screen, up, and toward the eye."""
    center_mm: Floats
    """(3,) point at the center of the picture."""
    radius_mm: float
    """Radius of the sphere around the center that should fill the picture."""

    def __post_init__(self) -> None:
        freeze(self, "axes", np.float64, (3, 3))
        freeze(self, "center_mm", np.float64, (3,))


@dataclass(frozen=True, eq=False)
class Scene:
    """Layers, color scales and views of a case."""

    panes: tuple[tuple[str, str], ...]
    """(name, title) of every pane: ``bare`` first, then the treatments."""
    layers: tuple[MeshLayer | LineLayer, ...]
    """All layers."""
    scales: tuple[Scale, ...]
    """Color scales in use."""
    views: tuple[View, ...]
    """Views offered, the best first."""
    is_oriented: bool
    """Whether left, right, front and back are known."""
    fade_mm: float
    """Depth behind the center of a picture at which wires are pale, so that the near side of a device stands out."""

    def scale(self, name: str) -> Scale:
        """Return the color scale called `name`."""
        return next(scale for scale in self.scales if scale.id == name)

    def view(self, name: str) -> View:
        """Return the view called `name`."""
        return next(view for view in self.views if view.id == name)

    def pick(self, ids: tuple[str, ...], pane: str) -> tuple[MeshLayer | LineLayer, ...]:
        """Return the layers with these ids that `pane` shows; its own replace those of all panes."""
        own = {layer.id for layer in self.layers if layer.pane == pane}
        panes = {layer.id: (pane,) if layer.id in own else ("", pane) for layer in self.layers}
        return tuple(layer for layer in self.layers if layer.id in ids and layer.pane in panes[layer.id])


Implants = Mapping[str, Mapping[str, Deployment]]
"""Deployed implants by treatment and id."""


def scene_of(
    anatomy: Anatomy,
    implants: Implants,
    flows: Mapping[str, FlowField],
    yielded: Mapping[str, Straightening] = MappingProxyType({}),
) -> Scene:
    """Return the scene of a case, decimated to the resolution of a screen.

    A treatment to which the artery has yielded is shown in that artery, with the flow in it.
    """
    layers, arteries = anatomy_layers(anatomy), {name: one.anatomy for name, one in yielded.items()}
    for name, artery in arteries.items():
        layers += own_layers(name, artery)
    seen = {name: yielded[name].deployed if name in yielded else (*found.values(),) for name, found in implants.items()}
    deployments = [(name, one) for name, deployed in seen.items() for one in deployed]
    for name, deployment in deployments:
        stent = deployment.stent
        layers.append(wire_layer(name, stent))
        if not isinstance(stent, Coils):
            coverage = 100 * node_coverage(stent).ravel()
            layers.append(contour_layer(name, deployment, arteries.get(name, anatomy)))
            layers.append(MeshLayer("coverage", name, STEEL_COLOUR, stent.contour, scale="coverage", values=coverage))
    for name, flow in flows.items():
        layers += flow_layers(name, flow, arteries.get(name, anatomy))
    titles = {name: treatment_title(deployed) for name, deployed in implants.items()}
    return Scene(
        panes=(
            (BARE, "Before (no device)"),
            *((name, f"{title}, artery straightened" if name in yielded else title) for name, title in titles.items()),
        ),
        layers=tuple(layers),
        scales=scales_of(layers, anatomy),
        views=views_of(anatomy, [deployment for _, deployment in deployments]),
        is_oriented=anatomy.vessel.is_oriented,
        fade_mm=1.2 * float(np.median(anatomy.parent.section_radius_mm)),
    )


def own_layers(pane: str, anatomy: Anatomy) -> Layers:
    """Return the layers of an artery that has yielded to a treatment, which replace those as scanned in a pane."""
    return [replace(one, pane=pane) for one in anatomy_layers(anatomy) if one.id in OWN]


def wires_of(name: str, pane: str, stent: Stent, **values: Any) -> LineLayer:
    """Return the wires of a device as a layer, with the fields `scale` and `values` where they are colored."""
    half_mm = stent.wire_diameter_um / 2000
    return LineLayer(name, pane, STEEL_COLOUR, stent.wire_points_mm, stent.wire_starts, half_mm, **values)


def wire_layer(name: str, stent: Stent) -> LineLayer:
    """Return the wires of a device in one color."""
    points, starts, _ = thin_lines(stent.wire_points_mm, stent.wire_starts, np.zeros(0), 60_000)
    return LineLayer("wires", name, STEEL_COLOUR, points, starts, stent.wire_diameter_um / 2000)


def device_title(deployment: Deployment) -> str:
    """Return the name of a device with its size: ``Silk 4.0 × 20 mm``."""
    stent, size = deployment.stent, deployment.stent.size
    if isinstance(stent, Coils):
        return f"{stent.design.name} {stent.density_fraction:.0%}"
    return f"{deployment.stent.design.name} {size.diameter_mm:g} × {size.length_mm:g} mm"


def implant_titles(deployed: Mapping[str, Deployment], before: str = "") -> dict[str, str]:
    """Return the titles of implants by id; several are numbered in their order, with `before` ahead of the number."""
    if len(deployed) == 1:
        return {key: device_title(one) for key, one in deployed.items()}
    return {key: f"{before}{n}. {device_title(one)}" for n, (key, one) in enumerate(deployed.items(), start=1)}


def titled(implants: Implants) -> list[tuple[str, str, str, Deployment]]:
    """Return name of the treatment, id, title and deployment of all implants."""
    return [
        (name, key, title, deployed[key])
        for name, deployed in implants.items()
        for key, title in implant_titles(deployed, f"{treatment_title(deployed)}: " * (len(implants) > 1)).items()
    ]


def treatment_title(deployed: Mapping[str, Deployment]) -> str:
    """Return the devices of a treatment with their sizes: ``Silk 4.0 × 20 mm + Silk 3.5 × 15 mm``."""
    return " + ".join(map(device_title, deployed.values()))


OWN: Final = ("lumen", "neck", "axis")
"""Layers that an artery that yields to a treatment has in its pane."""
WALL_COLOUR = (0.62, 0.68, 0.73)
NECK_COLOUR = (0.72, 0.20, 0.16)
STEEL_COLOUR = (0.33, 0.38, 0.43)
INK_COLOUR = (0.10, 0.17, 0.20)
ASSUMED_COLOUR = (0.45, 0.36, 0.58)
"""Colors of wall, neck, devices, lines, and of centerlines and assumed arteries: red, green and blue, 0 to 1."""
RING_MM = 1.0
"""Distance between the rings that show a continued artery, in mm."""


def anatomy_layers(anatomy: Anatomy) -> Layers:
    """Return the layers of lumen, landing surface, centerlines, axis, sacs and necks."""
    parent, own = anatomy.parent, anatomy.parent.landing_surface
    is_longer = any(parent.continued_mm)
    if is_longer:
        own = Surface(*triangles.compact(own.vertices_mm, own.faces[~parent.is_continued[own.faces].any(axis=1)]))
    centerlines = [line.points_mm for line in anatomy.vessel.centerlines]
    layers: Layers = [
        MeshLayer("lumen", "", WALL_COLOUR, thin_surface(anatomy.vessel.lumen, 40_000)[0], 0.16),
        MeshLayer("landing", "", (0.80, 0.74, 0.66), thin_surface(own, 24_000)[0]),
        curves_layer("centerlines", centerlines, 0.05, ASSUMED_COLOUR),
        curves_layer("axis", [parent.axis.points_mm], 0.06, (0.17, 0.32, 0.55)),
    ]
    if is_longer:  # assumed wall is drawn as rings, so that it does not look like the patient's
        count = len(parent.axis.points_mm)
        is_assumed = parent.is_continued.reshape(count, -1).all(axis=1)
        every = max(1, round(RING_MM / float(np.diff(parent.axis.abscissa_mm).mean())))
        rings_mm = parent.landing_surface.vertices_mm.reshape(count, -1, 3)[is_assumed][::every]
        layers.append(closed_layer("continued", rings_mm, 0.05, ASSUMED_COLOUR))
    for aneurysm in anatomy.aneurysms:
        layers.append(MeshLayer("sac", "", (0.62, 0.13, 0.16), thin_surface(aneurysm.sac, 12_000)[0], 0.45))
    if anatomy.aneurysms:
        layers.append(closed_layer("neck", [one.neck_mm for one in anatomy.aneurysms], 0.08, NECK_COLOUR))
    return layers


def curves_layer(
    name: str, curves: Iterable[Floats], radius_mm: float, colour: tuple[float, float, float]
) -> LineLayer:
    """Return curves, each (n, 3) points in mm, as one layer without values, shown in every pane."""
    some = list(curves)
    starts = np.concatenate([[0], np.cumsum([len(curve) for curve in some])]).astype(np.int32)
    return LineLayer(name, "", colour, np.concatenate([np.zeros((0, 3)), *some]), starts, np.full(len(some), radius_mm))


def closed_layer(name: str, rings: Iterable[Floats], radius_mm: float, colour: tuple[float, float, float]) -> LineLayer:
    """Return curves, each (n, 3) points in mm, as `curves_layer` does, their ends joined."""
    return curves_layer(name, [np.vstack([ring, ring[:1]]) for ring in rings], radius_mm, colour)


def contour_layer(name: str, deployment: Deployment, anatomy: Anatomy) -> MeshLayer:
    """Return the contour of a device with its expansion over time, colored by its gap to the wall."""
    wall = on_path(anatomy, deployment.stent.path).parent.landing_surface
    frames_mm, gaps_mm = thin_frames(deployment, wall, n_frames=24)
    return MeshLayer(
        "contour",
        name,
        STEEL_COLOUR,
        deployment.stent.contour,
        frames_mm=frames_mm,
        frame_values=gaps_mm,
        scale="wall_gap",
        values=gaps_mm[-1],
    )


def node_coverage(stent: Stent) -> Floats:
    """Return the fraction (rows, columns) of a device covered by metal, 0 to 1, at every node.

    Coverage is measured on the wires in each quad of the contour and averaged over 7 x 7 quads.
    """
    from scipy.ndimage import uniform_filter

    smooth = uniform_filter(coverage_fractions(stent), size=(7, 7), mode=("nearest", "wrap"))
    return np.concatenate([smooth, smooth[-1:]])


def flow_layers(name: str, flow: FlowField, anatomy: Anatomy) -> Layers:
    """Return the wall and the sac's wall, each colored by shear stress on a scale of its own, and the streamlines."""
    wall, origin = thin_surface(flow.wall, 40_000)
    layers: Layers = [MeshLayer("shear", name, WALL_COLOUR, wall, scale="shear", values=flow.shear_Pa[origin])]
    seeds = [inlet_seeds_mm(flow, anatomy.vessel, N_INLET)]
    for aneurysm in anatomy.aneurysms[:1]:
        is_sac = on_sac(flow.wall, aneurysm.sac, aneurysm.neck)
        used, corners = np.unique(flow.wall.faces[is_sac[flow.wall.faces].all(axis=1)], return_inverse=True)
        sac, origin = thin_surface(Surface(flow.wall.vertices_mm[used], corners.reshape(-1, 3)), 20_000)
        shear_Pa = flow.shear_Pa[used][origin]
        layers.append(MeshLayer("sac_shear", name, WALL_COLOUR, sac, scale="sac_shear", values=shear_Pa))
        seeds.append(neck_seeds_mm(flow, aneurysm.neck, N_NECK))
    return [*layers, stream_layer(name, flow, np.concatenate(seeds))]


def stream_layer(name: str, flow: FlowField, seeds_mm: Floats) -> LineLayer:
    """Return the streamlines through seeds (s, 3), colored by speed."""
    lines = streamlines(flow, seeds_mm)
    points, starts, speed = thin_lines(lines.points_mm, lines.starts, lines.speed_m_s, 24_000)
    radius_mm = np.full(len(starts) - 1, 0.025)
    return LineLayer("streamlines", name, INK_COLOUR, points, starts, radius_mm, scale="speed", values=speed)


_SCALES = {
    "speed": ("Speed", "m/s", "viridis", 0.05),
    "slice_speed": ("Speed, scale of the sac", "m/s", "viridis", 0.005),
    "shear": ("Wall shear stress", "Pa", "plasma", 1.0),
    "sac_shear": ("Wall shear stress of the sac", "Pa", "plasma", 0.05),
    "wall_gap": ("Gap between device and wall", "mm", "cividis", 0.1),
    "coverage": ("Metal coverage", "%", "viridis", 40.0),
    "diameter": ("Deployed diameter", "mm", "viridis", 1.0),
    "wire_diameter": ("Diameter of wires, width of struts", "µm", "viridis", 1.0),
}
"""Name of a scale: title, unit, color map, and the smallest upper end of the scale."""
_OF_FLOW = ("speed", "shear", "sac_shear")
"""Names of the color scales of the flow."""


def scales_of(layers: Sequence[MeshLayer | LineLayer], anatomy: Anatomy) -> tuple[Scale, ...]:
    """Return the color scales in use, each wide enough for all layers that use it.

    The range of a flow scale is set by the values near or in the first sac in the first layer, without a device.
    """
    import matplotlib

    scales = []
    for name, (title, unit, colour_map, least) in _SCALES.items():
        used = [layer for layer in layers if layer.scale == name and len(layer.values)]
        if not used:
            continue
        high = max([least, *(float(np.percentile(layer.values, 98)) for layer in used)])
        if name == "slice_speed" and anatomy.aneurysms:  # of the sac's inside, where devices differ
            wall_mm = anatomy.aneurysms[0].sac.vertices_mm
            middle = wall_mm.mean(axis=0)
            radius_mm = 0.75 * float(np.median(np.linalg.norm(wall_mm - middle, axis=1)))
            inside = used[0].values[np.linalg.norm(used[0].vertices_mm - middle, axis=1) < radius_mm]
            high = 2.5 * float(np.median(inside)) if len(inside) else high
        elif name in _OF_FLOW and anatomy.aneurysms:
            tree = cKDTree(anatomy.aneurysms[0].sac.vertices_mm)
            away_mm = tree.query(used[0].vertices_mm, distance_upper_bound=BESIDE_SAC_MM)[0]
            near = used[0].values[away_mm < BESIDE_SAC_MM]
            high = float(np.percentile(near, 98)) if near.any() else high
        # The lightest colors of a map would not show on the light background.
        colours = matplotlib.colormaps[colour_map](np.linspace(0.0, 0.93, 256))[:, :3]
        scales.append(Scale(name, title, unit, 0.0, round_up(high), colours))
    return tuple(scales)


def round_up(value: float) -> float:
    """Return the next round number: 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 or 10 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step >= value / power - 1e-9) * power)


def views_of(anatomy: Anatomy, deployments: Sequence[Deployment] = ()) -> tuple[View, ...]:
    """Return the views of a case, first the profile of the first sac, which encloses the deployed implants."""
    points = [deployment.stent.nodes_mm.reshape(-1, 3) for deployment in deployments]
    points += [aneurysm.sac.vertices_mm for aneurysm in anatomy.aneurysms[:1]]
    treated = np.concatenate(points or [anatomy.parent.axis.points_mm])
    whole = anatomy.vessel.lumen.vertices_mm

    def n_hiding(view: View) -> int:
        """Return the number of points between the eye and the sphere of a view."""
        offset = (whole - view.center_mm) @ view.axes.T
        aside_mm = np.linalg.norm(offset[:, :2], axis=1)
        return int(np.count_nonzero((aside_mm < view.radius_mm) & (offset[:, 2] > view.radius_mm)))

    right, up, toward = _profile(anatomy)
    sides = [view_of("profile", np.stack(axes), treated) for axes in ((right, up, toward), (-right, up, -toward))]
    views = [min(sides, key=n_hiding)]
    if anatomy.aneurysms:
        right, up, toward = views[0].axes
        views.append(view_of("neck", np.stack([right, -toward, up]), anatomy.aneurysms[0].neck_mm, 1.3))
    return *views, view_of("frontal", FRONTAL, whole), view_of("lateral", LATERAL, whole)


def view_of(name: str, axes: Floats, points_mm: Floats, room: float = 1.0) -> View:
    """Return a view whose sphere, its radius times `room`, encloses points (n, 3) as seen along its axes (3, 3)."""
    seen = points_mm @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    radius_mm = room * float(np.linalg.norm((seen - middle)[:, :2], axis=1).max())
    return View(name, axes, middle @ axes, radius_mm)


def _profile(anatomy: Anatomy) -> Floats:
    """Return rows right, up and toward the eye (3, 3): the artery at the neck runs to the right, the sac points up."""
    axis = anatomy.parent.axis
    if not anatomy.aneurysms:
        plane = np.linalg.svd(axis.points_mm - axis.points_mm.mean(axis=0))[2]
        return np.stack([plane[0], plane[1], np.cross(plane[0], plane[1])])
    aneurysm = anatomy.aneurysms[0]
    ends = np.array(anatomy.parent.span_mm(aneurysm))
    start, end = axis.at(np.clip(ends + np.array([-1.0, 1.0]), 0.0, axis.length_mm))
    right = (end - start) / np.linalg.norm(end - start)
    up = aneurysm.sac.vertices_mm.mean(axis=0) - 0.5 * (start + end)
    up = up - (up @ right) * right
    up = up / np.linalg.norm(up)
    return np.stack([right, up, np.cross(right, up)])
