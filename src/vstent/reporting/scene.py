"""Scene of a case: layers with colors, color scales and views, shared by the viewer and the pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from vstent.deployment.coverage import coverage_fractions
from vstent.devices.stent import Deployment, Stent
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
    scale: str
    """Name of the color scale of the values; empty: `colour` is used."""
    values: Floats
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


@dataclass(frozen=True, eq=False)
class LineLayer(Layer):
    """A layer of round lines: wires, streamlines, curves."""

    points_mm: Floats
    """(p, 3) points of all polylines, one after another."""
    starts: Ints
    """(w + 1,) index of the first point of every polyline, and p at the end."""
    radius_mm: Floats
    """(w,) radius of every polyline."""


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
        """Return the layers with these ids that `pane` shows."""
        return tuple(layer for layer in self.layers if layer.id in ids and layer.pane in ("", pane))


Implants = Mapping[str, Mapping[str, Deployment]]
"""Deployed implants by treatment and id."""


def scene_of(anatomy: Anatomy, implants: Implants, fields: Mapping[str, FlowField]) -> Scene:
    """Return the scene of a case, decimated to the resolution of a screen."""
    treatments = tuple((name, treatment_title(deployed)) for name, deployed in implants.items())
    layers: list[MeshLayer | LineLayer] = anatomy_layers(anatomy)
    for name, deployed in implants.items():
        for deployment in deployed.values():
            layers += [*device_layers(name, deployment, anatomy), coverage_layer(name, deployment.stent)]
    for name, field in fields.items():
        layers += flow_layers(name, field, anatomy)
    return Scene(
        panes=((BARE, "Before (no device)"), *treatments),
        layers=tuple(layers),
        scales=scales_of(layers, anatomy),
        views=views_of(anatomy, [one for deployed in implants.values() for one in deployed.values()]),
        is_oriented=anatomy.vessel.is_oriented,
        fade_mm=1.2 * float(np.median(anatomy.parent.section_radius_mm)),
    )


def device_title(deployment: Deployment) -> str:
    """Return the name of a device with its size: ``Silk 4.0 × 20 mm``."""
    size = deployment.stent.size
    return f"{deployment.stent.design.name} {size.diameter_mm:g} × {size.length_mm:g} mm"


def implant_titles(deployed: Mapping[str, Deployment], before: str = "") -> dict[str, str]:
    """Return the titles of the implants of a treatment by id.

    Parameters
    ----------
    deployed : deployed implants by id.
    before : text before the titles of several implants; these are numbered in the order of deployment.
    """
    if len(deployed) == 1:
        return {key: device_title(one) for key, one in deployed.items()}
    return {key: f"{before}{n}. {device_title(one)}" for n, (key, one) in enumerate(deployed.items(), start=1)}


def treatment_title(deployed: Mapping[str, Deployment]) -> str:
    """Return the devices of a treatment with their sizes: ``Silk 4.0 × 20 mm + Silk 3.5 × 15 mm``."""
    return " + ".join(map(device_title, deployed.values()))


_PLAIN: dict[str, Any] = {"scale": "", "values": np.zeros(0)}
"""Fields of a layer without values."""
_WALL = (0.62, 0.68, 0.73)
_SAC = (0.62, 0.13, 0.16)
_INK = (0.10, 0.17, 0.20)
_STEEL = (0.33, 0.38, 0.43)
_ASSUMED = (0.45, 0.36, 0.58)
"""Colors of wall, sac, lines, devices and assumed artery: red, green and blue, 0 to 1."""
ON_SAC_CELLS = 0.2
"""Distance from the sac, in cells, within which a vertex of the wall belongs to it (as in `flow.indices`)."""
RING_MM = 1.0
"""Distance between the rings that show a continued artery, in mm."""


def anatomy_layers(anatomy: Anatomy) -> list[MeshLayer | LineLayer]:
    """Return the layers of lumen, landing surface, centerlines, axis, sacs and necks."""
    lumen, _ = thin_surface(anatomy.vessel.lumen, 40_000)
    surface = anatomy.parent.landing_surface
    own = Surface(
        *triangles.compact(surface.vertices_mm, surface.faces[~anatomy.parent.is_continued[surface.faces].any(axis=1)])
    )
    landing, _ = thin_surface(own if any(anatomy.parent.continued_mm) else surface, 24_000)
    layers: list[MeshLayer | LineLayer] = [
        MeshLayer(id="lumen", pane="", colour=_WALL, surface=lumen, opacity=0.16, **_PLAIN),
        MeshLayer(id="landing", pane="", colour=(0.80, 0.74, 0.66), surface=landing, **_PLAIN),
        curves_layer("centerlines", [line.points_mm for line in anatomy.vessel.centerlines], 0.05, (0.45, 0.36, 0.58)),
        curves_layer("axis", [anatomy.parent.axis.points_mm], 0.06, (0.17, 0.32, 0.55)),
    ]
    if any(anatomy.parent.continued_mm):
        layers += [curves_layer("continued", _continued_rings(anatomy), 0.05, _ASSUMED)]
    if anatomy.aneurysms:
        sacs = [thin_surface(aneurysm.sac, 12_000)[0] for aneurysm in anatomy.aneurysms]
        rings = [np.vstack([aneurysm.neck_mm, aneurysm.neck_mm[:1]]) for aneurysm in anatomy.aneurysms]
        layers += [MeshLayer(id="sac", pane="", colour=_SAC, surface=sac, opacity=0.45, **_PLAIN) for sac in sacs]
        layers += [curves_layer("neck", rings, 0.08, (0.72, 0.20, 0.16))]
    return layers


def _continued_rings(anatomy: Anatomy) -> list[Floats]:
    """Return closed rings of the continued artery, about `RING_MM` apart: assumed wall is not drawn solid."""
    count = len(anatomy.parent.axis.points_mm)
    rings_mm = anatomy.parent.landing_surface.vertices_mm.reshape(count, -1, 3)
    is_assumed = anatomy.parent.is_continued.reshape(count, -1).all(axis=1)
    every = max(1, round(RING_MM / float(np.diff(anatomy.parent.axis.abscissa_mm).mean())))
    return [np.vstack([ring, ring[:1]]) for ring in rings_mm[is_assumed][::every]]


def curves_layer(name: str, curves: list[Floats], radius_mm: float, colour: tuple[float, float, float]) -> LineLayer:
    """Return curves as one layer without values, shown in every pane.

    Parameters
    ----------
    name : id of the layer.
    curves : (n, 3) points of every curve in mm.
    radius_mm : radius of the drawn lines.
    colour : red, green and blue, 0 to 1.
    """
    starts = np.concatenate([[0], np.cumsum([len(curve) for curve in curves])]).astype(np.int32)
    points = np.concatenate([np.zeros((0, 3)), *curves])
    radii = np.full(len(curves), radius_mm)
    return LineLayer(id=name, pane="", colour=colour, points_mm=points, starts=starts, radius_mm=radii, **_PLAIN)


def device_layers(name: str, deployment: Deployment, anatomy: Anatomy) -> list[MeshLayer | LineLayer]:
    """Return the contour of a device with its expansion over time, and its wires.

    Parameters
    ----------
    name : pane that shows them.
    deployment : the deployment.
    anatomy : vessel, parent artery and sacs.
    """
    frames_mm, gaps_mm = thin_frames(deployment, anatomy.parent.landing_surface, n_frames=24)
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
    """Return the contour of a device colored by the local metal coverage in percent."""
    values = 100 * node_coverage(stent).ravel()
    return MeshLayer(id="coverage", pane=name, colour=_STEEL, scale="coverage", values=values, surface=stent.contour)


def node_coverage(stent: Stent) -> Floats:
    """Return the metal coverage at every node of a device.

    Coverage is measured on the wires in each quad of the contour and averaged over 7 x 7 quads.

    Parameters
    ----------
    stent : the deployed device.

    Returns (rows, columns) fraction of the surface covered by metal, 0 to 1.
    """
    from scipy.ndimage import uniform_filter

    quads = coverage_fractions(stent)
    smooth = uniform_filter(quads, size=(7, 7), mode=("nearest", "wrap"))
    return np.concatenate([smooth, smooth[-1:]])


def flow_layers(name: str, field: FlowField, anatomy: Anatomy) -> list[MeshLayer | LineLayer]:
    """Return the wall colored by its shear stress, and the streamlines.

    Parameters
    ----------
    name : pane that shows them.
    field : the flow.
    anatomy : vessel, parent artery and sacs.
    """
    wall, origin = thin_surface(field.wall, 40_000)
    shear = MeshLayer(
        id="shear",
        pane=name,
        colour=_WALL,
        scale="shear",
        values=field.shear_Pa[origin],
        surface=wall,
    )
    of_sac = [_sac_shear(name, field, one.sac) for one in anatomy.aneurysms[:1]]
    return [shear, *of_sac, stream_layer(name, field, _seeds_mm(field, anatomy))]


def _sac_shear(name: str, field: FlowField, sac: Surface) -> MeshLayer:
    """Return the wall of the sac colored by its shear stress, on a scale of its own."""
    is_sac = on_sac(field.wall, sac, ON_SAC_CELLS * field.finest.cell_size_mm)
    faces = field.wall.faces[is_sac[field.wall.faces].all(axis=1)]
    used = np.unique(faces)
    place = np.zeros(len(field.wall.vertices_mm), dtype=np.int32)
    place[used] = np.arange(len(used))
    thin, origin = thin_surface(Surface(field.wall.vertices_mm[used], place[faces]), 20_000)
    values = field.shear_Pa[used][origin]
    return MeshLayer(id="sac_shear", pane=name, colour=_WALL, scale="sac_shear", values=values, surface=thin)


def stream_layer(name: str, field: FlowField, seeds_mm: Floats) -> LineLayer:
    """Return streamlines colored by speed.

    Parameters
    ----------
    name : pane that shows them.
    field : the flow.
    seeds_mm : (s, 3) points through which they run.
    """
    lines = streamlines(field, seeds_mm)
    points, starts, speed = thin_lines(lines.points_mm, lines.starts, lines.speed_m_s, 24_000)
    return LineLayer(
        id="streamlines",
        pane=name,
        colour=_INK,
        scale="speed",
        values=speed,
        points_mm=points,
        starts=starts,
        radius_mm=np.full(len(starts) - 1, 0.025),
    )


def _seeds_mm(field: FlowField, anatomy: Anatomy) -> Floats:
    """Return seed points (s, 3) of streamlines on the inlets and on the neck of the first sac."""
    seeds = [inlet_seeds_mm(field, anatomy.vessel, N_INLET)]
    seeds += [neck_seeds_mm(field, sac.neck, N_NECK) for sac in anatomy.aneurysms[:1]]
    return np.concatenate(seeds)


_SCALES = {
    "speed": ("Speed", "m/s", "viridis", 0.05),
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

    The range of a flow scale is set by the values near the sac without a device.

    Parameters
    ----------
    layers : all layers; the first one with a flow scale belongs to the flow without a device.
    anatomy : vessel, parent artery and sacs.
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
    """Return the values (k,) of a layer near the wall of the first sac; empty without a sac."""
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
    """Return 256 colors (256, 3) of a matplotlib color map."""
    import matplotlib

    # The lightest colors of a map would not show on the light background.
    return matplotlib.colormaps[name](np.linspace(0.0, 0.93, 256))[:, :3]


def views_of(anatomy: Anatomy, deployments: Sequence[Deployment] = ()) -> tuple[View, ...]:
    """Return the views of a case, the profile of the first sac first.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployments : deployed implants, which the profile view encloses.
    """
    points = [deployment.stent.nodes_mm.reshape(-1, 3) for deployment in deployments]
    points += [aneurysm.sac.vertices_mm for aneurysm in anatomy.aneurysms[:1]]
    treated = np.concatenate(points or [anatomy.parent.axis.points_mm])
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
    """Return a view whose sphere encloses points as seen along its axes.

    Parameters
    ----------
    name : id of the view.
    axes : (3, 3) unit rows in LPS: right, up, toward the eye.
    points_mm : (n, 3) points to enclose.
    room : factor on the radius of the sphere.
    """
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


def _hidden(points_mm: Floats, view: View) -> int:
    """Return the number of points (n, 3) between the eye and the sphere of a view."""
    offset = (points_mm - view.center_mm) @ view.axes.T
    aside_mm = np.linalg.norm(offset[:, :2], axis=1)
    return int(np.count_nonzero((aside_mm < view.radius_mm) & (offset[:, 2] > view.radius_mm)))
